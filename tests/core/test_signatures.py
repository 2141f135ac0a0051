"""What `help` and editors show of public names."""

import ast
import inspect
import re
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import get_type_hints

import pytest

import sonar_gl as sg
from sonar_gl import embed, ros
from sonar_gl.core.closing import Closable
from sonar_gl.core.signatures import shown_by_fields
from sonar_gl.embed.sectors import DrawnSector
from sonar_gl.live.session import LiveSession
from sonar_gl.live.viewer import LiveView

OF_OBJECTS = {"scene", "sonar"}  # in text these are objects, as in `scene.bodies`
PUBLIC = {
    f"{module.__name__}.{name}": getattr(module, name)
    for module in (sg, embed, ros)
    for name in module.__all__
    if callable(getattr(module, name))
}
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


def functions_of(public):
    """The function itself; or, of a class, its public methods and properties, and those for a `with` block."""
    if not inspect.isclass(public):
        yield public
        return
    for name, member in vars(public).items():
        member = getattr(member, "__func__", getattr(member, "fget", member))  # class methods, properties
        if inspect.isfunction(member) and (not name.startswith("_") or name in ("__enter__", "__exit__")):
            yield member


@pytest.mark.parametrize("name", [*PUBLIC])
def test_types_of_results_are_stated(name):
    """A type checker takes the result of a function without any for Any, and refuses to call it where it is strict."""
    for function in functions_of(PUBLIC[name]):
        assert "return" in function.__annotations__, function.__qualname__


# Parameters without a type: why.
UNTYPED = {
    ("load_scene", "what"): "also objects of libraries that need not be there",
    ("mujoco_poses", "data"): "of an optional library",
    ("mujoco_sonar_pose", "data"): "of an optional library",
    ("demarco_image", "simulator"): "`Simulator` is of a layer above",
}


@pytest.mark.parametrize("name", [*PUBLIC])
def test_types_of_parameters_are_stated(name):
    """Without them an editor says nothing of `simulator.ping(pose, labels="body")`."""
    public = PUBLIC[name]
    begins = [public.__init__] if "__init__" in vars(public) else []
    for function in [*begins, *functions_of(public)]:
        exempt = {parameter for owner, parameter in UNTYPED if owner == function.__name__}
        untyped = {
            name
            for name, one in inspect.signature(function).parameters.items()
            if one.annotation is one.empty and one.kind is not one.VAR_KEYWORD and not name.startswith("_")
        }
        assert untyped - {"self", "cls"} == exempt, function.__qualname__


@pytest.mark.parametrize(
    "kind", [sg.Simulator, embed.Sensor, ros.Publisher, DrawnSector, LiveView, LiveSession]
)
def test_blocks_have_the_type_of_their_object(kind):
    """Otherwise `simulator` of `with sg.Simulator(...) as simulator` and all that it returns is Any."""
    hints = get_type_hints(kind.__enter__)
    assert hints["return"] is (hints["self"] if issubclass(kind, Closable) else kind)


def test_a_simulator_takes_another_one_in_its_types_too():
    assert get_type_hints(sg.Simulator.__init__)["scene"] == sg.Scene | sg.Simulator


def test_the_decorator_of_dataclasses_keeps_the_class_for_type_checkers():
    """Pyright takes what returns `type` for any class, so that Acoustics and Noise would have no fields."""
    hints = get_type_hints(shown_by_fields)
    assert hints["return"] is hints["cls"] is not type


@pytest.mark.parametrize("package", [sg, ros])
def test_names_that_load_late_are_in_a_stub(package):
    """Type checkers do not see the names that `lazy_loader` makes; Jedi shows those that have an `as` alone."""
    stub = ast.parse(Path(package.__file__).with_suffix(".pyi").read_text())
    names = [name for node in stub.body if isinstance(node, ast.ImportFrom) for name in node.names]
    assert {name.name for name in names} == {*package.__all__} - {"__version__"}
    assert [name.asname for name in names] == [name.name for name in names]


def test_dir_lists_all_public_names():
    assert set(sg.__all__) <= set(dir(sg))
