"""What a receiver hears beside echoes: its own noise, the sea's, and other sonars, all through the TVG."""

from __future__ import annotations

import numpy as np

from sonar_gl.patterns import aperture_field
from sonar_gl.speckle import aperture_width

PULSE_S = 100e-6  # length of another sonar's pulse
SIDE_LOBES = 10**-3.5  # power with which a beam hears all about itself at least


def thermal_noise_db(frequency_hz):
    """Level of the water's thermal noise, dB re 1 µPa²/Hz; above 100 kHz it is what there is.

    −15 + 20 log10(f / 1 kHz). Source: Mellen, "The thermal-noise limit in the detection of underwater
    acoustic signals", J. Acoust. Soc. Am. 24, 478-480, 1952; Urick, Principles of Underwater Sound, 3rd ed.

    >>> round(float(thermal_noise_db(900e3)), 2)
    44.08
    """
    return -15 + 20 * np.log10(np.asarray(frequency_hz, np.float64) / 1e3)


def ambient_noise_db(frequency_hz, bandwidth_hz, source_level_db):
    """Thermal noise as `Noise.ambient_db` wants it: dB over the echo of an all-round surface at 1 m.

    Parameters
    ----------
    frequency_hz, bandwidth_hz : hertz; source_level_db : dB re 1 µPa at 1 m, on the projector's axis

    A surface of reflectivity 1 (a lossless Lambert one, 1/π per steradian) that fills a beam of solid angle
    Ω at 1 m echoes at SL + 10 log10(Ω/π). What the beam hears of noise from all about is NL + 10 log10 B − DI
    with DI = 10 log10(4π/Ω). In their difference, NL + 10 log10 B − SL − 6.02 dB, the beam's size cancels.
    Any other noise of level NL adds its difference to the thermal one. Real receivers are noisier by tens
    of dB. Source: the active sonar equation, Urick, Principles of Underwater Sound, 3rd ed., 1983

    >>> round(float(ambient_noise_db(900e3, 30e3, 205.0)), 2)
    -122.16
    """
    level = thermal_noise_db(frequency_hz) + 10 * np.log10(np.asarray(bandwidth_hz, np.float64))
    return level - source_level_db - 10 * np.log10(4)


def add_interference(out, count: float, power, array, bin_size_m: float, speed_m_s: float, random) -> None:
    """Add pulses of another sonar that sends when it likes, to out, (B, K) float32.

    Parameters
    ----------
    count : mean number in a ping; what comes is a Poisson number
    power : (K,) of a pulse in the beam that points at it, at each bin, TVG and all
    array : speckle.Array; bin_size_m, speed_m_s : metres, metres per second; random : Generator

    Each comes at one moment, from one azimuth of the fan, and lasts PULSE_S: an arc of a few bins at one
    range, bright in the beams that look there, and as weak as SIDE_LOBES in those that look elsewhere.
    """
    B, K = out.shape
    azimuth, length = np.asarray(array.azimuth_rad), max(1, round(PULSE_S * speed_m_s / 2 / bin_size_m))
    width = array.beam_width_rad or np.ptp(azimuth) / B or 1.0
    for _ in range(random.poisson(count)):
        first, share = int(random.integers(1 - length, K)), random.random()
        offset = azimuth - (azimuth[0] + share * (azimuth[-1] - azimuth[0]))
        heard = aperture_field(aperture_width(array.series) * offset / width, array.series) ** 2
        bins = slice(max(0, first), first + length)
        out[:, bins] += np.outer(np.maximum(heard, SIDE_LOBES), power[bins]).astype(np.float32)
