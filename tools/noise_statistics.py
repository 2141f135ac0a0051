"""Compare the statistics of speckle and noise over many pings with theory.

    python -m tools.noise_statistics                # 1000 pings of each kind, 15 seconds
    python -m tools.noise_statistics --pings 100

A ping is an even echo of 1 in 64 beams x 256 bins. `found` is over all bins of all pings; `off` is its
deviation from theory, in percent, but for correlations and the bias, where it is the difference. Apertures that slide
aside correlate by up to 0.01 too much, since the outermost of their waves count in part.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import fields, replace

import numpy as np

import sonar_gl as sg
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.settings import Noise
from sonar_gl.noise.speckle import aperture_width
from sonar_gl.ping import Ping

BEAMS, BINS, WIDTH_DEG, SPACING_DEG, BIN_M = 64, 256, 1.0, 0.25, 0.0125
FREQUENCY_HZ, SPEED_M_S = 900e3, 1500.0
LENGTH_M = aperture_width() * SPEED_M_S / FREQUENCY_HZ / np.radians(WIDTH_DEG)  # of the aperture
HALF_NULL_HZ = SPEED_M_S / (4 * BIN_M)  # a pulse whose c/2B is two bins
HAMMING = 0.23 / 0.54
# Place-locked speckle has cells of the sea, 0.5 m wide with their middles at multiples of it (docs/acoustics.md). From
# 0.05 m before a border to 0.05 m behind it, amplitudes fade from 1 to 0 as a quarter of a cosine, and those of the
# next cell, whose speckle is independent, rise: intensities correlate with those in the first cell as the square.
START_M, FADE_START_M, FADE_M = 0.1, 0.2, 0.1
SONAR_FIELDS = {field.name for field in fields(sg.Sonar)}


def even_ping(pose=None, level: float = 1.0, coherent: float = 0.0, **settings) -> Ping:
    """Return a ping of the same echo in all beams and bins; settings are fields of `Sonar` and `Acoustics`."""
    of_sonar = {key: settings.pop(key) for key in SONAR_FIELDS & settings.keys()}
    azimuth = np.radians(SPACING_DEG) * (np.arange(BEAMS) - (BEAMS - 1) / 2)
    shape = BEAMS, BINS, BEAMS * SPACING_DEG, 20.0, WIDTH_DEG
    sonar = sg.Sonar("even", FREQUENCY_HZ, *shape, 1.0, 1 + BINS * BIN_M, **of_sonar)
    acoustics = sg.Acoustics(**{"profile": "ideal", "water": sg.Water(sound_speed_m_s=SPEED_M_S)} | settings)
    intensity = np.full((BEAMS, BINS), level, np.float32)
    part = np.full_like(intensity, coherent) if coherent else None
    return Ping(intensity, azimuth, sonar.range_m, pose=pose, sonar=sonar, acoustics=acoustics, coherent=part)


def hamming_correlation(x):
    """Return the transform of a squared Hamming taper, 1 at 0."""
    f = HAMMING
    around = [np.sinc(x - m) + np.sinc(x + m) for m in (1, 2)]
    return ((1 + 2 * f * f) * np.sinc(x) + 2 * f * around[0] + f * f * around[1]) / (1 + 2 * f * f)


class Tally:
    """Moments of the intensity over pings, and its correlation some beams or bins aside."""

    def __init__(self, intensities: Iterator[np.ndarray], beams: int = 0, bins: int = 0):
        sums, count = np.zeros(5), 0
        for x in intensities:
            y = x.astype(np.float64)
            db = 10 * np.log10(np.maximum(y, 1e-30))
            a, b = y[: BEAMS - beams, : BINS - bins], y[beams:, bins:]
            sums += [y.mean(), (y**2).mean(), db.mean(), (db**2).mean(), (a * b).mean()]
            count += 1
        self.mean, square, self.db, db2, product = sums / count
        self.contrast = np.sqrt(square - self.mean**2) / self.mean
        self.db_std = np.sqrt(db2 - self.db**2)
        self.correlation = (product - self.mean**2) / (square - self.mean**2)


def pings(count: int, noise: Noise, ping: Ping | None = None) -> Iterator[np.ndarray]:
    """Make the intensities of noisy pings."""
    ping = even_ping() if ping is None else ping
    return (add_noise(ping, noise, 1, number).intensity for number in range(count))


def moved_correlation(count: int, step, bins: int = 0, start_m: float = START_M, **acoustics) -> float:
    """Return the correlation of place-locked speckle before and after a step (x, y, yaw), some bins aside.

    The step begins at x = y = start_m.
    """
    noise, a, b = Noise(speckle=True, follow_motion=True), [], []
    for seed in range(count):
        for to, (x, y, yaw) in ((a, (0, 0, 0)), (b, step)):
            ping = even_ping(sg.pose(start_m + x, start_m + y, 0, 0, 0, yaw), **acoustics)
            to.append(add_noise(ping, noise, seed).intensity[BEAMS // 2 - 1 : BEAMS // 2 + 1])
    a, b = np.array(a)[..., bins:], np.array(b)[..., : BINS - bins]
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def rows(count: int) -> Iterator[tuple[str, float, float]]:
    """Give (quantity, theory, found) of each number."""
    speckle = Noise(speckle=True)
    plain = Tally(pings(count, speckle))
    yield "speckle: mean", 1.0, plain.mean
    yield "speckle: contrast", 1.0, plain.contrast
    yield "speckle: dB bias", -2.50682, plain.db
    yield "speckle: dB std", 5.57004, plain.db_std
    for beams in (1, 2, 3):
        x = aperture_width() * beams * SPACING_DEG / WIDTH_DEG
        found = Tally(pings(count, speckle), beams).correlation
        yield f"beams {beams * SPACING_DEG:g} widths apart", np.sinc(x) ** 2, found
    for taper, correlation in (("uniform", np.sinc), ("hamming", hamming_correlation)):
        ping = even_ping(pulse=True, bandwidth_hz=HALF_NULL_HZ, pulse_taper=taper)
        for bins in (1, 2):
            wanted, found = (
                correlation(bins / 2) ** 2,
                Tally(pings(count, speckle, ping), 0, bins).correlation,
            )
            yield f"{taper} pulse, {bins / 2:g} c/2B apart", wanted, found
    ping = even_ping(beam_pattern="line_array", receive_taper="hamming")
    wanted = hamming_correlation(1.302982 * 2 * SPACING_DEG / WIDTH_DEG) ** 2
    yield "Hamming array, 0.5 widths apart", wanted, Tally(pings(count, speckle, ping), 2).correlation
    for shape in (0.5, 1.0, 5.0, 50.0):
        ping = even_ping()
        ping = replace(ping, texture_deviation=ping.intensity / np.float32(np.sqrt(shape)))
        found = Tally(pings(count, speckle, ping)).contrast
        yield f"K, shape {shape:g}: contrast", np.sqrt(1 + 2 / shape), found
    for looks, std in ((2, 3.488), (4, 2.314), (10, 1.408)):
        found = Tally(pings(count // 4, Noise(speckle=True, looks=looks)))
        yield f"{looks} looks: contrast", looks**-0.5, found.contrast
        yield f"{looks} looks: dB std", std, found.db_std
    for name, noise, wanted in (
        ("echo 1 and noise 0.1, no speckle: mean", Noise(ambient_db=-10), 1.1),
        ("echo 1 and noise 0.1, speckle: mean", Noise(speckle=True, ambient_db=-10), 1.1),
    ):
        yield name, wanted, Tally(pings(count, noise)).mean
    found = Tally(pings(count, Noise(ambient_db=-10))).contrast
    yield "the same, no speckle: contrast (Rice)", np.sqrt(0.2 + 0.01) / 1.1, found
    for part in (0.5, 0.99):
        wanted = np.sqrt(2 * part * (1 - part) + (1 - part) ** 2)
        found = Tally(pings(count, speckle, even_ping(coherent=part))).contrast
        yield f"coherent part {part:g}: contrast (Rice)", wanted, found
    for share in (0.05, 0.125, 0.25):
        found = moved_correlation(count, (0, share * LENGTH_M, 0))
        yield f"place-locked, {share:g} apertures aside", (1 - 2 * share) ** 2, found
    yield "place-locked, 3 bins forward, 3 bins on", 1.0, moved_correlation(count, (3 * BIN_M, 0, 0), 3)
    found = moved_correlation(count, (3 * BIN_M, 0, 0), 3, start_m=FADE_START_M)
    left = 1 - 3 * BIN_M / FADE_M  # share of the fade that lies ahead
    yield "place-locked, the same in a fade of cells", np.sin(np.pi / 2 * left) ** 2, found
    pulse = {"pulse": True, "bandwidth_hz": HALF_NULL_HZ, "pulse_taper": "hamming"}
    forward = moved_correlation(count, (0.5 * BIN_M, 0, 0), **pulse)
    yield "place-locked, 0.25 c/2B forward", hamming_correlation(0.25) ** 2, forward


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.noise_statistics", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--pings", type=int, default=1000)
    count = parser.parse_args().pings
    print(f"{'':44}{'theory':>9}{'found':>9}{'off':>9}")
    for name, wanted, found in rows(count):
        relative = not any(word in name for word in ("apart", "place-locked", "bias"))
        off = f"{100 * (found / wanted - 1):+.2f} %" if relative else f"{found - wanted:+.4f}"
        print(f"{name:44}{wanted:9.4f}{found:9.4f}{off:>9}")


if __name__ == "__main__":
    main()
