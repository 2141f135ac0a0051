import pytest

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
def test_software_renderers_are_known(renderer, expected):
    assert is_software(renderer) == expected
