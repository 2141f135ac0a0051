"""Addresses at which programs of this machine alone can be reached."""

LOCAL = "127.0.0.1", "localhost", "::1"
