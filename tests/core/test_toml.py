"""Reading TOML files."""

import codecs

import pytest

from sonar_gl.core.toml import read_toml
from tests.support.errors import error_of


def test_contents_are_returned_as_a_dict(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text('[water]\nname = "Öresund"\nph = 8\n', encoding="utf-8")
    assert read_toml(path, "the file") == {"water": {"name": "Öresund", "ph": 8}}


def test_a_mark_of_byte_order_is_skipped(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("ph = 8\n", encoding="utf-8-sig")
    assert read_toml(path, "the file") == {"ph": 8}


def test_messages_name_the_file_and_what_it_is(tmp_path):
    path = tmp_path / "a.toml"
    assert (
        error_of(read_toml, path, "the sonar's file")
        == f"{path}: the sonar's file must be readable (no such file or directory)"
    )
    path.write_text("ph = 8 8\n")
    assert error_of(read_toml, path, "the job file") == (
        f"{path}: the job file must be TOML "
        "(Expected newline or end of document after a statement (at line 1, column 8))"
    )


@pytest.mark.parametrize(
    ("data", "got"),
    [
        ("ph = 8\n".encode("utf-16"), "UTF-16"),
        ("ph = 8\n".encode("utf-16-le"), "UTF-16"),
        ("name = 'Öresund'\n".encode("utf-16-be"), "UTF-16"),
        (codecs.BOM_UTF16_BE + "ph = 8\n".encode("utf-16-be"), "UTF-16"),
        ("ph = 8\nname = 'Öresund'\n".encode("latin-1"), "byte 0xd6 in line 2"),
    ],
)
def test_another_encoding_is_named(tmp_path, data, got):
    path = tmp_path / "a.toml"
    path.write_bytes(data)
    for hint, cure in (("", "save it as UTF-8"), ("name it .toml", "name it .toml")):
        assert (
            error_of(read_toml, path, "the job file", hint)
            == f"{path}: the job file must be TOML in UTF-8 (got {got}; {cure})"
        )


@pytest.mark.parametrize(
    "text",
    [
        "a = " + "[" * 33 + "]" * 33,
        "a = " + "[" * 100_000,
        "a = " + "{a = " * 5000 + "1" + "}" * 5000,
        "[" + ".".join("a" * 33) + "]",
    ],
    ids=["arrays", "open arrays", "tables", "dotted"],
)
def test_deep_nesting_is_refused(tmp_path, text):
    path = tmp_path / "a.toml"
    path.write_text(text)
    assert error_of(read_toml, path, "the job file") == (
        f"{path}: the job file must nest tables and arrays at most 32 deep (got more)"
    )


def test_nesting_up_to_the_limit_is_read(tmp_path):
    path = tmp_path / "a.toml"
    path.write_text("a = " + "[" * 31 + "7" + "]" * 31)
    found = read_toml(path, "the file")["a"]
    for _ in range(31):
        (found,) = found
    assert found == 7
