"""A sensor of a scene's file that stands for a sonar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sonar_gl.core.checks import check_kind, check_number
from sonar_gl.core.poses import check_pose
from sonar_gl.sonar.sonar import Sonar

DEFAULT_SONAR = "p900-45"  # preset; its values stand for those that a sensor does not state
SONAR_WORDS = ("sonar", "fls", "multibeam")  # in names of what stands for a sonar


@dataclass(frozen=True, eq=False)
class SonarSensor:
    """A sensor of a scene's file that stands for a sonar.

    Raises
    ------
    Error
        if an attribute is not what it should be.

    Attributes
    ----------
    name : of the sensor; "" if it has none
    model : name of its model, "outer::inner" if nested
    pose : (4, 4) world_from_sonar
    sonar : what the sensor states of its sonar, the rest from the preset DEFAULT_SONAR; None if it states nothing
    rate_hz : pings per second; None if it states none
    assumed : fields of `sonar` that are the preset's, in words
    """

    name: str
    model: str
    pose: np.ndarray
    sonar: Sonar | None = None
    rate_hz: float | None = None
    assumed: tuple[str, ...] = ()

    def __post_init__(self):
        check_kind("the name of a sensor", self.name, str, "such as 'sonar', or ''")
        check_kind("the model of a sensor", self.model, str, "such as 'rov', or ''")
        object.__setattr__(self, "pose", check_pose(self.pose, "the pose of a sensor"))
        check_kind(
            "the sonar of a sensor",
            self.sonar,
            Sonar | None,
            "sonar_gl.load_sonar makes one from a name or a file",
        )
        if self.rate_hz is not None:
            check_number("rate_hz of a sensor", self.rate_hz)
        check_kind("assumed of a sensor", self.assumed, tuple, "of names of fields")

    def __str__(self):
        return f"sensor {self.name!r}" + (f" of model {self.model!r}" if self.model else "")

    def describe(self) -> str:
        """Return the sonar's numbers in words, and which of them are the preset's."""
        if self.sonar is None:
            return f"states no sonar; preset {DEFAULT_SONAR}"
        sonar, rate = self.sonar, "" if self.rate_hz is None else f", {self.rate_hz:g} Hz"
        text = (
            f"{sonar.azimuth_fov_deg:.4g} x {sonar.elevation_fov_deg:.4g} deg, {sonar.n_beams} beams, "
            f"{sonar.range_min_m:.4g} to {sonar.range_max_m:.4g} m in {sonar.n_bins} bins, "
            f"{sonar.frequency_hz / 1e3:g} kHz{rate}"
        )
        if not self.assumed:
            return text
        return f"{text} ({', '.join(self.assumed)} of {DEFAULT_SONAR}: the sensor states none)"
