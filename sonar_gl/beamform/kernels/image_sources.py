"""Image sources: multipath echoes by way of a planar reflector.

S is the sonar, S' its image behind the reflector. S' sees through the reflector what S sees in it. The samples of each
are summed and looked up in the view of the other: an echo that goes straight one way and by way of the reflector the
other needs both ways open.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import int64, uint64

from sonar_gl.beamform.kernels.footprints import find_footprints
from sonar_gl.beamform.kernels.range_bins import BinTable
from sonar_gl.beamform.kernels.spreading import SHORT_RAMP, spread_footprints
from sonar_gl.beamform.kernels.strips import LEAST_AHEAD, Lattice, StripTable, find_strip
from sonar_gl.beamform.kernels.views import ViewIndex, find_sector, find_surfaces
from sonar_gl.beamform.kernels.work_table import (
    ALONG,
    ALONG_U,
    BISTATIC,
    BORDER,
    ECHO,
    ENERGY,
    LEG_X,
    LEG_Y,
    LEG_Z,
    LINE_U,
    REFLECTED,
    REST,
    SEEN,
    SIDE,
    SLANT,
    TILT,
    WORK_COLUMNS,
    WORK_ROWS,
    A,
    B,
    S,
    X,
    Y,
    Z,
)
from sonar_gl.core.compiled import as_table, compiled, inlined, uncounted

# Two views of one place may differ by so much of its distance; less on a reflector, which is flat.
SAME_PLACE, SAME_PLANE = 2e-3, 2e-4
MIN_REFLECTED = 1e-4  # of the intensity: what reflects less is no reflector
GRID, SKIRTS_GRID = 24, 12  # directions along each side of a sector that are tried, and of one of the skirts
HORIZON = 1e-9  # 1/x of a plane past its horizon


class Interference(NamedTuple):
    """How the two ways of a single-bounce echo interfere in the beams that receive both.

    correlation, reach : of `Acoustics.receive_correlation`; a table of no length: they do not interfere
    is_straight : one straight array forms all beams, by the difference of sines, not by the sine of the difference
    """

    correlation: np.ndarray
    reach: float
    is_straight: bool


class Reflection(NamedTuple):
    """Geometry of the image source behind one planar reflector, for the samples of one sector.

    azimuth_rad : of the sector's middle
    to_other : (4, 4) from the frame of these samples' own sonar (S or S') to that of the other one
    ceiling : (4,) a · x > offset of what lies above the water's surface, in the frame of S
    from_image : these are samples of S': echoes by way of the reflector both ways are summed, too
    interference : plain tuple of Interference
    index, other_index : plain tuples of ViewIndex of S, and of the other one
    plane : (4,) normal and offset of normal · x = offset in the frame of S, offset > 0
    is_body : the reflector is a body and must be seen there; the water's surface is not seen
    reflected_intensity : (n,) by the sine of the grazing angle, 0 to 1
    """

    azimuth_rad: float
    to_other: np.ndarray
    ceiling: np.ndarray
    from_image: bool
    interference: tuple
    index: tuple
    other_index: tuple
    plane: np.ndarray
    is_body: bool
    reflected_intensity: np.ndarray


class SectorFrame(NamedTuple):
    """The geometry of a `Reflection` in the frame of its sector.

    own, other : (3, 4) from the sector's frame to that of its own sonar (S or S'), and to the other's
    ceiling : (4,) of `Reflection`
    """

    own: np.ndarray
    other: np.ndarray
    ceiling: np.ndarray


@compiled
def estimate_reflection(
    view, planes, are_bodies, reflected_intensities, range_max_m, elevation_pattern, reflected
):
    """Estimate, on a coarse grid of directions, how much intensity reflectors return, and the direct echo.

    Returns the direct echo.

    view : tuple of ViewIndex
    planes, are_bodies, reflected_intensities : (n, 4), (n,) and (n, sines) of n reflectors, as in `Reflection`
    elevation_pattern : as in `sum_footprints`
    reflected : (n,) float64, overwritten; in the unit of the direct echo
    """
    view = ViewIndex(*view)
    plane_echo, sectors = view
    work = np.empty((4, GRID * GRID))
    x, y, z, seen = work[0], work[1], work[2], work[3]
    echo = 0.0
    reflected[:] = 0.0
    for k in range(sectors.shape[0]):
        t = sectors[k]
        middle, half = (t.tan_high + t.tan_low) / 2, (t.tan_high - t.tan_low) / 2
        n = GRID if t.tan_low < 0.0 < t.tan_high else SKIRTS_GRID
        area = (2 * t.tan_half_width / n) * (2 * half / n)
        for g in range(n * n):
            u = t.tan_half_width * ((2 * (g % n) + 1) / n - 1)
            v = math.sqrt(1.0 + u * u) * (middle + half * ((2 * (g // n) + 1) / n - 1))
            x[g], y[g], z[g] = t.cos + t.sin * u, t.sin - t.cos * u, v
        find_surfaces(x, y, z, 0, n * n, view, seen)
        for g in range(n * n):
            if seen[g] < 0.0:
                continue
            u, v = t.sin * x[g] - t.cos * y[g], z[g]
            length = math.sqrt(1.0 + u * u + v * v)
            # a step in tan is one in v that is wider by the root of 1 + u^2
            weight = two_way = area * math.sqrt(1.0 + u * u) / length**3
            # of an echo by way of a reflector, one leg may lie on the boresight
            if elevation_pattern.shape[0]:
                power = _elevation_power(elevation_pattern, v / length)
                weight, two_way = weight * math.sqrt(power), weight * power
            if seen[g] > 0.0 and length / seen[g] < range_max_m:
                du, dv = u - t.u0, v - t.v0
                # half way between two samples, rounding may give another one than the one seen, also beside the window
                i = min(max(math.floor(t.iu * du + t.iv * dv + 0.5), 0.0), t.columns - 1.0)
                j = min(max(math.floor(t.ju * du + t.jv * dv + 0.5), 0.0), t.rows - 1.0)
                at = plane_echo[int(j), int(t.left + i), 3]
                echo += two_way * at * seen[g] / length
            for p in range(planes.shape[0]):
                along = planes[p, 0] * x[g] + planes[p, 1] * y[g] + planes[p, 2] * z[g]
                if along <= 0.0 or planes[p, 3] * length >= range_max_m * along:
                    continue
                if _is_first(seen[g] * planes[p, 3] / along, are_bodies[p]):
                    m, rest = _place_in_table(along / length, reflected_intensities.shape[1])
                    lower, upper = reflected_intensities[p, m], reflected_intensities[p, m + 1]
                    reflected[p] += weight * (lower + rest * (upper - lower))
    return echo


@compiled
def expect_imaged(samples, lattice, sectors, plane, step, range_max_m, elevation_pattern, sums):
    """Find how many samples the sonar's image behind a plane would have on what the sonar sees, if nothing hid it.

    samples : (plane_echo, body_id) of `SectorSamples` of the sonar, in `whole_rows`
    lattice : of `SectorSamples`
    sectors : of ViewIndex of the sonar. Its image has the same, mirrored
    plane : (4,) of `Reflection`
    step : one of so many columns and rows is read
    range_max_m : of the sonar
    elevation_pattern : as in `sum_footprints`
    sums : (4, bodies + 1) by number, added to: samples that are read; how many of the image fill the same solid angle
        there; the echo of those that are read; the part of it that goes one way by the plane, were that a mirror
    """
    (plane_echo, body_id), lattice = samples, Lattice(*lattice)
    area = lattice.u[1] * lattice.v[2] - lattice.u[2] * lattice.v[1]
    for j in range(step // 2, plane_echo.shape[0], step):
        for i in range(step // 2, lattice.columns, step):
            q = float(plane_echo[j, i, 0])
            if q <= 0.0 or plane_echo[j, i, 3] <= 0.0:
                continue
            u = lattice.u[0] + lattice.u[1] * i + lattice.u[2] * j
            v = lattice.v[0] + lattice.v[1] * i + lattice.v[2] * j
            x, y, z = (lattice.cosine + lattice.sine * u) / q, (lattice.sine - lattice.cosine * u) / q, v / q
            own_m = math.sqrt(x * x + y * y + z * z)
            own_sine, before_m = z / own_m, plane[3] - (plane[0] * x + plane[1] * y + plane[2] * z)
            # the image sees this place where the sonar would see the place's own mirror image
            x, y, z = x + 2 * before_m * plane[0], y + 2 * before_m * plane[1], z + 2 * before_m * plane[2]
            image_m = math.sqrt(x * x + y * y + z * z)
            solid_angle = area / (own_m * q) ** 3
            echo = one_way = plane_echo[j, i, 3] * solid_angle / own_m
            if elevation_pattern.shape[0]:
                power = _elevation_power(elevation_pattern, own_sine)
                echo *= power
                one_way *= math.sqrt(power * _elevation_power(elevation_pattern, z / image_m))
            body = body_id[j, i]
            sums[0, body] += 1.0
            sums[2, body] += echo
            k = find_sector(x, y, z, sectors)
            is_on_plane = before_m <= SAME_PLACE * own_m
            if k < 0 or is_on_plane or (own_m + image_m) / 2 >= range_max_m:
                continue
            t = sectors[k]
            per_steradian = (t.iu * t.jv - t.iv * t.ju) * (image_m / (t.cos * x + t.sin * y)) ** 3
            sums[1, body] += per_steradian * solid_angle * (own_m / image_m) ** 2
            sums[3, body] += one_way


@compiled
def sum_image_source(work, plane_echo, lattice, strips, bins, elevation_pattern, reflection, sums, spans):
    """Add some of one sector's samples to columns and bins, as a planar reflector returns them.

    Returns whether any of the samples is seen in the reflector.

    work .. elevation_pattern : as in `sum_footprints`; samples of the sonar, or of its image
    reflection : tuple of Reflection
    sums, spans : as in `sum_footprints`; the rows of these strips are added to
    """
    lattice, strips, bins = Lattice(*lattice), StripTable(*strips), BinTable(*bins)
    reflection = Reflection(*reflection)
    frame = _sector_frame(reflection)
    view, other_view = reflection.index, reflection.other_index
    work, no_face_id = as_table(work, WORK_ROWS, WORK_COLUMNS), np.empty((0, 0), np.int32)
    leg_x, leg_y, leg_z, seen = work[LEG_X], work[LEG_Y], work[LEG_Z], work[SEEN]
    is_reflected = False
    for p in range(strips.middle.shape[0]):
        strip = find_strip(work, plane_echo, no_face_id, lattice, strips, p, bins.q_unseen, (0.0, 0.0))
        if strip.first == strip.last:
            continue
        find_other_leg(work, strip, frame.other)
        _find_rays_by_reflector(work, strip, frame, reflection)
        find_surfaces(leg_x, leg_y, leg_z, strip.first, strip.last, view, seen)
        reflected_first, reflected_last = _keep_seen(work, strip, reflection)
        if reflected_first >= reflected_last:
            continue
        find_surfaces(leg_x, leg_y, leg_z, reflected_first, reflected_last, other_view, seen)
        first, last = _find_bistatic(work, reflected_first, reflected_last, elevation_pattern)
        is_reflected = True
        if reflection.from_image:
            find_footprints(work, strip, elevation_pattern, bins.per_metre)
            for m in range(reflected_first, reflected_last):
                work[ENERGY, m] *= work[REFLECTED, m] * work[REFLECTED, m]
            spread_footprints(
                work, reflected_first, reflected_last, sums, spans, strip.column, bins, SHORT_RAMP
            )
        if first < last:
            find_single_bounce(work, strip, first, last, frame.other)
            add_interference(work, strip, first, last, frame.own, Interference(*reflection.interference))
            spread_footprints(work, first, last, sums, spans, strip.column, bins, SHORT_RAMP)
    return is_reflected


@inlined
def _sector_frame(reflection):
    """Return the SectorFrame of a Reflection."""
    own, other, ceiling = np.zeros((3, 4)), np.empty((3, 4)), np.empty(4)
    cos, sin, to = math.cos(reflection.azimuth_rad), math.sin(reflection.azimuth_rad), reflection.to_other
    own[0, 0] = own[1, 1] = cos
    own[0, 1], own[1, 0], own[2, 2] = -sin, sin, 1.0
    for k in range(3):
        other[k, 0], other[k, 1] = to[k, 0] * cos + to[k, 1] * sin, to[k, 1] * cos - to[k, 0] * sin
        other[k, 2], other[k, 3] = to[k, 2], to[k, 3]
    from_sector, up = other if reflection.from_image else own, reflection.ceiling
    for k in range(4):
        ceiling[k] = up[0] * from_sector[0, k] + up[1] * from_sector[1, k] + up[2] * from_sector[2, k]
    ceiling[3] = up[3] - ceiling[3]
    return SectorFrame(own, other, ceiling)


@inlined
def find_other_leg(work, strip, other):
    """Find where a strip's samples lie for the other of S and S', and whether that is before their surface."""
    rest, along_u, along, border = work[REST], work[ALONG_U], work[ALONG], work[BORDER]
    line_u, tilt, first, last = work[LINE_U], work[TILT], strip.first, strip.last
    a, b, c, d = other[:, 0], other[:, 1], other[:, 2], other[:, 3]
    # position of the other one, in the frame of this sector
    ox = -(a[0] * d[0] + a[1] * d[1] + a[2] * d[2])
    oy = -(b[0] * d[0] + b[1] * d[1] + b[2] * d[2])
    oz = -(c[0] * d[0] + c[1] * d[1] + c[2] * d[2])
    for m in range(uint64(first), uint64(last)):
        vc = (border[m] + border[uint64(m + 1)]) / 2
        uc, along_v = line_u[m] + tilt[m] * vc, along[m] - along_u[m] * tilt[m]
        depth = 1.0 / max(rest[m] + along[m] * vc, HORIZON)
        work[X, m] = (a[0] - b[0] * uc + c[0] * vc) * depth + d[0]
        work[Y, m] = (a[1] - b[1] * uc + c[1] * vc) * depth + d[1]
        work[Z, m] = (a[2] - b[2] * uc + c[2] * vc) * depth + d[2]
        work[SIDE, m] = 1.0 - ((rest[m] - along_u[m] * line_u[m]) * ox - along_u[m] * oy + along_v * oz)


@inlined
def _find_rays_by_reflector(work, strip, frame, reflection):
    """Find for a strip's samples what a reflector reflects there, and the direction in which the sonar sees it.

    Samples that cannot return anything have no direction, and a reflected intensity of 0.
    """
    rest, along, border, echo = work[REST], work[ALONG], work[BORDER], work[ECHO]
    line_u, tilt, from_image = work[LINE_U], work[TILT], reflection.from_image
    reflected_intensity = reflection.reflected_intensity
    there_x, there_y, there_z, side = work[X], work[Y], work[Z], work[SIDE]
    leg_x, leg_y, leg_z, reflected = work[LEG_X], work[LEG_Y], work[LEG_Z], work[REFLECTED]
    bistatic, own, ceiling, plane = work[BISTATIC], frame.own, frame.ceiling, reflection.plane
    x_0, x_u, x_v, y_0, y_u, y_v = own[0, 0], own[0, 1], own[0, 2], own[1, 0], own[1, 1], own[1, 2]
    z_0, z_u, z_v = own[2, 0], own[2, 1], own[2, 2]
    normal_x, normal_y, normal_z, offset = plane[0], plane[1], plane[2], plane[3]
    up_0, up_u, up_v, top = ceiling[0], ceiling[1], ceiling[2], ceiling[3]
    # without branches, so that the compiler can vectorise it
    for m in range(uint64(strip.first), uint64(strip.last)):
        low, high = border[m], border[uint64(m + 1)]
        vc = (low + high) / 2
        uc, q = line_u[m] + tilt[m] * vc, rest[m] + along[m] * vc
        x, y, z = x_0 - x_u * uc + x_v * vc, y_0 - y_u * uc + y_v * vc, z_0 - z_u * uc + z_v * vc
        # what lies behind the reflector's plane, or turns away from the other one, meets no sound by way of it
        is_met = (side[m] > 0.0) & (normal_x * x + normal_y * y + normal_z * z <= offset * q)
        is_met |= from_image
        is_met &= (echo[m] > 0.0) & (high > low) & (q > HORIZON) & (up_0 - up_u * uc + up_v * vc <= top * q)
        x = x if from_image else there_x[m]
        y = -y if from_image else -there_y[m]  # the image has port and starboard exchanged
        z = z if from_image else there_z[m]
        sine = (normal_x * x + normal_y * y + normal_z * z) / math.sqrt(x * x + y * y + z * z)
        is_met &= sine > 1e-6
        reflected[m] = sine if is_met else 0.0
        leg_x[m], leg_y[m], leg_z[m] = x if is_met else 0.0, y if is_met else 0.0, z if is_met else 0.0
        bistatic[m] = 0.0
    for m in range(uint64(strip.first), uint64(strip.last)):
        if reflected[m] > 0.0:
            k, between = _place_in_table(reflected[m], reflected_intensity.shape[0])
            lower, upper = reflected_intensity[k], reflected_intensity[k + 1]
            reflected[m] = lower + between * (upper - lower)
            if reflected[m] < MIN_REFLECTED:
                reflected[m] = leg_x[m] = leg_y[m] = leg_z[m] = 0.0


@inlined
def _keep_seen(work, strip, reflection):
    """Set the reflected intensity to 0 where the sonar does not see the reflector; turn to the other one.

    Returns first, last: samples that are reflected, from the first to before the last.
    """
    plane, is_body, first, last = reflection.plane, reflection.is_body, strip.last, strip.first
    for m in range(strip.first, strip.last):
        if work[REFLECTED, m] == 0.0:
            continue
        leg_x, leg_y, leg_z = work[LEG_X, m], work[LEG_Y, m], work[LEG_Z, m]
        work[LEG_X, m] = work[LEG_Y, m] = work[LEG_Z, m] = 0.0
        seen = work[SEEN, m]
        distance_ratio = seen * plane[3] / (plane[0] * leg_x + plane[1] * leg_y + plane[2] * leg_z)
        if seen < 0.0 or not _is_first(distance_ratio, is_body):
            work[REFLECTED, m] = 0.0
            continue
        first, last = min(first, m), m + 1
        if work[SIDE, m] > 0.0:
            x, y, z = work[X, m], work[Y, m], work[Z, m]
            work[LEG_X, m], work[LEG_Y, m], work[LEG_Z, m] = x, y, z
    return first, last


@inlined
def _find_bistatic(work, begin, end, elevation_pattern):
    """Find the bistatic echo per steradian of a strip's samples that the other one sees, from `begin` to before `end`.

    Returns first, last: samples with such an echo, from the first to before the last.
    """
    border, line_u, tilt, echo = work[BORDER], work[LINE_U], work[TILT], work[ECHO]
    there_x, there_y, there_z, side = work[X], work[Y], work[Z], work[SIDE]
    # directions are no longer needed: their rows take the sines of elevation here and there
    seen, bistatic, sine_here, sine_there = work[SEEN], work[BISTATIC], work[LEG_X], work[LEG_Y]
    for m in range(uint64(begin), uint64(end)):
        x, y, z = there_x[m], there_y[m], there_z[m]
        range_there = math.sqrt(x * x + y * y + z * z)
        vc = (border[m] + border[uint64(m + 1)]) / 2
        uc = line_u[m] + tilt[m] * vc
        sine_here[m], sine_there[m] = vc / math.sqrt(1.0 + uc * uc + vc * vc), z / range_there
        is_seen = (seen[m] >= 0.0) & (seen[m] <= 1.0 + SAME_PLACE)
        bistatic[m] = min(echo[m] * side[m] / range_there, 1.0) if is_seen else 0.0
    first, last = end, begin
    for m in range(uint64(begin), uint64(end)):
        if bistatic[m] == 0.0:
            continue
        if elevation_pattern.shape[0]:  # insonified in one direction, received in the other
            here = _elevation_power(elevation_pattern, sine_here[m])
            bistatic[m] *= math.sqrt(here * _elevation_power(elevation_pattern, sine_there[m]))
        first, last = min(first, int64(m)), int64(m) + 1
    return first, last


@inlined
def find_single_bounce(work, strip, first, last, other):
    """Find the footprints of echoes that go one way straight and the other by way of the reflector.

    first, last : samples of the strip, from the first to before the last
    """
    rest, along_u, along, border = work[REST], work[ALONG_U], work[ALONG], work[BORDER]
    line_u, tilt, width = work[LINE_U], work[TILT], strip.width
    # numbers, not arrays, so that the compiler can vectorise the loop
    a0, a1, a2, b0, b1, b2 = other[0, 0], other[1, 0], other[2, 0], other[0, 1], other[1, 1], other[2, 1]
    c0, c1, c2, d0, d1, d2 = other[0, 2], other[1, 2], other[2, 2], other[0, 3], other[1, 3], other[2, 3]
    for m in range(uint64(first), uint64(last)):
        low, high = border[m], border[uint64(m + 1)]
        vc, height = (low + high) / 2, max(high - low, 0.0)
        uc = line_u[m] + tilt[m] * vc
        e0, e1, e2 = a0 - b0 * uc, a1 - b1 * uc, a2 - b2 * uc
        q = max(rest[m] + along[m] * vc, HORIZON)
        u2 = 1.0 + uc * uc
        length2 = u2 + vc * vc
        there_x, there_y, there_z = work[X, m], work[Y, m], work[Z, m]
        length = math.sqrt(length2)
        range_there = math.sqrt(there_x * there_x + there_y * there_y + there_z * there_z)
        s = 2.0 / (length / q + range_there)
        across = width
        if strip.are_cones:  # as in `find_footprints`
            across *= length2 * length / max(strip.cosine * (1.0 + vc * vc) + strip.sine * uc, LEAST_AHEAD)
        # across, where strips are narrow: by how both ranges change with u
        x, x_u = 1.0 / q, -along_u[m] / (q * q)
        r_u = (uc * x + length2 * x_u) / length
        r_u += there_x / range_there * ((e0 + c0 * vc) * x_u - b0 * x)
        r_u += there_y / range_there * ((e1 + c1 * vc) * x_u - b1 * x)
        r_u += there_z / range_there * ((e2 + c2 * vc) * x_u - b2 * x)
        # up and down, where planes may extend far: at both ends
        low_x = 1.0 / max(rest[m] + along[m] * low, HORIZON)
        high_x = 1.0 / max(rest[m] + along[m] * high, HORIZON)
        end_u = line_u[m] + tilt[m] * low
        tx, ty = (a0 - b0 * end_u + c0 * low) * low_x + d0, (a1 - b1 * end_u + c1 * low) * low_x + d1
        tz = (a2 - b2 * end_u + c2 * low) * low_x + d2
        end_length = math.sqrt(1.0 + end_u * end_u + low * low)
        low_s = 2.0 / (end_length * low_x + math.sqrt(tx * tx + ty * ty + tz * tz))
        end_u = line_u[m] + tilt[m] * high
        tx, ty = (a0 - b0 * end_u + c0 * high) * high_x + d0, (a1 - b1 * end_u + c1 * high) * high_x + d1
        tz = (a2 - b2 * end_u + c2 * high) * high_x + d2
        end_length = math.sqrt(1.0 + end_u * end_u + high * high)
        high_s = 2.0 / (end_length * high_x + math.sqrt(tx * tx + ty * ty + tz * tz))
        work[S, m], work[A, m], work[B, m] = s, abs(r_u) * s * s * across / 4, abs(high_s - low_s) / 2
        work[SLANT, m] = 0.0
        # r^-2 of the way there and back over that of the bin's gain, which is 1 / r'^2 of the mean range
        spreading = 1.0 / (s * range_there)
        strength = work[REFLECTED, m] * work[BISTATIC, m] * spreading * spreading
        work[ENERGY, m] = strength * across * height / (length * length2 * s)


@inlined
def add_interference(work, strip, first, last, own, interference):
    """Multiply single-bounce echoes by 1 + the correlation of their two bearings in the array.

    first, last : samples of the strip, from the first to before the last
    own : of SectorFrame
    interference : Interference
    """
    table, border, line_u, tilt = interference.correlation, work[BORDER], work[LINE_U], work[TILT]
    if not table.shape[0]:
        return
    scale = 1.0 / (interference.reach * interference.reach)
    x_0, x_u, x_v, y_0, y_u, y_v = own[0, 0], own[0, 1], own[0, 2], own[1, 0], own[1, 1], own[1, 2]
    for m in range(uint64(first), uint64(last)):
        vc = (border[m] + border[uint64(m + 1)]) / 2
        uc = line_u[m] + tilt[m] * vc
        x, y = x_0 - x_u * uc + x_v * vc, y_0 - y_u * uc + y_v * vc
        # the other leg reaches the sonar with port and starboard exchanged
        there_x, there_y, there_z = work[X, m], -work[Y, m], work[Z, m]
        if strip.are_cones:  # shown at the azimuth of the cone
            length2 = 1.0 + uc * uc + vc * vc
            x = math.sqrt(max(length2 - y * y, 0.0))
            there_x = math.sqrt(there_x * there_x + there_z * there_z)
        here_2, there_2 = x * x + y * y, there_x * there_x + there_y * there_y
        both = 1.0 / math.sqrt(here_2 * there_2)
        sine, cosine = (y * there_x - x * there_y) * both, x * there_x + y * there_y
        if interference.is_straight:
            sine, cosine = y / math.sqrt(here_2) - there_y / math.sqrt(there_2), 1.0
        k, rest = _place_in_table(sine * sine * scale if cosine > 0.0 else 1.0, table.shape[0])
        work[ENERGY, m] *= 1.0 + table[k] + rest * (table[k + 1] - table[k])


@uncounted
def _is_first(distance_ratio, is_body):
    """Return whether sound meets a reflector before anything else.

    distance_ratio : distance of the reflector over that of the surface seen in that direction
    is_body : of `Reflection`
    """
    return distance_ratio <= 1.0 + SAME_PLANE and (distance_ratio >= 1.0 - SAME_PLANE or not is_body)


@uncounted
def _place_in_table(share, n):
    """Return the entry of a table of n below a share of its length, and how far beyond it that lies, 0 to 1."""
    at = min(max(share, 0.0), 1.0) * (n - 1)
    k = min(int(at), n - 2)
    return k, at - k


@uncounted
def _elevation_power(elevation_pattern, sine):
    """Return the two-way elevation pattern at a sine of elevation."""
    k, rest = _place_in_table((sine + 1.0) / 2, elevation_pattern.shape[0])
    return max(elevation_pattern[k] + rest * (elevation_pattern[k + 1] - elevation_pattern[k]), 0.0)
