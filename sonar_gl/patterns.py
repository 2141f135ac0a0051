"""How a beam hears from each direction."""

from __future__ import annotations

import numpy as np

HALF_POWER = 0.442946470689  # x of sinc²(x) = 1/2: half the −3 dB width of a uniform line array, in λ/L


def line_array_pattern(azimuth_rad, steer_azimuth_rad, beam_width_rad):
    """What a beam of a uniform line array hears from each direction, linear power, 1 on its axis.

    Parameters
    ----------
    azimuth_rad, steer_azimuth_rad : radians, shapes that broadcast: the direction, the beam's axis
    beam_width_rad : −3 dB full width, radians, 0..π

    sinc²(u L/λ) with u = sin(ψ − ψ0) and L/λ = 0.44295 / sin(width / 2), so the −3 dB width is exact.
    Every beam is alike: a data sheet gives one width, and curved or many-faced arrays keep it over the
    fan. (One straight array would have u = sin ψ − sin ψ0 and broaden by 1/cos ψ0 where it is steered.)
    The array hears nothing from behind, more than 90° from the beam's axis.
    Source: Urick, Principles of Underwater Sound, 3rd ed., 1983

    >>> round(float(line_array_pattern(np.radians(0.5), 0.0, np.radians(1.0))), 9)
    0.5
    """
    offset = np.asarray(azimuth_rad, np.float64) - np.asarray(steer_azimuth_rad, np.float64)
    apertures = HALF_POWER / np.sin(np.asarray(beam_width_rad, np.float64) / 2)
    return np.where(np.cos(offset) > 0, np.sinc(np.sin(offset) * apertures) ** 2, 0.0)


def box_pattern(azimuth_rad, steer_azimuth_rad, beam_width_rad):
    """A beam that hears all within half its width of its axis alike, and nothing else: 1 or 0.

    Parameters
    ----------
    azimuth_rad, steer_azimuth_rad : radians, of any shapes that broadcast: the direction, the beam's axis
    beam_width_rad : full width, radians; its starboard edge is in the beam, its port edge is not

    >>> box_pattern(np.radians([-0.6, -0.4, 0.4, 0.6]), 0.0, np.radians(1.0)).tolist()
    [0.0, 1.0, 1.0, 0.0]
    """
    offset = np.asarray(azimuth_rad, np.float64) - np.asarray(steer_azimuth_rad, np.float64)
    offset = (offset + np.pi) % (2 * np.pi) - np.pi
    share = offset / np.asarray(beam_width_rad, np.float64)
    return ((share >= -0.5) & (share < 0.5)).astype(np.float64)


def gaussian_pattern(azimuth_rad, steer_azimuth_rad, beam_width_rad):
    """A beam without side lobes, linear power, 1 on its axis: 2^−(u / u₃)².

    u = sin(ψ − ψ0), u₃ = sin(width / 2).

    Parameters
    ----------
    azimuth_rad, steer_azimuth_rad : radians, shapes that broadcast: the direction, the beam's axis
    beam_width_rad : −3 dB full width, radians, 0..π

    >>> round(float(gaussian_pattern(np.radians(1.0), 0.0, np.radians(1.0))), 4)
    0.0625
    """
    offset = np.asarray(azimuth_rad, np.float64) - np.asarray(steer_azimuth_rad, np.float64)
    share = np.sin(offset) / np.sin(np.asarray(beam_width_rad, np.float64) / 2)
    return np.where(np.cos(offset) > 0, 2.0 ** -(share**2), 0.0)


BEAM_PATTERNS = {"box": box_pattern, "line_array": line_array_pattern, "gaussian": gaussian_pattern}
