"""Exact pings of simple scenes, profile `ideal`: closed forms of the echo at one azimuth, averaged over a beam.

Sonar frame: x along boresight, y to port, z up. Functions of azimuths ψ, shape (N, 1), return dE/dψ of each bin, shape
(N, K), in steradians per radian, for μ = 1. On a plane 1/r and cos θ depend on the ray only, so range bins are
intervals of elevation, over which cos θ cos φ dφ has a closed form.
"""

import math

import numpy as np


def plane_echo(normal, distance, azimuth, elevations, edges):
    """Return dE/dψ of the plane normal . x = distance between two elevations.

    At fixed ψ the cosine is A cos(φ − φ0), so r rises with |φ − φ0|, and the integral of
    A cos(φ − φ0) cos φ dφ is (A/2) [φ cos φ0 + sin(2 φ − φ0) / 2].
    """
    nx, ny, nz = normal
    g = nx * np.cos(azimuth) + ny * np.sin(azimuth)
    A, phi0 = np.hypot(g, nz), np.arctan2(nz, g)
    spread = np.arccos(np.clip(distance / (A * np.maximum(edges, 1e-12)), -1, 1))

    def antiderivative(phi):
        phi = np.clip(phi, *elevations)
        return A / 2 * (phi * np.cos(phi0) + np.sin(2 * phi - phi0) / 2)

    return np.diff(antiderivative(phi0 + spread)) - np.diff(antiderivative(phi0 - spread))


def sphere_echo(radius, distance, azimuth, elevation_max, edges):
    """Return dE/dψ of a sphere on the boresight, which the aperture may cut."""
    a, d = radius, distance
    P2 = 1 - (d / a * np.sin(azimuth)) ** 2
    met = P2 > 0
    P, Q = np.sqrt(np.where(met, P2, 1)), d / a * np.cos(azimuth)
    L2 = d * d - a * a
    # at fixed ψ the nearest point has φ = 0, and the tangent point a square root of 0
    nearest = d * np.cos(azimuth) - a * P
    r = np.clip(edges, nearest, math.sqrt(L2))
    C = (r * r + L2) / (2 * r * d) / np.cos(azimuth)
    s = np.sqrt(np.clip(1 - C * C, 0, None))
    s = np.minimum(s, np.minimum(P / Q, math.sin(elevation_max)))
    root, arc = np.sqrt(np.clip(P * P - Q * Q * s * s, 0, None)), np.arcsin(np.clip(Q * s / P, -1, 1))
    return np.where(met, np.diff(s * root + P * P / Q * arc), 0)


def cylinder_echo(radius, distance, azimuth, z_low, z_high, elevation_max, edges):
    """Return dE/dψ of an upright cylinder with its axis at `distance`, from height z_low to z_high over the sonar.

    At fixed ψ it acts as a wall at ρ across the ray, with a cosine scaled by cos θ_h of the horizontal incidence.
    """
    inside = radius**2 - (distance * np.sin(azimuth)) ** 2
    met = inside > 0
    root = np.sqrt(np.where(met, inside, 0))
    rho = distance * np.cos(azimuth) - root
    elevations = (
        np.maximum(-elevation_max, np.arctan2(z_low, rho)),
        np.minimum(elevation_max, np.arctan2(z_high, rho)),
    )
    return np.where(met, root / radius * plane_echo((1, 0, 0), rho, 0 * azimuth, elevations, edges), 0)


def plate_on_floor_echo(height, top, x0, azimuth, elevation_max, edges):
    """Return dE/dψ of a plate of height `top` at x0 on a floor `height` below the sonar, with its shadow."""
    X = x0 / np.cos(azimuth)
    foot, head = -np.arctan2(height, X), -np.arctan2(height - top, X)
    floor = (0, 0, -1)
    low, high = -elevation_max, elevation_max
    plate = plane_echo((1, 0, 0), x0, azimuth, (np.clip(foot, low, high), np.clip(head, low, high)), edges)
    before = plane_echo(floor, height, azimuth, (low, np.clip(foot, low, high)), edges)
    behind = plane_echo(floor, height, azimuth, (np.clip(head, low, high), 0.0), edges)
    return plate + before + behind


def floor_echo(height, pitch_rad, azimuth, elevation_pattern, edges):
    """Return dE/dψ of a floor by the midpoint rule over all sines of elevation, weighed by a pattern.

    elevation_pattern : function (sine of elevation) -> two-way power; azimuth : shape (N, 1)
    """
    nodes = 400_000
    sine = (np.arange(nodes) + 0.5) / nodes * 2 - 1
    weight, out = elevation_pattern(sine) * 2 / nodes, []
    for psi in azimuth[:, 0]:
        x = np.sqrt(1 - sine * sine) * np.cos(psi)
        cosine = x * math.sin(pitch_rad) - sine * math.cos(pitch_rad)  # of incidence
        met = cosine > 0
        out.append(np.histogram(height / cosine[met], edges, weights=(weight * cosine)[met])[0])
    return np.array(out)


def box_beams(sonar, echo, nodes=200):
    """Return a ping of box beams, (B, K): `echo(azimuth)` averaged over each beam, per solid angle of the beam."""
    half = math.radians(sonar.beam_width_deg) / 2
    offsets = half * ((np.arange(nodes) + 0.5) / nodes * 2 - 1)
    aperture = 2 * math.sin(math.radians(sonar.elevation_fov_deg) / 2)
    beams = [echo((axis + offsets)[:, None]).mean(axis=0) for axis in sonar.azimuth_rad]
    return np.array(beams) / aperture
