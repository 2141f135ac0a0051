"""The receiver of a ping: what correlates the fields that it receives, its range gain and its noise."""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.beam_pattern import taper_series
from sonar_gl.acoustics.pulse import PulseResponse, field_weights
from sonar_gl.core.errors import Error
from sonar_gl.noise.receiver import common_noise_pattern, receiver_levels_db
from sonar_gl.noise.settings import Noise
from sonar_gl.noise.speckle import FieldCorrelation
from sonar_gl.ping import Ping
from sonar_gl.sonar.sonar import Sonar

SOUND_SPEED_M_S = 1500.0  # in a ping of unknown acoustics
MAX_POWER = 1e30  # noise beyond it is cut off, so that float32 sums stay finite


def receiver_power(ping: Ping, noise: Noise) -> np.ndarray | None:
    """Return the mean power of the noise that the receiver of a ping adds, after the TVG.

    Parameters
    ----------
    ping : with the sonar and the acoustics that the levels and the TVG need
    noise : Noise, of which self-noise, thermal noise and ambient noise count

    Returns
    -------
    (1, K) float32, in the unit of `Ping.intensity`; (B, K) where channels have noise in common; None without such noise

    Raises
    ------
    Error
        if the ping lacks a sonar or acoustics that the levels need.

    >>> from sonar_gl.sonar.sonar_files import load_sonar
    >>> sonar = load_sonar("p900-45")
    >>> range_m = sonar.range_m
    >>> ping = Ping(np.zeros((1, len(range_m)), np.float32), np.zeros(1), range_m, sonar=sonar)
    >>> power = receiver_power(ping, Noise(self_noise=True))  # without acoustics, which have the TVG
    >>> round(10 * math.log10(power[0, 0]), 3) == sonar.self_noise_db
    True
    """
    return receiver_of(ping, noise).receiver_power


def receiver_of(ping: Ping, noise: Noise) -> Receiver:
    """Return the receiver of a ping; pings of the same sonar, acoustics and noise share one."""
    axes = (np.asarray(axis, np.float64).tobytes() for axis in (ping.azimuth_rad, ping.range_m))
    return _receiver(ping.sonar, ping.acoustics, noise, ping.bin_size_m, *axes)


def required(name: str, value, purpose: str):
    """Return a value, or raise an Error if it is None: the ping must have one, called `name`."""
    if value is None:
        article, them = ("its", "them") if name == "acoustics" else ("a", "one")
        raise Error(
            f"noise: the ping must have {article} {name} for {purpose} (got None; pings of a Simulator have {them})"
        )
    return value


class Receiver:
    """What determines the fields that a sonar receives in any ping of the same axes.

    Raises Error by a property that needs the sonar or the acoustics, if they are not known.

    sonar : its beam width correlates the fields of beams; None for independent beams
    acoustics : its pulse correlates the fields of bins; None for independent bins, and no TVG
    noise : Noise, of which the levels of the receiver's noise count
    bin_size_m : length of a bin
    azimuth_rad, range_m : of `Ping`, (B,) and (K,) float64
    """

    def __init__(
        self,
        sonar: Sonar | None,
        acoustics: Acoustics | None,
        noise: Noise,
        bin_size_m: float,
        azimuth_rad: np.ndarray,
        range_m: np.ndarray,
    ):
        self.sonar, self.acoustics, self.bin_size_m, self.range_m = sonar, acoustics, bin_size_m, range_m
        self._noise, self._azimuth_rad = noise, azimuth_rad

    @cached_property
    def receiver_power(self) -> np.ndarray | None:
        """The mean power of the receiver's noise, as of the function of this name; read-only."""
        levels_db = self._levels_db()
        if not levels_db:
            return None
        power = self.mean_power(*levels_db)[None]
        if self._noise.self_noise and self.sonar.common_noise_db is not None:
            pattern = common_noise_pattern(self._azimuth_rad, self.sonar.common_noise_width_deg)
            common = np.outer(pattern, self.mean_power(self.sonar.common_noise_db))
            power = power + common.astype(np.float32)
        power.setflags(write=False)
        return power

    def mean_power(self, *levels_db: float) -> np.ndarray:
        """Return the mean power of noise of these levels after the TVG, (K,) float32, up to MAX_POWER."""
        power = self._tvg * math.fsum(10 ** (db / 10) for db in levels_db)
        return np.minimum(power, MAX_POWER).astype(np.float32)

    @cached_property
    def ring_down(self) -> np.ndarray | None:
        """The power of the ring-down after the TVG, (K,) float32, up to MAX_POWER; None without it.

        The transducer rings on after the pulse, while the receiver listens already. An oscillation that is damped
        evenly decays exponentially in time, by so many dB per metre of range. All elements ring alike, and so do all
        beams. The power is added to that of the echo.
        """
        if not self._noise.self_noise or self.sonar is None or self.sonar.ring_down_db is None:
            return None
        level_db = self.sonar.ring_down_db - self.sonar.ring_down_decay_db_m * self.range_m
        return np.minimum(10 ** (np.clip(level_db, -300, 300) / 10) * self._tvg, MAX_POWER).astype(np.float32)

    @cached_property
    def correlation(self) -> FieldCorrelation:
        """What correlates the fields of beams and bins."""
        width_rad = None if self.sonar is None else float(np.radians(self.sonar.beam_width_deg))
        series = ()
        if self.sonar and self.acoustics is not None and self.acoustics.beam_pattern == "line_array":
            # a Chebyshev array, which has no series, counts as Taylor's of the same side lobes
            taper = "taylor" if self.sonar.receive_taper == "chebyshev" else self.sonar.receive_taper
            series = taper_series(taper, self.sonar.side_lobe_db)
        pulse_weights = None if self.pulse is None else field_weights(self.bin_size_m, *self.pulse)
        return FieldCorrelation(tuple(self._azimuth_rad.tolist()), width_rad, series, pulse_weights)

    @cached_property
    def pulse(self) -> PulseResponse | None:
        """The response of the matched filter; None without one."""
        if self.acoustics is None or not self.acoustics.pulse:
            return None
        return self.acoustics.pulse_response(required("sonar", self.sonar, "the bandwidth of its pulse"))

    @cached_property
    def sound_speed_m_s(self) -> float:
        """The speed of sound in the water."""
        return SOUND_SPEED_M_S if self.acoustics is None else self.acoustics.water.sound_speed()

    @cached_property
    def assumed_sound_speed_m_s(self) -> float:
        """The speed of sound that the sonar assumes."""
        return SOUND_SPEED_M_S if self.acoustics is None else self.acoustics.assumed_sound_speed_m_s()

    def _levels_db(self) -> list[float]:
        """Return the levels of the noises that the receiver adds, before the TVG."""
        if self._noise.self_noise:
            required("sonar", self.sonar, "the level of its self-noise")
        if self._noise.thermal_noise:
            required("sonar", self.sonar, "its source level, to which thermal noise is relative")
            required("acoustics", self.acoustics, "the bandwidth of its thermal noise")
        return receiver_levels_db(self._noise, self.sonar, self.acoustics)

    @cached_property
    def _tvg(self) -> np.ndarray:
        """The TVG's gain at each bin, (K,) linear power; 1 if there is none."""
        if self.acoustics is None or self.acoustics.range_law != "sonar_equation":
            return np.ones(len(self.range_m))
        sonar = required("sonar", self.sonar, "the absorption that its TVG assumes")
        return self.acoustics.tvg(self.range_m, sonar)


@lru_cache(maxsize=8)
def _receiver(sonar, acoustics, noise, bin_size_m: float, azimuths: bytes, ranges: bytes) -> Receiver:
    """Return a receiver; azimuths, ranges : the bytes of its axes."""
    return Receiver(sonar, acoustics, noise, bin_size_m, np.frombuffer(azimuths), np.frombuffer(ranges))
