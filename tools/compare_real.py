"""Compare our pings with those of a real Oculus, by the statistics of their pictures.

    python -m tools.compare_real three_pings_8bit.raw --out compared    # the table, and real and ours side by side
    python -m tools.compare_real three_pings_8bit.raw --record          # also keeps the real figures in this folder
    python -m tools.compare_real --out docs/pictures                    # ours against the figures that are kept

The file holds raw pings as the device sends them. github.com/apl-ocean-engineering/liboculus has one under
test/data. Ours is a ping of a sandy floor by a sonar with the beams, bins and frequency of the file, from where the
real floor begins and ends as ours does. `theory` is fully developed speckle in counts that go as intensity^0.26.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import re
import sys
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import trimesh
from PIL import Image

import sonar_gl as sg
from sonar_gl.core.atomic_file import atomic_write
from sonar_gl.core.errors import Error
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.speckle import aperture_width
from tests.support.even_ping import HAMMING_SERIES, hamming_correlation
from tools.count_statistics import (
    correlation,
    divergence,
    flattened,
    law_correlation,
    law_moments,
    moments,
    pattern_shares,
)
from tools.oculus_raw import RawPing, read_pings
from tools.pictures import write_png

RECORD = Path(__file__).with_name("real_oculus_m1200d.json")
SOURCE = (
    "Three consecutive pings of an Oculus M1200d, test/data/three_pings_8bit.raw of "
    "github.com/apl-ocean-engineering/liboculus, Copyright University of Washington, BSD-3-Clause. "
    "Figures that python -m tools.compare_real FILE --record computed from them, not the data"
)
LAW = 0.26  # counts go as intensity to this power: about the root of the amplitude, as the file's gamma byte says
FULL_SCALE = 255
PINGS = 3
SEED = 1


@dataclass(frozen=True)
class Setup:
    """What the real pings and ours have in common. B beams, K bins.

    Attributes
    ----------
    frequency_hz, sound_speed_m_s : hertz, metres per second
    beam_azimuths_deg : (B,) degrees, rising, positive to port
    n_bins, bin_size_m : K, and the length of a bin, metres; the first one begins at 0
    height_m, pitch_rad, roll_rad : of the sonar over a level floor, metres and radians, found by `fit`
    floor_counts : mean of the real counts on the floor; the gain of ours makes it the same
    """

    frequency_hz: float
    sound_speed_m_s: float
    beam_azimuths_deg: tuple[float, ...]
    n_bins: int
    bin_size_m: float
    height_m: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    floor_counts: float = 0.0

    @property
    def range_max_m(self) -> float:
        """The far edge of the last bin, metres."""
        return self.n_bins * self.bin_size_m


class Regions(NamedTuple):
    """Parts of a picture, (B, K) bool each.

    Attributes
    ----------
    water : before the first echo of the bottom
    floor : where the echo of an even floor is within FLOOR_DB of its beam's greatest
    after : from where that echo has fallen by AFTER_DB to the far field
    far : the last fifth of the bins
    """

    water: np.ndarray
    floor: np.ndarray
    after: np.ndarray
    far: np.ndarray


class Figures(NamedTuple):
    """What the pictures of some consecutive pings measure.

    Attributes
    ----------
    values : "region: measure" to number
    patterns : region to (59,) shares of `pattern_shares`
    """

    values: dict[str, float]
    patterns: dict[str, list[float]]


class Row(NamedTuple):
    """A line of the table; numbers are None where there are none.

    Attributes
    ----------
    name : "region: measure"
    real, ours, theory : numbers
    off : how far ours is from real, in the unit of the bound
    bound : greatest |off|
    """

    name: str
    real: float | None
    ours: float
    theory: float | None
    off: float
    bound: float

    @property
    def met(self) -> bool:
        """Whether ours is as close as the bound asks for."""
        return abs(self.off) <= self.bound


# ---- ours -----------------------------------------------------------------------------------------------------

PRESET = "oculus-m1200d-hf"
# The preset has 0.4 degrees. One straight array with that width, whose beams are even in sine, has neighbours that
# overlap as much as beams of 0.42 degrees do over this fan; our noise takes one width for all beams.
BEAM_WIDTH_DEG = 0.42
# Length ahead and width of the floor over the greatest range: more than the beams' main lobes see.
FLOOR = (0.75, 0.8)
FLOOR_CELLS = 270, 145  # along them: 6 x 11 mm for a range of 2 m
# Standard deviations of the blur that makes its patches, cells, and of their reflectivity: by the correlations and the
# contrast of the real floor, whose patches are longer across than ahead.
PATCH_CELLS = 1.3, 2.0
PATCH_DB = 4.0
FLOOR_REFLECTIVITY = 0.1
# By the levels of the real water and far field. The noise that channels have in common goes by the line ahead of the
# real pings, and the strength and the number of the water's scatterers by the contrast, skewness and correlations of
# the real water.
SELF_NOISE_DB = -61.5
COMMON_NOISE_DB = -60.5
VOLUME_BACKSCATTER_DB = -52.3
SCATTERER_DENSITY_M3 = 7000.0
DRIFT_M = 0.0005  # of the sonar to starboard, from ping to ping, by the correlation of the real ones
TOLERANCE = 0.02


def our_device(setup: Setup) -> tuple[sg.Sonar, sg.Acoustics, sg.Noise]:
    """Return the preset with the file's settings, and the acoustics and noise with which ours comes closest."""
    azimuths = setup.beam_azimuths_deg
    sonar = replace(
        sg.load_sonar(PRESET),
        frequency_hz=setup.frequency_hz,
        n_beams=len(azimuths),
        n_bins=setup.n_bins,
        azimuth_fov_deg=2 * max(-azimuths[0], azimuths[-1]),
        beam_azimuths_deg=azimuths,
        beam_width_deg=BEAM_WIDTH_DEG,
        range_min_m=0.0,
        range_max_m=setup.range_max_m,
        bandwidth_hz=200e3,  # by the correlation of neighbouring bins in the real far field
        pulse_taper="uniform",
        self_noise_db=SELF_NOISE_DB,
        common_noise_db=COMMON_NOISE_DB,
    )
    acoustics = sg.Acoustics.physical(
        water=sg.Water(
            salinity_psu=0.0,  # the file's setting
            temperature_c=22.0,  # at which fresh water has the file's speed of sound
            sound_speed_m_s=setup.sound_speed_m_s,
            volume_backscatter_db=VOLUME_BACKSCATTER_DB,
            scatterer_density_m3=SCATTERER_DENSITY_M3,
        ),
        tvg_k=32.0,  # by the rise of the real noise from the water to the far field
    )
    return sonar, acoustics, sg.Noise(speckle=True, follow_motion=True, self_noise=True)


def floor(setup: Setup, patches: bool) -> sg.Body:
    """Return a level floor at z = 0 ahead of the sonar, with or without patches."""
    columns, rows = FLOOR_CELLS
    size_m = np.array(FLOOR) * setup.range_max_m
    x, y = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(-0.5, 0.5, rows + 1))
    at = np.stack([x * size_m[0], y * size_m[1], 0 * x], axis=-1).reshape(-1, 3)
    corner = np.add.outer(np.arange(rows) * (columns + 1), np.arange(columns)).ravel()
    right, above = corner + 1, corner + columns + 1
    faces = np.stack([corner, right, above + 1, corner, above + 1, above], axis=-1).reshape(-1, 3)
    reflectivity = FLOOR_REFLECTIVITY
    if patches:
        normals = np.random.default_rng(SEED).standard_normal((rows, columns))
        blurred = cv2.GaussianBlur(normals, (0, 0), PATCH_CELLS[0], sigmaY=PATCH_CELLS[1])
        cells = np.minimum(FLOOR_REFLECTIVITY * 10 ** (PATCH_DB / 10 * blurred / blurred.std()), 1.0)
        reflectivity = np.repeat(cells.ravel(), 2)
    else:
        at, faces = at[[0, columns, -1, -columns - 1]], np.array([[0, 1, 2], [0, 2, 3]])
    return sg.Body("floor", trimesh.Trimesh(at, faces, process=False), reflectivity=reflectivity)


def pose_at(setup: Setup, drift_m: float = 0.0) -> np.ndarray:
    """Return the pose of the sonar over the floor, somewhat to starboard."""
    angles = setup.roll_rad, setup.pitch_rad, 0.0
    return sg.pose(0.0, -drift_m, setup.height_m, *angles)


def make_echoes(setup: Setup, poses: list[np.ndarray], patches: bool) -> list[sg.Ping]:
    """Return pings of the floor without noise."""
    sonar, acoustics, _ = our_device(setup)
    scene = sg.Scene([floor(setup, patches)])
    with sg.Simulator(scene, sonar, acoustics, tolerance=TOLERANCE) as simulator:
        return [simulator.ping(pose) for pose in poses]


def our_pictures(setup: Setup, region: np.ndarray) -> list[np.ndarray]:
    """Return our consecutive pictures, (B, K) uint8, with the gain that makes the mean of a region the real one."""
    _, _, noise = our_device(setup)
    poses = [pose_at(setup, number * DRIFT_M) for number in range(PINGS)]
    echoes = make_echoes(setup, poses, patches=True)
    lawful = [add_noise(ping, noise, SEED, number).intensity ** LAW for number, ping in enumerate(echoes)]
    gain = setup.floor_counts / np.mean([one[region].mean() for one in lawful])
    return [np.clip(np.round(gain * one), 0, FULL_SCALE).astype(np.uint8) for one in lawful]


# ---- where the real floor is ----------------------------------------------------------------------------------

BLOCKS = 16, 88  # beams and bins that levels are averaged to, so that speckle does not matter
FIT_DB = 15.0  # levels so far below the greatest count as none: beyond, the real echo is not the main lobe's
GRAZING = 0.6  # sine of the depression that the search begins with: 37 degrees
STEP, LEAST_STEP = 0.15, 0.003  # of the search, as shares of the height, and in radians


def intensity_of(counts: np.ndarray) -> np.ndarray:
    """Return the intensity of counts by the display law, relative to full scale."""
    return (np.asarray(counts, np.float64) / FULL_SCALE) ** (1 / LAW)


def decibels(ratio) -> np.ndarray:
    """Return power ratios in dB."""
    return 10 * np.log10(ratio)


def block_levels_db(intensity: np.ndarray) -> np.ndarray:
    """Return the levels of blocks of a picture, of shape BLOCKS, dB re the greatest tenth, none below −FIT_DB."""
    blocks = cv2.resize(np.asarray(intensity, np.float32), BLOCKS[::-1], interpolation=cv2.INTER_AREA)
    blocks = np.maximum(blocks, np.finfo(np.float32).tiny)
    greatest = np.sort(blocks.ravel())[-blocks.size // 10 :].mean()
    return np.maximum(decibels(blocks / greatest), -FIT_DB)


def fit(setup: Setup, real: np.ndarray) -> Setup:
    """Return the setup whose even floor begins and ends where the real one does.

    Parameters
    ----------
    real : (B, K) intensity, mean of the pings

    Notes
    -----
    A search along height, pitch and roll, one after the other, with steps that are halved where none helps.
    """
    wanted = block_levels_db(real)
    brightest_m = (np.median(wanted.argmax(1)) + 0.5) / BLOCKS[1] * setup.range_max_m
    sonar, acoustics, _ = our_device(setup)
    scene = sg.Scene([floor(setup, patches=False)])
    with sg.Simulator(scene, sonar, acoustics, tolerance=TOLERANCE) as simulator:

        def at(height: float, pitch_rad: float, roll_rad: float) -> Setup:
            return replace(
                setup, height_m=height * brightest_m, pitch_rad=float(pitch_rad), roll_rad=float(roll_rad)
            )

        def misfit(place: np.ndarray) -> float:
            levels_db = block_levels_db(simulator.ping(pose_at(at(*place))).intensity)
            return float(((levels_db - wanted) ** 2).mean())

        best, step = np.array([GRAZING, math.asin(GRAZING), 0.0]), STEP
        least = misfit(best)
        while step > LEAST_STEP:
            tries = [best + sign * step * axis for axis in np.eye(3) for sign in (1, -1)]
            found = [misfit(place) for place in tries]
            if min(found) < least:
                least, best = min(found), tries[int(np.argmin(found))]
            else:
                step /= 2
    return at(*best)


# ---- measures -------------------------------------------------------------------------------------------------

EDGE = 8  # beams and bins next to the border, whose local means and patterns reach beyond it
FLOOR_DB, AFTER_DB = 6.0, 25.0
WATER = 0.5, 0.75  # of the height: behind the ring of the pulse, before the first echo of the bottom
LAGS = 1, 2, 3  # beams
AHEAD, ASIDE = 1 / 3, 26 / 30  # of the fan's half-width: ahead is within, aside beyond
THIRD, THIRDS = 1 / 3, ("ahead", "aside")  # of the fan's half-width

# greatest |ours − real| by the kind of a measure
BOUNDS = {"mean/std": 0.03, "skewness": 0.1, "correlation": 0.05, "dB": 3.0, "divergence": 0.07}
RELATIVE = ("mean/std",)  # bounds as a share of the real number

ECHO_AFTER = "the real floor still echoes there, by a way that is not known; ours is mostly noise"
ARCS = "the real arcs aside have skirts of ten beams on each side; ours have none"
ECHO_FAR = "the real floor echoes there once more, strongest ahead; ours is noise"
UNKNOWN = "of something that the pings which the settings were found with did not show"
# "region: measure" that ours misses: why
MISSES = {
    "water: correlation of beams, 2 apart": ARCS,
    "water: correlation of beams, 3 apart": ARCS,
    "after: mean/std": ECHO_AFTER,
    "after: skewness": ECHO_AFTER,
    "after: correlation of beams, 1 apart": ECHO_AFTER,
    "after: correlation of beams, 2 apart": ECHO_AFTER,
    "after: correlation of beams, 3 apart": ECHO_AFTER,
    "after: correlation of bins, 1 apart": ECHO_AFTER,
    "after: correlation of pings": ECHO_AFTER,
    "far: correlation of pings": ECHO_FAR,
    "far: ahead over aside, dB": ECHO_FAR,
}


def regions(setup: Setup) -> Regions:
    """Return the regions of the pictures, by the echo of an even floor without noise.

    Raises Error if one of them is empty.
    """
    (ping,) = make_echoes(setup, [pose_at(setup)], patches=False)
    echo, range_m = ping.intensity, ping.range_m
    greatest, brightest = echo.max(1, keepdims=True), echo.argmax(1)[:, None]
    bins = np.arange(echo.shape[1])[None]
    inner = np.zeros(echo.shape, bool)
    inner[EDGE:-EDGE, EDGE:-EDGE] = True
    low, high = (share * setup.height_m for share in WATER)
    far = bins >= 4 * setup.n_bins // 5
    after = (bins > brightest) & (echo < greatest * 10 ** (-AFTER_DB / 10)) & ~far
    parts = (range_m > low) & (range_m < high), echo > greatest * 10 ** (-FLOOR_DB / 10), after, far
    out = Regions(*(part & inner for part in parts))
    for name, part in out._asdict().items():
        if not part.any():
            raise Error(f"the floor must leave bins for the region {name!r} (got none: is there a floor?)")
    return out


def measure(pictures: list[np.ndarray], setup: Setup, parts: Regions) -> Figures:
    """Return the figures of consecutive pictures, (B, K) counts each; those of pings need two."""
    values, patterns = {}, {}
    grains = [flattened(one) for one in pictures]
    intensity = np.mean([intensity_of(one) for one in pictures], axis=0)
    floor_level = intensity[parts.floor].mean()
    aside = np.abs(setup.beam_azimuths_deg)[:, None] / max(setup.beam_azimuths_deg)
    for name, region in parts._asdict().items():
        found = [moments(grain[region]) for grain in grains]
        values[f"{name}: mean/std"] = np.mean([one.mean_per_std for one in found])
        values[f"{name}: skewness"] = np.mean([one.skewness for one in found])
        for lag in LAGS:
            values[f"{name}: correlation of beams, {lag} apart"] = np.mean(
                [correlation(grain, grain, region, beams=lag) for grain in grains]
            )
        values[f"{name}: correlation of bins, 1 apart"] = np.mean(
            [correlation(grain, grain, region, bins=1) for grain in grains]
        )
        pairs = list(itertools.pairwise(grains))
        if pairs:
            values[f"{name}: correlation of pings"] = np.mean(
                [correlation(one, following, region) for one, following in pairs]
            )
        if name != "floor":
            values[f"{name}: level re floor, dB"] = decibels(intensity[region].mean() / floor_level)
        if name in ("floor", "far"):
            ahead, beside = (intensity[region & part].mean() for part in (aside < AHEAD, aside > ASIDE))
            values[f"{name}: ahead over aside, dB"] = decibels(ahead / beside)
        if name == "far":  # whether beams broaden to the sides, as those of one straight array do
            for part, where in zip((aside < THIRD, aside > 1 - THIRD), THIRDS, strict=True):
                values[f"{name}: correlation of beams, 1 apart, {where}"] = np.mean(
                    [correlation(grain, grain, region & part, beams=1) for grain in grains]
                )
        patterns[name] = np.mean([pattern_shares(one, region) for one in pictures], axis=0).tolist()
    return Figures({name: float(value) for name, value in values.items()}, patterns)


def theory(setup: Setup) -> dict[str, float]:
    """Return what fully developed speckle in all regions would measure, where there is a formula."""
    sonar, _, _ = our_device(setup)
    expected = law_moments(LAW)
    # of one straight array, with beams even in sine and as wide ahead as the data sheet says
    spacing = np.ptp(np.sin(np.radians(setup.beam_azimuths_deg))) / (len(setup.beam_azimuths_deg) - 1)
    apart = aperture_width(HAMMING_SERIES) * spacing / math.radians(sg.load_sonar(PRESET).beam_width_deg)
    bins = 2 * sonar.bandwidth_hz * setup.bin_size_m / setup.sound_speed_m_s
    out = {"floor: correlation of pings": 1.0, "far: correlation of pings": 0.0}
    for name in Regions._fields:
        out[f"{name}: mean/std"], out[f"{name}: skewness"] = expected
        for lag in LAGS:
            rho = float(hamming_correlation(lag * apart))
            out[f"{name}: correlation of beams, {lag} apart"] = law_correlation(rho, LAW)
        out[f"{name}: correlation of bins, 1 apart"] = law_correlation(float(np.sinc(bins)), LAW)
    # of beams of one width, ours; those of one straight array would correlate as ahead in both
    azimuths_rad = np.radians(setup.beam_azimuths_deg)
    widths = np.gradient(azimuths_rad) / math.radians(BEAM_WIDTH_DEG)
    aside = np.abs(azimuths_rad) / azimuths_rad.max()
    for part, where in zip((aside < THIRD, aside > 1 - THIRD), THIRDS, strict=True):
        rho = float(hamming_correlation(aperture_width(HAMMING_SERIES) * widths[part].mean()))
        out[f"far: correlation of beams, 1 apart, {where}"] = law_correlation(rho, LAW)
    return out


def compare(real: Figures, ours: Figures, expected: dict[str, float]) -> list[Row]:
    """Return the table: a row for each value, and for the patterns of each region."""
    rows = []
    for name, value in real.values.items():
        kind = next(kind for kind in BOUNDS if kind in name)
        scale = value if kind in RELATIVE else 1.0
        off = (ours.values[name] - value) / scale
        rows.append(Row(name, value, ours.values[name], expected.get(name), off, BOUNDS[kind]))
    for name, shares in real.patterns.items():
        found = divergence(shares, ours.patterns[name])
        rows.append(Row(f"{name}: divergence of patterns", None, found, 0.0, found, BOUNDS["divergence"]))
    return rows


# ---- files, table and pictures --------------------------------------------------------------------------------

PICTURE_HEIGHT = 400
COLORMAP = "gray"
OURS, BOTH = "oculus_ours", "oculus_real_and_ours"  # names of pictures
GRAYS = 32  # of a picture, in which more cost bytes and do not show


def setup_of(pings: list[RawPing]) -> Setup:
    """Return the setup of raw pings, with the sonar where the real floor is.

    Raises Error if the pings differ in their settings.
    """
    first = pings[0]
    for ping in pings:
        if ping.counts.shape != first.counts.shape or ping[1:] != first[1:]:
            raise Error("all pings of the file must have the same settings (got several; cut the file)")
    if not all(ping.counts.any() for ping in pings):
        raise Error("pings must have echoes (got one of zeros)")
    if min(first.counts.shape) <= 4 * EDGE:
        raise Error(f"pings must have more than {4 * EDGE} beams and bins (got {first.counts.shape})")
    setup = Setup(
        first.frequency_hz,
        first.sound_speed_m_s,
        first.beam_azimuths_deg,
        first.counts.shape[1],
        first.bin_size_m,
    )
    setup = fit(setup, np.mean([intensity_of(ping.counts) for ping in pings], axis=0))
    region = regions(setup).floor
    return replace(setup, floor_counts=float(np.mean([ping.counts[region].mean() for ping in pings])))


def read_record() -> tuple[Setup, Figures]:
    """Return the setup and the real figures that `write_record` wrote."""
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    setup = record["setup"]
    setup["beam_azimuths_deg"] = tuple(setup["beam_azimuths_deg"])
    return Setup(**setup), Figures(record["values"], record["patterns"])


def write_record(setup: Setup, real: Figures, path: Path = RECORD) -> None:
    """Write setup and real figures, with their source."""
    patterns = {name: [round(share, 6) for share in shares] for name, shares in real.patterns.items()}
    values = {name: round(value, 6) for name, value in real.values.items()}
    record = {"source": SOURCE, "setup": asdict(setup), "values": values, "patterns": patterns}
    # a number of a list takes no line of its own
    text = re.sub(r"(?<=[\[\d,])\n\s+(?=-?\d)|(?<=\d)\n\s+(?=\])", "", json.dumps(record, indent=1))
    with atomic_write(path) as name:
        Path(name).write_text(text + "\n", encoding="utf-8")


def print_table(rows: list[Row]) -> None:
    """Print the table, and why ours misses what it misses."""
    print(f"{'':42}{'real':>8}{'ours':>8}{'theory':>8}{'off':>9}{'bound':>8}")
    for row in rows:
        numbers = "".join("       -" if x is None else f"{x:8.2f}" for x in row[1:4])
        kind = "%" if "mean/std" in row.name else ""
        off, bound = (f"{100 * x:+.1f} %" if kind else f"{x:+.3f}" for x in (row.off, row.bound))
        print(f"{row.name:42}{numbers}{off:>9}{bound[1:]:>8}  {'met' if row.met else 'missed'}")
    missed = [row.name for row in rows if not row.met]
    print(f"{len(rows) - len(missed)} of {len(rows)} bounds are met")
    reasons = [MISSES.get(name, UNKNOWN) for name in missed]
    for reason in dict.fromkeys(reasons):
        print(f"missed: {reason}:")
        for name in (name for name, why in zip(missed, reasons, strict=True) if why == reason):
            print(f"  {name}")


def draw(picture: np.ndarray, setup: Setup) -> np.ndarray:
    """Return the fan picture of counts (B, K): (H, W, 3) uint8."""
    sonar, _, _ = our_device(setup)
    ping = sg.Ping((picture / FULL_SCALE).astype(np.float32), sonar.azimuth_rad, sonar.range_m, sonar=sonar)
    return sg.colorize(sg.fan_image(ping, PICTURE_HEIGHT, sg.Counts("power", exponent=1.0)), COLORMAP)


def run(options: argparse.Namespace) -> None:
    """Compare, and write what is asked for."""
    pictures = []
    if options.file is None:
        if options.record:
            raise Error("--record needs a file of raw pings (got none)")
        setup, real = read_record()
        parts = regions(setup)
    else:
        pings = read_pings(options.file)
        setup = setup_of(pings)
        parts = regions(setup)
        real = measure([ping.counts for ping in pings], setup, parts)
        pictures.append(pings[0].counts)
    ours = our_pictures(setup, parts.floor)
    pictures.append(ours[0])
    print(
        f"the sonar is {setup.height_m:.3f} m over the floor, {math.degrees(setup.pitch_rad):.1f} degrees down, "
        f"rolled by {math.degrees(setup.roll_rad):.1f}"
    )
    print_table(compare(real, measure(ours, setup, parts), theory(setup)))
    if options.record:
        write_record(setup, real)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        side_by_side = np.hstack([draw(picture, setup) for picture in pictures])
        name = OURS if options.file is None else BOTH
        write_png(options.out / f"{name}.png", Image.fromarray(side_by_side), GRAYS)


def main() -> int:
    """Run the command; return its exit status."""
    parser = argparse.ArgumentParser(prog="python -m tools.compare_real", description=__doc__.splitlines()[0])
    parser.add_argument("file", nargs="?", help="raw pings; without them the figures that are kept are real")
    parser.add_argument(
        "--out", type=Path, help="folder for the picture: real on the left, ours on the right"
    )
    parser.add_argument("--record", action="store_true", help=f"keep the real figures in {RECORD.name}")
    try:
        run(parser.parse_args())
    except (Error, OSError) as error:
        print(f"python -m tools.compare_real: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
