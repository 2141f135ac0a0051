"""The memory of the driver, and its errors: what is not drawn is an `Error`, not a black ping."""

from __future__ import annotations

import moderngl

from sonar_gl.core.errors import Error, MachineError, SampleLimitError
from sonar_gl.gl import egl

OUT_OF_MEMORY, CONTEXT_LOST = 0x0505, 0x0507
# Free kB: of the graphics card and of the main memory that it may use, each followed by the largest block (Mesa, AMD);
# of the card alone (NVIDIA)
ATI_FREE, NVX_FREE = 0x87FD, 0x9049
ROBUST = {"GL_KHR_robustness", "GL_ARB_robustness"}
COARSER = "ask for a larger tolerance or fewer samples"


def side_limit(context: moderngl.Context) -> int:
    """Return the most pixels that a side of a framebuffer with renderbuffers may have."""
    info = context.info
    return min(info["GL_MAX_TEXTURE_SIZE"], info["GL_MAX_RENDERBUFFER_SIZE"], *info["GL_MAX_VIEWPORT_DIMS"])


def free_bytes(context: moderngl.Context) -> int | None:
    """Return the free memory that the graphics card may use, or None if the driver does not tell."""
    gl = context.extra.gl
    if "GL_ATI_meminfo" in context.extensions:
        kilobytes = gl.integers(ATI_FREE, 4)[::2]
    elif "GL_NVX_gpu_memory_info" in context.extensions:
        kilobytes = gl.integers(NVX_FREE, 1)
    else:
        return None
    return 1024 * sum(map(int, kilobytes)) or None  # some say 0 where they do not know


def check_room(context: moderngl.Context, n_bytes: int) -> None:
    """Raise an Error if the graphics card is known to lack the memory for samples."""
    free = free_bytes(context)
    if free is not None and n_bytes > free:
        raise SampleLimitError(
            f"samples must fit the memory of the graphics card (got {n_bytes / 1e6:.1f} MB, where {free / 1e6:.1f} "
            f"MB are free; {COARSER})"
        )


def check_driver(context: moderngl.Context) -> None:
    """Raise an Error if the driver has reported an error since the last call, in the context that is current.

    It is a MachineError where no other pose or setting would help.
    """
    gl = context.extra.gl
    errors = gl.take_errors()
    if OUT_OF_MEMORY in errors:
        raise Error(f"the driver must have memory for the samples (got GL_OUT_OF_MEMORY; {COARSER})")
    if CONTEXT_LOST in errors or (
        not ROBUST.isdisjoint(context.extensions) and gl.glGetGraphicsResetStatus()
    ):
        raise MachineError(egl.LOST)
    if errors:
        got = ", ".join(f"0x{error:04x}" for error in errors)
        raise MachineError(
            f"the driver must draw without errors (got OpenGL error {got}; update the driver, and send in what "
            "'sonar-gl doctor --report FILE' writes)"
        )
