"""Presets, sonars from files, and the message about each mistake in them."""

import math
import re
import warnings
from dataclasses import MISSING, replace
from pathlib import Path

import numpy as np
import pytest

from sonar_gl.core.errors import Error
from sonar_gl.core.poses import pose as make_pose
from sonar_gl.sonar.sonar import CHOICES, TAPERS, Sonar
from sonar_gl.sonar.sonar_files import PRESETS, load_sonar, presets
from tests.support.errors import error_of

KEYS = {
    "frequency_hz": 900e3,
    "n_beams": 256,
    "n_bins": 512,
    "azimuth_fov_deg": 45.0,
    "elevation_fov_deg": 20.0,
    "beam_width_deg": 1.0,
    "range_min_m": 0.5,
    "range_max_m": 30.0,
}
TEXT = "\n".join(f"{key} = {value}" for key, value in KEYS.items()) + "\n"


@pytest.mark.parametrize("name", presets())
def test_presets_are_complete_and_plausible(name):
    sonar = load_sonar(name)
    assert sonar.name == name == name.lower(), "its heading must be in lower case"
    assert len(sonar.source) > 40, "`source` must name a document"
    assert sonar.n_bins <= 5000 and sonar.n_beams <= 1024, "no device has more"
    assert 0 < sonar.range_min_m < sonar.range_max_m <= 50, "range_max_m must be a usual first setting"
    tenths = sonar.bin_size_m * 1e4
    assert sonar.keeps_n_bins or tenths == pytest.approx(round(tenths), abs=1e-6), (
        "a bin is the resolution of the device, in tenths of a millimetre: choose range_max_m and n_bins by it"
    )
    # imaging sonars form beams that touch or overlap (the DIDSON's: 29/96 = 0.302 for a nominal 0.3), except for those
    # with a lens at the lower frequency, which use every other element
    has_gaps = sonar.azimuth_fov_deg / sonar.n_beams > sonar.beam_width_deg * 1.01
    known_gaps = "didson-lf", "aris-3000-lf", "aris-1800-lf", "aris-1200"
    assert has_gaps == (name in known_gaps), "if the data sheet has gaps between beams, name the preset here"


def test_the_limit_of_the_range_is_the_one_that_the_source_of_a_preset_states():
    without = [name for name, sonar in presets().items() if sonar.range_limit_m is None]
    assert without == ["demarco-2015"], "a device has a range_limit_m"  # that one is simulated
    for name, sonar in presets().items():
        if name not in without:
            assert sonar.range_max_m <= sonar.range_limit_m, name
            # such as "2-100 m", "up to 200 m"; widths in degrees and resolutions have other units
            assert re.search(rf"(?<![\d.]){sonar.range_limit_m:g} m\b", sonar.source), (
                f"{name}: `source` must have the range_limit_m as the document writes it, {sonar.range_limit_m:g} m"
            )


@pytest.mark.parametrize(("name", "fov", "n_beams"), [("45", 45, 256), ("90", 90, 512), ("130", 130, 768)])
def test_p900_presets_follow_the_data_sheet(name, fov, n_beams):
    sonar = load_sonar(f"p900-{name}")
    assert (sonar.frequency_hz, sonar.n_beams, sonar.azimuth_fov_deg) == (900e3, n_beams, fov)
    assert (sonar.elevation_fov_deg, sonar.beam_width_deg, sonar.range_min_m) == (20, 1, 0.5)
    assert sonar.bin_size_m == pytest.approx(0.0254, abs=1e-15)
    assert abs(sonar.range_max_m - 30) < 0.0254 / 2


def test_the_preset_of_demarco2015_is_the_sonar_of_the_paper():
    sonar = load_sonar("demarco-2015")
    assert (sonar.n_beams, sonar.azimuth_fov_deg, sonar.elevation_fov_deg) == (280, 45, 20)
    assert (sonar.range_min_m, sonar.range_max_m, sonar.n_bins) == (0.1, 10, 990)
    assert sonar.beam_width_deg == 45 / 280  # beams tile the fan


def test_unverified_numbers_are_marked():
    """All presets have numbers from memory, marked as such, except for these."""
    unverified = {name for name, sonar in presets().items() if "unverified:" in sonar.source}
    sourced = {"p900-45", "p900-90", "p900-130", "demarco-2015"}
    assert unverified == set(presets()) - sourced, (
        "`source` of a preset must mark numbers that no document confirms by 'unverified:'; name one without any here"
    )


def test_floors_of_presets_are_those_of_the_same_errors_in_as_many_elements_as_their_beams_need():
    """s²/N, errors of gain and phase of variance s² in N elements half a wavelength apart."""
    variance = round((10 ** (0.75 / 20) - 1) ** 2 + math.radians(5.0) ** 2, 3)
    assert variance == 0.016
    for name, sonar in presets().items():
        elements = 2 * 0.442946 / math.sin(math.radians(sonar.beam_width_deg) / 2)  # sinc² is 1/2 at 0.442946
        floor_db = 10 * math.log10(variance / elements)
        if name.startswith(("aris", "didson")):
            floor_db = -35.0  # lenses
        elif name in ("demarco-2015", "ping360"):
            floor_db = None  # no array
        assert sonar.element_error_db == (floor_db and round(floor_db)), (
            f"{name}: 'Element errors' in {PRESETS.name} says how its floor follows; name a sonar without an array here"
        )


def test_the_readme_states_the_number_of_presets():
    readme = Path(__file__).resolve().parents[2] / "README.md"
    stated = re.findall(r"; (\d+) presets \|", readme.read_text(encoding="utf-8"))
    assert stated == [str(len(presets()))], "write the number of presets into the table of the README"


def test_changing_the_returned_presets_changes_no_preset():
    names = list(presets())
    presets().clear()
    assert list(presets()) == names


def test_names_of_presets_ignore_case():
    assert load_sonar("P900-45") is load_sonar("p900-45")


def test_the_file_of_presets_explains_every_key():
    header = PRESETS.read_text().split("[p900-45]")[0]
    unexplained = [field for field in Sonar.__dataclass_fields__ if f"#   {field} " not in header]
    assert unexplained == [], "the head of sonars.toml must explain these fields of Sonar"


@pytest.mark.parametrize("name", sorted({name for names in CHOICES.values() for name in names}))
def test_the_file_of_presets_and_the_docstring_name_every_choice(name):
    """A taper that was added to TAPERS alone was told nowhere, and passed all tests."""
    assert f'"{name}"' in PRESETS.read_text().split("[p900-45]")[0], (
        f"the head of {PRESETS.name} must name it"
    )
    assert f'"{name}"' in Sonar.__doc__, "the docstring of Sonar must name it"


def test_the_page_of_acoustics_has_a_row_of_every_taper():
    page = (Path(__file__).parents[2] / "docs" / "acoustics.md").read_text()
    rows = page.partition("| taper | side lobes |")[2].partition("\n\n")[0]
    assert re.findall(r"^\| `(\w+)`", rows, re.MULTILINE) == list(TAPERS), (
        "docs/acoustics.md, the table of tapers"
    )


def test_the_file_of_presets_names_the_keys_that_a_table_must_have():
    stated = re.search(r"A table must have (.*?);", PRESETS.read_text(), re.DOTALL).group(1)
    required = {name for name, field in Sonar.__dataclass_fields__.items() if field.default is MISSING}
    assert set(re.findall(r"[a-z]+_\w+", stated)) == required - {"name"}  # which is the heading


def test_azimuths_and_bins():
    sonar = Sonar("s", **{**KEYS, "n_beams": 4, "n_bins": 59})
    np.testing.assert_allclose(np.degrees(sonar.azimuth_rad), [-16.875, -5.625, 5.625, 16.875], rtol=1e-15)
    assert (sonar.bin_edges_m[0], sonar.bin_edges_m[-1], sonar.bin_size_m) == (0.5, 30.0, 0.5)
    np.testing.assert_allclose(sonar.range_m, 0.75 + 0.5 * np.arange(59), rtol=1e-15)
    assert (sonar.with_range(10.5).n_bins, sonar.with_range(10.5).bin_size_m) == (20, 0.5)


def test_azimuths_even_in_sine():
    """Of a straight array of 8 elements half a wavelength apart, whose Fourier transform has beams at sines of n/4."""
    sonar = Sonar("s", **{**KEYS, "n_beams": 9, "azimuth_fov_deg": 180.0}, beam_spacing="sine")
    np.testing.assert_allclose(np.sin(sonar.azimuth_rad), np.arange(-4, 5) / 4, rtol=0, atol=1e-15)
    alone = Sonar("s", **{**KEYS, "n_beams": 1}, beam_spacing="sine")
    assert alone.azimuth_rad.tolist() == [0.0]


def test_oculus_bearings_are_those_of_a_device():
    """In raw pings of an M1200d (liboculus, test/data), hundredths of a degree, every 32nd of 256."""
    measured = [-30.0, -21.99, -14.41, -7.09, 0.11, 7.32, 14.65, 22.23]
    sonar = replace(load_sonar("oculus-m1200d-hf"), n_beams=256)
    np.testing.assert_allclose(np.degrees(sonar.azimuth_rad)[::32], measured, rtol=0, atol=0.01)


@pytest.mark.parametrize(
    ("azimuths_deg", "edges_deg"),
    [(None, (-30, 30)), ((-10, 0, 20), (-15, 30)), ((-30, -10), (-30, 0)), ((5,), (4, 6))],
)
def test_edges_of_what_the_beams_image(azimuths_deg, edges_deg):
    n_beams = 8 if azimuths_deg is None else len(azimuths_deg)
    sonar = Sonar("made", 900e3, n_beams, 100, 60.0, 20.0, 2.0, 1.0, 10.0, beam_azimuths_deg=azimuths_deg)
    assert np.degrees(sonar.fan_edges_rad) == pytest.approx(edges_deg)


def test_azimuths_from_a_table():
    sonar = Sonar("s", **{**KEYS, "n_beams": 3}, beam_azimuths_deg=[-20, 1, 22.5])
    assert np.degrees(sonar.azimuth_rad) == pytest.approx([-20, 1, 22.5], abs=1e-13)


@pytest.mark.parametrize("fov_deg", [60.0, 70.0, 90.0, 120.0, 128.0, 130.0])
def test_azimuths_of_a_sonar_may_be_given_as_a_table(fov_deg):
    """Those of sines lie on the edges of the fan but for rounding to radians and back."""
    sonar = replace(load_sonar("oculus-m750d-lf"), azimuth_fov_deg=fov_deg)
    azimuths_deg = np.degrees(sonar.azimuth_rad)
    given = replace(sonar, beam_azimuths_deg=azimuths_deg)
    np.testing.assert_allclose(given.azimuth_rad, sonar.azimuth_rad, rtol=0, atol=1e-15)
    azimuths_deg[-1] += 1e-9
    with pytest.raises(Error, match="within ±azimuth_fov_deg/2"):
        replace(sonar, beam_azimuths_deg=azimuths_deg)


def test_a_file_with_top_level_keys(tmp_path):
    (tmp_path / "mine.toml").write_text(TEXT)
    sonar = load_sonar(tmp_path / "mine.toml")
    assert sonar == load_sonar(str(tmp_path / "mine.toml")) == Sonar("mine", **KEYS)


def test_a_file_with_one_table(tmp_path):
    (tmp_path / "mine.toml").write_text(f"[other]\n{TEXT}beam_azimuths_deg = {list(range(-128, 128))}\n")
    message = error_of(load_sonar, tmp_path / "mine.toml")
    assert message == (
        f"{tmp_path}/mine.toml [other]: sonar 'other': beam_azimuths_deg must lie within "
        "±azimuth_fov_deg/2 = ±22.5 (got -128 to 127)"
    )
    (tmp_path / "mine.toml").write_text(f'[other]\nname = "mine"\nsource = "me"\n{TEXT}')
    assert load_sonar(tmp_path / "mine.toml") == Sonar("mine", **KEYS, source="me")


def test_a_file_with_several_tables(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(f"[a]\n{TEXT}[b]\n{TEXT}")
    assert load_sonar(f"{path}#b").name == "b"
    assert load_sonar(f"{PRESETS}#p900-90") == load_sonar("p900-90")
    assert error_of(load_sonar, path) == (
        f"{path}: must contain one sonar, or one of its tables must be named (got a, b; write {path}#a)"
    )
    assert error_of(load_sonar, f"{path}#c") == f"{path}: unknown table (got 'c'; known are a, b)"


def test_a_file_name_may_contain_a_hash(tmp_path):
    path = tmp_path / "a.toml#b"
    path.write_text(TEXT)
    assert load_sonar(path).n_beams == 256
    path = tmp_path / "a.toml#b.toml"
    path.write_text(f"[c]\n{TEXT}[d]\n{TEXT}")
    assert load_sonar(f"{path}#d").name == "d"


def test_a_file_name_may_look_like_a_change(tmp_path):
    path = tmp_path / "p900-45,n_beams=7.toml"
    path.write_text(TEXT)
    assert load_sonar(str(path)).n_beams == 256


def test_text_may_change_fields(tmp_path):
    changed = load_sonar("P900-45, receive_taper=taylor,bandwidth_hz=30e3")
    assert changed == replace(load_sonar("p900-45"), receive_taper="taylor", bandwidth_hz=30e3)
    (tmp_path / "a,b.toml").write_text(TEXT)
    path = str(tmp_path / "a,b.toml")
    assert load_sonar(f"{path},n_bins=7") == replace(load_sonar(path), n_bins=7)
    assert error_of(load_sonar, "p900-45,taper=hamming") == (
        "sonar 'taper=hamming': unknown name "
        "(got 'taper'; did you mean 'pulse_taper' or 'receive_taper' or 'transmit_taper'?)"
    )
    assert error_of(load_sonar, "p900-45,bandwidth_hz=wide") == (
        "sonar 'bandwidth_hz=wide': bandwidth_hz must be a number (got 'wide')"
    )
    message = error_of(load_sonar, "p900-45,nam=mine")
    assert message.startswith("sonar 'nam=mine': unknown name (got 'nam'; ") and "'name'" not in message
    assert error_of(load_sonar, "p901,n_bins=7").startswith("unknown sonar (got 'p901'")


@pytest.mark.parametrize(
    ("keys", "hint"),
    [
        ("freq frequency_khz operating_frequency_hz", "did you mean 'frequency_hz'?"),
        ("fov fov_deg hfov horizontal_fov horizontal_fov_deg azimuth_fov", "did you mean 'azimuth_fov_deg'?"),
        ("horizontal_aperture_deg", "did you mean 'azimuth_fov_deg'?"),
        ("vfov vertical_fov_deg vertical_beam_width_deg", "did you mean 'elevation_fov_deg'?"),
        ("vertical_aperture", "did you mean 'elevation_fov_deg'?"),
        ("beamwidth horizontal_beam_width_deg", "did you mean 'beam_width_deg'?"),
        ("angular_resolution angular_resolution_deg", "did you mean 'beam_width_deg'?"),
        (
            "beam_separation beam_spacing_deg",
            "give n_beams = azimuth_fov_deg / separation; beam_spacing says in what the beams are evenly apart",
        ),
        ("num_beams number_of_beams nbeams", "did you mean 'n_beams'?"),
        ("num_bins range_bins n_samples", "did you mean 'n_bins'?"),
        (
            "range_resolution range_resolution_m resolution_m bin_size_m bin_length_mm",
            "give n_bins = (range_max_m - range_min_m) / size of a bin; what the pulse resolves follows from "
            "bandwidth_hz",
        ),
        ("ping_rate_hz update_rate_hz max_frame_rate", "did you mean 'ping_rate_max_hz'?"),
        ("max_range maximum_range_m", "did you mean 'range_max_m'?"),
        ("min_range min_range_m", "did you mean 'range_min_m'?"),
        (
            "pulse_length_us pulse_length_s pulse_duration pulse_width",
            "give bandwidth_hz: the band that a chirp sweeps; of a pulse without modulation 1/length, together "
            "with pulse_taper = uniform",
        ),
        ("bit_depth n_bits", "write counts = { bits = 16 }"),
        ("sound_speed sound_speed_m_s", "it is of the water: give it as --water, or as sonar_gl.Water"),
    ],
)
def test_names_of_other_data_sheets_are_told_what_says_the_same(tmp_path, keys, hint):
    for key in keys.split():
        path = tmp_path / "mine.toml"
        path.write_text(f"{TEXT}{key} = 1\n")
        assert error_of(load_sonar, path) == f"{path} [mine]: unknown key (got {key!r}; {hint})"
        text = f"{key}=1"
        expected = f"sonar {text!r}: unknown name (got {key!r}; {hint})"
        assert error_of(load_sonar, f"p900-45,{text}") == expected


def test_an_unknown_preset_is_an_error():
    assert error_of(load_sonar, "p900-46") == (
        "unknown sonar (got 'p900-46'; did you mean 'p900-45' or 'p900-90' or 'm900-45'?)"
    )
    for text in ("p900-45;n_beams=64", "p900-45 n_beams=64", "p900-45:n_beams=64"):
        message = error_of(load_sonar, text)
        assert message.startswith(f"unknown sonar (got {text!r}; did you mean 'p900-45'")
        assert message.endswith(
            "?; changes of its fields follow a comma each, as in p900-45,n_beams=64,n_bins=400)"
        )
    assert error_of(load_sonar, "DIDSON") == (
        "unknown sonar (got 'DIDSON'; did you mean 'didson-lf' or 'didson-hf'?)"
    )
    everything = ", ".join(sorted(presets()))
    assert error_of(load_sonar, "zzz") == f"unknown sonar (got 'zzz'; known are {everything})"
    ending = "a sonar's file must end in .toml"
    assert (
        error_of(load_sonar, "zzz.tml") == f"unknown sonar (got 'zzz.tml'; known are {everything}; {ending})"
    )


def test_a_file_without_its_ending_is_an_error_that_names_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(TEXT)
    assert error_of(load_sonar, "mine") == "unknown sonar (got 'mine'; write mine.toml for the file)"


def test_a_sonar_is_a_name_or_a_path():
    message = "a sonar must be a preset's name or the path of a .toml file (got 900)"
    assert error_of(load_sonar, 900) == message


@pytest.mark.parametrize("name", ["none.toml", "none/mine", "none.toml#a"])
def test_a_missing_file_is_an_error(name):
    path = name.split("#")[0]
    assert error_of(load_sonar, name) == (
        f"{path}: the sonar's file must exist (got none there; paths start at {Path.cwd()})"
    )


def test_files_that_describe_no_sonar_are_errors(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("name = 'a'\nn_beams = 1 2\n")
    assert error_of(load_sonar, path) == (
        f"{path}: the sonar's file must be TOML "
        "(Expected newline or end of document after a statement (at line 2, column 13))"
    )
    path.write_bytes(b"name = '\xff'")
    assert error_of(load_sonar, path) == (
        f"{path}: the sonar's file must be TOML in UTF-8 (got byte 0xff in line 1; save it as UTF-8)"
    )
    table = tmp_path / "mine.csv"  # a file of poses in the wrong place
    table.write_text("t,x,y,z\n")
    assert error_of(load_sonar, table) == (
        f"{table}: the sonar's file must be TOML (Expected '=' after a key in a key/value pair (at line 1, column 2); "
        "a sonar is a preset's name, such as p900-45, or a .toml file)"
    )
    capitals = tmp_path / "mine.TOML"
    capitals.write_text("name\n")
    assert error_of(load_sonar, capitals).endswith(
        "(at line 1, column 5))"
    )  # no word of another kind of file
    path.write_text("# nothing\n")
    assert error_of(load_sonar, path) == (
        f"{path}: must contain one sonar (got an empty file; copy a table of {PRESETS})"
    )
    path.write_text(f"{TEXT}[a]\n{TEXT}")
    assert error_of(load_sonar, path) == (
        f"{path}: must contain either a sonar's keys or tables, not both (got key 'frequency_hz' and table 'a')"
    )
    for table, name in (("noise", "Noise"), ("acoustics", "Acoustics"), ("water", "Water")):
        for text in (f"{TEXT}[{table}]\nx = 1\n", f"[mine]\n{TEXT}[{table}]\nx = 1\n"):
            path.write_text(text)
            assert error_of(load_sonar, path) == (
                f"{path}: must describe the device alone (got the table [{table}]; write it in the job of a batch, "
                f"or give it as --{table} to commands and as sonar_gl.{name} in Python)"
            )
    path.write_text(f"[noise]\n{TEXT}")  # a sonar of this name
    assert load_sonar(path).name == "noise"
    path.write_text(f"[[sonars]]\n{TEXT}")  # as in a job
    assert error_of(load_sonar, path) == (
        f"{path}: must contain a sonar's keys or its table, [sonars] (got [[sonars]], a list of tables)"
    )
    path.write_text(f"{TEXT}beam_azimuths_deg = []\n")
    assert "a list of tables" not in error_of(load_sonar, path)
    path.write_text(f"{TEXT}count = {{ law = 'db' }}\n")
    assert error_of(load_sonar, path) == (
        f"{path}: must contain either a sonar's keys or tables, not both "
        "(got key 'frequency_hz' and table 'count'; did you mean 'counts'?)"
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_beam": 2}, "unknown key (got 'n_beam'; did you mean 'n_beams' or 'name' or 'n_bins_max'?)"),
        (
            {"bits": 8},
            "bits must be a key of the law of counts (got it as one of the sonar; write counts = { bits = ... })",
        ),
        ({"name": 3}, "name must be text (got 3; put it in quotes)"),
        ({"source": "[1]"}, "source must be text (got [1]; put it in quotes)"),
        ({"n_beams": "256.0"}, "n_beams must be a whole number in 1..65536 (got 256.0)"),
        ({"n_bins": 0}, "n_bins must be a whole number in 1..65536 (got 0)"),
        ({"n_bins": "true"}, "n_bins must be a whole number in 1..65536 (got True)"),
        ({"frequency_hz": "'900'"}, "frequency_hz must be a number (got '900')"),
        ({"frequency_hz": 900}, "frequency_hz must lie in 10000..1e+08 (got 900;"),
        ({"azimuth_fov_deg": 400}, "azimuth_fov_deg must lie in 0.01..360 (got 400; give degrees)"),
        ({"elevation_fov_deg": "nan"}, "elevation_fov_deg must lie in 0.01..170 (got nan; give degrees)"),
        ({"range_min_m": 40}, "range_min_m must be less than range_max_m (got 40 and 30)"),
        ({"range_min_m": 30 * (1 - 1e-13)}, "bins must be at least 1e-09 of range_max_m long"),
        ({"beam_azimuths_deg": [1, 2]}, "beam_azimuths_deg must have shape (256) (got (2,);"),
        ({"n_beams": 2, "beam_azimuths_deg": [2, 1]}, "beam_azimuths_deg must rise (got 1 after 2;"),
        ({"receive_taper": "'hann'"}, "unknown receive_taper (got 'hann'; did you mean 'hamming'?)"),
        ({"steered": "'bent'"}, "unknown steered (got 'bent'; known are alike, straight)"),
        ({"side_lobe_db": -30}, "side_lobe_db must lie in 15..60 (got -30;"),
        ({"transmit_width_deg": 0}, "transmit_width_deg must lie in 0.001..180 (got 0; give degrees)"),
        ({"bandwidth_hz": 0.03}, "bandwidth_hz must lie in 1..1e+08 (got 0.03; give hertz, 30e3 for 30 kHz)"),
        ({"bandwidth_hz": "29.5e6"}, "bandwidth_hz must not exceed frequency_hz (got 2.95e+07 and 900000;"),
        ({"tilt_deg": 100}, "tilt_deg must lie in -90..90 (got 100; give degrees, positive down)"),
        ({"range_limit_m": 0}, "range_limit_m must lie in 0.001..100000 (got 0; give metres)"),
        ({"range_limit_m": 0.1}, "range_limit_m must exceed range_min_m (got 0.1 and 0.5;"),
        ({"ping_rate_max_hz": 0}, "ping_rate_max_hz must lie in 0.001..10000 (got 0; give pings per second)"),
        ({"n_bins_max": 4}, "n_bins must not exceed n_bins_max (got 512 and 4;"),
        ({"n_bins_max": 0.5}, "n_bins_max must be a whole number in 1..65536 (got 0.5)"),
        ({"keeps_n_bins": 1}, "keeps_n_bins must be true or false (got 1)"),
        ({"source_level_db": -20}, "source_level_db must lie in 100..260 (got -20;"),
        ({"self_noise_db": "'low'"}, "self_noise_db must be a number (got 'low')"),
        ({"azimuth_fov_deg": 200, "beam_spacing": "'sine'"}, 'beam_spacing "sine" needs an azimuth_fov_deg'),
    ],
)
def test_messages_name_the_file_the_table_and_the_key(tmp_path, change, message):
    path = tmp_path / "mine.toml"
    path.write_text("[a]\n" + "".join(f"{key} = {value}\n" for key, value in {**KEYS, **change}.items()))
    found = error_of(load_sonar, path).removeprefix(f"{path} [a]: ").removeprefix("sonar 'a': ")
    assert found.startswith(message)


def test_a_range_of_more_bins_than_a_sonar_has_is_refused_as_a_range():
    sonar = load_sonar("aris-3000")
    most_m = sonar.range_min_m + 65536.49 * sonar.bin_size_m
    assert sonar.with_range(most_m).n_bins == 65536
    assert error_of(sonar.with_range, 500) == (
        "sonar 'aris-3000': the range must not exceed 197.3 m with bins of 0.003 m, of which a sonar has 65536 at most "
        "(got 500; give a shorter range, or the number of bins, too: --bins, bins in a job, with_range(..., n_bins))"
    )
    assert sonar.with_range(500, 1000) == replace(sonar, range_max_m=500, n_bins=1000)
    assert error_of(sonar.with_range, 500, 0) == (
        "sonar 'aris-3000': n_bins must be a whole number in 1..65536 (got 0)"
    )


def test_messages_name_missing_keys(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text("n_beams = 1\n" + "\n".join(TEXT.splitlines()[3:]))
    assert error_of(load_sonar, path) == (
        f"{path} [mine]: every required key must be present (missing: frequency_hz, n_bins)"
    )


@pytest.mark.parametrize("key", ["name", "source"])
@pytest.mark.parametrize(
    ("value", "got"), [(None, "None"), (5, "5"), (b"mine", "b'mine'"), (["mine"], "['mine']")]
)
def test_names_and_sources_are_text(key, value, got):
    """Of other values a ping has no record: bytes are not JSON, a list makes the sonar unhashable."""
    assert error_of(Sonar, **{"name": "s", **KEYS, key: value}) == f"sonar: {key} must be text (got {got})"


@pytest.mark.parametrize(
    ("change", "key", "option"),
    [
        ("counts=db", "counts", "; on a command line --counts changes it"),
        ("n_beams=2, beam_azimuths_deg = [-1,1]", "beam_azimuths_deg", ""),
        ("name=mine", "name", ""),
    ],
)
def test_a_field_that_text_cannot_change_is_not_said_to_be_unknown(change, key, option):
    assert error_of(load_sonar, f"p900-45,{change}") == (
        f"sonar {change!r}: {key} cannot be changed by text (write it in the sonar's file, or give it to "
        f"dataclasses.replace{option})"
    )


def test_the_range_must_exceed_the_least_range():
    assert error_of(load_sonar("p900-45").with_range, 0.5) == (
        "sonar 'p900-45': the range must exceed range_min_m = 0.5 m (got 0.5)"
    )


def test_real_and_unusual_sonars_give_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for sonar in presets().values():
            replace(sonar)
        Sonar("one narrow beam", **{**KEYS, "n_beams": 1, "azimuth_fov_deg": 0.01})
        Sonar("fine beams", **{**KEYS, "n_beams": 4096, "azimuth_fov_deg": 45.0})
        Sonar("narrow fan", **{**KEYS, "n_beams": 64, "azimuth_fov_deg": 6.0})
        Sonar("low fan", **{**KEYS, "elevation_fov_deg": 1.0, "tilt_deg": 0.5})
        Sonar("one low beam", **{**KEYS, "n_beams": 1, "elevation_fov_deg": 0.5})
        Sonar("narrow transmitter", **{**KEYS, "transmit_width_deg": 5.0, "bandwidth_hz": 1e3})
        Sonar(
            "wide beams", **{**KEYS, "beam_width_deg": 8.0, "common_noise_db": -70.0}
        )  # the width is the default
        Sonar("long pulse", **{**KEYS, "frequency_hz": 12e3, "bandwidth_hz": 100.0})


def test_max_ping_rate_is_one_over_the_two_way_travel_time_and_no_more_than_the_device_makes():
    sonar = Sonar("s", **KEYS)
    assert sonar.max_ping_rate_hz(1480.0) == 1480 / 60
    assert replace(sonar, ping_rate_max_hz=15.0).max_ping_rate_hz(1480.0) == 15.0
    assert replace(sonar, ping_rate_max_hz=25.0).max_ping_rate_hz(1480.0) == 1480 / 60


def test_a_device_that_keeps_its_number_of_bins_has_longer_ones_at_longer_range():
    sonar = load_sonar("didson-hf")
    assert (sonar.n_bins, sonar.with_range(10.4).n_bins) == (512, 512)
    assert sonar.with_range(10.4).bin_size_m == pytest.approx(10 / 512, rel=1e-15)


def test_a_device_that_delivers_so_many_bins_at_most_has_longer_ones_at_longer_range():
    sonar = Sonar("s", **{**KEYS, "n_bins": 59}, n_bins_max=60)
    assert (sonar.with_range(30.5).n_bins, sonar.with_range(30.5).bin_size_m) == (60, 0.5)
    assert (sonar.with_range(60.5).n_bins, sonar.with_range(60.5).bin_size_m) == (60, 1.0)
    assert (sonar.with_range(10.5).n_bins, sonar.with_range(10.5).bin_size_m) == (20, 0.5)
    assert replace(sonar, n_bins_max=None).with_range(60.5).n_bins == 120


@pytest.mark.parametrize("name", [name for name in presets() if name.startswith("oculus")])
def test_an_oculus_delivers_as_many_bins_at_its_greatest_range_as_a_network_carries(name):
    sonar = load_sonar(name)
    assert sonar.n_bins <= sonar.n_bins_max == sonar.with_range(500.0).n_bins == 5000
    assert "at most 5000 bins" in sonar.source.split("unverified: ")[1]


def test_beams_of_a_lens_are_those_of_the_makers_tables():
    """Spacing of the middle and of the outermost beams in aris-file-sdk, beam-width-metrics, rounded to 0.01."""
    for name, middle_deg, outer_deg, outermost_deg in (
        ("aris-1800", 0.346, 0.214, 13.812),
        ("aris-1800-lf", 0.692, 0.432, 13.574),
        ("aris-1200", 0.692, 0.432, 13.574),
        ("aris-1200-lf", 0.692, 0.432, 13.574),
    ):
        azimuth_deg = np.degrees(load_sonar(name).azimuth_rad)
        np.testing.assert_allclose(azimuth_deg, -azimuth_deg[::-1], rtol=0, atol=1e-12)
        spacing_deg = np.diff(azimuth_deg)
        # both ends of a spacing are rounded, and the fit errs by 0.01
        assert spacing_deg[len(spacing_deg) // 2] == pytest.approx(middle_deg, abs=0.02)
        assert spacing_deg[0] == pytest.approx(outer_deg, abs=0.02)
        assert azimuth_deg[-1] == pytest.approx(outermost_deg, abs=0.02)


def test_a_preset_as_a_path_and_a_folder_as_a_file(tmp_path):
    assert error_of(load_sonar, Path("P900-45")) == (
        f"P900-45: the sonar's file must exist (got none there; paths start at {Path.cwd()}; a Path is that of a file: "
        "name a preset by text)"
    )
    assert error_of(load_sonar, tmp_path) == (
        f"{tmp_path}: the sonar's file must be a file (got a folder; such as {tmp_path / 'mine.toml'})"
    )


@pytest.mark.parametrize("tilt_deg", [0.0, 10.0])
def test_the_pose_of_a_head_is_that_of_a_pose(tilt_deg):
    sonar, pose = Sonar("s", **KEYS, tilt_deg=tilt_deg), make_pose(1, 2, 3)
    assert (sonar.head_pose(pose.tolist()) == sonar.head_pose(pose)).all()
    assert error_of(sonar.head_pose, [1, 2, 3]) == (
        "pose must have shape (4, 4) (got (3,); sonar_gl.pose makes one from x y z roll pitch yaw)"
    )


def test_the_head_is_tilted_down_within_its_housing():
    pose = make_pose(1.0, 2.0, -3.0, 0.1, -0.2, 0.3)
    level = Sonar("s", **KEYS)
    assert level.head_pose(pose) is pose and (level.sonar_from_head == np.eye(4)).all()
    tilted = replace(level, tilt_deg=10.0).head_pose(pose)
    assert (tilted[:3, 3] == pose[:3, 3]).all()  # about the middle of the arrays
    sine, cosine = np.sin(np.radians(10)), np.cos(np.radians(10))
    np.testing.assert_allclose(tilted[:3, 0], pose[:3, :3] @ [cosine, 0, -sine], rtol=0, atol=1e-15)
    np.testing.assert_allclose(tilted[:3, 1], pose[:3, 1], rtol=0, atol=1e-15)
    assert load_sonar("gemini-720is").tilt_deg == 10.0


WIDE = {"azimuth_fov_deg": 140.0, "n_beams": 15, "beam_azimuths_deg": np.radians(np.linspace(-70, 70, 15))}


@pytest.mark.parametrize(
    ("change", "problem", "cure"),
    [
        ({"azimuth_fov_deg": 0.7854}, "256 beams within less than 7 degrees", "in radians, give 45"),
        ({"beam_width_deg": 0.01745}, "beams that are 0.176 degrees apart", "in radians, give 0.9998"),
        ({"elevation_fov_deg": 0.35}, "is lower than the fan of any device", "in radians, give 20.05"),
        ({"transmit_width_deg": 1.0}, "leaves most of a fan of 45 degrees without", "in radians, give 57.3"),
        (WIDE, "-1.222 to 1.222, leave most of a fan of 140 degrees without beams", "give -70 to 70"),
        ({"common_noise_db": -85.0, "common_noise_width_deg": 0.07}, "than the beams of", "give 4.011"),
        ({"tilt_deg": -0.17}, "is little against an elevation of 20 degrees", "in radians, give -9.74"),
        ({"bandwidth_hz": 30}, "makes a resolution cell of 25 m", "in kHz, give 30000"),
        (
            {"range_min_m": 0.0005, "range_max_m": 0.03, "n_bins": 1161},
            "bins of 0.0254 mm",
            "give 0.5 and 30",
        ),
        ({"range_max_m": 30000.0}, "comes back from range_max_m = 30000 m", "in millimetres, give 30"),
        ({"range_limit_m": 30000.0}, "comes back from range_limit_m = 30000 m", "in millimetres, give 30"),
        ({"common_noise_db": 85.0}, "common_noise_db = 85 exceeds the echo", "(absolute_levels states it)"),
        ({"self_noise_db": 85.0}, "self_noise_db = 85 exceeds the echo", "(absolute_levels states it)"),
    ],
)
def test_numbers_of_other_units_are_warned_of(change, problem, cure):
    with pytest.warns(UserWarning, match=f"^sonar 's': .*{re.escape(problem)}") as caught:
        Sonar("s", **{**KEYS, **change})
    assert [str(one.message).endswith(cure) for one in caught] == [True]


def test_the_warning_names_the_line_that_changed_the_sonar():
    """Not one inside of `dataclasses`."""
    sonar = Sonar("s", **KEYS)
    with pytest.warns(UserWarning, match="if it is in radians") as caught:
        replace(sonar, beam_width_deg=0.01745)
    assert [w.filename for w in caught] == [__file__]
