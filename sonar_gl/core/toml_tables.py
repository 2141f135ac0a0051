"""Tables of TOML files: types that pydantic checks, and errors that name file, table and key.

Jobs of batches and the settings of `sonar-gl ros2` are such tables. Needs pydantic, which comes with some extras alone.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Annotated, ClassVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from sonar_gl.core.errors import Error, nearest_names
from sonar_gl.core.poses import check_pose, pose

# errors of pydantic about the length of a list
LENGTHS = {
    "too_short": "should have a length of at least {min_length}",
    "too_long": "should have a length of at most {max_length}",
}
# errors of pydantic about the pattern of a name
PATTERNS = {
    r"^[A-Za-z][A-Za-z0-9_]*$": "should begin with a letter, A-Z or a-z, and go on with such letters, digits and _",
    r"^[\w.-]+$": "should consist of letters, digits, _, - and .",
}
IDENTIFIER, WORD = PATTERNS
TABLES = "dataclass_type", "dict_type", "model_attributes_type", "model_type"  # of what is no table

# settings of every table: no unknown keys, no conversion of types, no NaN
STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _check_mount(numbers: list[float]) -> list[float]:
    check_pose(pose(*numbers))
    return numbers


Mount = Annotated[
    list[float],
    Field(min_length=6, max_length=6, description="give [x, y, z, roll, pitch, yaw] in metres and radians"),
    AfterValidator(_check_mount),
]
Names = Annotated[list[str], Field(min_length=1)]


class Table(BaseModel):
    """A table of a file. Unknown keys are errors.

    REPLACED : keys of former versions -> what stands in their place, for messages
    NOT_IN_FILES : fields that no file gives
    """

    model_config = ConfigDict(**STRICT, frozen=True)
    REPLACED: ClassVar[dict[str, str]] = {}
    NOT_IN_FILES: ClassVar[tuple[str, ...]] = ()


def table_error(
    why: ValidationError, kind: type, file: str, table: tuple = (), whole: str = "the file"
) -> Error:
    """Return one error for all that pydantic found wrong with a table.

    kind : the pydantic model or dataclass; its fields' descriptions are the cures in the messages
    table : keys that lead to the table in the file, such as ("poses", 0)
    whole : what the file describes
    """
    sentences = [_sentence(error, kind, table, whole) for error in why.errors()]
    return Error(f"{file}: " + "; ".join(dict.fromkeys(sentences)))


def _sentence(error: Mapping, kind: type, table: tuple, whole: str) -> str:
    """Return one error of pydantic in the form: what must hold (what came; cure)."""
    place = (*table, *error["loc"])
    if error["type"] == "extra_forbidden":
        known = known_keys(kind, error["loc"][:-1])
        replaced = getattr(_kind_at(kind, error["loc"][:-1]), "REPLACED", {})
        if place[-1] in replaced:
            return f"{key_path(place)} is no key any more; give {replaced[place[-1]]}"
        hint = f"; {nearest_names(str(place[-1]), known)}" if known else ""
        return f"{key_path(place[:-1]) or whole}: unknown key (got {str(place[-1])!r}{hint})"
    if error["type"] == "missing":
        cure = _cure(kind, error["loc"])
        return f"{key_path(place)} must be given{cure and f' ({cure})'}"
    text = error["msg"].removeprefix("Value error, ").removeprefix("Input ")
    text = text[:1].lower() + text[1:]
    if error["type"] in LENGTHS:
        text = LENGTHS[error["type"]].format(**error["ctx"])
    elif error["type"] == "string_pattern_mismatch":
        text = PATTERNS[error["ctx"]["pattern"]]
    got, cure = error["input"], _cure(kind, error["loc"])
    if error["type"] in TABLES:
        text, known = "should be a table", known_keys(kind, error["loc"])
        cure = f"its keys are {', '.join(known)}" if known else cure
    if "(got " in text or not error["loc"]:
        return f"{key_path(place)}: {text}"
    if error["type"] == "list_type" and isinstance(got, dict):
        cure = f"write [[{key_path(place)}]], since there may be several"
    elif error["type"] == "list_type" and isinstance(got, str) and not cure:  # one name, of several
        cure = f"write {json.dumps([got[:80]], ensure_ascii=False)}"
    got = f"a table of {', '.join(map(str, got))}" if isinstance(got, dict) else repr(got)[:80]
    return f"{key_path(place)}: {text} (got {got}{cure and '; '}{cure})"


def _kind_at(kind: type, place: Iterable) -> type | None:
    """Return the type of the table at a place, as far as the types say."""
    for key in place:
        if isinstance(key, int) or not hasattr(kind, "model_fields"):
            continue
        field = kind.model_fields.get(key)
        inner = [] if field is None else [field.annotation, *getattr(field.annotation, "__args__", ())]
        found = [t for t in inner if isinstance(t, type) and issubclass(t, BaseModel)]
        kind = found[0] if found else None
    return kind


def known_keys(kind: type, place: Iterable = ()) -> list[str]:
    """Return the keys of the table at a place in a file, as far as the types say."""
    table = _kind_at(kind, place)
    hidden = getattr(table, "NOT_IN_FILES", ())
    return [key for key in getattr(table, "model_fields", ()) if key not in hidden]


def _cure(kind: type, place: tuple) -> str:
    """Return the description of the field that a place is in, or ''."""
    names = [k for k, key in enumerate(place) if isinstance(key, str)]
    table = _kind_at(kind, place[: names[-1]]) if names else None
    field = getattr(table, "__pydantic_fields__", {}).get(place[names[-1]]) if names else None
    return getattr(field, "description", None) or ""


def key_path(place: Iterable) -> str:
    """Return a path of keys as in the file, such as sonars[1].mount; entries are counted from 0."""
    out = ""
    for key in place:
        out += f"[{key}]" if isinstance(key, int) else f".{key}" if out else str(key)
    return out
