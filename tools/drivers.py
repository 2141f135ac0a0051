"""Compare pictures of several OpenGL drivers with those of the engine `cpu`, and run a part of the tests on each.

    python -m tools.drivers                              # all; exit status 1 if one that can be had fails
    python -m tools.drivers softpipe "OpenGL 3.3"        # some
    python -m tools.drivers --no-tests                   # pictures only
    python -m tools.drivers --debian debian13   # keeps the Debian 13 of `zink` there for the next time

`card` is the graphics card that OpenGL finds by itself; `softpipe` is another rasteriser; `OpenGL 3.3` draws bodies one
by one; `as on a card` reads by pixel-pack buffers, as graphics cards do; `none` is the engine without OpenGL, by whose
pictures the others are judged; `zink` translates to SPIR-V for Mesa's Vulkan driver. Mesa
25 is needed for `zink`, and comes from Debian 13: debootstrap installs its libraries in a folder, and the processes of
that driver see them in place of the system's, in a mount namespace of their own. That takes root, and a minute.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

import sonar_gl as sg
from sonar_gl.cli import system_checks
from sonar_gl.gl import context as gl

ROOT = Path(__file__).resolve().parents[1]
SCENES = "pylon", "diver", "ocean_floor"
# None is chosen for a tolerance: where the estimate just meets it, two drivers may take different ones.
SAMPLINGS = {"coarse": sg.Sampling(0.6, 68), "fine": sg.Sampling(2, 100)}
# A sample within 1/256 of an edge, to which drivers snap corners, belongs to either side by the driver's rule. The
# brightest sample of these pictures holds 2.3e-4 of the echo (pylon, coarse): two such samples may differ.
MAX_ECHO, MAX_BODIES = 5e-4, 5e-4
FAILURES = "tests/end_to_end/test_failures.py"
TESTS = (
    "tests/raster/test_renderer.py",
    "tests/raster/test_window.py",
    "tests/raster/test_cull.py",
    "tests/embed/test_shader_noise.py",
    "tests/beamform/test_labels.py",
    "tests/embed/test_modes.py",
    FAILURES,
)
TIMEOUT_S = 300
SUITE, MIRROR = "trixie", "http://deb.debian.org/debian"
PACKAGES = "python3,libegl1,libgl1,libgl1-mesa-dri,libegl-mesa0,mesa-vulkan-drivers"
LIBRARIES = f"usr/lib/{sysconfig.get_config_var('MULTIARCH') or 'none'}"
# in a mount namespace, so that no other process sees it
SEE_DEBIAN = f"""
mount --bind "$1/usr/share/glvnd" /usr/share/glvnd && mount --bind "$1/{LIBRARIES}" /{LIBRARIES} && shift && exec "$@"
"""


@dataclass(frozen=True)
class Driver:
    """An OpenGL driver: environment variables that choose it, and whether it is Debian 13's."""

    name: str
    environment: dict = field(default_factory=dict)
    is_debian: bool = False


ZINK = {"LIBGL_ALWAYS_SOFTWARE": "1", "GALLIUM_DRIVER": "zink", "MESA_LOADER_DRIVER_OVERRIDE": "zink"}
OPENGL_3_3 = {  # and no extension that lets one call draw many bodies
    "MESA_GL_VERSION_OVERRIDE": "3.3",
    "MESA_GLSL_VERSION_OVERRIDE": "330",
    "MESA_EXTENSION_OVERRIDE": "-GL_ARB_multi_draw_indirect",
}
REFERENCE = Driver("none", {"SONAR_GL_ENGINE": "cpu"})
DRIVERS = (
    Driver("card"),
    Driver("llvmpipe", {"LIBGL_ALWAYS_SOFTWARE": "1", "GALLIUM_DRIVER": "llvmpipe"}),
    Driver("softpipe", {"LIBGL_ALWAYS_SOFTWARE": "1", "GALLIUM_DRIVER": "softpipe"}),
    Driver("OpenGL 3.3", OPENGL_3_3),
    Driver("as on a card", {"SONAR_GL_SOFTWARE": "0"}),
    REFERENCE,
    Driver("llvmpipe 25", {"LIBGL_ALWAYS_SOFTWARE": "1", "GALLIUM_DRIVER": "llvmpipe"}, is_debian=True),
    Driver("zink", ZINK, is_debian=True),
)


@dataclass(frozen=True)
class Pictures:
    """What a driver draws: `facts` by name; intensity and numbers of bodies by picture."""

    facts: dict
    arrays: dict


def draw_pictures(folder: Path) -> None:
    """Write the pictures of this process's driver, and facts about it, to a folder."""
    ok, detail, _ = system_checks.check_known_scene()
    facts, arrays = {"doctor": "ok" if ok else f"FAIL: {detail}", "ms": []}, {}
    for name in SCENES:
        scene = sg.load_scene(name)
        for name_of_sampling, sampling in SAMPLINGS.items():
            with sg.Simulator(scene, sg.load_sonar("p900-45"), sampling=sampling) as simulator:
                ping = simulator.ping(scene.sonar_pose, labels=True)
                arrays[f"{name}, {name_of_sampling}, echo"] = ping.intensity
                arrays[f"{name}, {name_of_sampling}, bodies"] = ping.body_id
                facts |= {key: simulator.gl_info[key] for key in ("renderer", "version")}
                if name_of_sampling == "fine":
                    facts["ms"].append(ms_of_ping(simulator, scene.sonar_pose))
    np.savez(folder / "pictures.npz", **arrays)
    (folder / "facts.json").write_text(json.dumps(facts))


def ms_of_ping(simulator: sg.Simulator, pose) -> float:
    """Return the milliseconds of a ping, the least of nine."""
    times = []
    for _ in range(9):
        begin = time.perf_counter()
        simulator.ping(pose)
        times.append(1e3 * (time.perf_counter() - begin))
    return min(times)


def run_on(driver: Driver, debian: Path | None, *arguments: str) -> subprocess.CompletedProcess:
    """Run Python with arguments on a driver."""
    command = [sys.executable, *arguments]
    chosen = {variable for other in DRIVERS for variable in other.environment}
    environment = {name: value for name, value in os.environ.items() if name not in chosen}
    environment |= {"SONAR_GL_ENGINE": "opengl"} | driver.environment
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), environment.get("PYTHONPATH", "")]).rstrip(
        os.pathsep
    )
    if driver.is_debian:
        command = ["unshare", "--mount", "bash", "-c", SEE_DEBIAN, "bash", str(debian), *command]
        environment["VK_DRIVER_FILES"] = str(next(debian.glob("usr/share/vulkan/icd.d/lvp_icd*.json")))
    return subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S
    )


def install_debian(folder: Path) -> str:
    """Install the libraries of Debian 13 in a folder, if they are not there; return why not, or ''."""
    if next(folder.glob("usr/share/vulkan/icd.d/lvp_icd*.json"), None):
        return ""
    if missing := [tool for tool in ("debootstrap", "unshare") if shutil.which(tool) is None]:
        return f"needs {' and '.join(missing)}: apt-get install debootstrap util-linux"
    if os.geteuid() != 0:
        return "needs root, for debootstrap and a mount namespace"
    if not Path("/", LIBRARIES).is_dir():
        return f"needs a Debian or Ubuntu of {LIBRARIES}"
    folder.mkdir(parents=True, exist_ok=True)
    command = ["debootstrap", "--variant=minbase", f"--include={PACKAGES}", SUITE, str(folder), MIRROR]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return f"debootstrap took longer than {TIMEOUT_S} s"
    return (
        "" if done.returncode == 0 else f"debootstrap failed: {(done.stdout or done.stderr).splitlines()[-1]}"
    )


def why_no_card() -> str:
    """Return why there is no graphics card, or ''."""
    context = gl.hardware_context()
    if context is None:
        return "OpenGL finds none"
    context.release()
    return ""


def pictures_of(driver: Driver, debian: Path | None) -> Pictures | str:
    """Return a driver's pictures, or why there are none."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            done = run_on(driver, debian, "-W", "ignore", "-m", "tools.drivers", "--draw", folder)
        except subprocess.TimeoutExpired:
            return f"took longer than {TIMEOUT_S} s"
        if done.returncode:
            return (done.stderr.strip() or "ended without a message").splitlines()[-1]
        with np.load(Path(folder, "pictures.npz")) as arrays:
            return Pictures(json.loads(Path(folder, "facts.json").read_text()), dict(arrays))


def differences(pictures: Pictures, reference: Pictures) -> tuple[float, float]:
    """Return the worst shares of the echo that differ from the reference's, and that lie in bins of another body."""
    worst = [0.0, 0.0]
    for name in (name.removesuffix(", echo") for name in reference.arrays if name.endswith(", echo")):
        (got, bodies), (expected, expected_bodies) = (
            (one.arrays[f"{name}, echo"].astype(float), one.arrays[f"{name}, bodies"])
            for one in (pictures, reference)
        )
        differing = np.abs(got - expected).sum(), expected[bodies != expected_bodies].sum()
        worst = [max(most, float(one / expected.sum())) for most, one in zip(worst, differing, strict=True)]
    return worst[0], worst[1]


def run_tests(driver: Driver, debian: Path | None) -> tuple[dict[bool, Counter], list[str]]:
    """Return how many tests passed, failed or were skipped, by whether they are of the list of failures; and what to
    print.
    """
    counts, lines = {False: Counter(), True: Counter()}, []
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.xml")
        try:
            run_on(driver, debian, "-m", "pytest", "-q", "-m", "not slow", f"--junitxml={report}", *TESTS)
        except subprocess.TimeoutExpired:
            return counts, [f"the tests took longer than {TIMEOUT_S} s"]
        if not report.exists():
            return counts, ["the tests did not run"]
        for case in ElementTree.parse(report).iter("testcase"):
            result = next(
                (child.tag for child in case if child.tag in ("failure", "error", "skipped")), "passed"
            )
            counts[case.get("classname", "").endswith("test_failures")][result] += 1
            if result != "passed":
                lines.append(f"{result}: {case.get('classname')}::{case.get('name')}")
    return counts, lines


def passed_of(counts: Counter) -> str:
    """Return such as "56 passed, 1 skipped"."""
    return ", ".join(
        f"{counts[kind]} {kind}" for kind in ("passed", "failure", "error", "skipped") if counts[kind]
    )


def compare(drivers, debian: Path | None, with_tests: bool) -> bool:
    """Print a row of each driver; return whether all that can be had are right."""
    reference, all_right, notes = pictures_of(REFERENCE, None), True, []
    if isinstance(reference, str):
        sys.exit(
            f"the pictures of the engine cpu, with which the others are compared, must be drawn: {reference}"
        )
    print(
        "| driver | renderer, version | doctor | echo differs | bodies differ | ms a ping | tests | failure list |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for driver in drivers:
        why = install_debian(debian) if driver.is_debian else why_no_card() if driver.name == "card" else ""
        pictures = why or pictures_of(driver, debian)
        if isinstance(pictures, str):
            all_right &= bool(why)  # what cannot be had here is no failure
            print(
                f"| {driver.name} | {'not to be had' if why else 'FAIL'}: {pictures} | | | | | | |",
                flush=True,
            )
            continue
        echo, bodies = differences(pictures, reference)
        counts, lines = run_tests(driver, debian) if with_tests else ({False: Counter(), True: Counter()}, [])
        failed = sum(count["failure"] + count["error"] for count in counts.values())
        did_run = not with_tests or bool(counts[False]["passed"])
        all_right &= pictures.facts["doctor"] == "ok" and echo < MAX_ECHO and bodies < MAX_BODIES
        all_right &= did_run and not failed
        notes += [f"{driver.name}: {line}" for line in lines]
        facts, ms = pictures.facts, " / ".join(f"{ms:.1f}" for ms in pictures.facts["ms"])
        row = driver.name, f"{facts['renderer']}, {facts['version']}", facts["doctor"], f"{echo:.1e}"
        row += f"{bodies:.1e}", ms, passed_of(counts[False]), passed_of(counts[True])
        print(f"| {' | '.join(row)} |", flush=True)
    print("\n".join(["", *notes] if notes else []))
    return all_right


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="DRIVER", help=", ".join(one.name for one in DRIVERS))
    parser.add_argument("--no-tests", action="store_true", help="compare pictures only")
    parser.add_argument("--debian", type=Path, help="folder of Debian 13, kept; a temporary one by default")
    parser.add_argument("--draw", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.draw:
        draw_pictures(options.draw)
        return
    for driver in DRIVERS:  # a caller's own choice would make a software driver a card
        for variable in driver.environment:
            os.environ.pop(variable, None)
    if unknown := set(options.names) - {one.name for one in DRIVERS}:
        parser.error(f"drivers must be of {', '.join(one.name for one in DRIVERS)} (got {sorted(unknown)})")
    drivers = [one for one in DRIVERS if not options.names or one.name in options.names]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        all_right = compare(
            drivers, (options.debian or Path(folder, "debian")).resolve(), not options.no_tests
        )
    sys.exit(0 if all_right else 1)


if __name__ == "__main__":
    main()
