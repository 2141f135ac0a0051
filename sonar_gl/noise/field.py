"""Noise terms that act on a ping's complex echo field: texture, speckle, receiver noise, interference."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.beam_pattern import taper_series
from sonar_gl.acoustics.pulse import PulseResponse, field_weights
from sonar_gl.core.errors import Error
from sonar_gl.core.worker import SecondThread, run_rows
from sonar_gl.noise.k_distribution import multiply_by_texture
from sonar_gl.noise.place_locked_speckle import FieldShape, WaveCache, place_locked_field
from sonar_gl.noise.random_streams import stream
from sonar_gl.noise.receiver import add_interference, common_noise_pattern, receiver_levels_db
from sonar_gl.noise.scatterers import Scatterers, add_scatterers, scatterers_of
from sonar_gl.noise.settings import Noise
from sonar_gl.noise.speckle import FieldCorrelation, add_field, multiply_by_speckle, replace_by_look
from sonar_gl.ping import Ping

SOUND_SPEED_M_S = 1500.0  # in a ping of unknown acoustics
MAX_POWER = 1e30  # noise beyond it is cut off, so that float32 sums stay finite
# A sonar within a cell takes 1 to 20 MB of its waves; near a corner it takes those of four cells, of up to 100 MB each
# for the widest fans, most of which are then made anew in each ping.
_WAVES = WaveCache(64 << 20)
MANY_BINS = 200_000  # real and imaginary parts of a look that two threads finish: 0.15 ms of work
PLACE_LOCKED = "place-locked speckle, follow_motion=True"


class FieldKey(NamedTuple):
    """What determines a place-locked field.

    Attributes
    ----------
    shape : FieldShape
    place : the first two rows of the pose, float64
    random : seed, term and look
    """

    shape: FieldShape
    place: bytes
    random: tuple[int, str, int]

    def make(self, thread: SecondThread | None, beside: Callable[[], None] | None) -> np.ndarray:
        """Return the field, (B, 2, K), read-only; parameters as for `place_locked_field`."""
        seed, term, look = self.random

        def waves(cell_x, cell_y, chunks, n_wave_bins):
            def generator(chunk):
                return stream(
                    seed, 0, term, *((n + (1 << 31)) % (1 << 64) for n in (cell_x, cell_y, chunk)), look
                )

            return _WAVES.waves((self.random, cell_x, cell_y), chunks, n_wave_bins, generator)

        pose = np.frombuffer(self.place).reshape(2, 4)
        out = place_locked_field(self.shape, pose, waves, thread, beside)
        out.setflags(write=False)
        return out


class RecentFields:
    """The last place-locked fields, of speckle and texture: a sonar that stands still sees the same again."""

    def __init__(self):
        self._kept = ()

    def field(
        self, key: FieldKey, thread: SecondThread | None = None, beside: Callable[[], None] | None = None
    ) -> np.ndarray:
        """Return the field of a key, (B, 2, K), read-only; `beside` is done in any case."""
        kept = self._kept
        found = [field for known, field in kept if known == key]
        if not found:
            found = [key.make(thread, beside)]
        elif beside is not None:
            beside()
        others = [pair for pair in kept if pair[0] != key]
        self._kept = ((key, found[0]), *others)[:2]  # at once, for other threads and interrupts
        return found[0]


_FIELDS = RecentFields()


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
    return FieldNoise(ping, noise, seed=0, ping_number=0).receiver_power


class FieldNoise:
    """The noise terms of one ping that act on its complex echo field.

    Parameters
    ----------
    ping : Ping; its sonar's beam width and its pulse correlate the fields of beams and of bins. Without a
        sonar beams are independent; without acoustics bins are, and there is no TVG
    noise : Noise
    seed, ping_number : of `random_streams.stream`
    thread : does a part of the work, with the same bytes; None: the caller does all
    """

    def __init__(
        self, ping: Ping, noise: Noise, seed: int, ping_number: int, thread: SecondThread | None = None
    ):
        self._ping, self._noise, self._seed, self._ping_number = ping, noise, seed, ping_number
        self._thread, self._streams = thread, {}

    def apply(self, intensity: np.ndarray) -> None:
        """Apply the terms to echoes (B, K) float32, in place.

        Texture and speckle act on the diffuse part of the echo, not on the ping's `coherent` part. The few scatterers
        of its `volume` have a field of their own.

        Raises Error if a term needs a sonar or a pose and the ping has none.
        """
        noise = self._noise
        power = self.receiver_power
        for part in (self._ping.coherent, self._ping.volume):
            if part is not None and noise.speckle:  # what is left is diffuse; rounding may make it negative
                np.maximum(intensity - part, 0, out=intensity)
        if noise.speckle and self._ping.texture_deviation is not None:
            exponential = np.ones_like(intensity)
            self._multiply_by_speckle(exponential, "texture")
            multiply_by_texture(intensity, exponential, self._ping.texture_deviation)
        if noise.speckle or power is not None:
            echo = intensity.copy() if noise.looks > 1 else None  # only with speckle
            self._apply_look(intensity, power, 0)
            for look in range(1, noise.looks):
                other = echo.copy()
                self._apply_look(other, power, look)
                intensity += other
            if noise.looks > 1:
                intensity /= np.float32(noise.looks)
        if noise.interference_lines:
            add_interference(
                intensity,
                noise.interference_lines,
                self._mean_power(noise.interference_db),
                self._correlation,
                self._ping.bin_size_m,
                self._assumed_sound_speed_m_s,
                self._stream("interference"),
            )

    def _levels_db(self) -> list[float]:
        """Return the levels of the noises that the receiver adds, before the TVG."""
        noise, sonar, acoustics = self._noise, self._ping.sonar, self._ping.acoustics
        if noise.self_noise:
            sonar = self._required("sonar", "the level of its self-noise")
        if noise.thermal_noise:
            sonar = self._required("sonar", "its source level, to which thermal noise is relative")
            acoustics = self._required("acoustics", "the bandwidth of its thermal noise")
        return receiver_levels_db(noise, sonar, acoustics)

    def _apply_look(self, intensity, power, look: int) -> None:
        """Replace diffuse echoes E, in place, by one look |√C + √V s + √E g + √N n|²: g speckle or 1, n receiver noise.

        C is the coherent echo, V that of the water's few scatterers and s their field; without speckle all echo is E.
        `power` is the noise's mean power N, (B, K) or (1, K), or None. The fields g and n have the same correlation.
        """
        if not self._noise.speckle:
            self._add_receiver_noise(intensity, power)
        elif self._noise.follow_motion:
            self._apply_place_locked_speckle(intensity, power, look)
        else:
            self._apply_new_speckle(intensity, power)

    def _add_receiver_noise(self, intensity, power) -> None:
        """Apply a look of which g is 1."""
        total = np.zeros((len(intensity), 2, intensity.shape[1]), np.float32)
        np.sqrt(intensity, out=total[:, 0])
        add_field(total, np.sqrt(power), self._correlation, self._stream("receiver"))
        _square(total, intensity)

    def _apply_new_speckle(self, intensity, power) -> None:
        """Apply a look of which g, as n, is new in each ping.

        One field of power E + N has the same statistics: exactly in each bin, and between neighbours where the echo is
        even.
        """
        if power is not None:
            intensity += power
        if self._is_diffuse:
            self._multiply_by_speckle(intensity, "speckle")
            return
        total = np.empty((len(intensity), 2, intensity.shape[1]), np.float32)
        self._fill_by_others(total)
        add_field(total, np.sqrt(intensity), self._correlation, self._stream("speckle"))
        _square(total, intensity)

    def _apply_place_locked_speckle(self, intensity, power, look: int) -> None:
        """Apply a look of which g belongs to the ping's pose."""
        if self._is_diffuse and power is None:
            self._multiply_by_speckle(intensity, "speckle", look)
            return
        total = np.empty((len(intensity), 2, intensity.shape[1]), np.float32)

        def add_others() -> None:
            self._fill_by_others(total)
            if power is not None:
                add_field(total, np.sqrt(power), self._correlation, self._stream("receiver"))

        field = self._place_locked_field("speckle", look, add_others)

        def replace_rows(rows: slice) -> None:
            replace_by_look(field[rows], total[rows], intensity[rows])

        run_rows(self._thread if total.size > MANY_BINS else None, replace_rows, 0, len(total))

    @property
    def _is_diffuse(self) -> bool:
        """Whether speckle acts on all of the echo."""
        return self._scatterers is None and self._ping.coherent is None

    def _fill_by_others(self, total: np.ndarray) -> None:
        """Fill a field (B, 2, K) by what speckle does not act on, √C + √V s."""
        total[:, 1] = 0
        if self._ping.coherent is None:
            total[:, 0] = 0
        else:  # a circular g takes no notice of its phase: 0 in all bins
            np.sqrt(self._ping.coherent, out=total[:, 0])
        if self._scatterers is not None:
            add_scatterers(
                total, self._ping.volume, self._scatterers, self._correlation, self._stream("scatterers")
            )

    def _multiply_by_speckle(self, intensity, term: str, look: int = 0) -> None:
        """Multiply the intensity, in place, by |g|² of the term's field."""
        if self._noise.follow_motion:
            intensity *= np.square(self._place_locked_field(term, look)).sum(1)
        else:
            multiply_by_speckle(intensity, self._correlation, self._stream(term))

    def _place_locked_field(
        self, term: str, look: int, beside: Callable[[], None] | None = None
    ) -> np.ndarray:
        """Return the (B, 2, K) field that belongs to the ping's pose, whatever its number; `beside` is done, too."""
        sonar, pose, ping = (
            self._required("sonar", PLACE_LOCKED),
            self._required("pose", PLACE_LOCKED),
            self._ping,
        )
        place = np.asarray(sonar.head_pose(pose), np.float64)[:2].tobytes()
        wavelength_m = self._sound_speed_m_s / sonar.frequency_hz
        correlation = self._correlation._replace(pulse_weights=None)  # an array, which keys may not have
        # in true metres, as the pose; bins and pulse are in those that the sonar shows
        scale, pulse = 1.0 if ping.acoustics is None else ping.acoustics.shown_per_true(), self._pulse
        if pulse is not None:
            pulse = pulse._replace(sound_speed_m_s=pulse.sound_speed_m_s / scale)
        shape = FieldShape(correlation, len(ping.range_m), ping.bin_size_m / scale, wavelength_m, pulse)
        return _FIELDS.field(FieldKey(shape, place, (self._seed, term, look)), self._thread, beside)

    def _stream(self, term: str) -> np.random.Generator:
        """Return the term's random generator, which continues from one look to the next."""
        if term not in self._streams:
            self._streams[term] = stream(self._seed, self._ping_number, term)
        return self._streams[term]

    @cached_property
    def receiver_power(self) -> np.ndarray | None:
        """The mean power of the receiver's noise, as of the function of this name."""
        levels_db, sonar = self._levels_db(), self._ping.sonar
        if not levels_db:
            return None
        power = self._mean_power(*levels_db)[None]
        if not self._noise.self_noise or sonar.common_noise_db is None:
            return power
        pattern = common_noise_pattern(self._ping.azimuth_rad, sonar.common_noise_width_deg)
        return power + np.outer(pattern, self._mean_power(sonar.common_noise_db)).astype(np.float32)

    def _mean_power(self, *levels_db: float) -> np.ndarray:
        """Return the mean power of noise of these levels after the TVG, (K,) float32, up to MAX_POWER."""
        power = self._tvg * math.fsum(10 ** (db / 10) for db in levels_db)
        return np.minimum(power, MAX_POWER).astype(np.float32)

    @cached_property
    def _scatterers(self) -> Scatterers | None:
        """The few scatterers of the water, which looks with speckle receive; None if there are none."""
        if self._ping.volume is None:
            return None
        sonar = self._required("sonar", "the volume in which its water has scatterers")
        acoustics = self._required("acoustics", "the scatterers of its water")
        return scatterers_of(
            acoustics.water.scatterer_density_m3, self._ping.range_m, self._correlation, sonar, acoustics
        )

    @cached_property
    def _tvg(self) -> np.ndarray:
        """The TVG's gain at each bin, (K,) linear power; 1 if there is none."""
        acoustics = self._ping.acoustics
        if acoustics is None or acoustics.range_law != "sonar_equation":
            return np.ones(len(self._ping.range_m))
        return acoustics.tvg(
            self._ping.range_m, self._required("sonar", "the absorption that its TVG assumes")
        )

    @cached_property
    def _correlation(self) -> FieldCorrelation:
        sonar, acoustics = self._ping.sonar, self._ping.acoustics
        width_rad = None if sonar is None else float(np.radians(sonar.beam_width_deg))
        tapered = acoustics is not None and acoustics.beam_pattern == "line_array"
        series = ()
        if tapered and sonar:
            # a Chebyshev array, which has no series, counts as Taylor's of the same side lobes
            taper = "taylor" if sonar.receive_taper == "chebyshev" else sonar.receive_taper
            series = taper_series(taper, sonar.side_lobe_db)
        pulse_weights = None if self._pulse is None else field_weights(self._ping.bin_size_m, *self._pulse)
        azimuth_rad = tuple(np.asarray(self._ping.azimuth_rad, np.float64).tolist())
        return FieldCorrelation(azimuth_rad, width_rad, series, pulse_weights)

    @cached_property
    def _pulse(self) -> PulseResponse | None:
        """The response of the matched filter; None without one."""
        acoustics = self._ping.acoustics
        if acoustics is None or not acoustics.pulse:
            return None
        return acoustics.pulse_response(self._required("sonar", "the bandwidth of its pulse"))

    @cached_property
    def _sound_speed_m_s(self) -> float:
        acoustics = self._ping.acoustics
        return SOUND_SPEED_M_S if acoustics is None else acoustics.water.sound_speed()

    @property
    def _assumed_sound_speed_m_s(self) -> float:
        acoustics = self._ping.acoustics
        return SOUND_SPEED_M_S if acoustics is None else acoustics.assumed_sound_speed_m_s()

    def _required(self, name: str, purpose: str):
        """Return the ping's attribute `name`, or raise an Error if the ping has none."""
        value = getattr(self._ping, name)
        if value is None:
            article, them = ("its", "them") if name == "acoustics" else ("a", "one")
            raise Error(
                f"noise: the ping must have {article} {name} for {purpose} (got None; pings of a Simulator have {them})"
            )
        return value


def _square(field: np.ndarray, intensity: np.ndarray) -> None:
    """Set the intensity (B, K) to the squared magnitude of a field (B, 2, K), which is lost."""
    np.square(field, out=field)
    np.add(field[:, 0], field[:, 1], out=intensity)
