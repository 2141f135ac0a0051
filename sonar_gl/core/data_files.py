"""The folders of the shaders and of the bundled scenes."""

from __future__ import annotations

from pathlib import Path

from sonar_gl.core.errors import Error


def data_folder(name: str) -> Path:
    """Return the folder `shaders` or `scenes`, in the installed package or at the top of the checkout."""
    here = Path(__file__).resolve().parents[1]
    for folder in (here / name, here.parent / name):
        if folder.is_dir():
            return folder
    raise Error(f"the folder {name!r} is neither in {here} nor beside it (install sonar_gl again)")
