import gc
import sys

import pytest

from sonar_gl.core.errors import Error
from sonar_gl.gl.context import create_context, is_software


@pytest.mark.parametrize(
    "renderer, expected",
    [
        ("llvmpipe (LLVM 15.0.6, 256 bits)", True),
        ("softpipe", True),
        ("Gallium 0.4 on swrast", True),
        ("Google SwiftShader", True),
        ("Mesa DRI Software Rasterizer", True),
        ("NVIDIA H200/PCIe/SSE2", False),
        ("Mesa Intel(R) UHD Graphics 620 (KBL GT2)", False),
    ],
)
def test_software_renderers_are_known(monkeypatch, renderer, expected):
    monkeypatch.delenv("SONAR_GL_SOFTWARE", raising=False)
    assert is_software(renderer) == expected


@pytest.mark.parametrize("setting, expected", [("0", False), ("1", True), ("", True)])
def test_a_variable_overrides_the_renderer_s_kind(monkeypatch, setting, expected):
    monkeypatch.setenv("SONAR_GL_SOFTWARE", setting)
    assert is_software("llvmpipe") == expected


def test_another_value_of_the_variable_raises_an_error(monkeypatch):
    monkeypatch.setenv("SONAR_GL_SOFTWARE", "no")
    with pytest.raises(Error, match="SONAR_GL_SOFTWARE must be 0 or 1, or not be set"):
        is_software("llvmpipe")


def test_a_new_context_leaves_no_more_addresses_of_functions():
    """moderngl keeps what it was given for good, 670 numbers of each context."""

    def n_blocks():
        create_context().release()
        gc.collect()
        return sys.getallocatedblocks()

    before = [n_blocks() for _ in range(2)][-1]
    after = [n_blocks() for _ in range(3)][-1]
    assert (after - before) / 3 < 600  # of which nearly all are names of extensions
