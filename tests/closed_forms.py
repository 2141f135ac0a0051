"""Exact pings of simple scenes, profile `ideal`: the echo of bins at one azimuth, integrated over a beam.

Sonar frame: x along boresight, y to port, z up. All functions of one azimuth ψ give dE/dψ of each bin in
steradians per radian, μ = 1. Derivations: 1/r and cos θ along a plane depend on the ray alone, so bins of
range are intervals of elevation, over which cos θ cos φ dφ integrates in closed form.
"""

import math

import numpy as np


def plane_echo(normal, distance, azimuth, elevations, edges):
    """dE/dψ of the plane normal . x = distance, seen between two elevations.

    At fixed ψ the cosine is A cos(φ − φ0), so r rises with |φ − φ0|, and the integral of
    A cos(φ − φ0) cos φ dφ is (A/2) [φ cos φ0 + sin(2 φ − φ0) / 2].
    """
    nx, ny, nz = normal
    g = nx * math.cos(azimuth) + ny * math.sin(azimuth)
    A, phi0 = math.hypot(g, nz), math.atan2(nz, g)
    spread = np.arccos(np.clip(distance / (A * np.maximum(edges, 1e-12)), -1, 1))

    def integral(low, high):
        low, high = np.clip(low, *elevations), np.clip(high, *elevations)
        at = lambda phi: A / 2 * (phi * math.cos(phi0) + np.sin(2 * phi - phi0) / 2)  # noqa: E731
        return at(np.maximum(low, high)) - at(low)

    return integral(phi0 + spread[:-1], phi0 + spread[1:]) + integral(phi0 - spread[1:], phi0 - spread[:-1])


def sphere_echo(radius, distance, azimuth, elevation_max, edges):
    """dE/dψ of a sphere on the boresight, whole or cut by the aperture."""
    a, d = radius, distance
    P2 = 1 - (d / a * math.sin(azimuth)) ** 2
    if P2 <= 0:
        return np.zeros(len(edges) - 1)
    P, Q = math.sqrt(P2), d / a * math.cos(azimuth)
    L2 = d * d - a * a
    # along ψ the nearest point is at φ = 0, the tangent where the square root ends
    nearest = d * math.cos(azimuth) - math.sqrt(a * a - (d * math.sin(azimuth)) ** 2)
    r = np.clip(edges, nearest, math.sqrt(L2))
    C = (r * r + L2) / (2 * r * d) / math.cos(azimuth)
    s = np.sqrt(np.clip(1 - C * C, 0, None))
    s = np.minimum(s, min(P / Q, math.sin(elevation_max)))
    F = 0.5 * (
        s * np.sqrt(np.clip(P2 - Q * Q * s * s, 0, None)) + P2 / Q * np.arcsin(np.clip(Q * s / P, -1, 1))
    )
    return 2 * np.diff(F)


def cylinder_echo(radius, distance, azimuth, z_low, z_high, elevation_max, edges):
    """dE/dψ of an upright cylinder, axis at `distance`, from height z_low to z_high over the sonar.

    At fixed ψ it is a wall at ρ whose normal is turned by θ_h from the ray.
    """
    inside = radius**2 - (distance * math.sin(azimuth)) ** 2
    if inside <= 0:
        return np.zeros(len(edges) - 1)
    rho = distance * math.cos(azimuth) - math.sqrt(inside)
    cos_h = math.sqrt(1 - (distance / radius * math.sin(azimuth)) ** 2)
    elevations = (
        max(-elevation_max, math.atan2(z_low, rho)),
        min(elevation_max, math.atan2(z_high, rho)),
    )
    # a wall at ρ across the ray, cosine scaled by cos θ_h
    return cos_h * plane_echo((1, 0, 0), rho, 0.0, elevations, edges)


def plate_on_floor_echo(height, top, x0, azimuth, elevation_max, edges):
    """(plate, floor) dE/dψ of a plate `top` tall across the boresight at x0, on a floor `height` below."""
    X = x0 / math.cos(azimuth)
    foot, head = -math.atan2(height, X), -math.atan2(height - top, X)
    clip = lambda *pair: tuple(np.clip(pair, -elevation_max, elevation_max))  # noqa: E731
    plate = plane_echo((1, 0, 0), x0, azimuth, clip(foot, head), edges)
    floor = (0, 0, -1)
    before = plane_echo(floor, height, azimuth, clip(-math.pi / 2, foot), edges)
    behind = plane_echo(floor, height, azimuth, clip(head, 0.0), edges)
    return plate, before + behind


def box_beams(sonar, echo, nodes=400):
    """(B, K) ping of box beams: `echo(azimuth)` averaged over each beam, over the beam's solid angle."""
    half = math.radians(sonar.beam_width_deg) / 2
    offsets = half * ((np.arange(nodes) + 0.5) / nodes * 2 - 1)
    aperture = 2 * math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    return (
        np.array([np.mean([echo(axis + offset) for offset in offsets], axis=0) for axis in sonar.azimuth_rad])
        / aperture
    )
