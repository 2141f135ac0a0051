"""The files that a scene file names: found in its folder and the resource paths only, and parsed safely."""

from __future__ import annotations

import io
import os
import re
from contextlib import suppress
from pathlib import Path
from urllib.parse import unquote
from xml.parsers import expat

from sonar_gl.core.checks import shown
from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import LINK_LOOP, check_is_file, is_link_loop
from sonar_gl.scene.sdf.extensions import declare_namespace

MAX_XML_BYTES = 50_000_000
MAX_PACKAGE_DEPTH = 4  # of folders of ROS packages below a resource path
# What Gazebo's parser, tinyxml2, accepts against the rules of XML, by libxml2's numbers: a declaration that is not
# first, "--" in a comment, and prefixes that are not declared, of tags and attributes. lxml has no names for them.
TOLERATED = {64: "the XML declaration is not first", 80: '"--" in a comment', 201: "", 202: ""}
UNDECLARED = re.compile(r"Namespace prefix (\S+) ")  # in libxml2's text of 201
NAMESPACES = {"gz": "http://gazebosim.org/schema", "ignition": "http://ignitionrobotics.org/schema"}
BARE_AND = re.compile(rb"&(?!#?\w+;)")  # accepted as well, as in "A & B" or "?a=1&b=2"
# of tags without a prefix; Gazebo takes it for an attribute without meaning, and the tags for its own
DEFAULT_NAMESPACE = re.compile(rb"""(?<=\s)xmlns\s*=\s*("[^"]*"|'[^']*')""")
BARE_VALUE = re.compile(r"""<[^<>"']*?([\w:.-]+=[^"'\s<>/]+)""")  # of an attribute, without quotes
BUILT_IN = {  # models that come with Gazebo, so that worlds name them without their files
    "model://sun": "<sdf><light/></sdf>",
    "model://ground_plane": "<sdf><model name='ground_plane'><link name='link'><collision name='collision'>"
    "<geometry><plane/></geometry></collision></link></model></sdf>",
}

SEARCH_PATHS = (  # of gz-sim, of Gazebo when it was Ignition, of sdformat, of Gazebo Classic, of ROS 1
    *("GZ_SIM_RESOURCE_PATH", "IGN_GAZEBO_RESOURCE_PATH", "SDF_PATH"),
    *("GAZEBO_MODEL_PATH", "GAZEBO_RESOURCE_PATH", "ROS_PACKAGE_PATH"),
)
PACKAGE_FILE = "package.xml"
FUEL_URI = r"https?://([^/]+)/(?:[0-9.]+/)?([^/]+)/models/([^/]+)(?:/([0-9]+|tip))?(?:/files/(.+))?/?"
FUEL_CACHES = {  # environment variable: where the cache is without it
    "GZ_FUEL_CACHE_PATH": "~/.gz/fuel",
    "IGN_FUEL_CACHE_PATH": "~/.ignition/fuel",
}


def built_in_model(uri: str) -> str | None:
    """Return the key of BUILT_IN that a URI means, also one of Gazebo Fuel; None if there is none.

    >>> built_in_model("https://fuel.gazebosim.org/1.0/OpenRobotics/models/Ground Plane")
    'model://ground_plane'
    """
    found = re.fullmatch(FUEL_URI, unquote(uri), re.IGNORECASE)
    if found and found[2].lower() == "openrobotics" and found[5] is None:
        uri = f"model://{found[3].lower().replace(' ', '_')}"
    return uri if uri in BUILT_IN else None


# How users give what `load_scene` takes, in messages; a job of a batch has keys in their place.
GIVE_FOLDERS, SKIP_MISSING = "--resource-path, resource_paths=", "--skip-missing, skip_missing="
MAX_EXPLAINED = 5  # missing files: where each was looked for


class Resources:
    """The resource paths of one scene, the files parsed so far, and a list of missing files.

    Raises Error if one of `resource_paths` is not a folder.

    scene_path : the scene's file; its folder is searched last, with that of the ROS package that holds the file
    resource_paths : folders to search first; those of SEARCH_PATHS and of AMENT_PREFIX_PATH follow
    roots : folders that may be read
    recovered : file -> why, of files that are no proper XML, and were read as Gazebo reads them
    """

    def __init__(self, scene_path: Path, resource_paths=()):
        if isinstance(resource_paths, (str, os.PathLike)):
            resource_paths = [resource_paths]
        try:
            roots = [Path(p) for p in resource_paths]
        except TypeError:
            raise Error(
                f"resource_paths must be folders, each text or a Path (got {shown(resource_paths)})"
            ) from None
        for root in roots:
            if is_link_loop(root):
                raise Error(f"resource path {str(root)!r} must be a folder (got {LINK_LOOP})")
            if not root.is_dir():
                got = "got a file" if root.exists() else "there is none of that name"
                raise Error(f"resource path {str(root)!r} must be a folder ({got})")
        named = [Path(p) for key in SEARCH_PATHS for p in os.environ.get(key, "").split(os.pathsep) if p]
        prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        named += [Path(prefix, "share") for prefix in prefixes if prefix]
        roots += [root for root in named if not is_link_loop(root)]  # nor is a missing folder an error
        self._folder = folder = scene_path.parent.resolve()
        own_package = [one for one in (folder, *folder.parents) if (one / PACKAGE_FILE).is_file()]
        self.roots = list(dict.fromkeys([*(root.resolve() for root in roots), folder, *own_package[:1]]))
        self._packages: dict[str, Path] | None = None
        self._missing: dict[str, tuple[list, list]] = {}  # uri -> locations that name it, paths searched
        self._parsed, self.recovered, self._unsupported = {}, {}, {}

    def parse(self, path: Path):
        """Return the root element of an XML file; document types, entities and huge files are refused.

        Raises Error with the name of the file, and line and column of broken XML.
        """
        from defusedxml.ElementTree import fromstring

        if path in BUILT_IN:
            return fromstring(BUILT_IN[path])
        if path not in self._parsed:
            self._parsed[path] = self.parse_xml(self.read(path), path)
        return self._parsed[path]

    def read(self, path: Path) -> bytes:
        """Return the XML of a file, with the prefix sonar_gl declared, and no namespace for tags without a prefix.

        Huge files are refused.
        """
        try:
            if path.exists():
                check_is_file(path)
            if path.stat().st_size > MAX_XML_BYTES:
                raise Error(f"{path}: a scene file must not exceed {MAX_XML_BYTES // 1_000_000} MB of XML")
            # blanks, so that what is said of broken XML names its place
            xml = DEFAULT_NAMESPACE.sub(lambda found: re.sub(rb"[^\r\n]", b" ", found[0]), path.read_bytes())
            return declare_namespace(xml)
        except OSError as why:
            raise Error(f"{path}: {why.strerror or why}") from None

    def parse_xml(self, xml: bytes, path: Path):
        """Return the root element of the XML of a file; errors are those of `parse`."""
        from defusedxml import DefusedXmlException
        from defusedxml.ElementTree import ParseError, parse

        try:
            return parse(io.BytesIO(xml), forbid_dtd=True).getroot()
        except ParseError as why:
            root = self._recover(xml, path)
            if root is None:
                (line, column), text = why.position, expat.ErrorString(why.code)
                row = xml.splitlines()[line - 1 : line]
                bare = BARE_VALUE.search(row[0].decode(errors="replace")) if row else None
                text += f"; attribute values need quotes: {shown(bare[1])}" if bare else ""
                raise Error(f"{path}: line {line}, column {column + 1}: broken XML ({text})") from None
            return root
        except DefusedXmlException:
            raise Error(f"{path}: a document type or entities must not be declared (refused)") from None
        except (LookupError, ValueError) as why:  # an unknown encoding
            raise Error(f"{path}: broken XML ({why})") from None

    def _recover(self, xml: bytes, path: Path):
        """Return the root element of a file that Gazebo reads though it is no proper XML; None if it does not."""
        from lxml import etree

        parser = etree.XMLParser(
            recover=True,
            resolve_entities=False,
            load_dtd=False,
            no_network=True,
            remove_comments=True,
            remove_pis=True,
        )
        try:
            root = etree.fromstring(BARE_AND.sub(b"&amp;", xml), parser)
        except etree.XMLSyntaxError:  # of an empty file
            return None
        if root is None or any(found.type not in TOLERATED for found in parser.error_log):
            return None
        if root.getroottree().docinfo.doctype or any(True for _ in root.iter(etree.Entity)):
            raise Error(f"{path}: a document type or entities must not be declared (refused)")
        if len(parser.error_log):
            first = parser.error_log[0]
            self.recovered[path] = (
                f"line {first.line}: {TOLERATED[first.type] or _undeclared(first.message, root)}"
            )
        else:
            bare = BARE_AND.search(xml)
            self.recovered[path] = f"line {1 + xml[: bare.start()].count(10)}: a bare '&'" if bare else ""
        return root

    def find(self, uri: str, base: Path, location: str) -> Path | None:
        """Return the file or folder of a URI; None if it is missing, which is noted for `missing`.

        URIs of `model://` are searched in the resource paths, which may also be the folders of models
        themselves; those of `package://` in the ROS package; relative URIs in `base`, then in the resource
        paths.

        Raises Error if it leads out of the resource paths and the scene's folder, after symbolic links are resolved.

        base : folder of the file that holds the URI
        """
        scheme, _, rest = uri.rpartition("://")
        scheme = scheme.lower()  # by RFC 3986, capitals mean the same
        if not rest.strip("/."):
            raise Error(f"{location}: must name a file or a model (got {uri!r})")
        if scheme in ("http", "https"):
            return self._find_on_fuel(uri, location)
        if scheme not in ("", "package", "file"):
            scheme = "model"  # as for Gazebo, which searches whatever the scheme is, such as models://
        # as it stands, and with %20 and the like read, as URIs have them
        names = dict.fromkeys([rest, unquote(rest)])
        candidates = list(
            dict.fromkeys(path for name in names for path in self._candidates(scheme, name, base))
        )
        try:
            inside = [c for c in candidates if self._is_inside(c)]
            found = next((c for c in inside if c.exists()), None)
            if found is None and (loop := next(filter(is_link_loop, candidates), None)):
                raise Error(f"{location}: {uri!r} must be a path (got {LINK_LOOP} at {loop})")
            outside = [c for c in candidates if c not in inside]
            escapes = found is None and any(c.exists() for c in outside)
        except Error:
            raise
        except (OSError, ValueError) as why:  # a name that is too long, or with a null character
            raise Error(f"{location}: {uri!r} must be a path ({why})") from None
        if escapes:
            raise Error(
                f"{location}: {uri!r} must stay in the scene's folder and the resource paths (it leads to "
                f"{outside[0].resolve()}; if that is to be trusted, make its folder a resource path)"
            )
        if found is None and built_in_model(uri) is None:
            self.note_missing(uri, location, inside or outside)
        return found

    def _candidates(self, scheme: str, name: str, base: Path) -> list[Path]:
        """Return the paths at which a file may be, in order: of a URI scheme://name, or of a path without scheme."""
        if scheme in ("model", "package"):
            name = name.lstrip("/")
        candidates = [base / name] if scheme == "" or name.startswith("/") else []
        if not name.startswith("/"):
            candidates += [root / name for root in self.roots]
            head, _, tail = name.partition("/")
            if scheme == "package" and (package := self.find_package(head)) is not None:
                candidates.insert(0, package / tail)
            candidates += [root / tail for root in self.roots if scheme and root.name == head]
        return candidates

    def find_package(self, name: str) -> Path | None:
        """Return the folder of a ROS package in or below the resource paths, by its own name or its folder's."""
        for root in self.roots:
            for folder in (root / name, root):
                if folder.name == name and folder.is_dir() and self._is_inside(folder):
                    return folder
        if self._packages is None:
            self._packages = {}
            for root in self.roots:
                self._list_packages(root)
        return self._packages.get(name)

    def _list_packages(self, root: Path) -> None:
        """Add the ROS packages below a folder; packages hold no packages."""
        for folder, inner, files in os.walk(root):
            path = Path(folder)
            if PACKAGE_FILE in files and self._is_inside(path / PACKAGE_FILE):
                with suppress(Error):  # one that cannot be read is known by its folder's name alone
                    name = (self.parse(path / PACKAGE_FILE).findtext("name") or "").strip()
                    self._packages.setdefault(name, path)
                self.recovered.pop(path / PACKAGE_FILE, None)  # its XML is not the scene's
                self._packages.setdefault(path.name, path)
                inner.clear()
            if len(path.relative_to(root).parts) >= MAX_PACKAGE_DEPTH:
                inner.clear()
            inner[:] = sorted(one for one in inner if not one.startswith("."))

    def _find_on_fuel(self, uri: str, location: str) -> Path | None:
        """Return the file or folder of a URI of Gazebo Fuel, from Gazebo's caches or the resource paths.

        .../OWNER/models/NAME, /NAME/VERSION, or /NAME/VERSION/files/FILE. Gazebo keeps what it has downloaded as
        SERVER/OWNER/models/NAME/VERSION, with OWNER and NAME in lower case. In a resource path the folder has the
        model's name.
        """
        found = re.fullmatch(FUEL_URI, unquote(uri), re.IGNORECASE)
        if found is None:
            self.note_missing(uri, location, [])
            return None
        server, owner, name, version, file = found.groups()
        searched = []
        for key, usual in FUEL_CACHES.items():
            # of a user without a home, as in a container, `Path.expanduser` would raise a RuntimeError
            cache = Path(os.path.expanduser(os.environ.get(key) or usual))
            folder = cache / server.lower() / owner.lower() / "models" / name.lower()
            searched.append(folder)
            try:
                kept = [one for one in folder.iterdir() if one.name.isdigit() and one.is_dir()]
            except OSError:
                continue
            wanted = [one for one in kept if one.name == version] or kept
            if wanted:
                newest = max(wanted, key=lambda one: int(one.name))
                self.roots.append(newest.resolve())
                return self._existing(newest / file if file else newest, uri, location)
        names = dict.fromkeys([name, name.replace(" ", "_"), name.lower(), name.lower().replace(" ", "_")])
        for root in self.roots:
            for folder in [root / one for one in names] + [root] * (root.name in names):
                searched.append(folder)
                if folder.is_dir() and self._is_inside(folder):
                    return self._existing(folder / file if file else folder, uri, location)
        if built_in_model(uri) is None:
            self.note_missing(uri, location, searched)
        return None

    def _existing(self, path: Path, uri: str, location: str) -> Path | None:
        """Return a path that exists and may be read; None, noted as missing, if there is none."""
        if path.exists() and self._is_inside(path):
            return path
        self.note_missing(uri, location, [path])
        return None

    def find_model(self, uri: str, base: Path, location: str) -> Path | str | None:
        """Return the SDF file of an `<include>`; None if it is missing; a key of BUILT_IN for those.

        The URI names the file, or a folder. In a folder the file is the newest version in `model.config`,
        else `model.sdf`. Parameters and errors are those of `find`.
        """
        uri = uri if uri.endswith("://") else uri.rstrip("/")
        found = self.find(uri, base, location)
        if found is None:
            return built_in_model(uri)
        if found.is_file():
            return found
        chosen = self.file_of_model(found)
        if not chosen.is_file():
            self.note_missing(uri, location, [chosen])
            return None
        return chosen

    def file_of_model(self, folder: Path) -> Path:
        """Return the SDF file of a model's folder: the newest version in `model.config`, else `model.sdf`."""
        chosen = folder / "model.sdf"
        if (folder / "model.config").is_file() and self._is_inside(folder / "model.config"):
            names = self.parse(folder / "model.config").findall("sdf")
            names = [(_version(e.get("version", "")), (e.text or "").strip()) for e in names]
            chosen = folder / (max(names, key=lambda n: n[0])[1] if names else "model.sdf")
        if not self._is_inside(chosen):
            raise Error(f"{folder / 'model.config'}: sdf must name a file beside it (got {str(chosen)!r})")
        return chosen

    def missing(self, scene_path) -> str:
        """Return what is missing: files, the elements that name them, and the paths searched; "" if nothing is.

        Of more than MAX_EXPLAINED files the others are only named.
        """
        lines = [f"{scene_path}: models or files are missing:"] if self._missing else []
        for uri, (locations, searched) in list(self._missing.items())[:MAX_EXPLAINED]:
            lines += [f"  {uri}", *(f"    named by {location}" for location in locations)]
            lines += [f"    not at {path}" for path in searched]
            if found := re.fullmatch(FUEL_URI, unquote(uri), re.IGNORECASE):
                lines.append(
                    f"    'gz fuel download -u \"{uri}\"' downloads it to where it is found; "
                    f"or put the model's folder, named {found[3]!r}, into a folder of the resource paths"
                )
            elif package := re.match("package://([^/]+)", uri):
                lines.append(
                    f"    give the folder that holds the ROS package {package[1]!r} as resource path"
                )
            elif near := self._model_folder_near(uri):
                lines.append(f"    but in {near}: give that folder as resource path")
            elif not searched:
                lines.append("    not fetched: download it, and let the scene name the file")
        lines += [f"  and {uri}" for uri in self.missing_uris()[MAX_EXPLAINED:]]
        return "\n".join(lines)

    def _model_folder_near(self, uri: str) -> Path | None:
        """Return the folder near the scene's file that holds a model, where repositories of worlds have models."""
        found = re.match(r"model://([^/.][^/]*)", unquote(uri))
        if found is None:
            return None
        here = self._folder
        near = [
            one for one in (here / "models", here.parent / "models", here.parent) if one not in self.roots
        ]
        return next((one for one in near if (one / found[1]).is_dir()), None)

    def missing_uris(self) -> list[str]:
        """Return the URIs of what is missing."""
        return list(self._missing)

    def unsupported(self) -> str:
        """Return which shapes cannot be read, a line each."""
        return "\n".join(self._unsupported)

    def note_unsupported(self, message: str) -> None:
        """Note a shape that cannot be read, once; the message names file and element."""
        self._unsupported[message] = None

    def note_missing(self, uri: str, location: str, searched) -> None:
        """Note a file that is missing, the element that names it, and the paths at which it is not."""
        locations, _ = self._missing.setdefault(uri, ([], [str(c) for c in searched]))
        if location not in locations:  # a shape of water is read for its surface, too
            locations.append(location)

    def _is_inside(self, path: Path) -> bool:
        if is_link_loop(path):
            return False  # before Python 3.13, `resolve` raises a RuntimeError
        return any(path.resolve().is_relative_to(root) for root in self.roots)


def _undeclared(message: str, root) -> str:
    """Return what to change where libxml2 says that a prefix is not declared, or that a name with a colon has none."""
    found = UNDECLARED.match(message)
    if found is None:  # "Failed to parse QName 'gz:'"
        return f"{message.split()[-1]} is no name of XML; remove its colon"
    prefix = found[1]
    namespace = NAMESPACES.get(prefix, f"urn:{prefix}")
    return f"the prefix {prefix} is not declared; add xmlns:{prefix}='{namespace}' to <{root.tag}>"


def _version(text: str) -> tuple:
    return tuple(int(part) if part.isdigit() else 0 for part in text.strip().split("."))
