"""Simulators without side lobes in elevation, to compare embedded sonars with: hosts draw the main lobe alone."""

import pytest

from sonar_gl.acoustics import acoustics


def receive_main_lobe(monkeypatch) -> None:
    """Have simulators receive the main lobe in elevation alone, all of it with dense samples."""
    monkeypatch.setattr(acoustics, "MAX_SIDE_LOBE_DEG", 0.0)
    monkeypatch.setattr(acoustics, "SKIRTS_LEVEL", acoustics.ELEVATION_SUPPORT_LEVEL)


@pytest.fixture
def main_lobe_alone(monkeypatch):
    """`receive_main_lobe` during a test."""
    receive_main_lobe(monkeypatch)
