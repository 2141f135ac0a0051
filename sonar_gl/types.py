"""What flows between the stages, and the one error that a user can cause."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np


class Error(ValueError):
    """Something that the caller can put right; the message says what must hold, what came, what to do."""


def nearest_names(name: str, known: Iterable[str]) -> str:
    """End of an error message about an unknown name: the nearest known ones, or all of them."""
    known = sorted(known)
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    if near:
        return "did you mean " + " or ".join(repr(n) for n in near) + "?"
    return "known are " + ", ".join(known)


def frozen_array(array, dtype, shape: tuple, what: str) -> np.ndarray:
    """A read-only, finite, contiguous copy of `array`; `shape` may hold None for any length.

    Raises
    ------
    Error
        if the shape differs, or a value is not a finite number.
    """
    try:
        out = np.array(array, dtype=dtype, order="C")
    except (TypeError, ValueError) as why:
        raise Error(f"{what} must be an array of numbers (got {type(array).__name__}: {why})") from None
    if len(out.shape) != len(shape) or any(
        want not in (None, got) for want, got in zip(shape, out.shape, strict=True)
    ):
        wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise Error(f"{what} must have shape {wanted} (got {out.shape})")
    if not np.isfinite(out).all():
        count = int(out.size - np.isfinite(out).sum())
        raise Error(f"{what} must be finite (got NaN or infinity in {count} of {out.size} numbers)")
    out.setflags(write=False)
    return out


def check_kind(name: str, value, kind, cure: str):
    """Raise an Error if an argument is not of its kind, a class or a union of one and None."""
    if not isinstance(value, kind):
        wanted = getattr(kind, "__name__", str(kind).split(" ")[0].split(".")[-1])
        article = "an" if wanted[0] in "AEIOU" else "a"
        raise Error(f"{name} must be {article} {wanted} (got {type(value).__name__}; {cure})")


@dataclass(frozen=True, eq=False)
class GBuffer:
    """One sector's samples: what the depth + normal pass saw. R rows (elevation), C columns (azimuth).

    Attributes
    ----------
    range_m : (R, C) float32, slant range of the surface, metres; 0 where nothing was hit
    normal : (R, C, 3) float32, geometric unit normal in the sonar frame, turned towards the sonar
    echo : (R, C) float32, μ cos θ, the diffuse echo per steradian before any gain
    body_id : (R, C) uint16, 1 + index into `scene.bodies`; 0 where nothing was hit
    """

    range_m: np.ndarray
    normal: np.ndarray
    echo: np.ndarray
    body_id: np.ndarray


@dataclass(frozen=True, eq=False)
class Ping:
    """One transmission and what it brought back. B beams, K bins.

    Attributes
    ----------
    intensity : (B, K) float32, linear, power-like; a sphere of reflectivity μ about the sonar reads μ
    azimuth_rad : (B,) float64, rising, starboard first, positive to port
    range_m : (K,) float64, bin centres
    body_id : (B, K) uint16 or None, 1 + index of the body with the strongest echo, 0 = nothing
    elevation_rad : (B, K) float32 or None, mean elevation of that echo, NaN where nothing
    pose : (4, 4) float64, world_from_sonar
    meta : what made it: sonar, profile, sampling, seed, version, GL renderer
    body_echo : (bodies + 1,) float64 or None, each body's part of the sum of `intensity`, by its number
    error_estimate : float or None, the share of the echo that is thought to lie in wrong bins
    incidence_rad : (B, K) float32 or None, mean incidence of the strongest body's echo, NaN where nothing
    true_range_m : (B, K) float32 or None, mean slant range of that echo, in the water, NaN where nothing
    share : (B, K) float32 or None, that echo's share of the bin's, 0..1, 0 where nothing
    shadow : (B, K) bool or None, whether bodies before the background have taken its echo
    """

    intensity: np.ndarray
    azimuth_rad: np.ndarray
    range_m: np.ndarray
    body_id: np.ndarray | None = None
    elevation_rad: np.ndarray | None = None
    pose: np.ndarray | None = None
    meta: dict = field(default_factory=dict)
    body_echo: np.ndarray | None = None
    error_estimate: float | None = None
    incidence_rad: np.ndarray | None = None
    true_range_m: np.ndarray | None = None
    share: np.ndarray | None = None
    shadow: np.ndarray | None = None

    @property
    def bin_size_m(self) -> float:
        """Length of a bin, metres."""
        return float(self.meta["bin_size_m"])
