"""What `help` and editors show of public names."""

import inspect
import re
from dataclasses import fields, is_dataclass
from pathlib import Path

import pytest

import sonar_gl as sg

OF_OBJECTS = {"scene", "sonar"}  # in text these are objects, as in `scene.bodies`
DATACLASSES = [name for name in sg.__all__ if is_dataclass(getattr(sg, name))]


@pytest.mark.parametrize("name", DATACLASSES)
def test_dataclasses_show_their_fields(name):
    shown = inspect.signature(getattr(sg, name)).parameters
    assert list(shown) == [field.name for field in fields(getattr(sg, name)) if field.init]


@pytest.mark.parametrize("name", sg.__all__)
def test_docstrings_name_modules_in_full(name):
    """As `sonar_gl.noise.receiver.absolute_levels`: a reader of `help` does not know of which package `receiver` is."""
    public = getattr(sg, name)
    texts = [public, *(vars(public).values() if inspect.isclass(public) else ())]
    texts = " ".join(filter(None, map(inspect.getdoc, texts)))
    modules = {path.stem for path in Path(sg.__file__).parent.rglob("*.py")} - OF_OBJECTS
    assert {word for word in re.findall(r"`([a-z_0-9]+)\.\w", texts) if word in modules} == set()
