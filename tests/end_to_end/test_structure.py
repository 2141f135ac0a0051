"""The structure of the code: no reaching into other objects, no hidden imports, no old words.

Lists of exceptions shrink: an entry that is not needed any more fails its test, too, and is to be deleted.
"""

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE, OUTSIDE = ["sonar_gl"], ["tests", "tools"]


@cache
def sources(*folders):
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


@cache
def text_of(path):
    return path.read_text(encoding="utf-8")


@cache
def nodes_of(path):
    """All nodes of a module; to parse and to walk takes long, so that a word of the text is looked for first."""
    return list(ast.walk(ast.parse(text_of(path), str(path))))


def name_of(path):
    return path.relative_to(ROOT).as_posix()


def check_exceptions(name, listed, found, cure):
    """Check that the exceptions of a list are those that were found.

    name : of the list; cure : what is to be done with others, or function of one that returns it
    """
    wrong = [f"{one}: {cure if isinstance(cure, str) else cure(one)}" for one in sorted(found - listed)]
    wrong += [
        f"{one}: delete it from {name}, since it is not needed any more" for one in sorted(listed - found)
    ]
    assert wrong == [], "\n".join([f"what {name} lists must be what the files have:", *wrong])


# Private names of libraries, for which there is no public one: what is read: why.
OF_LIBRARIES = {
    "os._exit": "ends a process without running what its parent set up",
    "sys._getframe": "the line of a user's `with` block, or call",
    "moderngl._store": "the default context of a process",
    "array._getvalue": "the value of a Numba structure, as all intrinsics return it",
    "mesh._cache": "trimesh computes normals that the file has",
}
# of named tuples, and of what notebooks show
PUBLIC = {"_replace", "_fields", "_asdict", "_make", "_repr_png_"}


# in formatted code a private attribute follows its dot, and a private import its word, its comma or its indentation
MAY_REACH = re.compile(
    r"(?<!\bself)(?<!\bcls)\._(?!_)|^\s*(from|import)\b.*\b_(?!_)|^\s+_\w+(\s+as\s+\w+)?,", re.MULTILINE
)


def private_uses(path):
    """Attributes `x._y` where x is neither self nor cls, and private names that are imported."""
    for node in nodes_of(path) if MAY_REACH.search(text_of(path)) else ():
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
    found = {(name_of(path), use) for path in sources(*folders) for use in private_uses(path)}
    found = {(name, use) for name, use in found if use not in OF_LIBRARIES}
    assert found == set(), "give these public names; what a library keeps private goes into OF_LIBRARIES"


# Modules that a function imports from a layer above: file and module: why.
FROM_ABOVE = {
    ("sonar_gl/ping.py", "sonar_gl.imaging.styles"): "a notebook asks a ping for its picture",
}


def hidden_imports(path):
    """Modules of sonar_gl that functions import."""
    if not re.search(r"^[ \t]+(from|import)\s+sonar_gl", text_of(path), re.MULTILINE):
        return
    for function in nodes_of(path):
        if isinstance(function, (ast.FunctionDef, ast.AsyncFunctionDef)):
            for node in ast.walk(function):
                if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sonar_gl"):
                    yield node.module
                elif isinstance(node, ast.Import):
                    yield from (alias.name for alias in node.names if alias.name.startswith("sonar_gl"))


def test_no_function_imports_the_package():
    found = {(name_of(path), module) for path in sources(*PACKAGE) for module in hidden_imports(path)}
    check_exceptions("FROM_ABOVE", set(FROM_ABOVE), found, "import this at the top")


# Modules that import libraries by name: file: why.
BY_NAME = {
    "sonar_gl/cli/doctor.py": "each library that it reports on",
}


def imports_by_name(path):
    """Calls of import_module and __import__, as text."""
    if not re.search(r"import_module|__import__", text_of(path)):
        return
    for node in nodes_of(path):
        if isinstance(node, ast.Call) and re.search(
            r"(?:^|\.)(?:import_module|__import__)$", ast.unparse(node.func)
        ):
            yield ast.unparse(node)


def test_modules_of_the_package_are_not_imported_by_name():
    found = {name_of(path): list(imports_by_name(path)) for path in sources(*PACKAGE)}
    found = {name: calls for name, calls in found.items() if calls and name != "sonar_gl/__init__.py"}
    check_exceptions("BY_NAME", set(BY_NAME), set(found), "import libraries at the top")
    assert not any("sonar_gl" in call for calls in found.values() for call in calls), found


# Old words: what each is called now. A pattern is matched with whole words in small letters; `is_heard`, `HEARD` and
# `BeamsHeard` have three words of one. They stay out of code, comments, messages, shaders, scenes and pages.
REMOVED_WORDS = {
    "(un|over)?hear(s|d|ing|er|ers)?": "receive beam pattern; received, echo",
    "sounded": "insonified",
    "whereabouts?": "SceneState",
    "wheres": "states",
    "stocks?": "SceneMeshes",
    "sift(s|ed|ing)?": "rasterize small triangles",
    "ghost(s|ed|ly|ing)?": "multipath echo, ImageSource",
    "doors?": "embedding mode",
    "rungs?": "sampling level",
    "ladders?": "sampling levels",
    "census(es)?": "visibility count",
    "foreign(er)?": "host",
    "tenants?": "shared context",
    "smear(s|ed|ing)?": "matched filter",
    "strays?": "geometric error",
    "luck(y)?": "sampling error of a body's echo",
}
# Where the field's slang, or a paper's own word, is quoted: file: word: what it quotes.
QUOTED = {
    "docs/conventions.md": {"ghost": "the glossary leads from the informal word to ours"},
    "docs/acoustics.md": {"ghost": "the founding paper's word"},
    "docs/gallery.md": {"ghost": "the founding paper's word"},
    "docs/trials.md": {"tools/variants.py": "a tool of the commit that it names"},
}
TEXTS = {".py", ".pyi", ".md", ".toml", ".cfg", ".sh", ".sdf", ".vert", ".geom", ".frag", ".glsl", ".in"}
SCRIPTS = ".ci/run", "tools/demo", "tools/test"
FOLDERS = "sonar_gl", "tests", "tools", "examples", "shaders", "scenes", "docs"
# The changelog tells of the past, and this file has the list.
QUOTING = "CHANGELOG.md", Path(__file__).relative_to(ROOT).as_posix()


@cache
def texts():
    """All files that people wrote, but for those that quote old words."""
    found = [path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in TEXTS]
    found += [path for path in ROOT.iterdir() if path.suffix in TEXTS]
    found += [ROOT / name for name in SCRIPTS]
    return sorted(path for path in found if name_of(path) not in QUOTING)


def words_in(text):
    """The words of a text in small letters; names are taken apart at _ and at capitals.

    >>> sorted(words_in("was_HEARD, or BeamsHeard"))
    ['beams', 'heard', 'or', 'was']
    """
    return {word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", text)}


def test_old_words_are_found_in_names_and_stems():
    found = words_in("It is UNHEARD; BeamsHeard, `rung_sampling`, Doors. GLTenants")
    assert found >= {"unheard", "heard", "rung", "doors", "tenants"}
    assert found.isdisjoint({"hear", "door", "ung"})


def check_quoted(found, quotable, cure):
    """Check that (file, word) were found where they are quoted, and nowhere else.

    quotable : function of a word, whether it is of this kind; cure : function of a word, what to do with it elsewhere
    """
    quoted = {(name, word) for name, words in QUOTED.items() for word in words if quotable(word)}
    check_exceptions("QUOTED", quoted, found, lambda one: cure(one[1]))


def test_a_wrong_exception_says_what_to_do():
    """A list that did not fit raised an AssertionError with two sets, and left open which of them was to change."""
    with pytest.raises(AssertionError) as raised:
        check_exceptions("LIST", {"a", "c"}, {"b", "c"}, "import it")
    told = [line.strip() for line in str(raised.value).splitlines()[1:3]]
    assert told == ["b: import it", "a: delete it from LIST, since it is not needed any more"]


def now_called(word):
    """What REMOVED_WORDS says in place of an old word."""
    return next(now for pattern, now in REMOVED_WORDS.items() if re.fullmatch(pattern, word))


def test_old_words_stay_out():
    is_old = re.compile("|".join(REMOVED_WORDS)).fullmatch
    found = {(name_of(path), word) for path in texts() for word in words_in(text_of(path)) if is_old(word)}
    check_quoted(found, is_old, lambda word: f"write {now_called(word)!r}, by REMOVED_WORDS")


def missing_names(text):
    """What a text names as `sonar_gl.x.y`, or as the path of a file, and does not exist."""
    for dotted in re.findall(r"(?<![\w./'-])sonar_gl((?:\.[A-Za-z_]\w*)+)", text):
        if not exists(dotted[1:].split(".")):
            yield f"sonar_gl{dotted}"
    for file in re.findall(rf"(?<![\w./-])(?:{'|'.join(FOLDERS)})/[\w/.]*\w\.\w+", text):
        if not (ROOT / file).exists():
            yield file


def exists(parts):
    """Whether the parts of a dotted name under sonar_gl are packages, a module, and a name in the last of them."""
    place = ROOT / "sonar_gl"
    for part, following in zip(parts, [*parts[1:], None], strict=True):
        module = place / f"{part}.py"
        if module.is_file():
            return following is None or following in identifiers_of(module)
        if not (place / part).is_dir():
            is_data = place.name == "sonar_gl" and part in ("shaders", "scenes")
            return is_data or any(part in identifiers_of(path) for path in place.glob("__init__.py*"))
        place = place / part
    return True


@cache
def identifiers_of(path):
    return frozenset(re.findall(r"\w+", text_of(path)))


def test_modules_and_files_that_are_named_exist():
    missing = {(name_of(path), name) for path in texts() for name in missing_names(text_of(path))}
    check_quoted(missing, lambda word: "/" in word, lambda _: "name what exists: it was moved or removed")


COMPILED = {"added_in_any_order", "compiled", "rounded_alike", "uncounted", "inlined"}


def uses_of_other_sources(path):
    """Names that compiled functions of a module use, and that it imports from others than `sources_of` lists."""
    if not re.search(rf"^@({'|'.join(COMPILED)})$", text_of(path), re.MULTILINE):
        return
    together = ["sonar_gl.core.compiled"]
    if path.parent.name == "kernels":
        together.append(name_of(path.parent).replace("/", "."))
    outside = {
        alias.asname or alias.name
        for node in nodes_of(path)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sonar_gl")
        if not any(f"{node.module}.".startswith(f"{one}.") for one in together)
        for alias in node.names
    }
    for node in nodes_of(path):
        decorators = node.decorator_list if isinstance(node, ast.FunctionDef) else ()
        if any(isinstance(one, ast.Name) and one.id in COMPILED for one in decorators):
            body = ast.Module(node.body, [])
            used = {one.id for one in ast.walk(body) if isinstance(one, ast.Name)}
            yield from ((node.name, name) for name in used & outside)


def test_compiled_functions_use_their_own_sources():
    """Machine code on disk would go on with what another file said before it was changed."""
    found = {(name_of(path), *use) for path in sources(*PACKAGE) for use in uses_of_other_sources(path)}
    assert found == set(), "give it as an argument, or move it into a package named kernels"


# Constants of one name in several modules that mean different things: name: why.
OF_ONE_NAME = {
    "POINTS": "kernels use constants of their own file alone",
    "UNSCALED": "kernels use constants of their own file alone",
    "EXTENSIONS": "of GL, of EGL, and of SDF",
}


def capitals_of(path):
    """Names in capitals that a module assigns to, as its text tells, which is quicker than to parse it."""
    return set(re.findall(r"^([A-Z][A-Z0-9_]+) =", text_of(path), re.MULTILINE))


def constants_of(path, names):
    """Those of `names` that a module gives a number or text, or a tuple of them."""
    for node in ast.parse(text_of(path), str(path)).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            name = node.targets[0].id
            if name in names and not any(
                isinstance(part, (ast.Call, ast.Name, ast.Attribute)) for part in ast.walk(node.value)
            ):
                yield name, ast.unparse(node.value)


def test_a_constant_is_defined_once():
    """NEAR_M, SOFTWARE and WORST_BODY had several definitions, which could come to differ."""
    counts = Counter(name for path in sources(*PACKAGE) for name in capitals_of(path))
    several = {name for name, count in counts.items() if count > 1 and name not in OF_ONE_NAME}
    places = {}
    for path in sources(*PACKAGE):
        for name, value in constants_of(path, several) if several & capitals_of(path) else ():
            places.setdefault((name, value), []).append(name_of(path))
    found = {key: names for key, names in places.items() if len(names) > 1}
    assert found == {}, "import these from one module, or explain in OF_ONE_NAME why they differ in meaning"
