"""NPZ files of others: types and sizes are checked before anything is read."""

import io
import pickle
import struct
import zipfile

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.core import npz
from sonar_gl.core.errors import Error

PING = {"intensity": np.ones((2, 3), np.float32), "azimuth_rad": np.arange(2.0), "range_m": np.arange(3.0)}


class Trap:
    """An object that fails when it is unpickled."""

    def __reduce__(self):
        return pytest.fail, ("it was unpickled",)


def npy(array):
    data = io.BytesIO()
    np.save(data, array, allow_pickle=True)
    return data.getvalue()


def header(shape, dtype="<f4"):
    """Return the header of an array, without the array."""
    data = io.BytesIO()
    np.lib.format.write_array_header_1_0(data, {"descr": dtype, "fortran_order": False, "shape": shape})
    return data.getvalue()


@pytest.fixture
def message(tmp_path):
    """A function that writes an archive of members, and returns the message about it, after the name of the file."""

    def message(members, compression=zipfile.ZIP_DEFLATED, claimed=None):
        path = tmp_path / "a.npz"
        with zipfile.ZipFile(path, "w", compression) as archive:
            for name, data in members.items():
                archive.writestr(f"{name}.npy", data)
        if claimed is not None:  # the directory, at the end, states the sizes that count
            content = path.read_bytes()
            at = content.index(b"PK\1\2")
            path.write_bytes(content[: at + 24] + struct.pack("<I", claimed) + content[at + 28 :])
        with pytest.raises(Error) as caught:
            sg.load_npz(path)
        return str(caught.value).replace(repr(str(path)), "FILE")

    return message


def test_a_small_file_that_claims_large_arrays_is_refused_unread(message):
    """The member's data are missing: whoever reads it fails in another way."""
    members = {"intensity": header((2**29,))} | {name: npy(PING[name]) for name in ("azimuth_rad", "range_m")}
    assert message(members, claimed=2**31 + 128) == (
        "cannot read the ping FILE: its arrays must not exceed 1 GB (got 2.1 GB from 0.0 MB)"
    )


def test_a_file_as_large_as_its_arrays_may_exceed_the_bound(tmp_path, monkeypatch):
    monkeypatch.setattr(npz, "MAX_BYTES", 10)
    np.savez(tmp_path / "a.npz", **PING)
    assert sg.load_npz(tmp_path / "a.npz").intensity.shape == (2, 3)
    np.savez_compressed(
        tmp_path / "b.npz", **(PING | {"intensity": np.ones((2, 30_000)), "range_m": np.ones(30_000)})
    )
    with pytest.raises(Error, match="its arrays must not exceed 1e-08 GB"):
        sg.load_npz(tmp_path / "b.npz")


@pytest.mark.parametrize("shape", [(2**40,), (2**62, 4), (2, 4), (1, 3), ()])
def test_a_header_of_another_size_is_refused_unread(message, shape):
    members = {name: npy(array) for name, array in PING.items()}
    members["intensity"] = header(shape) + PING["intensity"].tobytes()
    assert message(members) == "cannot read the ping FILE: not an NPZ file"


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        ("intensity", np.array([[Trap()]]), "intensity must hold numbers (got Python objects)"),
        ("meta", np.array(Trap()), "meta must hold text (got Python objects)"),
        ("meta", np.array(3.0), "meta must hold text (got float64)"),
        ("range_m", np.array(["a", "b", "c"]), "range_m must hold numbers (got <U1)"),
        ("share", np.ones((2, 3), complex), "share must hold numbers (got complex128)"),
    ],
)
def test_other_types_are_refused_and_nothing_is_unpickled(message, name, array, words):
    members = {key: npy(value) for key, value in (PING | {name: array}).items()}
    assert message(members) == f"cannot read the ping FILE: {words}"


@pytest.mark.parametrize(
    ("name", "array", "words"),
    [
        ("share", np.ones((3, 2)), "share must be of shape (2, 3) (got shape (3, 2))"),
        ("pose", np.eye(3), "pose must be of shape (4, 4) (got shape (3, 3))"),
        ("azimuth_rad", np.ones((1, 2)), "azimuth_rad must be of shape (2,) (got shape (1, 2))"),
        ("error_estimate", np.ones(2), "error_estimate must be of shape () (got shape (2,))"),
        ("body_echo", np.ones((2, 2)), "body_echo must be one number for each body (got shape (2, 2))"),
        ("meta", np.array("[1]"), "meta must be JSON, an object (got '[1]')"),
        ("meta", np.array("{"), "meta must be JSON, an object (got '{')"),
        ("meta", np.array("[" * 100_000), f"meta must be JSON, an object (got {'[' * 40!r})"),
    ],
)
def test_arrays_that_make_no_ping(message, name, array, words):
    assert message({key: npy(value) for key, value in (PING | {name: array}).items()}) == f"FILE: {words}"


def test_other_members_are_not_read(tmp_path):
    """Programs may add arrays of their own."""
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for name, array in PING.items():
            archive.writestr(f"{name}.npy", npy(array))
        archive.writestr("other.npy", pickle.dumps(Trap()))
    assert sg.load_npz(tmp_path / "a.npz").intensity.sum() == 6.0
