"""The sonar as a device that runs: a session whose settings and poses change, its page, what it records."""
