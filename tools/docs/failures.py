"""Measure naive methods and sonar_gl in the regimes where methods fail.

    python -m tools.docs.failures                  # a table; some minutes
    python -m tools.docs.failures --markdown       # the table of docs/failures.md
    python -m tools.docs.failures --soak 100000    # only many pings: memory, GL objects, time
    python -m tools.docs.failures --triangles 10   # only a mesh of so many million triangles
    python -m tools.docs.failures --moving 20000   # only a moving sonar whose samples change: memory; some minutes
    python -m tools.docs.failures --rods 6         # only rods by tolerance, so many of each kind

The measures are those of the tests, in tests/support/: regimes.py, oddities.py, rods.py, soak.py. One of them
needs Embree (the extra `reference`).
"""

from __future__ import annotations

import argparse
import itertools
import math
import warnings
from time import perf_counter

import numpy as np
import trimesh

import sonar_gl as sg
from tests.support import moving, naive, oddities, regimes, rods, soak

SHARE = "{:.2g}".format


def per_cent(share):
    """Return a share as text, of two digits or whole."""
    if math.isinf(share):
        return "no picture"
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def pair(measure, form=SHARE):
    """Return the naive figure and ours, as text."""
    return tuple(form(number) for number in measure)


def rows():
    """Give (regime, what is measured, naive, ours, where its tests are), one by one."""
    for fov in (120.0, 130.0, 179.0, 180.0, 270.0, 360.0):
        yield (
            f"fan of {fov:g}°",
            "worst beam inside a ball",
            *pair(regimes.wide_fan(fov), per_cent),
            "wide_fans",
        )
    level, rolled = {}, {"roll": 0.3, "pitch": 0.1, "yaw": 0.7}
    for lowest, turn, how in ((1.0, level, ""), (0.5, level, ""), (1.0, rolled, ", sonar rolled")):
        got = regimes.grazing_floor(3.0, 0.05, lowest, **turn)
        plain = f"{per_cent(got['empty'])} of bins empty, rms {per_cent(got['naive'])}"
        ours = f"rms {per_cent(got['ours'])}, worst {per_cent(got['worst'])}"
        yield f"floor to {lowest:g}° of grazing{how}", "error of single bins", plain, ours, "grazing_floors"
    got = regimes.grazing_floor(3.0, 0.05, roll=math.pi / 2, bins=200, nodes=2000)
    its = per_cent(got["naive_wrong"]), per_cent(got["wrong"])
    yield "floor, sonar on its side", "echo in wrong bins", *its, "on_its_side"
    for tolerance in (0.05, 0.01):
        plain, ours, empty, worst = regimes.fine_bins(tolerance)
        yield (
            f"bins of 2.5 mm, tolerance {tolerance:g}",
            "echo in wrong bins",
            f"{per_cent(plain)}, {per_cent(empty)} of bins empty",
            f"{per_cent(ours)}, worst bin {per_cent(worst)}",
            "fine_bins",
        )
    for name, bodies in (("no bodies", []), ("nothing in range", [regimes.plate("wall", 30, 10)])):
        (_, plain), (_, ours) = regimes.no_echo(bodies)
        words = (f"“{text[0]}”" if text else "black image, no message" for text in (plain, ours))
        yield name, "message", *words, "empty_scenes"
    for distance in (100.0, 1000.0):
        millimetres = pair(regimes.far_wall(distance), lambda m: f"{1000 * m:.2g} mm")
        yield f"wall at {distance:g} m", "error of range", *millimetres, "far_walls"
    leaks = "echo that leaks through the nearer surface"
    yield "hand nearer than range_min", leaks, *pair(regimes.hand_before_the_sonar(), per_cent), "nearer_than"
    yield "inside a closed body", "echo over true echo", *pair(regimes.inside_a_body(), per_cent), "inside_a"
    for name, place in (("face", (0.3, 0.2, 0)), ("edge", (2, 0.5, 0)), ("corner", (2, 2, 0))):
        measured = "naive: rays that hit the body; ours: echo in wrong bins"
        yield f"sonar on its {name}", measured, *pair(oddities.on_a_body(*place), per_cent), "on_a_face"
    wrong = "echo in wrong bins"
    yield "ball, 2 samples a beam", wrong, *pair(regimes.silhouette(), per_cent), "silhouettes"
    for distance in (20.0, 100.0):
        got = pair(regimes.paint_before_a_wall(distance), per_cent)
        yield f"faces 5 mm apart at {distance:g} m", leaks, *got, "close_one_behind"
    yield "coplanar faces", "echo over that of one face", *pair(oddities.coplanar((1.0, 1.0))), "coplanar"
    yield (
        "open sheet from behind",
        "echo over that from the front",
        *pair(regimes.sheet_from_behind()),
        "from_behind",
    )
    changes = {"reversed": lambda n: -n, "ten times too long": lambda n: 10 * n, "missing": lambda n: 0 * n}
    for name, change in changes.items():
        yield (
            f"normals {name}",
            "echo over that with valid normals",
            *pair(oddities.shading_normals(change)),
            "odd_normals",
        )
    measured = "naive: normals that are NaN; ours: echo in wrong bins"
    yield "degenerate and duplicate triangles", measured, *pair(oddities.broken_triangles()), "degenerate"
    yield "UTM coordinates", wrong, *pair(regimes.far_from_the_origin(), per_cent), "far_from_the_origin"
    measured = "naive: turn by a round trip through Euler angles; ours: echo in wrong bins"
    turned, ours = oddities.attitude(0.3, math.pi / 2, 1.0)
    yield "sonar looking straight down", measured, f"{turned:.0f}°", per_cent(ours), "straight_down"
    measured = "naive: share of NaN; ours: float32 steps above 1"
    yield "cos θ a hair above 1", measured, *pair(oddities.cosine_above_one()), "hair_above"
    measured = "bin (-1: none) of walls just before and after range_min and range_max, 12 bins"
    yield "ends of the bins", measured, *map(str, oddities.bin_ends()), "ends_of_the_bins"
    for beams, bins in ((1, 1), (255, 8191), (4096, 512)):
        got = pair(oddities.many_beams_and_bins(beams, bins), per_cent)
        yield f"beams, bins: {beams}, {bins}", "worst beam inside a ball", *got, "odd_counts"
    yield "millions of echoes in one bin", "error", *pair(oddities.long_sums(), per_cent), "saturation"
    measured = "sums that differ when repeated"
    yield "same seed", measured, *pair(oddities.order_of_sums(), per_cent), "test_stability.py"
    yield from rod_rows()


def rod_rows():
    """Give the rows of rods and cables: pings that lose them, and the worst spread of their echo."""
    normal, fine = sg.Sampling(1.5, 62), sg.Sampling(4, 130)
    for settings, plain, lengths, askew, text in (
        ({"sampling": fine}, fine, (2.0, 4.0), 45, "2 to 4 m, 1024 x 130 samples"),
        (
            {"tolerance": 0.05},
            normal,
            (0.3, 3.0),
            0,
            "0.3 to 3 m; naive 384 x 62 samples, ours tolerance 0.05",
        ),
    ):
        for diameter, range_m in rods.RODS + rods.CABLES:
            sonar, plain_ratios, ours = rods.rod_sonar(range_max_m=60.0), [], []
            for k in range(9):
                rng = rods.rng_of(diameter, range_m, k)
                rod = rods.random_rod(rng, diameter, range_m, rods.KINDS[k % 3], lengths, askew)
                places = rods.shifts(rng)[::4]
                ours.append(rods.echo_ratios(rod, sonar, places, **settings))
                with naive.plain_grid():
                    plain_ratios.append(rods.echo_ratios(rod, sonar, places, sampling=naive.in_points(plain)))
            regime = f"rod of {1000 * diameter:g} mm at {range_m:g} m"
            yield regime, text, *map(describe_ratios, (plain_ratios, ours)), "test_rods.py"


def describe_ratios(ratios):
    """Return the share of pings that lose their rod, and the worst spread of echoes, as text."""
    lost = (np.concatenate(ratios) < 0.01).mean()
    return f"lost in {per_cent(lost)}, spread {max(map(rods.spread, ratios)):.2f}"


def print_table(markdown):
    """Print all rows as they are measured."""
    if markdown:
        print("| regime | what is measured | naive | ours | test |\n|---|---|---|---|---|")
    for row in rows():
        print("| " + " | ".join(row) + " |" if markdown else "   ".join(row), flush=True)


def print_soak(n_pings):
    """Print the growth of memory and of GL objects over so many pings."""
    with soak.make_simulator() as simulator:
        soak.run(simulator, 500)
        before, objects, start = soak.resident_bytes(), soak.gl_objects(simulator), perf_counter()
        soak.run(simulator, n_pings)
        seconds = perf_counter() - start
        growth = soak.resident_bytes() - before
        print(f"{n_pings} pings, {seconds:.0f} s, {1000 * seconds / n_pings:.2f} ms a ping")
        print(f"memory {before / 1e6:.0f} MB, grown by {growth / 1e6:.2f} MB")
        print(f"GL objects before {objects}\nGL objects after  {soak.gl_objects(simulator)}")


def print_moving(n_pings):
    """Print the memory of a sequence whose samples change, with labels and noise."""
    after, peak, n_samplings = moving.measure(n_pings)
    print(f"{n_pings} pings with {n_samplings} samplings: {after:.0f} MB after them, {peak:.0f} MB at most")


def print_triangles(millions):
    """Print time and memory of a ping of one rough floor of so many triangles."""
    side = round(math.sqrt(millions * 1e6 / 2))
    x, y = np.meshgrid(np.linspace(0, 40, side + 1), np.linspace(-20, 20, side + 1), indexing="ij")
    vertices = np.stack([x, y, 0.1 * np.sin(7 * x) * np.sin(5 * y) - 3], axis=-1).reshape(-1, 3)
    corner = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()[:, None]
    faces = np.concatenate(
        [corner + np.array(three) for three in ((0, side + 1, side + 2), (0, side + 2, 1))]
    )
    start = perf_counter()
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    with regimes.simulate([sg.Body("floor", mesh)]) as simulator:
        made = perf_counter()
        total = simulator.ping(np.eye(4)).intensity.sum()
        done = perf_counter()
        simulator.ping(np.eye(4))
        print(f"{len(faces)} triangles, made in {made - start:.1f} s")
        print(f"memory {soak.resident_bytes() / 1e9:.1f} GB")
        print(f"first ping {done - made:.2f} s, next {perf_counter() - done:.2f} s, echo {total:.4g}")


def print_rods(count):
    """Print how `tolerance=0.05` keeps the echo of random rods, `count` a kind, alone and before a floor."""
    for place in ("alone", "before a floor"):
        spreads, least, faint, start = [], [], 0, perf_counter()
        for (diameter, range_m), width, k in itertools.product(
            rods.RODS, (rods.WIDE_BEAMS_DEG, rods.NARROW_BEAMS_DEG), range(count)
        ):
            rod, rng = rods.rod_of(diameter, range_m, width, k)
            sonar, places = rods.rod_sonar(width), rods.shifts(rng)[::20]
            if place == "alone":
                ratios = rods.echo_ratios(rod, sonar, places, tolerance=0.05)
            else:
                below_m = rng.uniform(2, 3)
                ratios, shares = rods.echo_ratios_before_a_floor(rod, below_m, sonar, places, tolerance=0.05)
                if shares.min() < 1e-3:  # too faint for the tolerance to hold
                    faint += 1
                    continue
            spreads.append(rods.spread(ratios))
            least.append(ratios.min())
        spreads = np.array(spreads)
        print(
            f"{len(spreads)} rods {place} ({faint} too faint): spread median {np.median(spreads):.2f}, "
            f"worst {spreads.max():.2f}, above 0.25 {(spreads > 0.25).sum()}; "
            f"least echo {min(least):.2f} of the truth; {perf_counter() - start:.0f} s"
        )


def main():
    """Print what the options name."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.docs.failures", description=__doc__.partition("\n")[0]
    )
    parser.add_argument("--markdown", action="store_true", help="the table of docs/failures.md")
    parser.add_argument("--soak", type=int, metavar="N", help="only so many pings")
    parser.add_argument("--moving", type=int, metavar="N", help="only so many pings of a moving sonar")
    parser.add_argument(
        "--triangles", type=float, metavar="M", help="only a mesh of so many million triangles"
    )
    parser.add_argument("--rods", type=int, metavar="N", help="only so many rods of each kind, by tolerance")
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # no echo came back: that is measured
    if options.soak:
        print_soak(options.soak)
    if options.moving:
        print_moving(options.moving)
    if options.triangles:
        print_triangles(options.triangles)
    if options.rods:
        print_rods(options.rods)
    if not (options.soak or options.moving or options.triangles or options.rods):
        print_table(options.markdown)


if __name__ == "__main__":
    main()
