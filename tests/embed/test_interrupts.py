"""An interrupt (Ctrl-C) at a line of an embedded sonar: the host's OpenGL state is as it was."""

import gc
from pathlib import Path

import pytest

import sonar_gl as sg
from sonar_gl import embed
from tests.support.host_state import GL, changes, enum, snapshot
from tests.support.interrupts import PACKAGE, SONAR, Interrupter

FILES = "gl/host.py", "gl/state_guard.py", "embed/sectors.py", "embed/framebuffer.py"


def set_state(gl):
    """Set what differs from OpenGL's defaults and from what a sector's block has."""
    for name in ("BLEND", "SCISSOR_TEST", "CULL_FACE", "STENCIL_TEST"):
        gl.Enable(enum(name))
    gl.Viewport(1, 2, 3, 4)
    gl.Scissor(5, 6, 7, 8)
    gl.BlendFunc(enum("SRC_ALPHA"), enum("DST_COLOR"))
    gl.PixelStorei(enum("PACK_ALIGNMENT"), 1)
    gl.DepthMask(0)
    gl.ClearColor(0.1, 0.2, 0.3, 0.4)
    gl.BindFramebuffer(enum("FRAMEBUFFER"), 0)


@pytest.mark.slow
def test_an_interrupt_as_a_block_begins_or_ends_leaves_the_state_of_the_host(context):
    """Early versions left blending, viewport, or framebuffer of the sonar in three of 150 interrupted blocks."""
    gl = GL()
    with embed.Sensor(SONAR, sg.Acoustics.ideal(), sg.Sampling(1, 8)) as sensor:

        def draw():
            (sector,) = sensor.sectors(sg.pose())
            with sector:
                pass

        draw()  # makes the framebuffer
        set_state(gl)
        with Interrupter() as every:
            draw()
        # Python handles signals where it calls something; ctypes drops what is raised in the lambda that C code calls
        lines = {file: (Path(PACKAGE) / file).read_text().splitlines() for file in FILES}
        places = [
            (file, line)
            for file, line in dict.fromkeys(every.places)
            if file in FILES and "(" in lines[file][line - 1] and "lambda" not in lines[file][line - 1]
        ]
        faults, n_interrupts = {}, 0
        for place in places:
            gl.errors()
            set_state(gl)
            before = snapshot(gl) | {"errors": ["INVALID_VALUE"]}
            gl.make_error("INVALID_VALUE")
            try:
                with Interrupter(place):
                    draw()
            except KeyboardInterrupt:
                n_interrupts += 1
            if changed := changes(before, snapshot(gl)):
                faults[place] = changed
            draw()
            assert gc.isenabled(), place
        assert faults == {}
        assert n_interrupts == len(places) > 60
        with pytest.warns(UserWarning, match="no echo"):  # nothing was drawn
            sensor.finish()
