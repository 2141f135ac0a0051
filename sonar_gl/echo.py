"""Planes and echoes before any gain: the twins of shaders/plane.glsl and echo.glsl, of the same names."""

from __future__ import annotations

import numpy as np


def cos_incidence(normal, direction):
    """Lambert: per steradian the echo is the cosine of incidence, never above 1 or below 0.

    Parameters
    ----------
    normal : (..., 3) unit, on the side of the sonar; direction : (..., 3) unit, from the sonar

    >>> float(cos_incidence(np.array([-1.0, 0, 0]), np.array([1.0, 0, 0])))
    1.0
    """
    return np.clip(-(normal * direction).sum(axis=-1), 0.0, 1.0)


def specular_lobe(cos_incidence, strength, slope):
    """Facets of a smooth surface that look at the sonar: echo per steradian, beside the diffuse μ cos θ.

    |R|² / (8 s² cos⁵ θ) · exp(−tan² θ / (2 s²)): of the backscattering cross section per area, whose cos⁴ the
    solid angle in place of the area makes a cos⁵. A sphere of radius a echoes a² |R|² / 4 (1 + s²) in all.

    Parameters
    ----------
    cos_incidence : cos θ, 0..1, held above 0.001
    strength : |R|² at normal incidence
    slope : s, rms slope of the facets along any one direction

    Source: Kirchhoff's approximation at high frequency, as in Brekhovskikh, Lysanov, "Fundamentals of Ocean
    Acoustics", 3rd ed. 2003, ch. 9

    >>> round(float(specular_lobe(1.0, 0.8, 0.1)), 9)
    10.0
    """
    c, s2 = np.clip(np.asarray(cos_incidence, np.float64), 1e-3, 1.0), np.square(slope)
    return strength * np.exp(-(1 - c**2) / (2 * s2 * c**2)) / (8 * s2 * c**5)


def plane_of(depth_inverse, slopes, at):
    """(..., 3) p of the plane p · x = 1 that a ray meets, in the sector's frame: 1/x = p_x − p_y u + p_z v.

    Parameters
    ----------
    depth_inverse : (...) 1/x on the ray
    slopes, at : (..., 2) of 1/x along u and v; (u, v) of the ray

    >>> plane_of(np.array(0.25), np.zeros(2), np.array([0.1, 0.2])).tolist()
    [0.25, -0.0, 0.0]
    """
    x = depth_inverse - (slopes * at).sum(axis=-1)
    return np.stack([x, -slopes[..., 0], slopes[..., 1]], axis=-1)


def cos_times_range(plane, depth_inverse, at, normal):
    """(...) cos θ times slant range, where a ray meets a plane; arguments as of `plane_of`.

    Parameters
    ----------
    normal : (..., 3) gives cos θ alone, whichever side it is of; where it is 0 the plane gives it

    >>> float(cos_times_range(np.array([0.25, 0, 0]), np.array(0.25), np.array([0.1, 0.2]), np.zeros(3)))
    4.0
    """
    ray = np.stack([np.ones_like(depth_inverse), -at[..., 0], at[..., 1]], axis=-1)
    length, squares = np.linalg.norm(ray, axis=-1), (normal * normal).sum(axis=-1)
    turned = (
        normal * (np.sign(-(normal * plane).sum(axis=-1)) / np.sqrt(np.maximum(squares, 1e-30)))[..., None]
    )
    shaded = cos_incidence(turned, ray / length[..., None]) * length / depth_inverse
    return np.where(squares > 1e-6, shaded, 1 / np.linalg.norm(plane, axis=-1))
