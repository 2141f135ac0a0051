"""Compiled functions: tables whose shape the compiler knows, and what is said of compilation."""

import os
import resource
import zipfile
from pathlib import Path

import numba
import numpy as np
import pytest

from sonar_gl.core import compiled as module
from sonar_gl.core.compiled import (
    announce_compilation,
    as_table,
    compiled,
    from_column,
    reason_not_kept,
    sources_of,
)
from sonar_gl.core.errors import Error
from tests.support.processes import python


@pytest.mark.parametrize(
    ("module", "is_announced"),
    [("sonar_gl.beamform.kernels.strips", True), ("program_of_a_user", False), (None, False)],
)
def test_only_kernels_of_this_package_are_announced(module, is_announced, capsys):
    """An early version announced its kernels when a program compiled a function of its own.

    A function that `exec` made has no module; to compile it raised an AttributeError.
    """

    def add(x):
        return x + 1

    add.__module__ = module
    announce_compilation(True)
    assert numba.njit(add)(1) == 2
    announce_compilation(False)
    assert capsys.readouterr().err.startswith("sonar_gl: compiling numerical kernels") == is_announced


@pytest.mark.parametrize("is_kept", [True, False])
def test_the_announcement_says_whether_the_machine_code_is_kept(is_kept, tmp_path, monkeypatch, capsys):
    """Without a folder that can be written to, as in some containers, each process compiles again."""

    def add(x):
        return x + 1

    add.__module__ = "sonar_gl.beamform.kernels.strips"
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path) if is_kept else "")
    announce_compilation(True)
    assert numba.njit(cache=is_kept)(add)(1) == 2
    announce_compilation(False)
    assert capsys.readouterr().err == (
        "sonar_gl: compiling numerical kernels; all of them take a minute or two (some minutes on one core), "
        + (
            "once after each installation ('sonar-gl doctor' compiles them)\n"
            if is_kept
            else "in each process, since no folder to keep them in can be written to; set NUMBA_CACHE_DIR to one "
            "that can\n"
        )
    )


def kept_function():
    """Return a new object of one and the same function, as another process has it."""

    def add(x):
        return x + 1

    return compiled(add)


def test_functions_run_where_their_machine_code_finds_no_room(tmp_path, monkeypatch):
    """In a home folder that was full, each ping ended with the error that the standard output must be writable."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(module, "_reasons_not_kept", [])
    add, limits = kept_function(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, limits[1]))
    try:
        with pytest.warns(UserWarning, match="find room in .* file too large; .* NUMBA_CACHE_DIR") as found:
            assert (add(1), add(1.5)) == (2, 2.5)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert len(found) == 1 and reason_not_kept() == "file too large"
    assert kept_function()(1) == 2  # once there is room, it is kept
    assert list(tmp_path.rglob("*.nbc"))


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("n_bytes", [pytest.param(0, marks=pytest.mark.slow), 30])
def test_damaged_files_of_machine_code_are_written_again(suffix, n_bytes, tmp_path, monkeypatch):
    """After a loss of power a file may be empty; each ping ended with an EOFError, until the user deleted it."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert kept_function()(1) == 2
    (file,) = tmp_path.rglob(f"*.{suffix}")
    file.write_bytes(file.read_bytes()[:n_bytes])
    assert kept_function()(1) == 2
    again = kept_function()
    assert again(1) == 2 and sum(again.stats.cache_hits.values()) == 1


# Ctrl-C where Numba looks for new types and functions: at the first look, in a generator that then ended for good.
INTERRUPT = """
import math, signal, sys
from sonar_gl.core.compiled import compiled

@compiled
def double(x):
    return 2 * x

@compiled
def root(x):
    return math.sqrt(double(x))

def ctrl_c(frame, event, arg):
    if frame.f_code.co_name == sys.argv[1]:
        sys.settrace(None)
        signal.raise_signal(signal.SIGINT)

sys.settrace(ctrl_c)
try:
    double(1)
except KeyboardInterrupt:
    print("interrupted", double.nopython_signatures)
print(root(8.0), signal.getsignal(signal.SIGINT) is signal.default_int_handler)
"""


@pytest.mark.slow
@pytest.mark.parametrize("place", ["stream_list", "new_registrations"])
@pytest.mark.parametrize("is_kept", [True, False])
def test_an_interrupt_waits_until_a_function_is_compiled(place, is_kept, tmp_path):
    """After Ctrl-C in the first ping of a notebook, later pings ended with "generator raised StopIteration"."""
    if is_kept:
        (tmp_path / "program.py").write_text(INTERRUPT)
        words = [tmp_path / "program.py"]
    else:
        words = ["-c", INTERRUPT]
    run = python(*words, place, environment={"NUMBA_CACHE_DIR": str(tmp_path)})
    assert run.stdout.splitlines() == ["interrupted [(int64,) -> int64]", "4.0 True"], run.stderr


def test_files_of_machine_code_that_stay_damaged_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    assert kept_function()(1) == 2
    (file,) = tmp_path.rglob("*.nbi")
    file.unlink()
    file.mkdir()  # neither read nor replaced, as a file of another user may be
    with pytest.raises(Error, match=f"kept in '{Path(file).parent}' must be readable .* delete that folder"):
        kept_function()(1)


SOURCES = {
    "__init__": "",
    "constants": "STEP = 1",
    "inner": """
from kernels.constants import STEP
from sonar_gl.core.compiled import compiled

@compiled
def add(x):
    return x + STEP
""",
    "outer": """
from kernels.inner import add
from sonar_gl.core.compiled import compiled

@compiled
def add_twice(x):
    return add(add(x))
""",
}
# Each run imports the package in a process of its own, forked once Numba has loaded what it needs for any function.
RUN_TWICE = """
import os, shutil, sys
import numba
import sonar_gl.core.compiled
numba.njit(lambda x: x)(1)
place, path, *states = sys.argv[1:]
for state in states:
    if os.path.isdir(place):
        shutil.rmtree(place)
    os.replace(state, place)
    for _ in range(2):
        if os.fork() == 0:
            sys.path.insert(0, path)
            from kernels.outer import add_twice
            print(add_twice(1), sum(add_twice.stats.cache_hits.values()), flush=True)
            os._exit(0)
        assert os.wait()[1] == 0
"""


def run_twice(place, path, states, **environment):
    """Return results and hits of the cache, of two runs of each state of a package, which is moved to a place."""
    out = python("-c", RUN_TWICE, place, path, *states, environment=environment, check=True).stdout
    return [tuple(map(int, line.split())) for line in out.splitlines()]


@pytest.mark.slow
def test_machine_code_is_outdated_by_any_file_of_its_package(tmp_path):
    """Numba knows the file of the function alone: it would run with what it calls as that was before."""

    def package(state, **changed):
        folder = tmp_path / state
        folder.mkdir()
        for name, text in {**SOURCES, **changed}.items():
            (folder / f"{name}.py").write_text(text)
            os.utime(folder / f"{name}.py", (1e9, 1e9))  # as of an archive whose files all have one time
        return folder

    other_function = SOURCES["inner"].replace("x + STEP", "x + 2 * STEP")
    states = (
        package("first"),
        package("function", inner=other_function),
        package("constant", constants="STEP = 10"),
    )
    found = run_twice(tmp_path / "kernels", tmp_path, states, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert found == [(3, 0), (3, 1), (5, 0), (5, 1), (21, 0), (21, 1)]


@pytest.mark.slow
def test_machine_code_of_a_package_in_an_archive_is_outdated_by_the_archive(tmp_path):
    def package(state, **changed):
        with zipfile.ZipFile(tmp_path / state, "w") as archive:
            for name, text in {**SOURCES, **changed}.items():
                archive.writestr(f"kernels/{name}.py", text)
        return tmp_path / state

    program, states = tmp_path / "program.zip", (package("first"), package("constant", constants="STEP = 10"))
    found = run_twice(program, program, states, XDG_CACHE_HOME=str(tmp_path))
    assert [value for value, _ in found] == [3, 3, 21, 21]


def test_sources_of_a_function_are_its_file_or_its_package(tmp_path):
    """A file that is not there, as in an executable, has no others beside it."""
    own = module.__file__
    for name in ("a.py", "b.py", "kernels/a.py", "kernels/b.py", "kernels/c.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    for name, others in {"b.py": [], "kernels/b.py": ["kernels/a.py"], "absent/kernels/b.py": []}.items():
        assert sources_of(str(tmp_path / name)) == [*(str(tmp_path / one) for one in (name, *others)), own]


@pytest.mark.slow
def test_functions_of_an_executable_run_and_are_kept(tmp_path):
    code = """
import sys
from sonar_gl.core.compiled import compiled
sys.frozen, names = True, {}
exec(compile("def add(x): return x + 1", "kernels/absent.py", "exec"), names)
add = compiled(names["add"])
print(add(1), add.stats.cache_path is not None)
"""
    done = python("-c", code, environment={"XDG_CACHE_HOME": str(tmp_path)}, check=True, cwd=tmp_path)
    assert done.stdout.split() == ["2", "True"]


def test_a_table_of_known_shape_lies_in_the_memory_of_its_array():
    @numba.njit
    def double(array):
        table = as_table(array, 3, 4)
        for k in range(4):
            table[2, k] = 2 * table[1, k]
        return table.shape, table.strides

    array = np.arange(20.0).reshape(4, 5)
    shape, strides = double(array)
    assert (shape, strides) == ((3, 4), (32, 8))
    np.testing.assert_array_equal(array.ravel()[:12].reshape(3, 4)[2], [8, 10, 12, 14])
    np.testing.assert_array_equal(array.ravel()[12:], np.arange(12.0, 20.0))


@pytest.mark.slow
def test_a_table_keeps_its_array_alive_and_no_longer():
    """The first form of it counted no reference, so that the array was released while it was in use."""

    @numba.njit
    def total(n):
        array = np.ones((3, 4))
        table = as_table(array, 3, 4)
        array = np.zeros((n, 4))
        return table.sum() + array.sum()

    @numba.njit
    def replaced(array):
        array = as_table(array, 3, 4)
        return array.sum()

    given = np.ones((3, 4))
    assert all(total(12) == replaced(given) == 12 for _ in range(1000))
    del given  # aborts where it was released already


def test_a_table_of_a_shape_that_is_not_constant_is_refused():
    @numba.njit
    def of_shape(array, n):
        return as_table(array, n, 4).sum()

    with pytest.raises(numba.TypingError):
        of_shape(np.ones((3, 4)), 3)


def test_a_table_in_an_array_that_is_not_contiguous_is_refused():
    @numba.njit
    def total(array):
        return as_table(array, 3, 4).sum()

    for array in (np.ones((8, 8))[::2], np.ones((4, 3)).T, np.ones(12)):
        with pytest.raises(numba.TypingError):
            total(array)


def test_a_process_without_compilation_says_why_it_cannot_ping():
    """Early versions had a NotImplementedError of an intrinsic in the middle of the first ping."""
    code = "import sonar_gl as sg\ntry: sg.Simulator\nexcept sg.Error as why: print(why)"
    out = python("-c", code, environment={"NUMBA_DISABLE_JIT": "1"}, check=True).stdout
    assert out.startswith("NUMBA_DISABLE_JIT must be 0 or unset")


@pytest.mark.parametrize("tail", [(), (4,)])
def test_rows_from_a_column_on_are_a_view_of_an_image(tail):
    image = np.arange(5 * 7 * int(np.prod(tail)), dtype=np.float32).reshape(5, 7, *tail)

    @numba.njit
    def write(image, column, n_rows):
        rows = from_column(image, column, n_rows)
        rows[1, 0] = 0.0
        return rows.shape, rows.size

    expected = image.copy()
    expected[1, 2] = 0.0
    assert write(image, 2, 3) == ((3, 7, *tail), 3 * 7 * int(np.prod(tail)))
    np.testing.assert_array_equal(image, expected)
