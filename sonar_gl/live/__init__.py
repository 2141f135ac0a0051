"""The sonar as a device that runs: emulators that speak the protocols of real sonars."""
