"""Shade the samples of a visibility buffer: their echoes, and the specular lobes among these."""

from __future__ import annotations

import math

import numpy as np
from numba import uint64

from sonar_gl.core.compiled import compiled, inlined, uncounted
from sonar_gl.raster.cpu.kernels.tables import FLAT_DIFFUSE, NOTHING, ROW_SLOPE, ROW_STRENGTH, SINGLE

# of a sample's echo: a lobe that is less may change from sample to sample as it likes
FAINT_LOBE = 1e-2
NEARLY = 1.0 - 1e-6  # times what is compared: well above its rounding
FAINTEST = -60.0  # exponent of a lobe that counts: e^-60 is 260 dB below its peak
# Where shading normals turn from sample to sample, a lobe is widened to a normal distribution of this variance,
# samples², if it is narrower: with a deviation of 1/2, the sum of samples finds it to 3 % wherever it lies between
# them. It turns normals by no more than so many radians², as far as those of a body that few samples meet turn.
BLUR, MAX_TURN = 0.25, 0.1


@inlined
def lobe_times_range(echo, range_m, strength, slope):
    """Return the specular lobe times range of a sample, from cos θ times range; see `specular_lobe`."""
    cosine = min(max(echo / range_m, 1e-3), 1.0)
    square, s2 = cosine * cosine, np.float64(slope) * slope
    exponent = -0.5 * (1.0 - square) / (square * s2)
    if exponent < FAINTEST:
        return 0.0
    return strength * math.exp(exponent) / (8.0 * s2 * square * square * cosine) * range_m


@inlined
def _is_faint(cos_over_depth, over_depth2, slope):
    """Return whether a lobe is surely 0, as it is for most samples: without a root, a quotient or an exponential.

    cos_over_depth : cos θ times range over depth
    over_depth2 : square of range over depth
    """
    square = cos_over_depth * cos_over_depth
    return square * (1.0 - 2.0 * FAINTEST * slope * slope) < NEARLY * over_depth2


@compiled
def write_lobes(image, lobes, windows, lobes_alone):
    """Write a view in which bodies return their specular lobes alone, from the view in which they return all.

    image : plane_echo, body_id and face_id of the whole view, as for `shade`; face_id is not read
    lobes : of `shade`
    windows : (S, 5) int64, a window of samples of each sector: its first column in the images of the whole view and of
        the lobes, its first row, its columns and its rows
    lobes_alone : plane_echo, body_id and face_id of the lobes' image, overwritten in the windows
    """
    (whole, numbers, _), (plane_echo, body_id, face_id) = image, lobes_alone
    for s in range(uint64(len(windows))):
        from_left, left, bottom, columns, rows = windows[s]
        for j in range(uint64(rows)):
            row = uint64(bottom) + j
            for i in range(uint64(columns)):
                at, to = uint64(from_left) + i, uint64(left) + i
                for k in range(uint64(3)):
                    plane_echo[j, to, k] = whole[row, at, k]
                plane_echo[j, to, 3] = lobes[row, at]
                face_id[j, to] = SINGLE - np.int64(row) if lobes[row, at] > np.float32(0.0) else NOTHING
            if body_id.shape[0]:
                for i in range(uint64(columns)):
                    body_id[j, uint64(left) + i] = numbers[row, uint64(from_left) + i]


@inlined
def _shaded_echo(normal_forms, t, x, y, u, v, q, slope_u, slope_v, flat):
    """Return cos θ times range of a sample by its shading normal, which faces the side that is seen.

    t : row of `normal_forms`; x, y : column and row of the sample
    flat : the same of the face, where there is no normal
    """
    nx = normal_forms[t, 0] + normal_forms[t, 1] * x + normal_forms[t, 2] * y
    ny = normal_forms[t, 3] + normal_forms[t, 4] * x + normal_forms[t, 5] * y
    nz = normal_forms[t, 6] + normal_forms[t, 7] * x + normal_forms[t, 8] * y
    squares = nx * nx + ny * ny + nz * nz
    if not squares > 0.0:  # or NaN; float64 holds the squares of all float32
        return flat
    along_plane = nx * (q - slope_u * u - slope_v * v) - ny * slope_u + nz * slope_v
    along_ray = nx - ny * u + nz * v
    turned = along_ray if along_plane > 0.0 else -along_ray
    return max(turned, 0.0) / (math.sqrt(squares) * q)


@inlined
def widens_lobe(forms, x, y, slope):
    """Return whether `mean_lobe_times_range` may widen a lobe; else it is that of the sample's normal, found faster.

    It does so where normals turn by more than twice the roughness from one sample to the next, and they turn by no more
    than what a form changes by, over the length of the normal.

    forms : (9,) row of `normal_forms`; x, y : column and row of the sample
    """
    mx = forms[0] + forms[1] * x + forms[2] * y
    my = forms[3] + forms[4] * x + forms[5] * y
    mz = forms[6] + forms[7] * x + forms[8] * y
    across = forms[1] * forms[1] + forms[4] * forms[4] + forms[7] * forms[7]
    upward = forms[2] * forms[2] + forms[5] * forms[5] + forms[8] * forms[8]
    return not BLUR * max(across, upward) < NEARLY * slope * slope * (mx * mx + my * my + mz * mz)


@inlined
def mean_lobe_times_range(normal, ray, echo, range_m, strength, slope):
    """Return the specular lobe times range about a sample whose shading normal turns, from cos θ times range.

    The mean of the lobe by normals of a normal distribution is the lobe of a greater and uneven roughness, of variance
    Σ = s² + A a aᵀ + B b bᵀ, for normals that turn by a from column to column and by b from row to row; A is
    BLUR − s²/a², or 0, as a lobe is s/|a| samples wide anyway. With t the slope of the surface about the ray,
    |t| = tan θ, s⁻² exp(−t²/(2s²)) becomes |Σ|^−½ exp(−tᵀ Σ⁻¹ t / 2).

    normal : (9,) row of `normal_forms`, then column and row of the sample
    ray : its u and v

    Source: Kaplanyan, Hill, Patney, Lefohn, "Filtering distributions of normals for shading antialiasing", HPG 2016
    """
    forms, x, y = normal
    u, v = ray
    mx = forms[0] + forms[1] * x + forms[2] * y
    my = forms[3] + forms[4] * x + forms[5] * y
    mz = forms[6] + forms[7] * x + forms[8] * y
    square, ray2 = mx * mx + my * my + mz * mz, 1.0 + u * u + v * v
    if not square > 0.0:  # or NaN: the echo is that of the plane
        return lobe_times_range(echo, range_m, strength, slope)
    cosine, s2 = min(max(echo / range_m, 1e-3), 1.0), np.float64(slope) * slope
    turned, of_slope, both = 0.0, 0.0, 1.0  # A |a|² + B |b|² and A |t × a|² + B |t × b|², across the ray; A B
    for k in range(1, 3):
        fx, fy, fz = forms[k], forms[3 + k], forms[6 + k]
        along = (mx * fx + my * fy + mz * fz) / square
        ax, ay, az = fx - along * mx, fy - along * my, fz - along * mz
        of_ray = ax - ay * u + az * v
        turn = (ax * ax + ay * ay + az * az - of_ray * of_ray / ray2) / square
        blur = max(BLUR - s2 / max(turn, 1e-30), 0.0)
        turned, both = turned + blur * turn, both * blur
        triple = my * fz - mz * fy - u * (mz * fx - mx * fz) + v * (mx * fy - my * fx)
        of_slope += blur * triple * triple / (ray2 * square * square)
    triple = mx * (forms[4] * forms[8] - forms[7] * forms[5])
    triple += my * (forms[7] * forms[2] - forms[1] * forms[8])
    triple += mz * (forms[1] * forms[5] - forms[4] * forms[2])
    less, cosine2 = min(1.0, MAX_TURN / max(turned, 1e-30)), cosine * cosine
    determinant = s2 * (s2 + less * turned) + both * (less * triple) ** 2 * cosine2 / square**3
    exponent = -0.5 * (s2 * (1.0 - cosine2) + less * of_slope) / (cosine2 * determinant)
    if exponent < FAINTEST:
        return 0.0
    return (
        strength * math.exp(exponent) / (8.0 * math.sqrt(determinant) * cosine2 * cosine2 * cosine) * range_m
    )


@inlined
def _lobe_of(echo, u, v, q, strength, slope):
    """Return the specular lobe times range of a sample, from cos θ times range."""
    over_depth2 = 1.0 + u * u + v * v  # square of range over depth
    if not strength > np.float32(0.0) or _is_faint(echo * q, over_depth2, slope):
        return 0.0
    return lobe_times_range(echo, math.sqrt(over_depth2) / q, strength, slope)


@inlined
def _write_bodies(buffer, bodies, left, body_id):
    """Write the number of the body of each sample into an image, from column `left` on."""
    depth, triangle = buffer
    for j in range(uint64(depth.shape[0])):
        for i in range(uint64(depth.shape[1])):
            is_hit = depth[j, i] > np.float32(0.0)
            number = bodies[uint64(triangle[j, i]), 0] + 1 if is_hit else 0
            body_id[j, uint64(left) + i] = number


@uncounted
def shade(buffer, triangles, view, window, bodies_seen, left, image, lobes):
    """Write a visibility buffer into an image of samples, as shaders/gbuffer.frag does.

    Returns first and past the last column, counted from the window's, and first and past the last row of samples with a
    lobe; without one, past the last comes before the first.

    buffer, triangles, view, window : as for `rasterize`
    bodies_seen : table of PlacedBodies, and whether any body has a specular lobe
    left : column of the image at which the window begins
    image : plane_echo, body_id and face_id of `SectorSamples`: (H, W, 4) float32, (H, W) uint16 and int32; body_id of
        no length if it is not wanted
    lobes : (H, W) float32, overwritten with the specular lobe times range of each sample; of no length if they are not
        wanted
    """
    (body_rows, has_lobes), (plane_echo, body_id, face_id) = bodies_seen, image
    depth, triangle = buffer
    planes, bodies, normal_forms = triangles
    lattice_u, lattice_v = view[5], view[6]
    u0, v0, i0, j0 = lattice_u[0], lattice_v[0], window[0], window[2]
    zero, with_lobes = np.float32(0.0), lobes.shape[0] > 0
    low, past, bottom, top = depth.shape[1], 0, depth.shape[0], 0
    for j in range(uint64(depth.shape[0])):
        if with_lobes:
            for i in range(uint64(depth.shape[1])):
                lobes[j, uint64(left) + i] = zero
        for i in range(uint64(depth.shape[1])):
            q, t, at = depth[j, i], uint64(triangle[j, i]), uint64(left) + i
            if q <= zero:
                for k in range(uint64(4)):
                    plane_echo[j, at, k] = zero
                face_id[j, at] = NOTHING
                continue
            face_id[j, at] = bodies[t, 2]
            plane_echo[j, at, 0] = q
            plane_echo[j, at, 1] = planes[t, 0]
            plane_echo[j, at, 2] = planes[t, 1]
            echo = np.float64(planes[t, 2])
            if bodies[t, 1] == FLAT_DIFFUSE:
                plane_echo[j, at, 3] = planes[t, 3] * echo
            else:
                x, y = np.float64(np.int64(i) + i0), np.float64(np.int64(j) + j0)
                u = u0 + lattice_u[1] * x + lattice_u[2] * y
                v = v0 + lattice_v[1] * x + lattice_v[2] * y
                if bodies[t, 1] >= 0:
                    echo = _shaded_echo(normal_forms, t, x, y, u, v, q, planes[t, 0], planes[t, 1], echo)
                plane_echo[j, at, 3] = planes[t, 3] * echo
                body = bodies[t, 0]
                strength, slope = body_rows[body, ROW_STRENGTH], body_rows[body, ROW_SLOPE]
                of_lobe = 0.0
                is_turning = has_lobes and bodies[t, 1] >= 0 and strength > zero
                if is_turning and widens_lobe(normal_forms[t], x, y, slope):
                    range_m = math.sqrt(1.0 + u * u + v * v) / q
                    normal = normal_forms[t], x, y
                    of_lobe = mean_lobe_times_range(normal, (u, v), echo, range_m, strength, slope)
                elif has_lobes:
                    of_lobe = _lobe_of(echo, u, v, q, strength, slope)
                if of_lobe > 0.0:
                    plane_echo[j, at, 3] += of_lobe
                    if with_lobes:
                        lobes[j, at] = of_lobe
                        low, past = min(low, np.int64(i)), max(past, np.int64(i) + 1)
                        bottom, top = min(bottom, np.int64(j)), np.int64(j) + 1
                    if of_lobe > FAINT_LOBE * plane_echo[j, at, 3]:
                        face_id[j, at] = SINGLE - np.int64(j)
            # what returns nothing is joined whatever its face, as most of a view of lobes alone
            if plane_echo[j, at, 3] == zero:
                face_id[j, at] = NOTHING
    if body_id.shape[0]:
        _write_bodies(buffer, bodies, left, body_id)
    return low, past, bottom, top
