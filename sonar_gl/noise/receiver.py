"""Noise that the receiver adds to echoes: absolute and relative levels, and interference from other sonars."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.acoustics.beam_pattern import ArrayPattern, aperture_field
from sonar_gl.acoustics.solid_angle import beam_solid_angles
from sonar_gl.core.errors import Error
from sonar_gl.noise.settings import Noise
from sonar_gl.noise.speckle import FieldCorrelation, aperture_width
from sonar_gl.sonar.sonar import Sonar

PULSE_S = 100e-6  # length of an interfering sonar's pulse
SIDE_LOBES = 10**-3.5  # floor of the receive beam pattern, power relative to its axis


def thermal_noise_db(frequency_hz):
    """Return the level of thermal noise in water, dB re 1 µPa²/Hz.

    NL = −15 + 20 log10(f / 1 kHz) [1]_ [2]_. Above 100 kHz it is the main part of ambient noise.

    References
    ----------
    .. [1] Mellen, "The thermal-noise limit in the detection of underwater acoustic signals", J. Acoust. Soc.
       Am. 24, 478-480, 1952
    .. [2] Urick, Principles of Underwater Sound, 3rd ed., 1983

    >>> round(float(thermal_noise_db(900e3)), 2)
    44.08
    """
    return -15 + 20 * np.log10(np.asarray(frequency_hz, np.float64) / 1e3)


def ambient_noise_db(frequency_hz, bandwidth_hz, source_level_db, receive_per_echo=1.0):
    """Return the thermal noise level as `Noise.ambient_db` takes it.

    Parameters
    ----------
    frequency_hz, bandwidth_hz : hertz, of the sonar and its receiver
    source_level_db : dB re 1 µPa at 1 m, on the projector's axis
    receive_per_echo : the solid angle of the receive pattern over that of the echo, of
        `sonar_gl.acoustics.solid_angle.beam_solid_angles`; 1 of a box

    Returns
    -------
    dB relative to the echo of a sphere of reflectivity 1 about the sonar, at 1 m

    Notes
    -----
    A lossless Lambert surface (1/π per steradian) that surrounds the sonar at 1 m returns SL + 10 log10(Ω₂/π), Ω₂ the
    integral of the two-way pattern over solid angle. The beam receives NL + 10 log10 B − DI of isotropic noise, where
    DI = 10 log10(4π/Ω₁), Ω₁ the integral of the receive pattern [1]_. The difference is
    NL + 10 log10 B − SL − 6.02 dB + 10 log10(Ω₁/Ω₂). For ambient noise of another level, add its difference from
    `thermal_noise_db`. The self-noise of real receivers is higher by tens of dB.

    References
    ----------
    .. [1] Urick, Principles of Underwater Sound, 3rd ed., 1983, the active sonar equation

    >>> round(float(ambient_noise_db(900e3, 30e3, 205.0)), 2)
    -122.16
    """
    level = thermal_noise_db(frequency_hz) + 10 * np.log10(np.asarray(bandwidth_hz, np.float64))
    return level - source_level_db - 10 * np.log10(4) + 10 * np.log10(receive_per_echo)


class AbsoluteLevels(NamedTuple):
    """The terms of the active sonar equation of a beam, for a sonar whose source level is known.

    The solid angles Ω₁ of its receive pattern, one way, and Ω₂ of the two-way pattern are those of
    `sonar_gl.acoustics.solid_angle.beam_solid_angles`.

    Attributes
    ----------
    source_level_db : SL, dB re 1 µPa at 1 m
    bandwidth_hz : B of the matched filter
    directivity_index_db : DI = 10 log10(4π/Ω₁)
    echo_level_db : dB re 1 µPa, SL + 10 log10(Ω₂/π): the echo of a lossless Lambert sphere about the sonar, at
        1 m, to which levels of `Noise` and an intensity of 1 before the TVG refer. At range r it is lower by 20 log10 r
        + 2αr: the two-way transmission loss 40 log10 r + 2αr, less 20 log10 r, by which the insonified area grows
    thermal_noise_level_db : dB re 1 µPa, NL + 10 log10 B of `thermal_noise_db`, in all directions
    thermal_noise_db : the part of it that the beam receives, NL + 10 log10 B − DI, dB relative to `echo_level_db`
    self_noise_level_db : dB re 1 µPa, the plane wave on the axis of the beam that is as strong as the self-noise
    """

    source_level_db: float
    bandwidth_hz: float
    directivity_index_db: float
    echo_level_db: float
    thermal_noise_level_db: float
    thermal_noise_db: float
    self_noise_level_db: float


def absolute_levels(sonar: Sonar, acoustics: Acoustics, beam: int | None = None) -> AbsoluteLevels:
    """Return the absolute terms of the active sonar equation [1]_.

    Parameters
    ----------
    sonar : with its `source_level_db`. Without a `bandwidth_hz` its resolution cell is as long as a bin
    acoustics : Acoustics, whose beam patterns count; its speed of sound counts where the bandwidth follows from the
        bins
    beam : its number; None: the one nearest to the boresight. Those of most sonars differ by 0.3 dB at most; those of
        one straight array whose beams broaden (`steered="straight"`) are wider aside

    Raises
    ------
    Error
        if the source level is not known.

    References
    ----------
    .. [1] Urick, Principles of Underwater Sound, 3rd ed., 1983

    >>> from sonar_gl.sonar.sonar_files import load_sonar
    >>> sonar = load_sonar("p900-45,bandwidth_hz=30e3,source_level_db=205")
    >>> levels = absolute_levels(sonar, Acoustics.physical())
    >>> round(levels.directivity_index_db, 1), round(levels.thermal_noise_db, 2), round(levels.echo_level_db, 1)
    (30.8, -120.55, 178.6)
    """
    level_db = sonar.source_level_db
    if level_db is None:
        raise Error(
            f"sonar {sonar.name!r}: source_level_db must be known for absolute levels and thermal noise "
            "(got None; give it in the sonar's file or by --sonar ...,source_level_db=..., or give the noise as "
            "ambient_db)"
        )
    bandwidth_hz = acoustics.pulse_response(sonar).bandwidth_hz
    receive_sr, echo_sr = beam_solid_angles(sonar, acoustics, beam)
    echo_level_db = level_db + 10 * math.log10(echo_sr / math.pi)
    noise_db = ambient_noise_db(sonar.frequency_hz, bandwidth_hz, level_db, receive_sr / echo_sr)
    return AbsoluteLevels(
        source_level_db=level_db,
        bandwidth_hz=bandwidth_hz,
        directivity_index_db=10 * math.log10(4 * math.pi / receive_sr),
        echo_level_db=echo_level_db,
        thermal_noise_level_db=float(thermal_noise_db(sonar.frequency_hz)) + 10 * math.log10(bandwidth_hz),
        thermal_noise_db=float(noise_db),
        self_noise_level_db=echo_level_db + sonar.self_noise_db,
    )


def receiver_levels_db(noise: Noise, sonar: Sonar | None, acoustics: Acoustics | None) -> list[float]:
    """Return the level of each noise that the receiver adds, before the TVG.

    Raises Error if thermal noise is on and the sonar's source level is not known.

    Returns dB relative to the echo of a sphere of reflectivity 1 about the sonar, at 1 m; of thermal noise that of the
    beam nearest to the boresight, from which others differ by 0.3 dB at most.

    sonar, acoustics : may be None where the noise has neither self-noise nor thermal noise
    """
    out = [sonar.self_noise_db] if noise.self_noise else []
    if noise.thermal_noise:
        out.append(absolute_levels(sonar, acoustics).thermal_noise_db)
    return out if noise.ambient_db is None else [*out, noise.ambient_db]


def common_noise_pattern(azimuth_rad, width_deg: float) -> np.ndarray:
    """Return what beams receive of noise that neighbouring channels have in common, 1 straight ahead.

    A group of channels that pick up the same interference is a small array for which it comes from ahead. Groups are
    independent of one another, and so beams have the power pattern of one group, and the grain of other noise.

    Returns (B,) float64.

    azimuth_rad : (B,) azimuths of beams; beams more than 90 degrees off receive nothing of it
    width_deg : −3 dB width of the pattern of a group

    Source: Van Trees, Optimum Array Processing, 2002: uniform linear arrays

    >>> common_noise_pattern(np.radians([0.0, 1.5]), 3.0).round(6).tolist()
    [1.0, 0.5]
    """
    azimuth = np.asarray(azimuth_rad, np.float64)
    group = ArrayPattern("line_array", math.radians(width_deg))
    return np.where(np.cos(azimuth) > 0, group.power(np.sin(azimuth)), 0.0)


def add_interference(
    intensity: np.ndarray,
    mean_count: float,
    power: np.ndarray,
    correlation: FieldCorrelation,
    bin_size_m: float,
    sound_speed_m_s: float,
    generator: np.random.Generator,
) -> None:
    """Add pulses of an unsynchronised sonar to the intensity, in place.

    A pulse arrives from one azimuth of the fan at one moment and lasts PULSE_S: an arc of a few bins, shaped
    across beams by the receive beam pattern, which has a floor of SIDE_LOBES.

    intensity : (B, K) float32
    mean_count : mean number of pulses in a ping; the number is Poisson-distributed
    power : (K,) power of a pulse on the axis of a beam, at each bin, after the TVG
    correlation : azimuths, width and taper of the beams
    bin_size_m, sound_speed_m_s : metres, metres per second
    """
    B, K = intensity.shape
    azimuth = np.asarray(correlation.azimuth_rad)
    length = max(1, round(PULSE_S * sound_speed_m_s / 2 / bin_size_m))
    width = correlation.beam_width_rad or np.ptp(azimuth) / B or 1.0
    taper = correlation.taper_series
    for _ in range(generator.poisson(mean_count)):
        first, share = int(generator.integers(1 - length, K)), generator.random()
        offset = azimuth - (azimuth[0] + share * (azimuth[-1] - azimuth[0]))
        offset = np.where(np.abs(offset) > np.pi, 2 * np.pi - np.abs(offset), offset)  # the other way round
        pattern = aperture_field(aperture_width(taper) * offset / width, taper) ** 2
        bins = slice(max(0, first), first + length)
        intensity[:, bins] += np.outer(np.maximum(pattern, SIDE_LOBES), power[bins]).astype(np.float32)
