"""The software that decides the last bits of pings: OpenGL, and the libraries that compute."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass

import llvmlite.binding
import numba
import numpy as np

from sonar_gl.core.errors import Error


@dataclass(frozen=True)
class System:
    """What may change pings by rounding, from one machine or day to another.

    Libraries that draw or encode what was computed, such as OpenCV and Zarr, are not among it. Nor is the
    processor, so that a cluster may have several kinds: it may change the last bits of echo and noise. The manifest
    names that which began the batch, see `processor`.

    gl_renderer, gl_version : the driver's names of itself and of its version, or the engine `cpu`'s
    numpy, numba : their versions. NumPy computes functions and random numbers, Numba compiles the sums
    """

    gl_renderer: str
    gl_version: str
    numpy: str
    numba: str

    @classmethod
    def of(cls, gl_info: Mapping) -> System:
        """Return that of this process; gl_info : as of a Simulator."""
        return cls(gl_info["renderer"], gl_info["version"], np.__version__, numba.__version__)

    def check(self, first: System, url: str) -> None:
        """Raise an Error if this is not the system that began the batch at a URL."""
        now, then = asdict(self), asdict(first)
        changed = [f"{key} {now[key]!r} instead of {then[key]!r}" for key in now if now[key] != then[key]]
        if changed:
            raise Error(
                f"{url}: pings must be made by the OpenGL and the libraries that began the batch, as others round "
                f"otherwise (got {', '.join(changed)} on {platform.node()}; restore these, give another folder, "
                "or accept other last bits by --any-system)"
            )


def processor() -> str:
    """Return the kind of this processor, for which Numba compiles, by LLVM's name of it, such as "znver4"."""
    return numba.config.CPU_NAME or llvmlite.binding.get_host_cpu_name()
