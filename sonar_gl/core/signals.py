"""Signals that end commands."""

REPEAT_S = 0.3  # within it, signals are one: `timeout` sends its own to a command and to the group of it
