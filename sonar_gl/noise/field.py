"""Noise terms that act on a ping's complex echo field: texture, speckle, receiver noise, interference."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_gl.core.worker import SecondThread, run_halves
from sonar_gl.noise.k_distribution import multiply_by_texture
from sonar_gl.noise.place_locked_speckle import FieldShape, place_locked_field
from sonar_gl.noise.random_streams import stream
from sonar_gl.noise.receiver import add_interference
from sonar_gl.noise.reception import receiver_of, required
from sonar_gl.noise.scatterers import add_scatterers, scatterers_of
from sonar_gl.noise.settings import Noise
from sonar_gl.noise.speckle import BeamField, correlated_field, look_at
from sonar_gl.noise.wave_cache import WaveCache
from sonar_gl.ping import Ping

# A sonar within a cell takes 2 to 25 MB of its waves; near a corner it takes those of four cells, of up to 30 MB each
# for many bins and for the widest fans, some of which are then made anew in each ping.
_WAVES = WaveCache(64 << 20)
PLACE_LOCKED = "place-locked speckle, follow_motion=True"


class FieldKey(NamedTuple):
    """What determines a place-locked field.

    place : the first two rows of the pose, float64
    random : seed, term and look
    """

    shape: FieldShape
    place: bytes
    random: tuple[int, str, int]

    def make(self, thread: SecondThread | None) -> BeamField:
        """Return the field; parameters as for `place_locked_field`."""
        seed, term, look = self.random

        def waves(cell_x, cell_y, chunks, n_wave_bins):
            def generator(chunk):
                numbers = ((n + (1 << 31)) % (1 << 64) for n in (cell_x, cell_y, *chunk))
                return stream(seed, 0, term, *numbers, look)

            return _WAVES.waves((self.random, cell_x, cell_y), chunks, n_wave_bins, generator)

        pose = np.frombuffer(self.place).reshape(2, 4)
        return place_locked_field(self.shape, pose, waves, thread)


class RecentFields:
    """The last place-locked fields, of speckle and texture: a sonar that stands still sees the same again."""

    def __init__(self):
        self._kept = ()

    def field(self, key: FieldKey, thread: SecondThread | None = None) -> BeamField:
        """Return the field of a key, whose arrays must not be changed."""
        kept = self._kept
        found = [field for known, field in kept if known == key] or [key.make(thread)]
        others = [pair for pair in kept if pair[0] != key]
        self._kept = ((key, found[0]), *others)[:2]  # at once, for other threads and interrupts
        return found[0]


_FIELDS = RecentFields()


class FieldNoise:
    """The noise terms of one ping that act on its complex echo field.

    ping : Ping; its sonar's beam width and its pulse correlate the fields of beams and of bins. Without a
        sonar beams are independent; without acoustics bins are, and there is no TVG
    seed, ping_number : of `random_streams.stream`
    thread : does a part of the work, with the same bytes; None: the caller does all
    """

    def __init__(self, ping: Ping, noise: Noise, seed: int, ping_number: int, thread: SecondThread | None):
        self._ping, self._noise, self._seed, self._ping_number = ping, noise, seed, ping_number
        self._thread, self._streams, self._receiver = thread, {}, receiver_of(ping, noise)

    def noisy(self) -> np.ndarray:
        """Return the intensity of the ping with these terms, (B, K) float32.

        Texture and speckle act on the diffuse part of the echo, not on the ping's `coherent` part. The few scatterers
        of its `volume` have a field of their own.

        Raises Error if a term needs a sonar or a pose and the ping has none.
        """
        noise, ping, power = self._noise, self._ping, self._receiver.receiver_power
        out = echo = np.ascontiguousarray(ping.intensity, np.float32)
        if noise.speckle and ping.volume is not None:
            echo = np.maximum(echo - ping.volume, 0)  # rounding may make it negative
        if noise.speckle and ping.texture_deviation is not None:
            echo = self._textured(echo)
        if noise.speckle or power is not None:
            out = self._look(echo, power, 0)
            for look in range(1, noise.looks):
                out += self._look(echo, power, look)
            if noise.looks > 1:
                out /= np.float32(noise.looks)
        if noise.interference_lines:
            out = np.array(out)
            add_interference(
                out,
                noise.interference_lines,
                self._receiver.mean_power(noise.interference_db),
                self._receiver.correlation,
                ping.bin_size_m,
                self._receiver.assumed_sound_speed_m_s,
                self._stream("interference"),
            )
        return out

    def _textured(self, echo: np.ndarray) -> np.ndarray:
        """Return echoes (B, K) whose diffuse part has the texture."""
        coherent = self._ping.coherent
        out = np.array(echo) if coherent is None else np.maximum(echo - coherent, 0)
        exponential = look_at(np.ones_like(out), self._field("texture"), thread=self._thread)
        multiply_by_texture(out, exponential, self._ping.texture_deviation)
        return out if coherent is None else out + coherent

    def _look(self, echo, power, look: int) -> np.ndarray:
        """Return one look |√C + √V s + √E g + √N n|²: g speckle or 1, n receiver noise.

        C is the coherent echo, V that of the water's few scatterers and s their field; without speckle all echo is E.
        `power` is the noise's mean power N, (B, K) or (1, K), or None. The fields g and n have the same correlation.

        echo : E + C
        """
        noise, with_speckle = self._noise, self._noise.speckle
        if with_speckle and not noise.follow_motion and power is not None:
            # Both g and n are new in each ping. One field of power E + N has the same statistics: exactly in each bin,
            # and between neighbours where the echo is even.
            echo, power = echo + power, None

        def make(half: int):
            if half == 0:
                return self._field("speckle", look) if with_speckle else None
            receiver = None if power is None else self._new_field("receiver")
            return receiver, self._scattered_field() if with_speckle else None

        both = with_speckle and power is not None
        speckle, (receiver, scattered) = run_halves(self._thread if both else None, make)
        steady = self._ping.coherent if with_speckle else None
        return look_at(echo, speckle, steady, scattered, receiver, power, self._thread)

    def _scattered_field(self) -> np.ndarray | None:
        """Return √V s, (B, 2, K); None without few scatterers."""
        volume, correlation = self._ping.volume, self._receiver.correlation
        if volume is None:
            return None
        sonar = self._required("sonar", "the volume in which its water has scatterers")
        acoustics = self._required("acoustics", "the scatterers of its water")
        density_m3 = acoustics.water.scatterer_density_m3
        scatterers = scatterers_of(density_m3, self._ping.range_m, correlation, sonar, acoustics)
        out = np.zeros((len(volume), 2, volume.shape[1]), np.float32)
        add_scatterers(out, volume, scatterers, correlation, self._stream("scatterers"))
        return out

    def _field(self, term: str, look: int = 0) -> BeamField:
        """Return the field of speckle or texture."""
        return self._place_locked_field(term, look) if self._noise.follow_motion else self._new_field(term)

    def _new_field(self, term: str) -> BeamField:
        """Return a field that is new in each ping."""
        return correlated_field(self._receiver.correlation, len(self._ping.range_m), self._stream(term))

    def _place_locked_field(self, term: str, look: int) -> BeamField:
        """Return the field that belongs to the ping's pose, whatever its number."""
        sonar, pose = (self._required(name, PLACE_LOCKED) for name in ("sonar", "pose"))
        ping, receiver = self._ping, self._receiver
        place = np.asarray(sonar.head_pose(pose), np.float64)[:2].tobytes()
        wavelength_m = receiver.sound_speed_m_s / sonar.frequency_hz
        correlation = receiver.correlation._replace(pulse_weights=None)  # an array, which keys may not have
        # in true metres, as the pose; bins and pulse are in those that the sonar shows
        scale, pulse = 1.0 if ping.acoustics is None else ping.acoustics.shown_per_true(), receiver.pulse
        if pulse is not None:
            pulse = pulse._replace(sound_speed_m_s=pulse.sound_speed_m_s / scale)
        shape = FieldShape(correlation, len(ping.range_m), ping.bin_size_m / scale, wavelength_m, pulse)
        return _FIELDS.field(FieldKey(shape, place, (self._seed, term, look)), self._thread)

    def _stream(self, term: str) -> np.random.Generator:
        """Return the term's random generator, which continues from one look to the next."""
        if term not in self._streams:
            self._streams[term] = stream(self._seed, self._ping_number, term)
        return self._streams[term]

    def _required(self, name: str, purpose: str):
        """Return the ping's attribute `name`, or raise an Error if the ping has none."""
        return required(name, getattr(self._ping, name), purpose)
