"""Speckle, texture and receiver noise of a ping, as its `meta` says that its beams and pulse are."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.frozen import frozen_field
from sonar_gl.patterns import taper_series
from sonar_gl.pulse import field_weights
from sonar_gl.receiver import add_interference
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
        return float(self.ping.meta.get("sound_speed_m_s") or SOUND_SPEED_M_S)

    @cached_property
    def _bin_size_m(self) -> float:
        r = self.ping.range_m
        return float((r[-1] - r[0]) / (len(r) - 1)) if len(r) > 1 else float(r[0])

    @cached_property
    def _pulse(self) -> tuple | None:
        """bandwidth_hz, taper and the speed that the sonar believes in; None = no range response."""
        bandwidth = self._acoustics.get("bandwidth_hz")
        taper = self._acoustics.get("pulse_taper", "uniform")
        speed_m_s = float(self._acoustics.get("sonar_sound_speed_m_s") or self._speed_m_s)
        return None if bandwidth is None else (float(bandwidth), taper, speed_m_s)

    @cached_property
    def _array(self) -> Array:
        width = self._sonar.get("beam_width_deg")
        width = None if width is None else float(np.radians(width))
        tapered = self._acoustics.get("beam_pattern") == "line_array"
        # Chebyshev's array is taken for Taylor's of the same side lobes
        taper = [
            self._acoustics.get(key, known) for key, known in (("taper", "uniform"), ("side_lobe_db", 30.0))
        ]
        series = taper_series(*taper) if tapered else ()
        along = None if self._pulse is None else field_weights(self._bin_size_m, *self._pulse)
        azimuths = tuple(np.asarray(self.ping.azimuth_rad, np.float64).tolist())
        return Array(azimuths, width, series, along)

    @cached_property
    def _tvg(self) -> np.ndarray:
        """(K,) linear power gain of the TVG at the bins; 1 where there is none."""
        if self._acoustics.get("range_law") != "sonar_equation":
            return np.ones(len(self.ping.range_m))
        acoustics, what = Acoustics(**self._acoustics), "the absorption that its TVG makes good"
        told = acoustics.absorption_db_m is not None or acoustics.tvg_absorption_db_m is not None
        frequency_hz = 0.0 if told else self._known("frequency_hz", what)
        return acoustics.tvg(self.ping.range_m, SimpleNamespace(frequency_hz=frequency_hz))

    def _known(self, key: str, what: str):
        """Something that the ping's sonar must tell."""
        if (value := self._sonar.get(key)) is None:
            raise Error(f"noise: the ping must have {key} in meta['sonar'] for {what} (a Simulator's has)")
        return value

    def _heard(self, *levels_db: float) -> np.ndarray:
        """(K,) float32 mean power of noise of these levels, TVG and all; up to 1e30."""
        power = self._tvg * math.fsum(10 ** (db / 10) for db in levels_db)
        return np.minimum(power, 1e30).astype(np.float32)

    def _frozen(self, term: str, look: int) -> np.ndarray:
        """(B, 2, K) field that belongs to the ping's pose."""
        why = "speckle that follows its motion"
        self._known("beam_width_deg", why)
        if self.ping.pose is None:
            raise Error(f"noise: the ping must have a pose for {why} (a Simulator's has)")

        def random(cell_x, cell_y, chunk):
            return self.random(term, *(n + (1 << 31) for n in (cell_x, cell_y, chunk)), look)

        wavelength_m = self._speed_m_s / self._known("frequency_hz", why)
        shape = len(self.ping.range_m), self._bin_size_m, wavelength_m
        return frozen_field(self._array, *shape, np.asarray(self.ping.pose), random, self._pulse)

    @cached_property
    def _streams(self) -> dict:
        return {}

    def _stream(self, term: str):
        """The generator of one term, which goes on from look to look."""
        if term not in self._streams:
            self._streams[term] = self.random(term)
        return self._streams[term]

    def _multiply(self, out, term: str, look: int = 0) -> None:
        """Multiply out by |g|² of this term's field."""
        if self.noise.follow_motion:
            out *= np.square(self._frozen(term, look)).sum(1)
        else:
            multiply_by_speckle(out, *self._array[:2], self._stream(term), *self._array[2:])

    def _look(self, out, power, number: int) -> None:
        """One look, in place: |√E g + √N n|², with N `power`, (K,) or None, and g = 1 without speckle.

        g and n have the same correlation. Where both are new in each ping, one field of power E + N is
        the same: in each bin, and for neighbours too where the echo is even.
        """
        noise = self.noise
        if power is None or (noise.speckle and not noise.follow_motion):
            if power is not None:
                out += power
            self._multiply(out, "speckle", number)
            return
        total = np.zeros((len(out), 2, out.shape[1]), np.float32)
        if noise.speckle:
            np.multiply(np.sqrt(out)[:, None], self._frozen("speckle", number), out=total)
        else:
            np.sqrt(out, out=total[:, 0])
        add_field(total, np.sqrt(power)[None], self._array, self._stream("receiver"))
        np.square(total, out=total)
        np.add(total[:, 0], total[:, 1], out=out)

    def add(self, out: np.ndarray) -> None:
        """Texture, speckle, receiver noise and interference, in place on (B, K) float32 echoes."""
        noise = self.noise
        levels = [db for db in (noise.electronic_db, noise.ambient_db) if db is not None]
        power = self._heard(*levels) if levels else None
        if noise.speckle and noise.speckle_shape is not None:
            exponential = np.ones_like(out)
            self._multiply(exponential, "texture")
            multiply_by_texture(out, exponential, noise.speckle_shape)
        if noise.speckle or power is not None:
            looks = noise.looks if noise.speckle else 1
            echo = out.copy() if looks > 1 else None
            self._look(out, power, 0)
            for number in range(1, looks):
                more = echo.copy()
                self._look(more, power, number)
                out += more
            if looks > 1:
                out /= np.float32(looks)
        if noise.interference_lines:
            power = self._heard(noise.interference_db)
            more = self._array, self._bin_size_m, self._speed_m_s, self._stream("interference")
            add_interference(out, noise.interference_lines, power, *more)
