"""Backscatter and reflection at boundaries, before any gain; cross sections of bubbles.

`plane_of`, `cos_incidence` and `specular_lobe` are the NumPy twins of the functions of the same names in
shaders/plane.glsl and shaders/echo.glsl. `lobe_times_range` there has its twin in the engine cpu, compiled.
"""

from __future__ import annotations

import math

import numpy as np


def cos_incidence(normal, direction):
    """Return the cosine of incidence, 0..1: the backscatter per steradian by Lambert's law.

    Parameters
    ----------
    normal : (..., 3) unit vectors, on the side of the sonar
    direction : (..., 3) unit vectors, from the sonar

    >>> float(cos_incidence(np.array([-1.0, 0, 0]), np.array([1.0, 0, 0])))
    1.0
    """
    return np.clip(-(normal * direction).sum(axis=-1), 0.0, 1.0)


def specular_lobe(cos_incidence, strength, slope):
    """Return the specular backscatter lobe of a smooth surface, per steradian, which adds to the diffuse μ cos θ.

    Parameters
    ----------
    cos_incidence : cos θ, 0..1; values below 0.001 count as 0.001
    strength : |R|² at normal incidence
    slope : s, rms slope of the facets along any one direction

    Notes
    -----
    |R|² / (8 s² cos⁵ θ) · exp(−tan² θ / (2 s²)): the backscattering cross section per area, whose cos⁴ becomes
    cos⁵ per solid angle. A sphere of radius a returns a² |R|² / 4 (1 + s²) in total.

    Source: Kirchhoff's approximation at high frequency, as in Brekhovskikh, Lysanov, "Fundamentals of Ocean
    Acoustics", 3rd ed. 2003, ch. 9

    >>> round(float(specular_lobe(1.0, 0.8, 0.1)), 9)
    10.0
    """
    c, s2 = np.clip(np.asarray(cos_incidence, np.float64), 1e-3, 1.0), np.square(slope)
    return strength * np.exp(-(1 - c**2) / (2 * s2 * c**2)) / (8 * s2 * c**5)


def cos_of_greatest_lobe(slope):
    """Return cos θ where `specular_lobe` of a rms slope is greatest: face on, or beside it where cos⁻⁵ θ outweighs.

    The derivative of its logarithm, tan θ (5 − 1 / (s² cos² θ)), is zero at cos² θ = 1 / (5 s²).

    >>> float(cos_of_greatest_lobe(0.1)), round(float(cos_of_greatest_lobe(0.5)), 4)
    (1.0, 0.8944)
    """
    return np.minimum(1.0, 1.0 / (math.sqrt(5.0) * np.maximum(slope, 1e-9)))


def plane_of(depth_inverse, slopes, at):
    """Return (..., 3) p of the plane p · x = 1 that a ray meets, in the sector's frame: 1/x = p_x − p_y u + p_z v.

    depth_inverse : (...) 1/x on the ray, 1/metres
    slopes : (..., 2) derivatives of 1/x along u and v, 1/metres
    at : (..., 2) u and v of the ray

    >>> plane_of(np.array(0.25), np.zeros(2), np.array([0.1, 0.2])).tolist()
    [0.25, -0.0, 0.0]
    """
    x = depth_inverse - (slopes * at).sum(axis=-1)
    return np.stack([x, -slopes[..., 0], slopes[..., 1]], axis=-1)


def rayleigh_reflection(grazing_rad, density_ratio, speed_ratio, loss=0.0):
    """Return the Rayleigh reflection coefficient of a plane boundary between water and a fluid, complex amplitude.

    Parameters
    ----------
    grazing_rad : g, grazing angle between ray and boundary, radians, 0..π/2; arrays broadcast
    density_ratio : m, density of the fluid over that of the water; 0 for a vacuum, R = −1
    speed_ratio : speed of sound in the fluid over that in the water
    loss : δ, imaginary over real part of the wave number in the fluid

    Notes
    -----
    R = (m sin g − √(n² − cos² g)) / (m sin g + √(n² − cos² g)), n = (1 + iδ) / speed_ratio.

    Source: Rayleigh, "The Theory of Sound", vol. 2, 1896; with loss as in APL-UW TR 9407, 1994, ch. IV

    >>> medium_sand = rayleigh_reflection(np.pi / 2, 1.845, 1.1782, 0.01624)
    >>> round(float(20 * np.log10(abs(medium_sand))), 2)
    -8.64
    """
    n = (1 + 1j * np.asarray(loss, np.float64)) / np.asarray(speed_ratio, np.float64)
    sine = np.maximum(np.sin(grazing_rad), 1e-9)  # the limit at 0, which is 0 / 0 for equal speeds
    below = np.sqrt(n**2 - 1 + sine**2)  # the root that decays away from the boundary
    above = np.asarray(density_ratio, np.float64) * sine
    return (above - below) / (above + below)


def sediment_backscattering(grazing_rad, density_ratio, speed_ratio, loss, volume_parameter):
    """Return the backscattering cross section of a sediment's volume per area of its boundary and steradian.

    grazing_rad : g, grazing angle between ray and boundary, radians, above 0..π/2; arrays broadcast
    density_ratio, speed_ratio, loss : δ, as `rayleigh_reflection` takes them; loss above 0
    volume_parameter : σ₂, the volume's cross section over its attenuation in dB per metre

    5 δ σ₂ |1 − R²|² sin² g / (ν ln 10 |P|² Im P), P = √(κ² − cos² g), κ = (1 + iδ)/ν, ν = speed_ratio: the sound that
    enters is scattered, and attenuated on both ways. It does not depend on the frequency, as the attenuation is
    proportional to it.

    Source: APL-UW TR 9407, 1994, ch. IV

    >>> medium_silt = sediment_backscattering(np.pi / 4, 1.149, 0.9885, 0.00676, 0.001)
    >>> round(float(10 * np.log10(medium_silt)), 1)
    -28.3
    """
    g = np.asarray(grazing_rad, np.float64)
    below = np.sqrt(((1 + 1j * loss) / speed_ratio) ** 2 - np.cos(g) ** 2)
    entering = np.abs(1 - rayleigh_reflection(g, density_ratio, speed_ratio, loss) ** 2) ** 2
    scattered = 5 * loss * volume_parameter * entering * np.sin(g) ** 2
    return scattered / (speed_ratio * math.log(10) * np.abs(below) ** 2 * np.imag(below))


def coherent_loss(grazing_rad, roughness_m, wavenumber_rad_m):
    """Return the factor of a rough boundary on the coherently reflected amplitude, 0..1: exp(−2 (k σ sin g)²).

    grazing_rad : g, grazing angle between ray and boundary, radians, 0..π/2; arrays broadcast
    roughness_m : σ, rms height of the roughness, metres
    wavenumber_rad_m : k, 2π over the wavelength, radians per metre

    Source: Eckart, "The scattering of sound from the sea surface", J. Acoust. Soc. Am. 25, 566-570, 1953

    >>> k = 2 * np.pi * 900e3 / 1500
    >>> round(float(20 * np.log10(coherent_loss(np.radians(10), 0.5e-3, k))), 2)
    -1.86
    """
    sigma, k = np.asarray(roughness_m, np.float64), np.asarray(wavenumber_rad_m, np.float64)
    return np.exp(-2 * (k * sigma * np.sin(grazing_rad)) ** 2)


def bubble_backscattering(radius_m):
    """Return the backscattering cross section σ_bs of a bubble, m² per steradian: a²/4.

    radius_m : a, metres, any shape

    It holds for ka >> 1, k = 2π/λ, where a sphere reflects all sound that meets it: at 900 kHz a bubble of 1 mm has
    ka = 3.8. The formula for a resonant bubble, a² / ((f₀²/f² − 1)² + δ²), holds for bubbles that are small against
    the wavelength; here it would give 1/k², since its damping δ tends to ka.

    Source: Urick, Principles of Underwater Sound, 3rd ed., 1983

    >>> (10 * np.log10(bubble_backscattering(np.array([1e-3, 2.5e-3, 10e-3])))).round(1).tolist()
    [-66.0, -58.1, -46.0]
    """
    return np.asarray(radius_m, np.float64) ** 2 / 4


def bubble_extinction(radius_m):
    """Return the extinction cross section of a bubble, m²: 2πa², twice its geometric cross section.

    radius_m : a, metres, any shape

    One half meets the bubble; the other half is diffracted around it by about λ/(2πa), 3 to 15 degrees for radii
    of 5 to 1 mm at 900 kHz. That is wider than a beam: diffracted sound returns as a faint haze from other directions
    and is neglected. Beyond a²/λ, 6 cm at most for radii up to 1 cm, diffraction fills the shadow of a single bubble,
    and the attenuation by many bubbles is even.

    Source: van de Hulst, Light Scattering by Small Particles, 1957

    >>> round(float(bubble_extinction(2.5e-3) / (np.pi * 2.5e-3**2)), 9)
    2.0
    """
    return 2 * math.pi * np.asarray(radius_m, np.float64) ** 2
