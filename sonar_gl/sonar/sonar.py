"""The data sheet of a sonar."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np

from sonar_gl.core.checks import (
    check_choice,
    check_fields,
    check_number,
    check_whole_number,
    frozen_array,
    is_number,
    make_numbers_plain,
    number_text,
    plain_number,
    shown,
)
from sonar_gl.core.errors import Error, errors_at
from sonar_gl.core.poses import check_pose
from sonar_gl.core.poses import pose as make_pose
from sonar_gl.core.warn import warn_caller
from sonar_gl.sonar.counts import DEFAULT_COUNTS, Counts

RANGE_MAX_BOUNDS_M = 1e-3, 1e5
MAX_BINS = 65536  # also of beams
# Least length of a bin over range_max_m. The sums find the bin of a range from 1/range: if its rounding were not far
# below a bin, they would write beyond their arrays.
SHORTEST_BIN = 1e-9
ROUNDING = 1e-12  # of azimuths, relative: those of another sonar's beams may lie on the edges of its fan
LEVEL = "give dB relative to the echo of a sphere about the sonar, at 1 m"  # of noise, in messages
# what is likely wrong with a level of noise above 0 dB
ABSOLUTE_LEVEL = (
    "exceeds the echo of a sphere about the sonar at 1 m, to which it is relative; if it is in dB re 1 µPa, subtract "
    "that echo's level (absolute_levels states it)"
)
TAPERS = ("uniform", "hamming", "taylor", "chebyshev")  # of line arrays
CHOICES = {  # field: allowed names
    "beam_spacing": ("angle", "sine"),
    "receive_taper": TAPERS,
    "steered": ("alike", "straight"),
    "transmit_taper": TAPERS,
    "elevation_taper": TAPERS,
    "pulse_taper": ("uniform", "hamming"),
}
BOUNDS = (  # field, least and greatest value, hint for messages
    ("frequency_hz", 1e4, 1e8, "give hertz, 900e3 for 900 kHz"),
    ("azimuth_fov_deg", 0.01, 360.0, "give degrees"),
    ("elevation_fov_deg", 0.01, 170.0, "give degrees"),
    ("beam_width_deg", 1e-3, 180.0, "give degrees"),
    ("range_min_m", 0.0, 1e5, "give metres"),
    ("range_max_m", *RANGE_MAX_BOUNDS_M, "give metres"),
    ("range_limit_m", *RANGE_MAX_BOUNDS_M, "give metres"),
    ("side_lobe_db", 15, 60, "give dB below the main lobe, positive"),
    ("element_error_db", -80, -15, "give dB relative to the main lobe, negative"),
    ("transmit_width_deg", 1e-3, 180, "give degrees"),
    ("bandwidth_hz", 1, 1e8, "give hertz, 30e3 for 30 kHz"),
    ("cross_talk_db", -120, 0, "give dB relative to the echo in the other beam, not above 0"),
    ("ring_down_db", -300, 300, LEVEL),
    ("ring_down_decay_db_m", 0.1, 1e5, "give dB per metre of range, positive"),
    ("tilt_deg", -90, 90, "give degrees, positive down"),
    ("ping_rate_max_hz", 1e-3, 1e4, "give pings per second"),
    ("source_level_db", 100, 260, "give dB re 1 µPa at 1 m, about 200"),
    ("self_noise_db", -300, 100, LEVEL),
    ("common_noise_db", -300, 100, LEVEL),
    ("common_noise_width_deg", 1e-3, 180, "give degrees"),
)
UNPARSED = "name", "beam_azimuths_deg", "source", "counts"  # fields that a command line cannot set


@dataclass(frozen=True)
class Sonar:
    """A multibeam imaging sonar, as its data sheet describes it.

    Parameters
    ----------
    name : name for records and messages
    frequency_hz : centre frequency, hertz, 1e4..1e8
    n_beams : number of beams across the fan
    n_bins : number of range bins, which divide [range_min_m, range_max_m) evenly
    azimuth_fov_deg : width of the fan, degrees, up to 360
    elevation_fov_deg : height of a beam, degrees, up to 170: the full aperture, or the −3 dB width of the two-way
        pattern if `Acoustics.elevation_pattern` is not a box
    beam_width_deg : −3 dB width of a receive beam in azimuth, degrees; beams overlap where it exceeds the spacing
    range_min_m, range_max_m : slant ranges of the first bin's near edge and of the last bin's far edge, metres
    beam_azimuths_deg : azimuths of the n_beams beams, degrees, rising, positive to port, within the fan; None: by
        `beam_spacing`
    beam_spacing : "angle": beams are spread evenly over the fan, the outermost half a spacing within its edges: beam b,
        from 0 on, points at −fov/2 + (b + ½) fov / n_beams. "sine":
        the sines of their azimuths are evenly spaced, as one straight array forms them by a Fourier transform, and
        the outermost beams lie on the edges of the fan; such beams are cones, see `Acoustics.has_cones`
    steered : "alike": every receive beam has the width of the data sheet. "straight": one straight array forms all
        beams, which broaden as 1/cos of their azimuth, and are cones
    receive_taper, transmit_taper, elevation_taper : "uniform", "hamming", "taylor" or "chebyshev"
        tapers (shading) of the line arrays that receive in azimuth, transmit in azimuth, and do both in elevation
    side_lobe_db : level of the side lobes of tapers "taylor" and "chebyshev", dB below the main lobe, positive
    element_error_db : mean level of the floor that random errors of the receive array's elements add to its pattern in
        azimuth, dB relative to the main lobe, one way, negative; None: an array without errors
    transmit_width_deg : −3 dB width in azimuth of the transmit beam about the boresight, degrees; None: the fan is
        insonified evenly. `beam_width_deg` stays the width of the receive beams
    bandwidth_hz : bandwidth of the pulse, hertz; None: not known, taken so that the
        resolution cell is as long as a bin, but not above frequency_hz
    pulse_taper : "uniform" or "hamming", weights of the spectrum in the matched filter
    source : reference for the numbers
    cross_talk_db : level of cross-talk, dB: what a beam receives of the echo in each other beam of its set; None: none
    cross_talk_beams : spacing of the beams of a set, which are received together: every 8th beam, if a frame takes 8
        transmissions
    ring_down_db : power of the ringing of the transducer after the pulse, before the TVG, extrapolated to range 0, dB
        relative to the echo of a sphere of reflectivity 1 about the sonar, at 1 m; None: none
    ring_down_decay_db_m : how fast it decays, dB per metre of range
    counts : Counts, or a table of its fields: how the device turns intensity into the whole numbers that it delivers
    tilt_deg : tilt of the head, which holds the arrays, inside the housing, degrees, positive down. Poses are those of
        the housing; azimuths, elevations and the fan are those of the head
    ping_rate_max_hz : pings per second that the device makes at most, however short the range; None: not known
    keeps_n_bins : whether the device divides any range into `n_bins`; otherwise its bins stay as long as they are
    n_bins_max : most bins that the device delivers: at ranges that would take more, `with_range` makes bins longer;
        None: no limit
    source_level_db : level of the transmitted pulse on the projector's axis, dB re 1 µPa at 1 m; None: not known
    self_noise_db : mean power of the receiver's own noise before the TVG, dB relative to the echo of a sphere of
        reflectivity 1 about the sonar, at 1 m; `Noise.self_noise` switches it on
    common_noise_db : mean power, likewise, of noise that neighbouring channels of the receiver have in common, in a
        beam straight ahead, where it is strongest; None: none. It belongs to the self-noise
    common_noise_width_deg : −3 dB width over azimuth of that noise, degrees: of a uniform array as long as a group of
        channels that have it in common
    range_limit_m : greatest range that the device allows, metres, more than `range_min_m`; None: not known. Programs
        that offer ranges to choose from end there; the command line and jobs warn of a range beyond it, which is no
        error

    Raises
    ------
    Error
        if a name is unknown or no text, a number is out of bounds, or the beams do not lie in rising order within the
        fan.
    """

    name: str
    frequency_hz: float
    n_beams: int
    n_bins: int
    azimuth_fov_deg: float
    elevation_fov_deg: float
    beam_width_deg: float
    range_min_m: float
    range_max_m: float
    beam_azimuths_deg: tuple[float, ...] | None = None
    source: str = ""
    beam_spacing: str = "angle"
    steered: str = "alike"
    receive_taper: str = "uniform"
    transmit_taper: str = "uniform"
    elevation_taper: str = "uniform"
    side_lobe_db: float = 30.0
    element_error_db: float | None = None
    transmit_width_deg: float | None = None
    bandwidth_hz: float | None = None
    pulse_taper: str = "hamming"
    cross_talk_db: float | None = None
    cross_talk_beams: int = 8
    ring_down_db: float | None = None
    ring_down_decay_db_m: float = 100.0
    counts: Counts = DEFAULT_COUNTS
    tilt_deg: float = 0.0
    ping_rate_max_hz: float | None = None
    keeps_n_bins: bool = False
    n_bins_max: int | None = None
    source_level_db: float | None = None
    self_noise_db: float = -90.0
    common_noise_db: float | None = None
    common_noise_width_deg: float = 3.0
    range_limit_m: float | None = None

    def __post_init__(self):
        make_numbers_plain(self)
        for key in ("name", "source"):
            if not isinstance(getattr(self, key), str):
                raise Error(f"sonar: {key} must be text (got {shown(getattr(self, key))})")
        location = f"sonar {self.name!r}"
        if not isinstance(self.counts, Counts):  # a table of a file
            with errors_at(location):
                object.__setattr__(self, "counts", DEFAULT_COUNTS.changed(self.counts))
        self._check_each_field(location)
        self._check_fields_together(location)
        if self.beam_azimuths_deg is not None:
            object.__setattr__(self, "beam_azimuths_deg", self._checked_azimuths_deg(location))
        for text in self._likely_mistakes():
            warn_caller(f"{location}: {text}")

    def _check_each_field(self, location: str) -> None:
        """Raise an `Error` for a number out of bounds, or an unknown name, and for more bins than the device has."""
        for key in ("n_beams", "n_bins"):
            check_whole_number(f"{location}: {key}", getattr(self, key), 1, MAX_BINS)
        check_whole_number(f"{location}: cross_talk_beams", self.cross_talk_beams, 1, MAX_BINS)
        if self.n_bins_max is not None:
            check_whole_number(f"{location}: n_bins_max", self.n_bins_max, 1, MAX_BINS)
            if self.n_bins > self.n_bins_max:
                raise Error(
                    f"{location}: n_bins must not exceed n_bins_max "
                    f"(got {self.n_bins} and {self.n_bins_max}; set a shorter range, or leave n_bins_max out)"
                )
        check_fields(location, self, BOUNDS)
        if not isinstance(self.keeps_n_bins, bool):
            raise Error(f"{location}: keeps_n_bins must be true or false (got {shown(self.keeps_n_bins)})")
        for key, names in CHOICES.items():
            check_choice(key, getattr(self, key), names, location)

    def _check_fields_together(self, location: str) -> None:
        """Raise an `Error` for fields that contradict each other."""
        if self.beam_spacing == "sine" and self.azimuth_fov_deg > 180:
            raise Error(
                f'{location}: beam_spacing "sine" needs an azimuth_fov_deg of 180 degrees at most '
                f"(got {self.azimuth_fov_deg:g}; one straight array looks ahead only)"
            )
        if self.range_min_m >= self.range_max_m:
            raise Error(
                f"{location}: range_min_m must be less than range_max_m "
                f"(got {self.range_min_m:g} and {self.range_max_m:g})"
            )
        if self.range_limit_m is not None and self.range_limit_m <= self.range_min_m:
            raise Error(
                f"{location}: range_limit_m must exceed range_min_m "
                f"(got {self.range_limit_m:g} and {self.range_min_m:g}; give both in metres)"
            )
        if self.bin_size_m < SHORTEST_BIN * self.range_max_m:
            raise Error(
                f"{location}: bins must be at least {SHORTEST_BIN:g} of range_max_m long "
                f"(got {self.bin_size_m:g} m at {self.range_max_m:g} m; set a lesser range_min_m)"
            )
        if self.bandwidth_hz is not None and self.bandwidth_hz > self.frequency_hz:
            raise Error(
                f"{location}: bandwidth_hz must not exceed frequency_hz "
                f"(got {self.bandwidth_hz:g} and {self.frequency_hz:g}; give both in hertz)"
            )

    def _checked_azimuths_deg(self, location: str) -> tuple[float, ...]:
        """Return the table of azimuths as numbers; raise an `Error` unless they rise, within the fan."""
        azimuths = frozen_array(
            self.beam_azimuths_deg,
            np.float64,
            (self.n_beams,),
            f"{location}: beam_azimuths_deg",
            "give one azimuth for each of the n_beams beams, or none for even ones",
        )
        if (steps := np.diff(azimuths) <= 0).any():
            k = int(steps.argmax())
            raise Error(
                f"{location}: beam_azimuths_deg must rise (got {azimuths[k + 1]:g} after {azimuths[k]:g}; give "
                "starboard first, positive to port)"
            )
        if np.abs(azimuths).max() > self.azimuth_fov_deg / 2 * (1 + ROUNDING):
            raise Error(
                f"{location}: beam_azimuths_deg must lie within ±azimuth_fov_deg/2 = "
                f"±{self.azimuth_fov_deg / 2:g} (got {azimuths[0]:g} to {azimuths[-1]:g})"
            )
        return tuple(azimuths.tolist())

    def _likely_mistakes(self) -> Iterator[str]:
        """Yield a sentence about each number that looks like one of another unit: unlikely but possible."""
        spacing_deg = self.azimuth_fov_deg / self.n_beams
        # at most 2π wide, and finer than the beams of any device
        if self.n_beams > 8 and self.azimuth_fov_deg <= 6.2832 and spacing_deg < 0.02:
            yield (
                f"azimuth_fov_deg = {self.azimuth_fov_deg:g} puts {self.n_beams} beams within less "
                f"than 7 degrees; if it is in radians, give {math.degrees(self.azimuth_fov_deg):.4g}"
            )
        azimuths_deg = self.beam_azimuths_deg
        # half a circle is π; a table of a device fills its fan
        if azimuths_deg is not None and self.n_beams > 8:
            widest_deg = max(-azimuths_deg[0], azimuths_deg[-1])
            if widest_deg <= 3.1416 and widest_deg < self.azimuth_fov_deg / 20:
                yield (
                    f"beam_azimuths_deg, {azimuths_deg[0]:.4g} to {azimuths_deg[-1]:.4g}, leave most of a fan of "
                    f"{self.azimuth_fov_deg:g} degrees without beams; if they are in radians, give "
                    f"{math.degrees(azimuths_deg[0]):.4g} to {math.degrees(azimuths_deg[-1]):.4g}"
                )
        if self.n_beams > 8 and self.beam_width_deg < min(0.05, spacing_deg / 5):
            yield (
                f"beam_width_deg = {self.beam_width_deg:g} leaves gaps between beams that are {spacing_deg:.3g} "
                f"degrees apart; if it is in radians, give {math.degrees(self.beam_width_deg):.4g}"
            )
        # the elevations of devices are 1 degree, 0.017 rad, and more; single beams may be anything
        if self.n_beams > 8 and 0.015 < self.elevation_fov_deg < 0.9:
            yield (
                f"elevation_fov_deg = {self.elevation_fov_deg:g} is lower than the fan of any device; if it is in "
                f"radians, give {math.degrees(self.elevation_fov_deg):.4g}"
            )
        width_deg = self.transmit_width_deg
        if width_deg is not None and width_deg <= 3.1416 and width_deg < self.azimuth_fov_deg / 10:
            yield (
                f"transmit_width_deg = {width_deg:g} leaves most of a fan of {self.azimuth_fov_deg:g} degrees without "
                f"sound; if it is in radians, give {math.degrees(width_deg):.4g}"
            )
        # no group of channels is longer than the whole array, whose taper makes its beams wider by a half at most
        width_deg = self.common_noise_width_deg
        is_given = width_deg != Sonar.common_noise_width_deg
        if self.common_noise_db is not None and is_given and width_deg < min(3.1416, self.beam_width_deg / 2):
            yield (
                f"common_noise_width_deg = {width_deg:g} is narrower than the beams of the whole array, "
                f"{self.beam_width_deg:g} degrees; if it is in radians, give {math.degrees(width_deg):.4g}"
            )
        if self.cross_talk_db is not None and self.cross_talk_beams >= self.n_beams:
            yield (
                f"cross_talk_beams = {self.cross_talk_beams} leaves {self.n_beams} beams without cross-talk; give "
                f"fewer than {self.n_beams}, the number of transmissions a frame, or set no cross_talk_db"
            )
        # no more than 45 degrees in radians, and so little that a picture does not show it
        if 0 < abs(self.tilt_deg) < min(0.8, self.elevation_fov_deg / 10):
            yield (
                f"tilt_deg = {self.tilt_deg:g} is little against an elevation of {self.elevation_fov_deg:g} degrees; "
                f"if it is in radians, give {math.degrees(self.tilt_deg):.4g}"
            )
        # bandwidths of devices are 1 kHz and more, but for long pulses of low frequencies
        if self.bandwidth_hz is not None and self.bandwidth_hz < min(500.0, self.frequency_hz / 1e3):
            yield (
                f"bandwidth_hz = {self.bandwidth_hz:g} makes a resolution cell of "
                f"{750.0 / self.bandwidth_hz:.3g} m; if it is in kHz, give {1e3 * self.bandwidth_hz:g}"
            )
        # a pulse shorter than a half of its wavelength has no bandwidth to be resolved with; c is about 1500 m/s
        half_wavelength_m = 750.0 / self.frequency_hz
        if self.bin_size_m < half_wavelength_m / 20:
            yield (
                f"bins of {1e3 * self.bin_size_m:.3g} mm are far below the wavelength; if range_min_m and "
                f"range_max_m are in kilometres, give {1e3 * self.range_min_m:g} and {1e3 * self.range_max_m:g}"
            )
        # sea water absorbs about 0.3 dB/m at 1 MHz, and less in proportion below: 600 dB there and back
        for key in ("range_max_m", "range_limit_m"):
            range_m = getattr(self, key)
            if range_m is not None and range_m > 500.0 and range_m * self.frequency_hz > 1e9:
                yield (
                    f"no echo of {self.frequency_hz / 1e3:g} kHz comes back from {key} = {range_m:g} m; "
                    f"if it is in millimetres, give {range_m / 1e3:g}"
                )
        for key in ("self_noise_db", "common_noise_db"):
            level_db = getattr(self, key)
            if level_db is not None and level_db > 0:  # above all that comes back
                yield f"{key} = {level_db:g} {ABSOLUTE_LEVEL}"

    def meta(self) -> dict:
        """Return the fields as plain values, which JSON reads back as they are, for the record of a ping."""
        azimuths = self.beam_azimuths_deg
        return asdict(self) | {"beam_azimuths_deg": None if azimuths is None else list(azimuths)}

    @property
    def azimuth_rad(self) -> np.ndarray:
        """Beam centres, (B,) float64, radians, rising, positive to port.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> np.degrees(load_sonar("p900-45").azimuth_rad[[0, -1]]).round(3).tolist()
        [-22.412, 22.412]
        """
        if self.beam_azimuths_deg is not None:
            return np.radians(self.beam_azimuths_deg)
        if self.beam_spacing == "sine" and self.n_beams > 1:
            edge = math.sin(math.radians(self.azimuth_fov_deg) / 2)
            return np.arcsin(np.linspace(-edge, edge, self.n_beams))
        return np.radians(self.azimuth_fov_deg * ((np.arange(self.n_beams) + 0.5) / self.n_beams - 0.5))

    @property
    def fan_edges_rad(self) -> tuple[float, float]:
        """Edges of what the beams image, radians, starboard first: those of the field of view.

        With a table of azimuths, which may fill a part of the field of view, the edges lie half a spacing outside the
        outer beams; of a single beam, half its width.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> [round(math.degrees(edge), 3) for edge in load_sonar("p900-45").fan_edges_rad]
        [-22.5, 22.5]
        """
        half = math.radians(self.azimuth_fov_deg) / 2
        if self.beam_azimuths_deg is None:
            return -half, half
        azimuth = self.azimuth_rad
        spacing = np.diff(azimuth) if self.n_beams > 1 else np.radians([self.beam_width_deg])
        return max(-half, float(azimuth[0] - spacing[0] / 2)), min(half, float(azimuth[-1] + spacing[-1] / 2))

    @property
    def is_straight_array(self) -> bool:
        """Whether one straight array forms all beams, as `beam_spacing` "sine" or `steered` "straight" say.

        This holds for a table of azimuths, too: if no straight array forms its beams, `beam_spacing` must be "angle".
        """
        return self.beam_spacing == "sine" or self.steered == "straight"

    @property
    def bin_edges_m(self) -> np.ndarray:
        """Edges of the bins, (K + 1,) float64, metres."""
        return np.linspace(self.range_min_m, self.range_max_m, self.n_bins + 1)

    @property
    def range_m(self) -> np.ndarray:
        """Bin centres, (K,) float64, metres.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> load_sonar("p900-45").range_m[:2].round(4).tolist()  # bins of 25.4 mm, from 0.5 m on
        [0.5127, 0.5381]
        """
        edges = self.bin_edges_m
        return (edges[1:] + edges[:-1]) / 2

    @property
    def bin_size_m(self) -> float:
        """Length of a bin, metres."""
        return (self.range_max_m - self.range_min_m) / self.n_bins

    @property
    def sonar_from_head(self) -> np.ndarray:
        """The pose of the tilted head in the frame of the housing, (4, 4) float64."""
        return make_pose(pitch=math.radians(self.tilt_deg))

    def head_pose(self, world_from_sonar: np.ndarray) -> np.ndarray:
        """Return the pose of the head, from which the fan is seen, for a pose of the housing.

        Parameters
        ----------
        world_from_sonar : (4, 4)

        Returns
        -------
        (4, 4) world_from_head, read-only; the pose itself if the head is not tilted

        Raises
        ------
        Error
            if it is not a (4, 4) pose.
        """
        if not isinstance(world_from_sonar, np.ndarray) or world_from_sonar.shape != (4, 4):
            world_from_sonar = check_pose(world_from_sonar)
        if self.tilt_deg == 0:
            return world_from_sonar
        out = np.asarray(world_from_sonar) @ self.sonar_from_head
        out.setflags(write=False)
        return out

    def max_ping_rate_hz(self, sound_speed_m_s: float) -> float:
        """Return the highest ping rate, hertz: the lesser of `ping_rate_max_hz` and of the rate that sound allows.

        The next ping waits for the echo from R = range_max_m, which arrives after 2R/c.

        Parameters
        ----------
        sound_speed_m_s : c, metres per second

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> sonar = load_sonar("p900-45")
        >>> round(sonar.with_range(75.0).max_ping_rate_hz(1500.0), 6), sonar.with_range(30.0).max_ping_rate_hz(1500.0)
        (10.0, 15.0)
        """
        by_device_hz = math.inf if self.ping_rate_max_hz is None else float(self.ping_rate_max_hz)
        return min(sound_speed_m_s / (2 * self.range_max_m), by_device_hz)

    def beyond_limit_text(self) -> str | None:
        """Return a sentence if the sonar is set to a longer range than the device allows, else None.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> load_sonar("aris-1800").with_range(30.0).beyond_limit_text()
        "sonar 'aris-1800' allows ranges of 15 m at most, its range_limit_m (got 30 m)"
        """
        if self.range_limit_m is None or self.range_max_m <= self.range_limit_m:
            return None
        return (
            f"sonar {self.name!r} allows ranges of {self.range_limit_m:g} m at most, its range_limit_m "
            f"(got {self.range_max_m:g} m)"
        )

    def with_range(self, range_max_m: float, n_bins: int | None = None) -> Sonar:
        """Return the sonar set to another maximum range, with bins of the same size, or as many if `keeps_n_bins`.

        If the range would take more than `n_bins_max` bins of the same size, there are `n_bins_max` longer ones. Longer
        bins do not become shorter again at a shorter range: set each range from the sonar with the shorter bins.

        Parameters
        ----------
        range_max_m : metres
        n_bins : number of bins; None for the rule above

        Raises
        ------
        Error
            if a number is out of bounds, or there would be too many bins.

        >>> from sonar_gl.sonar.sonar_files import load_sonar
        >>> sonar = load_sonar("oculus-m1200d-lf")  # bins of 2.5 mm, 5000 at most
        >>> [(s.n_bins, round(s.bin_size_m, 6)) for s in (sonar.with_range(5.1), sonar.with_range(40.1))]
        [(2000, 0.0025), (5000, 0.008)]
        """
        range_max_m = plain_number(range_max_m)
        if is_number(range_max_m) and not range_max_m > self.range_min_m:  # also NaN
            raise Error(
                f"sonar {self.name!r}: the range must exceed range_min_m = {self.range_min_m:g} m "
                f"(got {number_text(range_max_m)})"
            )
        check_number(f"sonar {self.name!r}: the range", range_max_m, *RANGE_MAX_BOUNDS_M, "give metres")
        if self.keeps_n_bins and n_bins is None:
            return replace(self, range_max_m=range_max_m)
        if n_bins is None:
            n_bins = max(1, round((range_max_m - self.range_min_m) / self.bin_size_m))
            n_bins = n_bins if self.n_bins_max is None else min(n_bins, self.n_bins_max)
            if n_bins > MAX_BINS:
                most_m = self.range_min_m + MAX_BINS * self.bin_size_m
                raise Error(
                    f"sonar {self.name!r}: the range must not exceed {most_m:.4g} m with bins of "
                    f"{self.bin_size_m:.3g} m, of which a sonar has {MAX_BINS} at most (got "
                    f"{number_text(range_max_m)}; give a shorter range, or the number of bins, too: --bins, bins in a "
                    "job, with_range(..., n_bins))"
                )
        return replace(self, range_max_m=range_max_m, n_bins=n_bins)


def too_short_step_s(times_s, max_rate_hz: float) -> float | None:
    """Return the shortest time between two pings if a sonar makes none as quickly, else None; equal times have no rate.

    times_s : (pings,) times of transmission, seconds
    max_rate_hz : of `Sonar.max_ping_rate_hz`

    >>> too_short_step_s([0, 1, 1, 2], 2.0), too_short_step_s([0.0, 0.5, 0.75], 2.0)
    (None, 0.25)
    """
    steps_s = np.diff(np.asarray(times_s, np.float64))
    shortest_s = float(steps_s[steps_s != 0].min(initial=math.inf))
    return shortest_s if shortest_s < (1 - 1e-6) / max_rate_hz else None  # times may be rounded
