"""The chart of time against error: `python -m tools.chart`; see `__main__`."""
