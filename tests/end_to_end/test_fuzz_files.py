"""Files with random mistakes, and settings with odd numbers, give one `sonar_gl.Error` or are accepted.

`python -m tests.support.file_fuzzer SEED SECONDS` tries more.
"""

import dataclasses
import random

import numpy as np
import pytest

import sonar_gl as sg
from tests.support.file_fuzzer import JOB, is_sound_message, make_kinds, read_all_of_job, try_case

N_CASES = 30  # of each kind; ten thousand of each by hand
KINDS = ["sonar.toml", "beams.toml", "job.toml", "scene.sdf", "poses.csv", "ping.npz", "members.npz"]
MESHES = ["obj", "stl", "text.stl", "ply", "text.ply", "glb", "gltf", "dae"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture(scope="module")
def kinds(folder):
    return {kind.name: kind for kind in make_kinds(folder)}


@pytest.mark.parametrize("name", [*KINDS, *(f"a.{suffix}" for suffix in MESHES)])
@pytest.mark.filterwarnings("ignore")
def test_files_with_random_mistakes(kinds, folder, name):
    kind, chance = kinds[name], random.Random(name)
    (folder / name).write_bytes(kind.content)
    kind.read(folder / name)
    accepted = [try_case(kind, folder, chance) for _ in range(N_CASES)]
    assert sum(accepted) < N_CASES  # some mistakes are noticed


OBJ_FACES = "f 1 2 3\n"


@pytest.mark.parametrize(
    "text",
    [
        "v 1\nv 2\nv 3\n",
        "v 1 2\nv 2 3\nv 3 4\n",
        "v 0 0 0 0 0 0 0\nv 1 0 0 0 0 0 0\nv 0 1 0 0 0 0 0\n",
        "v\nv\nv\n",
    ],
)
def test_vertices_of_other_columns(tmp_path, text):
    (tmp_path / "a.obj").write_text(text + OBJ_FACES)
    try:
        (body,) = sg.load_scene(tmp_path / "a.obj").bodies
    except sg.Error as why:
        assert str(why).startswith(f"{tmp_path / 'a.obj'}: ") and is_sound_message(str(why))
    else:
        assert body.surface.vertices.shape == (3, 3)  # what follows x y z is colour


@pytest.mark.parametrize(
    ("old", "new", "place"),
    [
        ("target_size_m = [1.0, 1.0, 1.0]", "target_size_m = [1.0, [], 1.0]", "poses[4].target_size_m"),
        (
            "mount = [0.1, 0.0, 0.2, 0.0, 0.1, 0.0]",
            "mount = [0.1, [], 0.2, 0.0, 0.1, 0.0]",
            "sonars[0].mount",
        ),
        ("x_m = [-1.0, 1.0]", "x_m = [-1.0, [1.0]]", "vary.bodies[0].x_m"),
        ("x_m = [-1.0, 1.0]", f"x_m = [-1.0, 1{'0' * 400}]", "vary.bodies[0].x_m"),
        ('preset = "physical"', "preset = []", "noise.preset"),
        ("range_m = 8.0", "range_m = 1e308", "sonars[0]"),
        ("bins = 24", f"bins = 1{'0' * 400}", "sonars[0]"),
    ],
)
def test_values_of_a_job_that_are_none(kinds, folder, old, new, place):
    assert old in JOB
    path = folder / "wrong.toml"
    path.write_text(JOB.replace(old, new, 1))
    with pytest.raises(sg.Error) as caught:
        read_all_of_job(path)
    assert str(caught.value).startswith(f"{path}: {place}") and is_sound_message(str(caught.value))


ODD = [
    1e308,
    -1e308,
    1e-308,
    -1e-308,
    5e-324,
    np.nan,
    np.inf,
    -np.inf,
    10**400,
    -(10**400),
    10**5000,
    2**63,
    1e20,
]
ODD += [
    True,
    False,
    "1",
    "",
    None,
    [],
    [1],
    {},
    (),
    1j,
    b"x",
    0,
    -0.0,
    -1,
    np.float32(3),
    np.int64(-1),
    object(),
]
ODD += [np.array(1.0), np.array([1.0, 2.0])]
SONAR = sg.Sonar("mine", 900e3, 16, 32, 40.0, 20.0, 2.0, 0.5, 20.0)
SETTINGS = {
    "sonar": SONAR,
    "acoustics": sg.Acoustics(),
    "noise": sg.Noise(speckle=True),
    "sampling": sg.Sampling(1.0, 16),
}


@pytest.mark.parametrize("kind", SETTINGS)
@pytest.mark.filterwarnings("ignore:sonar 'mine'")  # angles that look like radians
def test_odd_values_of_every_setting(kind):
    settings = SETTINGS[kind]
    for field in dataclasses.fields(settings):
        if field.name in ("name", "source"):
            continue
        for value in ODD:
            try:
                changed = dataclasses.replace(settings, **{field.name: value})
                if kind == "sonar":
                    assert np.isfinite(changed.range_m).all() and np.isfinite(changed.azimuth_rad).all()
                if kind == "acoustics":
                    assert np.isfinite(changed.range_gain(np.array([0.5, 20.0]), SONAR)).all()
            except sg.Error as why:
                assert is_sound_message(str(why))


@pytest.mark.parametrize("value", ODD, ids=range(len(ODD)))
def test_odd_ranges(value):
    try:
        assert SONAR.with_range(value).range_max_m == value
    except sg.Error as why:
        assert is_sound_message(str(why))
    with pytest.raises(sg.Error, match="range"):
        SONAR.with_range(1e308)
