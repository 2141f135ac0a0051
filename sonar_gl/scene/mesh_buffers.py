"""The files that a mesh file names, found and read for trimesh: those in permitted folders only."""

from __future__ import annotations

import stat
from collections.abc import Collection
from pathlib import Path
from urllib.parse import unquote

from sonar_gl.core.errors import Error
from sonar_gl.core.input_files import LINK_LOOP, is_link_loop, note_file, read_error_text

MAX_BUFFER_BYTES = 1_000_000_000  # ten million triangles with corners and normals of their own take 840 MB
FALLBACK = "model.gltf"  # that trimesh asks for if a glTF is no JSON


class MeshBuffers:
    """Reads the buffers of a glTF file; a resolver of trimesh, which for its own may read any file.

    mesh_file : path of the mesh file; relative URIs start at its folder
    roots : folders that may be read
    """

    def __init__(self, mesh_file: Path, roots: Collection[Path]):
        self._mesh_file, self._roots = mesh_file, [root.resolve() for root in roots]
        self.file_name = mesh_file.name  # by which trimesh names the geometry of OBJ files

    def get(self, uri: str) -> bytes:
        """Return the content of a file.

        Raises Error with the names of the mesh file and the URI, if there is no such file, it is outside of the folders
        that may be read, after symbolic links are resolved, it is no regular file, or larger than MAX_BUFFER_BYTES.
        """
        if uri == FALLBACK:
            raise FileNotFoundError("broken JSON")
        location = f"{self._mesh_file}: the URI {uri[:200]!r}"
        folder = self._mesh_file.parent
        try:
            if is_link_loop(folder / uri):
                raise Error(f"{location} must name a file (got {LINK_LOOP})")
            path = next((p for p in (folder / uri, folder / unquote(uri)) if p.exists()), folder / uri)
            real = path.resolve()
            if not any(real.is_relative_to(root) for root in self._roots):
                raise Error(
                    f"{location} must name a file in the mesh's folder (it leads to {real}; put it there)"
                )
            found = path.stat()
            if not stat.S_ISREG(found.st_mode):
                raise Error(f"{location} must name a regular file (got a folder or device at {path})")
            n_bytes = found.st_size
            if n_bytes > MAX_BUFFER_BYTES:
                most = MAX_BUFFER_BYTES // 1_000_000
                raise Error(
                    f"{location} must name a file of {most} MB or less (got {n_bytes // 1_000_000} MB)"
                )
            note_file(path)
            return path.read_bytes()
        except Error:
            raise
        except (FileNotFoundError, NotADirectoryError):
            raise Error(f"{location} must name a file (there is none at {path})") from None
        except OSError as why:  # such as a name that is too long
            raise Error(f"{location} must name a file that can be read ({read_error_text(why)})") from None
        except ValueError as why:  # a null character
            raise Error(f"{location} must name a file that can be read ({why})") from None

    __getitem__ = get


class NoFiles:
    """A resolver of trimesh that finds no file: other formats name only materials, which have no acoustic meaning."""

    def __init__(self, mesh_file: Path):
        self.file_name = mesh_file.name

    def get(self, name: str) -> bytes:
        """Raise a FileNotFoundError."""
        raise FileNotFoundError(name)

    __getitem__ = get
