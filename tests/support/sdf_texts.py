"""The text of SDF files, put together of its elements, and what the reader makes of it."""

import warnings

from sonar_gl.scene.sdf.reader import read_sdf

ROUNDING = 1e-12  # of a few products of float64 matrices
BOX = "<geometry><box><size>2 4 6</size></box></geometry>"
RETRO = "<laser_retro>255</laser_retro>"
SHAPE = f"<collision name='c'>{BOX}{RETRO}</collision>"


def shape(tags="", name="c", kind="collision", geometry=BOX):
    return f"<{kind} name='{name}'>{geometry}{tags}</{kind}>"


def link(inside="", name="link", shape=SHAPE):
    return f"<link name='{name}'>{inside}{shape}</link>"


def model(inside, name="m"):
    return f"<model name='{name}'>{inside}</model>"


def model_of(geometry, name="m"):
    """Return a model of one shape, whose geometry is <box>, <mesh> or another."""
    return model(link(shape=shape(RETRO, geometry=f"<geometry>{geometry}</geometry>")), name)


def write(path, inside, world=True):
    path.parent.mkdir(parents=True, exist_ok=True)
    inside = f"<world name='w'>{inside}</world>" if world else inside
    path.write_text(f"<?xml version='1.0'?>\n<sdf version='1.9'>{inside}</sdf>", encoding="utf-8")
    return path


def read_warned(tmp_path, inside, *paths, **options):
    """Return the scene of a world, and the texts of its warnings without the path of its file."""
    path = write(tmp_path / "a.sdf", inside)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = read_sdf(path, paths, **options)
    return scene, [str(w.message).removeprefix(f"{path}: ") for w in caught]


def add_model(folder, name, inside=None, config=None):
    text = model(link(), name) if inside is None else inside
    write(folder / name / "model.sdf", text, world=False)
    if config:
        (folder / name / "model.config").write_text(config)
    return folder / name


SHEET = "<geometry><box><size>400 300 0.1</size></box></geometry>"


def visual(name, geometry=SHEET, material="", z=0.0):
    script = f"<material><script><name>{material}</name></script></material>" if material else ""
    return f"<visual name='{name}'><pose>0 0 {z} 0 0 0</pose>{geometry}{script}</visual>"


SKIPPABLE = "\nCarry on without them (--skip-missing, skip_missing=True)."
