"""Speckle, texture and receiver noise of a ping, as its `meta` says that its beams and pulse are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.frozen import frozen_field
from sonar_gl.pulse import PULSE_TAPERS, field_weights
from sonar_gl.receiver import add_interference, tvg_gain
from sonar_gl.speckle import Array, add_field, multiply_by_speckle
from sonar_gl.texture import multiply_by_texture
from sonar_gl.types import Error, Ping

SOUND_SPEED_M_S = 1500.0  # where a ping does not tell


@dataclass(frozen=True)
class Grain:
    """How fields over a ping are made; `random(term, *more)` gives the generator of one term."""

    ping: Ping
    noise: object
    random: object

    @cached_property
    def _sonar(self) -> dict:
        return self.ping.meta.get("sonar", {})

    @cached_property
    def _acoustics(self) -> dict:
        return self.ping.meta.get("acoustics", {})

    @cached_property
    def _speed_m_s(self) -> float:
        return float(self._acoustics.get("sound_speed_m_s") or SOUND_SPEED_M_S)

    @cached_property
    def _bin_size_m(self) -> float:
        r = self.ping.range_m
        return float((r[-1] - r[0]) / (len(r) - 1)) if len(r) > 1 else float(r[0])

    @cached_property
    def _pulse(self) -> tuple | None:
        """bandwidth_hz, taper and sound speed of the pulse; None = no range response."""
        bandwidth = self._acoustics.get("bandwidth_hz")
        taper = self._acoustics.get("pulse_taper", "uniform")
        return None if bandwidth is None else (float(bandwidth), taper, self._speed_m_s)

    @cached_property
    def _array(self) -> Array:
        width = self._sonar.get("beam_width_deg")
        width = None if width is None else float(np.radians(width))
        series = PULSE_TAPERS.get(self._acoustics.get("taper", "uniform"), ())
        along = None if self._pulse is None else field_weights(self._bin_size_m, *self._pulse)
        azimuths = tuple(np.asarray(self.ping.azimuth_rad, np.float64).tolist())
        return Array(azimuths, width, series, along)

    @cached_property
    def _tvg(self) -> np.ndarray:
        """(K,) linear power gain of the TVG at the bins; 1 where there is none."""
        a = self._acoustics
        if a.get("range_law") != "sonar_equation":
            return np.ones(len(self.ping.range_m))
        loss = a.get("tvg_absorption_db_m")
        if loss is None:
            loss = Acoustics(**a).absorption(self._sonar["frequency_hz"])
        return tvg_gain(self.ping.range_m, a["tvg_k"], loss)

    def _frozen(self, term: str, look: int) -> np.ndarray:
        """(B, 2, K) field that belongs to the ping's pose."""
        wanted = self.ping.pose, self._array.beam_width_rad, self._sonar.get("frequency_hz")
        if any(part is None for part in wanted):
            raise Error(
                "noise: follow_motion needs a ping with a pose, and with beam_width_deg and frequency_hz of "
                "its sonar in meta['sonar'] (a ping of a Simulator has all)"
            )
        pose, _, frequency_hz = wanted

        def random(cell_x, cell_y, chunk):
            return self.random(term, *(n + (1 << 31) for n in (cell_x, cell_y, chunk)), look)

        wavelength_m = self._speed_m_s / frequency_hz
        shape = len(self.ping.range_m), self._bin_size_m, wavelength_m
        return frozen_field(self._array, *shape, np.asarray(pose), random, self._pulse)

    def _multiply(self, out, term: str, random, look: int = 0) -> None:
        """Multiply out by |g|² of this term's field; `random`: unless it belongs to the pose."""
        if self.noise.follow_motion:
            out *= np.square(self._frozen(term, look)).sum(1)
        else:
            multiply_by_speckle(out, *self._array[:2], random, *self._array[2:])

    def _look(self, out, power, number: int, speckle, receiver) -> None:
        """One look, in place: |√E g + √N n|², with N `power`, (K,) or None, and g = 1 without speckle.

        g and n have the same correlation. Where both are new in each ping, one field of power E + N is
        the same: in each bin, and for neighbours too where the echo is even.
        """
        noise = self.noise
        if power is None or (noise.speckle and not noise.follow_motion):
            if power is not None:
                out += power
            self._multiply(out, "speckle", speckle, number)
            return
        total = np.zeros((len(out), 2, out.shape[1]), np.float32)
        if noise.speckle:
            np.multiply(np.sqrt(out)[:, None], self._frozen("speckle", number), out=total)
        else:
            np.sqrt(out, out=total[:, 0])
        amplitude = np.ascontiguousarray(np.broadcast_to(np.sqrt(power), out.shape))
        add_field(total, amplitude, self._array, receiver)
        np.square(total, out=total)
        np.add(total[:, 0], total[:, 1], out=out)

    def add(self, out: np.ndarray) -> None:
        """Texture, speckle, receiver noise and interference, in place on (B, K) float32 echoes."""
        noise = self.noise
        levels = [db for db in (noise.electronic_db, noise.ambient_db) if db is not None]
        power = None
        if levels:
            power = (self._tvg * math.fsum(10 ** (db / 10) for db in levels)).astype(np.float32)
        if noise.speckle and noise.speckle_shape is not None:
            exponential = np.ones_like(out)
            self._multiply(exponential, "texture", None if noise.follow_motion else self.random("texture"))
            multiply_by_texture(out, exponential, noise.speckle_shape)
        if noise.speckle or power is not None:
            looks = noise.looks if noise.speckle else 1
            speckle = None if noise.follow_motion else self.random("speckle")
            receiver = self.random("receiver")
            echo = out.copy() if looks > 1 else None
            self._look(out, power, 0, speckle, receiver)
            for number in range(1, looks):
                more = echo.copy()
                self._look(more, power, number, speckle, receiver)
                out += more
            if looks > 1:
                out /= np.float32(looks)
        if noise.interference_lines:
            level = self._tvg * 10 ** (noise.interference_db / 10)
            more = self._array, self._bin_size_m, self._speed_m_s, self.random("interference")
            add_interference(out, noise.interference_lines, level, *more)
