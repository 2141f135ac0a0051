"""What a driver says of its limits, memory and errors, by a stand-in for the context."""

from types import SimpleNamespace

import pytest

from sonar_gl.core.errors import Error, MachineError
from sonar_gl.gl.driver import check_driver, check_room, free_bytes, side_limit

LIMITS = {
    "GL_MAX_TEXTURE_SIZE": 16384,
    "GL_MAX_RENDERBUFFER_SIZE": 16384,
    "GL_MAX_VIEWPORT_DIMS": (16384, 16384),
}


class Driver(SimpleNamespace):
    """A context, and its functions."""

    def __init__(self, extensions=(), errors=(), numbers=None, status=0, **limits):
        self.extensions, self.info, self.extra = (
            set(extensions),
            {**LIMITS, **limits},
            SimpleNamespace(gl=self),
        )
        self.take_errors = lambda: list(errors)
        self.integers = lambda name, count: numbers[name, count]
        self.glGetGraphicsResetStatus = lambda: status


@pytest.mark.parametrize(
    "limit, expected",
    [
        ({}, 16384),
        ({"GL_MAX_RENDERBUFFER_SIZE": 8192}, 8192),
        ({"GL_MAX_TEXTURE_SIZE": 4096}, 4096),
        ({"GL_MAX_VIEWPORT_DIMS": (16384, 2048)}, 2048),
    ],
)
def test_the_least_limit_bounds_a_framebuffer(limit, expected):
    assert side_limit(Driver(**limit)) == expected


@pytest.mark.parametrize(
    "extension, numbers",
    [
        ("GL_NVX_gpu_memory_info", {(0x9049, 1): [5000]}),
        ("GL_ATI_meminfo", {(0x87FD, 4): [4000, 3000, 1000, 900]}),
        ("GL_ATI_meminfo", {(0x87FD, 4): [0, 0, 5000, 5000]}),  # llvmpipe, which has no card
    ],
)
def test_samples_must_fit_the_free_memory(extension, numbers):
    driver = Driver([extension], numbers=numbers)
    assert free_bytes(driver) == 5000 * 1024
    check_room(driver, 5000 * 1024)
    with pytest.raises(
        Error, match=r"samples must fit the memory of the graphics card \(got 10.0 MB, where 5.1 MB are free"
    ):
        check_room(driver, 10_000_000)


@pytest.mark.parametrize("driver", [Driver(), Driver(["GL_NVX_gpu_memory_info"], numbers={(0x9049, 1): [0]})])
def test_a_driver_that_does_not_tell_its_memory_is_not_believed_to_lack_it(driver):
    assert free_bytes(driver) is None
    check_room(driver, 1 << 60)


@pytest.mark.parametrize(
    "driver, message",
    [
        (
            Driver(errors=[0x0505]),
            r"memory for the samples \(got GL_OUT_OF_MEMORY; ask for a larger tolerance",
        ),
        (Driver(errors=[0x0502, 0x0505]), "GL_OUT_OF_MEMORY"),
        (Driver(errors=[0x0507]), r"must keep the sonar's OpenGL context \(got a lost one"),
        (
            Driver(["GL_KHR_robustness"], status=0x8254),
            r"must keep the sonar's OpenGL context \(got a lost one",
        ),
        (Driver(errors=[0x0502]), "without errors .got OpenGL error 0x0502; update the driver"),
    ],
)
def test_errors_of_the_driver(driver, message):
    with pytest.raises(Error, match=message) as caught:
        check_driver(driver)
    # fewer samples would need less memory, but nothing else that a caller may ask for would help
    assert isinstance(caught.value, MachineError) == ("OUT_OF_MEMORY" not in str(caught.value))


@pytest.mark.parametrize("driver", [Driver(), Driver(["GL_KHR_robustness"]), Driver(status=0x8254)])
def test_a_driver_without_errors(driver):
    """Without the extension there is no status to ask for."""
    check_driver(driver)
