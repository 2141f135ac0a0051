"""Data sheets that are written as files."""

import math
from dataclasses import replace

import pytest

import sonar_gl as sg
from sonar_gl.sonar.sonar_files import sonar_file_text

P900 = sg.load_sonar("p900-45")


@pytest.mark.parametrize(
    "sonar",
    [
        *sg.presets().values(),
        replace(P900, name='a "name" \\ # ü \x7f', source="two\nlines"),
        replace(P900, n_beams=3, beam_azimuths_deg=(-22.5, math.pi, 1e1)),
        replace(P900, counts=sg.Counts("db", low_db=-50, bits=16), element_error_db=None),
    ],
    ids=lambda sonar: sonar.name,
)
def test_a_sonar_is_read_as_it_was_written(sonar, tmp_path):
    path = tmp_path / "mine.toml"
    sg.save_sonar(path, sonar)
    assert sg.load_sonar(path) == sonar


def test_what_has_its_default_or_no_effect_is_not_written(tmp_path):
    sg.save_sonar(tmp_path / "mine.toml", replace(P900, counts=sg.Counts("db", exponent=0.3)))
    assert sg.load_sonar(tmp_path / "mine.toml").counts == sg.Counts("db")
    text = sonar_file_text(replace(P900, source="", counts=sg.Counts(bits=16)))
    assert "counts = { bits = 16 }\n" in text
    assert not {"source", "tilt_deg", "beam_azimuths_deg"} & {line.split()[0] for line in text.splitlines()}


@pytest.mark.parametrize(
    ("path", "sonar", "message"),
    [
        ("mine.txt", P900, r"^'mine.txt' must end in .toml \(got .txt\)$"),
        (None, P900, r"^path must be a str \(got NoneType; the name of a file that ends in .toml\)$"),
        ("none/mine.toml", P900, r"^cannot write 'none/mine.toml': the folder 'none' does not exist$"),
        (
            "mine.toml",
            replace(P900, source="page \udcb3"),
            r"^mine.toml: source must be text that a file can hold \(got 'page \\udcb3', with half of a letter\)$",
        ),
        (
            "mine.toml",
            "p900-45",
            r"^sonar must be a Sonar \(got str; such as sonar_gl.load_sonar\('p900-45'\)\)$",
        ),
    ],
)
def test_no_other_file_is_written(path, sonar, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(sg.Error, match=message):
        sg.save_sonar(path, sonar)
    assert not list(tmp_path.iterdir())
