"""The arrays that a simulation returns: a `Ping` per transmission, a `GBuffer` per sector."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from sonar_gl.core.checks import check_kind
from sonar_gl.core.errors import Error
from sonar_gl.sonar.counts import DEFAULT_COUNTS, Counts

if TYPE_CHECKING:  # Acoustics loads Numba, for which commands that only list things would wait
    from sonar_gl.acoustics.acoustics import Acoustics
    from sonar_gl.sonar.sonar import Sonar


# the labels of bins, (B, K) each, with their values in bins without a labelled echo
BIN_LABELS = {
    "body_id": 0,
    "elevation_rad": np.nan,
    "incidence_rad": np.nan,
    "true_range_m": np.nan,
    "share": 0.0,
    "shadow": False,
}
# parts of a ping's echo that only its noise needs; a noisy ping has none of them
NOISE_PARTS = "coherent", "texture_deviation", "volume"


@dataclass(frozen=True, eq=False, repr=False)
class GBuffer:
    """Samples of the depth + normal pass of one sector. R rows (elevation), C columns (azimuth).

    Attributes
    ----------
    range_m : (R, C) float32, slant range of the surface, metres; 0 if there is none
    direction : (R, C, 3) float32, unit vector of the sample's ray in the frame of the head; by `range_m` its point
    normal : (R, C, 3) float32, geometric unit normal in the frame of the head, turned towards the sonar
    echo : (R, C) float32, per steradian before any gain: the diffuse echo μ cos θ, and the specular lobe of smooth
        faces if the acoustics have lobes
    body_id : (R, C) uint16, 1 + index into `scene.bodies`; 0 if there is none
    """

    range_m: np.ndarray
    direction: np.ndarray
    normal: np.ndarray
    echo: np.ndarray
    body_id: np.ndarray

    def __repr__(self):
        shape = np.shape(self.range_m)
        size = f"{shape[0]} rows x {shape[1]} columns" if len(shape) == 2 else f"shape {shape}"
        return f"<GBuffer of {size}>"


@dataclass(frozen=True, eq=False, repr=False)
class Ping:
    """One transmission and what it brought back. B beams, K bins.

    Attributes
    ----------
    intensity : (B, K) float32, linear, power-like; a sphere of reflectivity μ about the sonar, at range r, reads μ G(r)
    azimuth_rad : (B,) float64, radians, rising, starboard first, positive to port; of beams that are cones (see
        `Acoustics.has_cones`) the true azimuth of what lies at elevation 0 alone
    range_m : (K,) float64, bin centres, metres
    body_id : (B, K) uint16 or None, 1 + index of the body with the strongest echo, 0 if there is none, or none that a
        display shows above the noise by itself; likewise the other labels of a bin
    elevation_rad : (B, K) float32 or None, mean elevation of that echo, radians, NaN if there is none
    pose : (4, 4) float64, world_from_sonar, of the housing; `sonar.head_pose` of it is the head's, whose axes
        azimuths and elevations refer to
    meta : how the ping was made, as plain values; docs/conventions.md, "Files", has the keys
    body_echo : (bodies + 1,) float64 or None, each body's part of the sum of `intensity`, by its number: of its direct
        echo before noise, with what a pulse carries beyond the first and the last bin
    error_estimate : float or None, estimated share of the echo that lies in wrong bins, or, where the tolerance is not
        met for a body, a fifth of the error of that body's own echo if that is more; None where samples were given,
        or planned for other pings
    incidence_rad : (B, K) float32 or None, mean incidence of the strongest body's echo, radians, NaN if there is none
    true_range_m : (B, K) float32 or None, mean slant range of that echo in the water, metres, NaN if there is none
    share : (B, K) float32 or None, that echo's share of all mean echo in the bin, 0..1
    shadow : (B, K) bool or None, whether bodies in front of the background have blocked its echo
    sonar : the Sonar of the ping; None if unknown, as in a `Ping` made from arrays alone
    acoustics : the Acoustics of the ping, in its own water; None if unknown
    coherent : (B, K) float32 or None, the part of `intensity` that specular lobes return: a steady echo, which
        speckle spares. Only in pings without noise for which it was asked, as those of a batch
    texture_deviation : (B, K) float32 or None, standard deviation of the mean echo by the texture of bodies with a
        `speckle_shape` ν, the sum of their echoes over √ν; likewise
    volume : (B, K) float32 or None, the part of `intensity` that the water returns, where it has few scatterers
        (`Water.scatterer_density_m3`): speckle shows them one by one. Only in pings without noise

    Raises
    ------
    Error
        if `intensity` is an array of another shape than (beams, bins), the lengths of `azimuth_rad` and `range_m`.
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
    sonar: Sonar | None = None
    acoustics: Acoustics | None = None
    coherent: np.ndarray | None = None
    texture_deviation: np.ndarray | None = None
    volume: np.ndarray | None = None

    def __post_init__(self):
        """Refuse an intensity that does not fit the axes; what is no array is refused where it is used."""
        arrays = self.azimuth_rad, self.range_m, self.intensity
        azimuths, ranges, got = (getattr(array, "shape", ()) for array in arrays)
        if len(azimuths) == len(ranges) == 1 and got and got != (wanted := azimuths + ranges):
            cure = "; give its transpose, intensity.T" if got == wanted[::-1] else ""
            raise Error(
                f"a ping's intensity must be (beams, bins) = {wanted}, as long as azimuth_rad and range_m "
                f"(got {got}{cure})"
            )

    def __repr__(self):
        shape = np.shape(self.intensity)
        size = f"{shape[0]} beams x {shape[1]} bins" if len(shape) == 2 else f"shape {shape}"
        name = "" if self.sonar is None else f", sonar {self.sonar.name!r}"
        by = f", by {self.meta['gl_renderer']}" if "gl_renderer" in self.meta else ""
        return f"<Ping of {size}{name}{by}>"

    def _repr_png_(self) -> bytes | None:
        """Return the picture that a notebook shows of the ping: a fan image with axes. None if it has none."""
        from sonar_gl.imaging.styles import notebook_png  # of a layer above, which only notebooks need

        return notebook_png(self)

    @property
    def bin_size_m(self) -> float:
        """Length of a bin, metres: that of the sonar, else of `meta`, else the spacing of `range_m`.

        A single bin of an unknown sonar counts from range 0.
        """
        if self.sonar is not None:
            return float(self.sonar.bin_size_m)
        if "bin_size_m" in self.meta:
            return float(self.meta["bin_size_m"])
        r = self.range_m
        return float((r[-1] - r[0]) / (len(r) - 1) if len(r) > 1 else 2 * r[0])

    def counts(self, law: Counts | None = None) -> np.ndarray:
        """Return what the device delivers of this ping: whole numbers, (B, K) uint8 or uint16.

        Parameters
        ----------
        law : None for that of the sonar, or `Counts()` if the sonar is unknown
        """
        return self.counts_law(law).apply(self.intensity)

    def counts_law(self, law: Counts | None = None) -> Counts:
        """Return the law of `counts` with the gain that it has in this ping, where the gain is automatic."""
        if law is None:
            law = DEFAULT_COUNTS if self.sonar is None else self.sonar.counts
        check_kind("counts", law, Counts, 'such as Counts("power", exponent=0.26)')
        return law.settle(self.intensity)


def changed_powers(ping: Ping, change: Callable[[np.ndarray], np.ndarray]) -> dict[str, np.ndarray]:
    """Return the intensity and those NOISE_PARTS that a ping has, by name, as a function changes each; read-only."""
    powers = {name: getattr(ping, name) for name in ("intensity", *NOISE_PARTS)}
    out = {name: change(power) for name, power in powers.items() if power is not None}
    for power in out.values():
        power.setflags(write=False)
    return out
