"""Time and judge the embedding modes of `sonar_gl.embed`, in a bare OpenGL program and in examples/.

    python -m tools.bench embed --docs docs       # all; writes the tables of docs/embedding.md, and its chart
    python -m tools.bench embed --only pylon
    python -m tools.bench embed --hosts           # the hosts of examples/ alone
    python -m tools.bench embed --cameras         # what depth cameras that are not ideal cost, alone

The scenes are the chart's: 256 box beams a degree wide over 45 degrees, 512 bins to 30 m, profile ideal,
faces flat, errors against `sonar_gl.reference_ping`. What the host draws anyway, its images, is not counted;
what it draws for the sonar alone, its sectors, is.
"""

from __future__ import annotations

import tempfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from PIL import Image

import sonar_gl as sg
from sonar_gl.analysis.verify import ping_error
from sonar_gl.embed.sensor import Sensor
from sonar_gl.embed.textures import read_textures
from sonar_gl.gl.host import CurrentContext, HostContext
from tests.support import gl_host
from tools.bench import harness, host
from tools.bench.harness import Contender
from tools.chart.scenes import make_scene, make_sonar, make_truth
from tools.docs.pages import put_table
from tools.pictures import write_figure, write_png

ROUNDS = 15, 1
SCENES = ("pylon", "tank", "ocean_floor")
SAMPLES = ((0.5, 24), (1, 48), (2, 96), (4, 192))  # columns a beam, rows
PIXELS_DEG = (0.8, 0.4, 0.2, 0.1, 0.05)
STANDALONE, SHARED, SECTORS = "standalone", "1: shared context", "2: host-drawn sectors"
TEXTURES, IMAGES = "3: textures with normals", "4: depth images with normals"
BARE = "4: depth images, normals from depth"
LOOKS = {
    STANDALONE: ("#222222", "s"),
    SHARED: ("#1f77b4", "o"),
    SECTORS: ("#2ca02c", "^"),
    TEXTURES: ("#9467bd", "D"),
    IMAGES: ("#d62728", "v"),
    BARE: ("#ff9896", "x"),
}
KINDS = "metres", "normals", "numbers"
SHOWN = "pyrender_host", "mujoco_host"  # in the page
SHOWN_SCENE = "pylon"  # whose table is in the page; the chart shows all
CAMERA = sg.Camera.of_fov(640, 480, fov_x_rad=np.radians(60))
NOISE_M, HOLES, STEPS_MM, ASIDE_CM = 0.005, 0.05, (1, 10), (2, 5, 10, 30)


class Modes:
    """All ways to a ping of one scene, in a host that draws it.

    Attributes
    ----------
    pings : {(mode, samples or pixels): function that makes a ping}
    """

    def __init__(self, scene, sonar, stack, quick):
        self.scene, self.sonar, self.stack, self.pose = scene, sonar, stack, scene.sonar_pose
        self.ideal, self.host, self.pings = sg.Acoustics.ideal(), gl_host.Program(scene), {}
        self.mu = {number: float(np.mean(body.reflectivity)) for number, body in enumerate(scene.bodies, 1)}
        for columns, rows in SAMPLES[:2] if quick else SAMPLES:
            arguments = sonar, self.ideal, sg.Sampling(columns, rows)
            alone = stack.enter_context(sg.Simulator(scene, *arguments, engine="opengl"))
            shared = stack.enter_context(sg.Simulator(scene, *arguments, context="current"))
            sensor = stack.enter_context(Sensor(*arguments))
            samples = f"{columns:g} x {rows}"
            self.pings |= {
                (STANDALONE, samples): lambda it=alone: it.ping(self.pose),
                (SHARED, samples): lambda it=shared: it.ping(self.pose),
                (SECTORS, samples): lambda it=sensor: self.draw_sectors(it),
            }
        for pixel_deg in PIXELS_DEG[:2] if quick else PIXELS_DEG:
            self.add_images(pixel_deg)

    def draw_sectors(self, sensor):
        """Have the host draw the sectors; return the ping."""
        for sector in sensor.sectors(self.pose):
            with sector:
                self.host.draw("sonar", sector.view, sector.projection, sector.lattice)
        return sensor.finish()

    def add_images(self, pixel_deg):
        """Have the host draw images of a pixel size, once, and add the pings of their textures and arrays."""
        cameras = sg.Camera.covering(self.sonar, self.ideal, pixel_deg)
        sensor = self.stack.enter_context(Sensor(self.sonar, self.ideal))
        drawn, metres, normals, numbers, projections = [], [], [], [], []
        for number, camera in enumerate(cameras):
            view, projection = np.linalg.inv(camera.pose_gl(self.pose)), camera.projection(0.1, 300.0)
            # the host draws images of one size into the same textures: those of several cameras must differ
            self.host.framebuffers.pop((camera.width, camera.height), None)
            drawn.append(self.host.textures(view, projection, camera.width, camera.height))
            projections.append(projection)
            images = read_textures(
                HostContext(CurrentContext()), [(drawn[number][kind], kind, kind) for kind in KINDS]
            )
            metres.append(images[0])
            normals.append(images[1][..., :3] * np.float32([1, -1, -1]))
            numbers.append(images[2])
        rotations, mu = [camera.rotation for camera in cameras], {"reflectivity": self.mu}
        size = f"{cameras[0].width} x {cameras[0].height}" + (f", {len(cameras)}" if len(cameras) > 1 else "")

        def textures():
            names = [[one[name] for one in drawn] for name in ("z-buffer", "normals", "numbers")]
            more = {"rotation": rotations, "normals": names[1], "body_id": names[2], **mu}
            return sensor.ping_from_textures(names[0], projections, self.pose, **more)

        def arrays(normals=None):
            return sensor.ping_from_depth(metres, cameras, self.pose, normals=normals, body_id=numbers, **mu)

        self.pings |= {
            (TEXTURES, size): textures,
            (IMAGES, size): lambda: arrays(normals),
            (BARE, size): arrays,
        }


def measure(name: str, rounds: int, quick: bool) -> list[dict]:
    """Return one row a mode and size of samples or pixels."""
    scene, sonar = make_scene(name), make_sonar(name, "wide")
    truth = make_truth(scene, sonar, quick=True)
    context = gl_host.make_context()
    with ExitStack() as stack:
        pings = Modes(scene, sonar, stack, quick).pings
        errors = {key: ping_error(ping(), truth) for key, ping in pings.items()}

        def contender(ping):
            return Contender(lambda _: ping(), before=lambda _: ping())

        times = harness.take_turns({key: contender(ping) for key, ping in pings.items()}, rounds, warm_up=0)
    context.release()
    return [
        {
            "mode": mode,
            "samples": samples,
            "ms": float(np.median(times[mode, samples])),
            "ratio": harness.ratio(ms, times[STANDALONE, samples])
            if (STANDALONE, samples) in times
            else None,
            "error": errors[mode, samples],
        }
        for (mode, samples), ms in times.items()
    ]


def measure_camera(name: str) -> dict[str, float]:
    """Return the share of echo in wrong bins, by what is wrong with the images of CAMERA."""
    scene, sonar = make_scene(name), make_sonar(name, "wide")
    truth, context = make_truth(scene, sonar, quick=True), gl_host.make_context()
    host, size = gl_host.Program(scene), (CAMERA.width, CAMERA.height)
    mu = {number: float(np.mean(body.reflectivity)) for number, body in enumerate(scene.bodies, 1)}
    random = np.random.default_rng(0)

    def images(aside_m=0.0):
        view = np.linalg.inv(CAMERA.pose_gl(scene.sonar_pose @ sg.pose(0, aside_m, 0)))
        drawn = host.textures(view, CAMERA.projection(0.1, 300.0), *size)
        out = read_textures(HostContext(CurrentContext()), [(drawn[kind], kind, kind) for kind in KINDS])
        return {"depth": out[0], "normals": out[1][..., :3] * np.float32([1, -1, -1]), "body_id": out[2]}

    with Sensor(sonar, sg.Acoustics.ideal()) as sensor:

        def error(depth, body_id, normals=None, camera=CAMERA):
            more = {"normals": normals, "body_id": body_id, "reflectivity": mu}
            return ping_error(sensor.ping_from_depth(depth, camera, scene.sonar_pose, **more), truth)

        exact = images()
        depth, body_id = exact["depth"], exact["body_id"]
        found = {"none, with normals": error(**exact), "none": error(depth, body_id)}
        lower = np.add(CAMERA.intrinsics, [[0, 0, 0], [0, 0, 0.5], [0, 0, 0]])
        found["half a pixel too low, with normals"] = error(**exact, camera=sg.Camera(*size, lower))
        for step_mm in STEPS_MM:
            steps = np.round(depth * (1000 / step_mm)) * (step_mm / 1000)
            found[f"depth in steps of {step_mm} mm"] = error(steps, body_id)
        noise = random.normal(0, NOISE_M, depth.shape)
        found[f"noise of {1000 * NOISE_M:g} mm"] = error(np.where(depth > 0, depth + noise, 0), body_id)
        holes = random.random(depth.shape) < HOLES
        found[f"{100 * HOLES:g} % of pixels empty"] = error(np.where(holes, 0, depth), body_id)
        for aside_cm in ASIDE_CM:
            found[f"{aside_cm} cm to port of the sonar, with normals"] = error(**images(aside_cm / 100))
    context.release()
    return found


def table_of_cameras(found: dict) -> str:
    """Return the figures of `measure_camera`, by scene, as Markdown."""
    faults = next(iter(found.values()))
    return harness.markdown(
        [
            {"fault": fault, **{name: f"{100 * errors[fault]:.1f} %" for name, errors in found.items()}}
            for fault in faults
        ]
    )


def table_of(rows: list[dict]) -> str:
    """Return the rows as Markdown, mode by mode."""
    return harness.markdown(
        [
            {
                "mode": row["mode"],
                "samples, or pixels": row["samples"],
                "ms": f"{row['ms']:.1f}",
                "over standalone": ""
                if mode == STANDALONE or row["ratio"] is None
                else f"{row['ratio']:.2f}",
                "echo in wrong bins": f"{100 * row['error']:.2f} %",
            }
            for mode in LOOKS
            for row in rows
            if row["mode"] == mode
        ]
    )


def table_of_hosts(found: dict) -> str:
    """Return the figures of hosts as Markdown; found : of `host.measure` by name."""
    return harness.markdown(
        [
            {
                "example": f"`{name}.py`",
                "mode": row["mode"],
                "ms": f"{row['ms']:.1f}",
                "over standalone": f"{row['ratio']:.2f}",
            }
            for name, rows in found.items()
            for row in rows
        ]
    )


def draw_chart(path: Path, charts: dict, about: str):
    """Draw time and error of all modes, one panel a scene."""
    from matplotlib import pyplot
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure, panels = pyplot.subplots(1, len(charts), figsize=(3.6 * len(charts) + 0.6, 5.0), sharey=True)
    panels = np.atleast_1d(panels)
    for axes, (name, rows) in zip(panels, charts.items(), strict=True):
        for mode, (colour, marker) in LOOKS.items():
            points = [(row["ms"], 100 * row["error"]) for row in rows if row["mode"] == mode]
            axes.loglog(*zip(*points, strict=True), color=colour, marker=marker, markersize=5, label=mode)
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("ping, ms (median)")
        axes.grid(True, which="major", color="#dddddd")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(10, (1.0, 3.0)))
            axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
            axis.set_minor_formatter(NullFormatter())
    panels[0].set_ylabel("echo in wrong bins, %")
    handles = panels[0].get_legend_handles_labels()
    figure.legend(
        *handles, loc="lower center", ncols=3, fontsize=8.5, frameon=False, bbox_to_anchor=(0.5, 0.05)
    )
    figure.text(0.5, 0.015, about, ha="center", fontsize=7.2, color="#444444")
    figure.subplots_adjust(left=0.08, right=0.985, top=0.93, bottom=0.29, wspace=0.06)
    write_figure(path, figure, dpi=110)


def measure_hosts(rounds: int, pictures: Path | None) -> dict:
    """Run all hosts of examples/; put the pictures of SHOWN into a folder."""
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in host.HOSTS:
            found[name] = host.measure(name, rounds, Path(folder))
            if pictures and name in SHOWN:
                with Image.open(Path(folder) / f"{name}.png") as picture:
                    write_png(pictures / f"embedding_{name}.png", picture, 160)
    return found


def add_options(parser):
    """Add the options of this bench."""
    parser.add_argument("--only", action="append", choices=SCENES, help="may be repeated; default: all")
    parser.add_argument("--hosts", action="store_true", help="the hosts of examples/ alone")
    parser.add_argument("--cameras", action="store_true", help="depth cameras that are not ideal, alone")
    parser.add_argument("--docs", type=Path, help="folder of embedding.md and pictures/, which are rewritten")


def run(options) -> dict:
    """Measure scenes and hosts; write the page."""
    names = () if options.hosts or options.cameras else options.only or SCENES
    found = {name: measure(name, options.rounds, options.quick) for name in names}
    texts, docs = {name: table_of(rows) for name, rows in found.items()}, options.docs
    if options.cameras or not (options.only or options.quick or options.hosts):
        found["cameras"] = {name: measure_camera(name) for name in SCENES}
        texts["cameras"] = table_of_cameras(found["cameras"])
    if options.hosts or not (options.only or options.quick or options.cameras):
        found["hosts"] = measure_hosts(host.ROUNDS[0], docs and docs / "pictures")
        texts["hosts"] = table_of_hosts(found["hosts"])
    if docs:
        machine = harness.describe_machine("opengl")  # by which all modes draw
        by, cores = machine["gl_renderer"], f"{machine['cores']} cores of {machine['processor']}"
        alone_by = harness.describe_machine()["gl_renderer"]
        if names:
            charts = {name: found[name] for name in names}
            draw_chart(docs / "pictures" / "chart_embedding.png", charts, harness.one_line(machine))
        for name, text in texts.items():
            if name in SCENES and name != SHOWN_SCENE:
                continue
            about = f"All modes draw by {by}; {cores}."
            if name == "hosts":
                about = f"Hosts draw by {by}, the standalone simulator by its default: {alone_by}; {cores}."
            # errors alone, whatever draws
            text = text if name == "cameras" else f"{about}\n\n{text}"
            put_table(docs / "embedding.md", name, text)
    return {"modes": found, "tables": texts}


def report(found: dict):
    """Print the tables."""
    for name, text in found["tables"].items():
        print(f"\n{name}\n\n{text}")
