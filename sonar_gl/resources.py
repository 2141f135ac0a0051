"""Finds and parses the files that a scene file names, and follows nothing out of the folders it was given."""

from __future__ import annotations

import io
import os
import re
from pathlib import Path
from xml.parsers import expat

from sonar_gl.types import Error

MAX_XML_BYTES = 50_000_000
NAMESPACE = "urn:sonar_gl"  # what the prefix stands for in our own tags, whatever a file says
BUILT_IN = {  # Gazebo's own models, which worlds name and nobody ships
    "model://sun": "<sdf><light/></sdf>",
    "model://ground_plane": "<sdf><model name='ground_plane'><link name='link'><collision name='collision'>"
    "<geometry><plane/></geometry></collision></link></model></sdf>",
}


def declare(xml: bytes) -> bytes:
    """A file in which the prefix sonar_gl stands for our namespace: Gazebo asks no file to declare its own.

    >>> declare(b"<sdf><sonar_gl:material/></sdf>")
    b'<sdf xmlns:sonar_gl="urn:sonar_gl"><sonar_gl:material/></sdf>'
    """
    if b"sonar_gl:" not in xml:
        return xml
    ours = f'xmlns:sonar_gl="{NAMESPACE}"'.encode()
    xml, found = re.subn(rb"xmlns:sonar_gl\s*=\s*(\"[^\"]*\"|'[^']*')", ours, xml)
    return xml if found else re.sub(rb"<(sdf|gazebo)(?=[\s>])", rb"<\1 " + ours, xml, count=1)


def tag(element, name: str):
    """The child `sonar_gl:name` of an element, or None."""
    return element.find(f"{{{NAMESPACE}}}{name}")


def tags(element) -> list[str]:
    """Names of all children of our own, without the prefix."""
    return [child.tag.partition("}")[2] for child in element if child.tag.startswith(f"{{{NAMESPACE}}}")]


class Finder:
    """The resource paths of one scene, and what was not found in them.

    Parameters
    ----------
    scene_path : the scene's file; its folder is searched last
    resource_paths : folders searched first; then those of GZ_SIM_RESOURCE_PATH and GAZEBO_MODEL_PATH

    Raises
    ------
    Error
        if one of `resource_paths` is not a folder.
    """

    def __init__(self, scene_path: Path, resource_paths=()):
        if isinstance(resource_paths, (str, os.PathLike)):
            resource_paths = [resource_paths]
        roots = [Path(p) for p in resource_paths]
        for root in roots:
            if not root.is_dir():
                raise Error(f"resource path {str(root)!r} must be a folder (there is none of that name)")
        for key in ("GZ_SIM_RESOURCE_PATH", "GAZEBO_MODEL_PATH"):
            roots += [Path(p) for p in os.environ.get(key, "").split(os.pathsep) if p]
        self.roots = list(dict.fromkeys(root.resolve() for root in [*roots, scene_path.parent]))
        self._missing: dict[str, tuple[list, list]] = {}  # uri -> who asked, where it was looked for
        self._parsed = {}

    def parse(self, path: Path):
        """Root element of an XML file; document types, entities and huge files are refused.

        Raises
        ------
        Error
            naming the file, and line and column of broken XML.
        """
        from defusedxml import DefusedXmlException
        from defusedxml.ElementTree import ParseError, fromstring, parse

        if path in BUILT_IN:
            return fromstring(BUILT_IN[path])
        if path in self._parsed:
            return self._parsed[path]
        try:
            if path.stat().st_size > MAX_XML_BYTES:
                raise Error(f"{path}: a scene file must not exceed {MAX_XML_BYTES // 1_000_000} MB of XML")
            root = parse(io.BytesIO(declare(path.read_bytes())), forbid_dtd=True).getroot()
        except ParseError as why:
            (line, column), text = why.position, expat.ErrorString(why.code)
            if text == "unbound prefix":
                text += '; declare it, as in <sdf xmlns:gz="http://gazebosim.org/schema">'
            raise Error(f"{path}: line {line}, column {column + 1}: broken XML ({text})") from None
        except DefusedXmlException:
            raise Error(f"{path}: a document type or entities must not be declared (refused)") from None
        except OSError as why:
            raise Error(f"{path}: {why.strerror or why}") from None
        except Error:
            raise
        except (LookupError, ValueError) as why:  # an encoding that nobody knows
            raise Error(f"{path}: broken XML ({why})") from None
        self._parsed[path] = root
        return root

    def find(self, uri: str, base: Path, where: str) -> Path | None:
        """The file or folder that `uri` means in a file of folder `base`, or None, noted, if it is missing.

        `model://` (and ROS's `package://`) are looked for in the resource paths, where a path may also be the
        model's own folder; relative URIs beside the file that names them, then in the resource paths.

        Raises
        ------
        Error
            if it leads out of the resource paths and the scene's folder, symbolic links followed.
        """
        scheme, _, rest = uri.rpartition("://")
        if not rest.strip("/."):
            raise Error(f"{where}: must name a file or a model (got {uri!r})")
        if scheme not in ("", "model", "package", "file"):
            self._note(uri, where, [])
            return None
        candidates = [base / rest] if scheme == "" or rest.startswith("/") else []
        if not rest.startswith("/"):
            candidates += [root / rest for root in self.roots]
            head, _, tail = rest.partition("/")
            candidates += [root / tail for root in self.roots if scheme and root.name == head]
        candidates = list(dict.fromkeys(candidates))
        try:
            inside = [c for c in candidates if self._is_inside(c)]
            found = next((c for c in inside if c.exists()), None)
            outside = [c for c in candidates if c not in inside]
            escapes = found is None and outside and (not inside or any(c.exists() for c in outside))
        except (OSError, RuntimeError, ValueError) as why:  # too long a name, a circle of symbolic links
            raise Error(f"{where}: {uri!r} must be a path ({why})") from None
        if escapes:
            raise Error(
                f"{where}: {uri!r} must stay in the scene's folder and the resource paths (it leads to "
                f"{outside[0].resolve()}; if that is to be trusted, make its folder a resource path)"
            )
        if found is None and uri not in BUILT_IN:
            self._note(uri, where, inside)
        return found

    def find_model(self, uri: str, base: Path, where: str) -> Path | None:
        """The SDF file that an `<include>` means: a file, or what `model.config` or else `model.sdf` say.

        Of several versions in `model.config` the newest is taken. A key of BUILT_IN stands for itself.
        """
        uri = uri if uri.endswith("://") else uri.rstrip("/")
        found = self.find(uri, base, where)
        if found is None:
            return uri if uri in BUILT_IN else None
        if found.is_file():
            return found
        chosen = found / "model.sdf"
        if (found / "model.config").is_file() and self._is_inside(found / "model.config"):
            names = self.parse(found / "model.config").findall("sdf")
            names = [(_version(e.get("version", "")), (e.text or "").strip()) for e in names]
            chosen = found / (max(names, key=lambda n: n[0])[1] if names else "model.sdf")
        if not self._is_inside(chosen):
            raise Error(f"{found / 'model.config'}: sdf must name a file beside it (got {str(chosen)!r})")
        if not chosen.is_file():
            self._note(uri, where, [chosen])
            return None
        return chosen

    def missing(self, scene_path) -> str:
        """What was not found, who asked for it and where it was looked for; empty if all was found."""
        lines = [f"{scene_path}: models or files are missing:"] if self._missing else []
        for uri, (asked, searched) in self._missing.items():
            lines += [f"  {uri}", *(f"    asked for by {where}" for where in asked)]
            lines += [f"    not at {path}" for path in searched]
            if not searched:
                lines.append("    not fetched: download it, and put its folder into the resource paths")
        return "\n".join(lines)

    def _note(self, uri, where, searched):
        self._missing.setdefault(uri, ([], [str(c) for c in searched]))[0].append(where)

    def _is_inside(self, path: Path) -> bool:
        return any(path.resolve().is_relative_to(root) for root in self.roots)


def _version(text: str) -> tuple:
    return tuple(int(part) if part.isdigit() else 0 for part in text.strip().split("."))
