import pytest

from sonar_gl.core.errors import Error
from sonar_gl.gl.context import is_software


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
