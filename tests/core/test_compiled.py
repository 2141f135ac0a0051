"""What is said of compilation."""

import numba
import pytest

from sonar_gl.core.compiled import announce_compilation


@pytest.mark.parametrize(
    ("module", "is_announced"), [("sonar_gl.beamform.kernels", True), ("program_of_a_user", False)]
)
def test_only_kernels_of_this_package_are_announced(module, is_announced, capsys):
    """An early version announced its kernels when a program compiled a function of its own."""

    def add(x):
        return x + 1

    add.__module__ = module
    announce_compilation(True)
    assert numba.njit(add)(1) == 2
    announce_compilation(False)
    assert capsys.readouterr().err.startswith("sonar_gl: compiling numerical kernels") == is_announced
