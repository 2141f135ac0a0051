"""The structure of the code: no reaching into other objects, no hidden imports, no old names.

Lists of exceptions shrink: an entry that is not needed any more fails its test, too, and is to be deleted.
"""

import ast
import io
import re
import tokenize
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE, OUTSIDE = ["sonar_gl"], ["tests", "tools"]


def sources(folders):
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


@cache
def tree_of(path):
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def name_of(path):
    return path.relative_to(ROOT).as_posix()


# Private names of libraries, for which there is no public one: what is read: why.
OF_LIBRARIES = {
    "os._exit": "ends a process without running what its parent set up",
    "sys._getframe": "the line of a user's `with` block, or call",
    "moderngl._store": "the default context of a process",
    "mesh._cache": "trimesh computes normals that the file has",
}
PUBLIC = {"_replace", "_fields", "_asdict", "_make"}  # of named tuples


def private_uses(path):
    """Attributes `x._y` where x is neither self nor cls, and private names that are imported."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Attribute) and re.match("_(?!_)", node.attr) and node.attr not in PUBLIC:
            if not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")):
                yield ast.unparse(node)
        elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
            ("sonar_gl", "tests", "tools")
        ):
            for alias in node.names:
                if re.match("_(?!_)", alias.name):
                    yield f"{node.module}.{alias.name}"


@pytest.mark.parametrize("folders", [PACKAGE, OUTSIDE], ids=lambda folders: "_".join(folders))
def test_nothing_reaches_into_other_objects(folders):
    found = {(name_of(path), use) for path in sources(folders) for use in private_uses(path)}
    found = {(name, use) for name, use in found if use not in OF_LIBRARIES}
    assert found == set(), "give these public names"


def hidden_imports(path):
    """Modules of sonar_gl that functions import."""
    for function in ast.walk(tree_of(path)):
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            for node in ast.walk(function):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sonar_gl"):
                    yield node.module
                elif isinstance(node, ast.Import):
                    yield from (alias.name for alias in node.names if alias.name.startswith("sonar_gl"))


def test_no_function_imports_the_package():
    found = {(name_of(path), module) for path in sources(PACKAGE) for module in hidden_imports(path)}
    assert found == set(), "import these at the top"


# Modules that import libraries by name: file: why.
BY_NAME = {
    "sonar_gl/cli/doctor.py": "each library that it reports on",
}


def imports_by_name(path):
    """Calls of import_module and __import__, as text."""
    for node in ast.walk(tree_of(path)):
        if isinstance(node, ast.Call) and re.search(
            r"(?:^|\.)(?:import_module|__import__)$", ast.unparse(node.func)
        ):
            yield ast.unparse(node)


def test_modules_of_the_package_are_not_imported_by_name():
    found = {name_of(path): list(imports_by_name(path)) for path in sources(PACKAGE)}
    found = {name: calls for name, calls in found.items() if calls and name != "sonar_gl/__init__.py"}
    assert set(found) == set(BY_NAME)
    assert not any("sonar_gl" in call for calls in found.values() for call in calls)


# Old words: what each is called now. They stay out of code, comments, messages and pages.
REMOVED_WORDS = {
    "hearing": "receive beam pattern",
    "Hearing": "Beamformer",
    "unheard": "without echo",
    "why_unheard": "no-echo diagnosis",
    "heard": "received",
    "sounded": "insonified",
    "Whereabouts": "SceneState",
    "whereabouts": "state",
    "wheres": "states",
    "Stock": "SceneMeshes",
    "stock": "meshes",
    "sift": "rasterize small triangles",
    "sifted": "rasterized",
    "sifting": "rasterizing",
    "sift_patches": "rasterize_small_triangles",
    "Ghost": "ImageSource",
    "Ghosts": "ImageSources",
    "ghostly": "with multipath",
    "door": "embedding mode",
    "doors": "embedding modes",
    "rung": "sampling level",
    "rungs": "sampling levels",
    "rung_sampling": "sampling_of",
    "ladder": "sampling levels",
    "ladders": "sampling levels",
    "census": "visibility count",
    "foreign": "host",
    "Tenant": "SharedContext",
    "tenant": "shared context",
    "smear": "matched_filter",
    "find_mirrors": "planar_reflectors",
    "left_of": "reflected intensity",
    "drawn_sonar": "sampled_sonar",
    "compiled_with": "compiled",
    "SceneOnGpu": "SceneBuffers",
    "bubble_strength": "backscattering cross section",
    "stray": "geometric error",
    "strays": "geometric error",
}
# Old names of modules, classes, functions and parameters that are ordinary words in a sentence: they stay out
# of the code's names, and out of `code` in pages.
REMOVED_NAMES = {
    "Given": "ArrayPool",
    "Pair": "SecondThread",
    "Lookup": "ViewIndex",
    "Reducer": "Beamformer",
    "Pass": "Stage",
    "Passes": "Stages",
    "Views": "SectorSamples",
    "Parts": "Strips",
    "make_parts": "make_strips",
    "Watch": "replan trigger",
    "Planner": "AdaptiveSampling",
    "Fixed": "FixedSampling",
    "Multipath": "ImageSources",
    "Mirror": "PlanarReflector",
    "shine": "specular backscatter",
    "screen": "attenuate_behind_bubbles",
    "replacing": "atomic_write",
    "Grain": "noise field",
    "Record": "provenance",
    "Asked": "PingRequest",
    "Order": "PingRequest",
    "Orders": "PingRequests",
    "Kept": "Schema",
    "Planned": "Manifest",
    "Maker": "PartMaker",
    "Work": "worker task",
    "Away": "Cluster",
    "Trial": "dry run",
    "Dump": "RenderJob",
    "ghost": "multipath echo",
    "ghosts": "multipath echoes",
    "mirrors": "planar reflectors",
    "LEFT": "reflected intensity",
}


def pages():
    return [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


@cache
def words_of(path):
    """All words of a file, with _ as a letter."""
    return frozenset(re.findall(r"\w+", path.read_text(encoding="utf-8")))


@cache
def names_of(path):
    """Names in the code of a module, or in `code` of a page."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".md":
        return frozenset(re.findall(r"\w+", " ".join(re.findall(r"`[^`\n]+`", text))))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return frozenset(token.string for token in tokens if token.type == tokenize.NAME)


def files_with(word):
    """Files in which an old word or name occurs, but for those that quote them."""
    quoting = Path(__file__).resolve(), ROOT / "tools" / "mutations.py"
    files = [path for path in sources(PACKAGE + OUTSIDE) if path not in quoting] + pages()
    parts = names_of if word in REMOVED_NAMES else words_of
    return [name_of(path) for path in files if word in parts(path)]


@pytest.mark.parametrize("word", sorted({*REMOVED_WORDS, *REMOVED_NAMES}))
def test_old_names_stay_out(word):
    now = {**REMOVED_WORDS, **REMOVED_NAMES}[word]
    assert files_with(word) == [], f"{word!r} is {now} now"
