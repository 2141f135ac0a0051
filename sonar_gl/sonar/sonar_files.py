"""Files of data sheets: those of the presets, and those that users write."""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import MISSING, fields, replace
from functools import lru_cache
from pathlib import Path

from sonar_gl.core.atomic_file import atomic_write
from sonar_gl.core.checks import check_choice, check_file_name, check_kind, shown
from sonar_gl.core.errors import Error, errors_at, nearest_names, similar_names
from sonar_gl.core.input_files import check_no_link_loop
from sonar_gl.core.key_values import parse_fields
from sonar_gl.core.toml import read_toml, toml_text
from sonar_gl.sonar.counts import LAWS, Counts
from sonar_gl.sonar.sonar import UNPARSED, Sonar

# tables of a job that describe no device: what they are in Python
OTHER_TABLES = {"noise": "Noise", "acoustics": "Acoustics", "water": "Water"}
OF_COUNTS = {field.name for field in fields(Counts)}
PRESETS = Path(__file__).with_name("sonars.toml")
# names of other data sheets and simulators, as patterns: the field that says the same, or what to write
OTHER_NAMES = {
    r"((operating|center|centre|carrier)_)?freq(uency)?(_[km]?hz)?": "frequency_hz",
    r"(h|hor\w*_|azimuth_)?(fov|aperture)(_deg|_rad)?": "azimuth_fov_deg",
    r"(v|ver\w*_|elevation_)(fov|aperture)(_deg|_rad)?|(vertical|elevation)_beam_?width\w*": "elevation_fov_deg",
    r"(horizontal_|azimuth_)?beam_?width(_rad)?|(horizontal_|azimuth_)beam_?width_deg": "beam_width_deg",
    r"(ang\w+|azimuth|horizontal)_resolution(_deg|_rad)?": "beam_width_deg",
    r"beam_(spacing|separation)_(deg|rad)|beam_separation": (
        "give n_beams = azimuth_fov_deg / separation; beam_spacing says in what the beams are evenly apart"
    ),
    r"n(um(ber)?)?_?(of_)?beams": "n_beams",
    r"n(um(ber)?)?_?(of_)?(range_)?(bins|samples)|range_bins": "n_bins",
    r"(range_)?resolution(_[cm]?m)?|(range_)?bin_(size|length|width)(_[cm]?m)?": (
        "give n_bins = (range_max_m - range_min_m) / size of a bin; what the pulse resolves follows from bandwidth_hz"
    ),
    r"max(imum)?_range(_m)?": "range_max_m",
    r"min(imum)?_range(_m)?": "range_min_m",
    r"pulse_(length|duration|width)(_\w+)?": (
        "give bandwidth_hz: the band that a chirp sweeps; of a pulse without modulation 1/length, together with "
        "pulse_taper = uniform"
    ),
    r"(max(imum)?_)?(ping|update|frame|refresh)_rate(_max)?(_hz)?": "ping_rate_max_hz",
    r"bit_depth|n(um(ber_of)?)?_bits": "write counts = { bits = 16 }",
    r"(sound_speed|speed_of_sound)\w*": "it is of the water: give it as --water, or as sonar_gl.Water",
}


def load_sonar(what: str | Path) -> Sonar:
    """Return a preset, or the sonar of a file.

    Parameters
    ----------
    what : name of a preset, in upper or lower case, or path of a .toml file that contains one sonar, as top-level keys
        or as a table; "path.toml#table" selects one of several tables. Text may go on with changes of fields,
        ",key=value,..."

    Raises
    ------
    Error
        if there is no such preset, file or table, the file does not describe a sonar, or a change is not one.

    >>> load_sonar("P900-45").n_beams
    256
    >>> load_sonar("p900-45,receive_taper=hamming,bandwidth_hz=30e3").bandwidth_hz
    30000.0
    """
    if not isinstance(what, (str, Path)):
        raise Error(f"a sonar must be a preset's name or the path of a .toml file (got {shown(what)})")
    if isinstance(what, str) and (changes := re.search(r",\s*\w+\s*=", what)) and not Path(what).exists():
        return _changed(what[: changes.start()], what[changes.start() + 1 :])
    known, text = presets(), str(what)
    if isinstance(what, str) and text.casefold() in known:
        return known[text.casefold()]
    stem, mark, table = text.rpartition(".toml#")
    path = Path(stem + ".toml") if mark and not Path(text).exists() else Path(text)
    check_no_link_loop(path)
    if not path.exists() or (path.is_dir() and path.suffix != ".toml"):
        raise _no_sonar_error(what, path, known)
    tables = _read_tables(path)
    if path != Path(text):  # the text names a table
        check_choice("table", table, tables, str(path))
    elif len(tables) > 1:
        raise Error(
            f"{path}: must contain one sonar, or one of its tables must be named "
            f"(got {', '.join(tables)}; write {path}#{next(iter(tables))})"
        )
    else:
        (table,) = tables
    return _sonar_from_table(f"{path} [{table}]", table, tables[table])


def split_sonar(text: str) -> tuple[str, str]:
    """Return the name of a sonar's file, or of a preset, and what follows it: a table's name, or changes of fields.

    >>> split_sonar("mine.toml#deep"), split_sonar("p900-45,receive_taper=hamming")
    (('mine.toml', '#deep'), ('p900-45', ',receive_taper=hamming'))
    """
    found = re.search(r"#|,\s*\w+\s*=", text)
    at = len(text) if found is None else found.start()
    return text[:at], text[at:]


def _changed(what: str, text: str) -> Sonar:
    """Return the sonar of a name or file, with changes of fields, "key=value,..."."""
    for key in (item.partition("=")[0].strip() for item in text.split(",")):
        if key in UNPARSED:
            option = "; on a command line --counts changes it" if key == "counts" else ""
            raise Error(
                f"sonar {text!r}: {key} cannot be changed by text (write it in the sonar's file, or give it to "
                f"dataclasses.replace{option})"
            )
    _, values = parse_fields("sonar", text, Sonar, without=UNPARSED, hint_of=_field_hint)
    return replace(load_sonar(what), **values)


def _field_hint(name: str, known: Collection[str]) -> str:
    """Return the hint about an unknown name of a field: what says the same here, or the most similar known names."""
    for pattern, hint in OTHER_NAMES.items():
        if re.fullmatch(pattern, name.casefold()):
            return f"did you mean {hint!r}?" if hint in known else hint
    return nearest_names(name, known)


def _no_sonar_error(what: str | Path, path: Path, known: Collection[str]) -> Error:
    """Return the error for what names neither a preset nor a file at `path`, which is where its file would be."""
    text = str(what)
    if isinstance(what, str) and path.name == text and path.suffix != ".toml":
        hint = nearest_names(text.casefold(), known)
        if Path(f"{text}.toml").is_file():
            hint = f"write {text}.toml for the file"
        elif "=" in text:
            hint += "; changes of its fields follow a comma each, as in p900-45,n_beams=64,n_bins=400"
        elif path.suffix:
            hint += "; a sonar's file must end in .toml"
        return Error(f"unknown sonar (got {text!r}; {hint})")
    if path.is_dir():
        return Error(f"{path}: the sonar's file must be a file (got a folder; such as {path / 'mine.toml'})")
    hint = "; a Path is that of a file: name a preset by text" if text.casefold() in known else ""
    return Error(f"{path}: the sonar's file must exist (got none there; paths start at {Path.cwd()}{hint})")


def save_sonar(path: str | Path, sonar: Sonar) -> None:
    """Write a sonar as a file that `load_sonar`, `--sonar` and jobs of batches read.

    Parameters
    ----------
    path : ends in .toml; its folder exists

    Raises
    ------
    Error
        if the path has another ending, or the file cannot be written, or cannot hold a text of the sonar.
    """
    path = check_file_name(path, (".toml",))
    check_kind("sonar", sonar, Sonar, "such as sonar_gl.load_sonar('p900-45')")
    with errors_at(str(path)):
        text = sonar_file_text(sonar)
    with atomic_write(path) as beside:
        beside.write_text(text, encoding="utf-8")


def sonar_file_text(sonar: Sonar) -> str:
    """Return the content of a file that describes a sonar, without what has its default value.

    >>> print(sonar_file_text(Sonar("mine", 900e3, 256, 512, 45.0, 20.0, 1.0, 0.5, 30.0, receive_taper="hamming")))
    name = "mine"
    frequency_hz = 900000.0
    n_beams = 256
    n_bins = 512
    azimuth_fov_deg = 45.0
    elevation_fov_deg = 20.0
    beam_width_deg = 1.0
    range_min_m = 0.5
    range_max_m = 30.0
    receive_taper = "hamming"
    <BLANKLINE>
    """
    check_kind("sonar", sonar, Sonar, "such as sonar_gl.load_sonar('p900-45')")
    table = _changed_fields(sonar)
    if "counts" in table:  # those of another law would be refused
        unused = {key for law, keys in LAWS.items() if law != sonar.counts.law for key in keys}
        changed = _changed_fields(sonar.counts).items()
        table["counts"] = {key: value for key, value in changed if key not in unused}
    return toml_text(table)


def _changed_fields(one: Sonar | Counts) -> dict:
    """Return the fields that have no default, or another value."""
    values = ((field, getattr(one, field.name)) for field in fields(one))
    return {field.name: value for field, value in values if value != field.default}  # nothing equals MISSING


def presets() -> dict[str, Sonar]:
    """Return name -> Sonar of the presets that come with the package."""
    return dict(_presets())


@lru_cache(maxsize=1)
def _presets() -> dict[str, Sonar]:
    return {
        name: _sonar_from_table(f"{PRESETS} [{name}]", name, t) for name, t in _read_tables(PRESETS).items()
    }


def _read_tables(path: Path) -> dict[str, dict]:
    """Return the tables of a file by name; top-level keys are one table, named after the file."""
    other_kind = path.suffix.lower() != ".toml"
    hint = "a sonar is a preset's name, such as p900-45, or a .toml file" if other_kind else ""
    data = read_toml(path, "the sonar's file", hint)
    tables = {key: value for key, value in data.items() if isinstance(value, dict) and key != "counts"}
    if not data:
        raise Error(f"{path}: must contain one sonar (got an empty file; copy a table of {PRESETS})")
    for key, value in tables.items():
        if key in OTHER_TABLES and "frequency_hz" not in value:  # else a sonar of that name
            raise Error(
                f"{path}: must describe the device alone (got the table [{key}]; write it in the job of a batch, "
                f"or give it as --{key} to commands and as sonar_gl.{OTHER_TABLES[key]} in Python)"
            )
    for key, value in data.items():
        if isinstance(value, list) and any(isinstance(one, dict) for one in value):
            got = f"[[{key}]], a list of tables"
            raise Error(f"{path}: must contain a sonar's keys or its table, [{key}] (got {got})")
    if not tables:
        return {path.stem: data}
    if len(tables) < len(data):
        key, table = next(key for key in data if key not in tables), next(iter(tables))
        hint = similar_names(table, ["counts"])
        raise Error(
            f"{path}: must contain either a sonar's keys or tables, not both "
            f"(got key {key!r} and table {table!r}{hint and '; '}{hint})"
        )
    return tables


def _sonar_from_table(location: str, name: str, table: dict) -> Sonar:
    """Return the sonar that a table of a file describes; messages begin with the location."""
    required = {field.name: field.default is MISSING for field in fields(Sonar)}
    with errors_at(location):
        for key in table:
            if key in OF_COUNTS:  # gain_db and bits resemble other keys of a sonar
                cure = f"write counts = {{ {key} = ... }}"
                raise Error(f"{key} must be a key of the law of counts (got it as one of the sonar; {cure})")
            if key not in required:
                raise Error(f"unknown key (got {shown(key)}; {_field_hint(key, required)})")
        for key in ("name", "source"):
            if not isinstance(table.get(key, ""), str):
                raise Error(f"{key} must be text (got {table[key]!r}; put it in quotes)")
        table = {"name": name} | table
        missing = [key for key, is_required in required.items() if is_required and key not in table]
        if missing:
            raise Error(f"every required key must be present (missing: {', '.join(missing)})")
        return Sonar(**table)
