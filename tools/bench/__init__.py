"""Benches of sonar_gl, all with one harness: `python -m tools.bench NAME`; see `__main__`."""
