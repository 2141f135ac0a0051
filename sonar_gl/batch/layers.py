"""What is kept of each bin, and how: as few bits as say it, so that CF readers find the values again."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sonar_gl.compiled import compiled

ELEVATION_STEP_RAD, ELEVATION_NONE = 1e-4, -32768
INCIDENCE_STEP_RAD, INCIDENCE_NONE = math.pi / 2 / 254, 255


@dataclass(frozen=True)
class Layer:
    """One array of the store, (ping, beam, range).

    Attributes
    ----------
    name, dtype, fill : of the array; fill stands where nothing is
    attributes : units, and the scale that CF readers multiply by
    encode : function (ping, class of each body, first body of its scene) -> (B, K) of dtype
    """

    name: str
    dtype: str
    fill: float
    attributes: dict
    encode: object


def round_mantissa(values: np.ndarray, bits: int) -> np.ndarray:
    """float32 values to so many bits of mantissa, the nearest; half is rounded up. 0 stays 0.

    The relative error is 2^-(bits + 1) at most; the low bits are 0 and pack to nothing.

    >>> round_mantissa(np.float32([1.0, 1.01, 0.0]), 5).tolist()
    [1.0, 1.0, 0.0]
    """
    if bits >= 23:
        return values
    drop = 23 - bits
    whole = np.ascontiguousarray(values, np.float32).view(np.uint32) + np.uint32(1 << (drop - 1))
    whole &= np.uint32((0xFFFFFFFF << drop) & 0xFFFFFFFF)
    return whole.view(np.float32)


def _codes(values, step, none, dtype):
    """Values by their nearest steps, and `none` for NaN."""
    out = np.empty(values.shape, dtype)
    _count_steps(values.ravel(), np.float32(1 / step), none, out.ravel())
    return out


@compiled
def _count_steps(values, per_step, none, out):
    """`_codes` in one go; NumPy would go over the values five times."""
    for k in range(values.size):
        value = values[k]
        out[k] = none if value != value else np.int32(np.rint(value * per_step))


def _looked_up(table, numbers):
    """table[numbers]."""
    out = np.empty(numbers.shape, table.dtype)
    _look_up(table, numbers.ravel(), out.ravel())
    return out


@compiled
def _look_up(table, numbers, out):
    """In one go; NumPy would make 64-bit indices first."""
    for k in range(numbers.size):
        out[k] = table[numbers[k]]


def layers_of(names, sonar, acoustics, mantissa_bits: int, n_bodies: int, n_classes: int) -> list[Layer]:
    """The arrays of a sonar's pings: intensity, and what of `job.LAYERS` is asked for.

    Parameters
    ----------
    names : of layers
    sonar, acoustics : of these pings
    n_bodies : of all scenes; n_classes
    """
    range_step_m = acoustics.drawn_sonar(sonar).range_max_m * 1.001 / 65535
    of_bodies = "uint16" if n_bodies < 65536 else "uint32"
    of_classes = np.uint8 if n_classes < 256 else np.uint16

    def body(ping, _classes, first):
        found = ping.body_id.astype(of_bodies)
        return np.where(found > 0, found + np.asarray(first, of_bodies), found) if first else found

    error = 2.0 ** -(mantissa_bits + 1) if mantissa_bits < 23 else 0.0
    known = [
        Layer(
            "intensity",
            "float32",
            0.0,
            {
                "long_name": "echo intensity",
                "units": "1",
                "comment": "linear, power-like; a sphere of reflectivity μ about the sonar reads μ G(r)",
                "mantissa_bits": mantissa_bits,
                "relative_error_max": error,
            },
            lambda ping, *_: round_mantissa(ping.intensity, mantissa_bits),
        ),
        Layer("body_id", of_bodies, 0, {"long_name": "body of the strongest echo, 0 for none"}, body),
        Layer(
            "class_id",
            np.dtype(of_classes).name,
            0,
            {"long_name": "class of the body of the strongest echo, 0 for none"},
            lambda ping, classes, first: _looked_up(classes, ping.body_id),
        ),
        Layer(
            "elevation_rad",
            "int16",
            ELEVATION_NONE,
            {
                "long_name": "elevation of the strongest echo",
                "units": "rad",
                "scale_factor": ELEVATION_STEP_RAD,
                "_FillValue": ELEVATION_NONE,
            },
            lambda ping, *_: _codes(ping.elevation_rad, ELEVATION_STEP_RAD, ELEVATION_NONE, np.int16),
        ),
        Layer(
            "true_range_m",
            "uint16",
            0,
            {
                "long_name": "slant range of the strongest echo",
                "units": "m",
                "scale_factor": range_step_m,
                "_FillValue": 0,
            },
            lambda ping, *_: _codes(ping.true_range_m, range_step_m, 0, np.uint16),
        ),
        Layer(
            "incidence_rad",
            "uint8",
            INCIDENCE_NONE,
            {
                "long_name": "incidence of the strongest echo",
                "units": "rad",
                "scale_factor": INCIDENCE_STEP_RAD,
                "_FillValue": INCIDENCE_NONE,
            },
            lambda ping, *_: _codes(ping.incidence_rad, INCIDENCE_STEP_RAD, INCIDENCE_NONE, np.uint8),
        ),
        Layer(
            "share",
            "uint8",
            0,
            {"long_name": "share of the strongest body in the echo", "units": "1", "scale_factor": 1 / 255},
            lambda ping, *_: _codes(ping.share, 1 / 255, 0, np.uint8),
        ),
        Layer(
            "shadow",
            "uint8",
            0,
            {"long_name": "1 where the background would echo but for a body before it", "units": "1"},
            lambda ping, *_: ping.shadow.astype(np.uint8),
        ),
    ]
    asked = {"intensity", *(f"{name}_id" if name in ("body", "class") else name for name in names)}
    short = {"elevation_rad": "elevation", "true_range_m": "range", "incidence_rad": "incidence"}
    return [layer for layer in known if short.get(layer.name, layer.name) in asked]
