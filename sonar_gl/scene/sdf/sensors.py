"""The sensors of a scene that stand for sonars, and what their tags state of the sonar.

Gazebo has no imaging sonar of its own: its users describe one by a ray sensor (`<ray>` or `<lidar>`), a depth
camera (`<camera>`), and the settings of a plugin. DAVE and nps_uw_multibeam_sonar give the plugin the vertical
aperture, frequency, bandwidth and range; these take precedence, since the scan or image is there to be taller than
the beam.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from sonar_gl.core.errors import Error
from sonar_gl.scene.sdf.links import Link
from sonar_gl.scene.sonar_sensor import DEFAULT_SONAR, SONAR_WORDS, SonarSensor
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import load_sonar

OTHER_SONARS = ("dvl", "altimeter")  # which make no images
# Types of sensor that Gazebo's users simulate sonars with. In a model that is named after a sonar only these
# are taken for one: the model may hold an IMU as well.
RAY_SENSORS = {"ray", "gpu_ray", "lidar", "gpu_lidar"}
IMAGING_SENSORS = {"camera", "depth", "depth_camera", "rgbd_camera", *RAY_SENSORS}
PLUGIN_SOUND_SPEED_M_S = 1500.0  # of DAVE's plugins, where a sensor states none
MAX_BEAMS, MAX_CELLS = 4096, 2**25  # beams, and beams x bins; more is no sonar, and takes gigabytes
BOUNDS = {  # of what tags state, as for `Sonar`, and its name in messages
    "azimuth_fov_deg": (0.01, 360.0, "field of view"),
    "elevation_fov_deg": (0.01, 170.0, "vertical aperture"),
    "n_beams": (1, MAX_BEAMS, "number of beams"),
    "range_min_m": (0.0, 1e5, "least range"),
    "range_max_m": (1e-3, 1e5, "range"),
    "bin_size_m": (1e-4, 1e5, "bin size"),
    "frequency_hz": (1e4, 1e8, "frequency"),
}


class SensorOfLink(NamedTuple):
    """A sensor that stands for a sonar, and the link that holds it."""

    link: Link
    element: object

    @property
    def location(self) -> str:
        """File and element, for messages."""
        return f"{self.link.location}/sensor[{self.element.get('name') or ''}]"


def find_sonars(links) -> list[SensorOfLink]:
    """Return the sensors that stand for sonars, the scene's own first.

    It is the first `<sensor type="custom">`; else the first sensor whose own name, type or plugin contains one of
    SONAR_WORDS; else the first of IMAGING_SENSORS in a model whose name contains one, or in such a link of a URDF
    file. A custom sensor of which `gz:type` says what it is, such as an odometer, needs one of SONAR_WORDS there or
    in its name. By their names or `gz:type`, DVLs and altimeters are none.
    """
    found = []
    for link in links:
        for sensor in link.element.findall("sensor"):
            kind, custom_kind = (sensor.get("type") or "").strip(), _custom_kind(sensor)
            names = [sensor.get("name") or "", kind, custom_kind]
            names += [p.get(key) or "" for p in sensor.findall("plugin") for key in ("name", "filename")]
            owner = link.model or link.name
            by_sensor, by_model = (
                any(word in text.lower() for word in SONAR_WORDS) for text in (" ".join(names), owner)
            )
            # by its kind, too: Sonardyne makes DVLs
            if any(word in f"{names[0]} {custom_kind}".lower() for word in OTHER_SONARS):
                continue
            if any(word in owner.lower() for word in OTHER_SONARS):
                by_model = False
            if kind == "custom" and (by_sensor or not custom_kind):
                rank = 0
            elif by_sensor:
                rank = 1
            elif by_model and kind in IMAGING_SENSORS:
                rank = 2
            else:
                continue
            found.append((rank, len(found), SensorOfLink(link, sensor)))
    return [sensor for _, _, sensor in sorted(found, key=lambda candidate: candidate[:2])]


def ray_sensors_of(links) -> list[str]:
    """Return the names of ray sensors, with their models': they may stand for sonars without being named so."""
    return [
        f"{link.model or link.name}/sensor[{sensor.get('name') or ''}]"
        for link in links
        for sensor in link.element.findall("sensor")
        if (sensor.get("type") or "").strip() in RAY_SENSORS
        and not any(
            word in f"{sensor.get('name') or ''} {link.model or link.name}".lower() for word in OTHER_SONARS
        )
    ]


def _custom_kind(sensor) -> str:
    """Return the attribute `gz:type` or `ignition:type` of a sensor, whether its prefix is declared or not."""
    return next(
        (value for key, value in sensor.attrib.items() if key.endswith((":type", "}type"))), ""
    ).strip()


def read_sensor(sensor: SensorOfLink) -> tuple[SonarSensor, list[str]]:
    """Return a sensor with its pose and what its tags state, and what had to be changed to make a sonar of it.

    No tag is refused: a value that is no sonar's is replaced by the nearest that is, or by the preset's.
    """
    link, element = sensor
    pose = link.world_pose() @ link.pose_in_link(element, sensor.location)
    tags = _Tags(element)
    rate_hz = tags.number("update_rate")
    stated = tags.stated()
    name = (element.get("name") or "").strip()
    sonar, assumed = None, ()
    if stated:
        try:
            sonar, assumed = _complete(name or "sensor", stated, sensor.location, tags.notes)
        except Error as why:
            tags.notes.append(f"{why}; the sonar is preset {DEFAULT_SONAR}")
    return SonarSensor(name, link.model, pose, sonar, rate_hz or None, assumed), tags.notes


def _complete(name: str, stated: dict, location: str, notes: list[str]) -> tuple[Sonar, tuple[str, ...]]:
    """Return a sonar of what is stated and else the preset's, and in words which fields are the preset's."""
    preset = load_sonar(DEFAULT_SONAR)
    values = {key: stated.get(key, getattr(preset, key)) for key in BOUNDS}
    low_m, high_m = values["range_min_m"], values["range_max_m"]
    if low_m >= high_m and "range_min_m" in stated and "range_max_m" in stated:
        notes.append(f"the range must rise (got {low_m:g} to {high_m:g} m); it is that of {DEFAULT_SONAR}")
        values["range_min_m"], values["range_max_m"] = preset.range_min_m, preset.range_max_m
        stated = {key: stated[key] for key in stated if not key.startswith("range_")}
    elif low_m >= high_m and "range_max_m" in stated:
        values["range_min_m"] = 0.0
    elif low_m >= high_m:
        values["range_max_m"] = 2 * low_m
    length_m, bin_size_m = values["range_max_m"] - values["range_min_m"], values.pop("bin_size_m")
    n_bins = max(1, round(length_m / bin_size_m))
    most = min(MAX_CELLS // values["n_beams"], 65536)
    if n_bins > most:
        notes.append(f"{n_bins} bins of {bin_size_m:.3g} m are too many; there are {most}")
        n_bins = most
    # beams narrower than their spacing would leave gaps
    spacing_deg = values["azimuth_fov_deg"] / values["n_beams"]
    middle_deg = stated.get("middle_deg", 0.0)
    azimuths_deg = None
    if middle_deg:
        width_deg, n = values["azimuth_fov_deg"], values["n_beams"]
        azimuths_deg = tuple(middle_deg + width_deg * ((k + 0.5) / n - 0.5) for k in range(n))
        values["azimuth_fov_deg"] += 2 * abs(middle_deg)
    sonar = Sonar(
        name=name,
        n_bins=n_bins,
        beam_width_deg=min(max(preset.beam_width_deg, spacing_deg), 180.0),
        beam_azimuths_deg=azimuths_deg,
        source=location,
        **values,
    )
    assumed = [word for key, (*_, word) in BOUNDS.items() if key not in stated]
    if spacing_deg <= preset.beam_width_deg:
        assumed.append("beam width")
    return sonar, tuple(assumed)


@dataclass(frozen=True)
class _Span:
    """The angles of a scan: lowest and highest, degrees, and the number of rays."""

    low_deg: float
    high_deg: float
    count: float | None

    @property
    def width_deg(self) -> float:
        return self.high_deg - self.low_deg

    @property
    def middle_deg(self) -> float:
        return (self.low_deg + self.high_deg) / 2


class _Tags:
    """The numbers in the tags of a sensor.

    notes : what is no number, or no sonar's
    """

    def __init__(self, element):
        self._element, self.notes = element, []

    def number(self, path: str) -> float | None:
        """Return the number of the first element of this path, anywhere in the sensor; None if there is none."""
        text = (self._element.findtext(f".//{path}") or "").strip()
        if not text:
            return None
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            self.notes.append(f"<{path.rpartition('/')[2]}> must be a number (got {text!r})")
            return None
        return value

    def stated(self) -> dict:
        """Return which of BOUNDS the sensor states, within them, and "middle_deg", the azimuth of its middle."""
        found, out = {}, {}
        for values in (self._camera(), self._scan(), self._plugin()):
            found |= {key: value for key, value in values.items() if value is not None}
        for key, (low, high, word) in BOUNDS.items():
            value = found.get(key)
            if value is None:
                continue
            out[key] = type(low)(min(max(value, low), high))
            if not low <= value <= high:
                unit = " degrees" if key.endswith("_deg") else ""
                hint = "; tags of a scan or camera hold radians" if unit and value > high else ""
                self.notes.append(
                    f"{word} must lie in {low:g} to {high:g}{unit} (got {value:g}{hint}); it is {out[key]:g}"
                )
        if "azimuth_fov_deg" in out and (middle_deg := found.get("middle_deg", 0.0)):
            if out["azimuth_fov_deg"] / 2 + abs(middle_deg) <= 180:
                out["middle_deg"] = middle_deg
            elif out["azimuth_fov_deg"] < 360:
                self.notes.append(
                    f"the scan's middle must be ahead (got {middle_deg:.4g} deg); it is taken as 0"
                )
        return out

    def _plugin(self) -> dict:
        """Return what the settings of DAVE's plugins state."""
        bandwidth_hz, sound_speed_m_s = self.number("bandwidth"), self.number("soundSpeed")
        values = {
            "elevation_fov_deg": self.number("verticalFOV"),
            "frequency_hz": self.number("sonarFreq"),
            "range_max_m": self.number("maxDistance"),
        }
        if bandwidth_hz and bandwidth_hz > 0:
            values["bin_size_m"] = (sound_speed_m_s or PLUGIN_SOUND_SPEED_M_S) / (2 * bandwidth_hz)
        return values

    def _scan(self) -> dict:
        """Return what `<scan>` and `<range>` of a ray sensor state, and the range of Gazebo's `<sonar>`."""
        horizontal, vertical = self._span("horizontal"), self._span("vertical")
        values = {
            "range_min_m": self._first("range/min", "sonar/min"),
            "range_max_m": self._first("range/max", "sonar/max"),
            "bin_size_m": self.number("range/resolution") or None,
        }
        if horizontal is not None and horizontal.width_deg > 0:  # else a single ray, which has no fan
            values |= {"azimuth_fov_deg": horizontal.width_deg, "middle_deg": horizontal.middle_deg}
            values["n_beams"] = horizontal.count
        if vertical is not None and vertical.width_deg > 0:
            values["elevation_fov_deg"] = vertical.width_deg
            if abs(vertical.middle_deg) > 0.01 * vertical.width_deg:
                self.notes.append(
                    f"the scan's elevations must lie about 0 (got {vertical.low_deg:.4g} to {vertical.high_deg:.4g} "
                    "deg); turn the sonar by its pose"
                )
        return values

    def _span(self, name: str) -> _Span | None:
        low, high = (self.number(f"scan/{name}/{tag}") for tag in ("min_angle", "max_angle"))
        if low is None or high is None:
            return None
        rays = [*self._element.iter("ray"), *self._element.iter("lidar")]
        in_degrees = any(one.get("degrees") in ("true", "1") for one in rays)
        to_deg = 1.0 if in_degrees else math.degrees(1.0)
        count = self._first(f"scan/{name}/samples", f"scan/{name}/beams", f"scan/{name}/rays")
        resolution = self.number(f"scan/{name}/resolution")
        rays = count and count * (resolution or 1.0)
        if rays is not None and not math.isfinite(rays):
            self.notes.append(
                f"the rays of <{name}> must be a number (got {count:g} samples x {resolution:g})"
            )
            rays = None
        return _Span(low * to_deg, high * to_deg, None if rays is None else round(rays))

    def _camera(self) -> dict:
        """Return what `<camera>` states: its image is as many beams wide, and as high as its shape says."""
        if self._element.find("camera") is None:
            return {}
        fov_rad, width, height = (
            self.number(f"camera/{tag}") for tag in ("horizontal_fov", "image/width", "image/height")
        )
        values = {
            "azimuth_fov_deg": fov_rad and math.degrees(fov_rad),
            "n_beams": width,
            "range_min_m": self.number("camera/clip/near"),
            "range_max_m": self.number("camera/clip/far"),
        }
        if fov_rad and width and height and 0 < fov_rad < math.pi:
            values["elevation_fov_deg"] = math.degrees(2 * math.atan(math.tan(fov_rad / 2) * height / width))
        return values

    def _first(self, *paths: str) -> float | None:
        return next((value for value in map(self.number, paths) if value is not None), None)
