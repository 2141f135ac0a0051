"""What of OpenGL's state bears on drawing and reading: how it is asked for and set, and its defaults."""

from __future__ import annotations

import math

# What an extension brought, and the version that has it without: drivers list many in older contexts, too.
SINCE = {
    "ARB_draw_buffers_blend": 400,
    "ARB_draw_indirect": 400,
    "ARB_sample_shading": 400,
    "ARB_viewport_array": 410,
    "ARB_ES3_compatibility": 430,
    "KHR_debug": 430,
    "ARB_clip_control": 450,
    "EXT_depth_bounds_test": math.inf,
    "MESA_pack_invert": math.inf,
}
# What has one value: what brought it, "" being OpenGL 3.3, how it is asked for, what sets it, the first
# argument of that, the default that we draw with, None where it does not bear on that.
VALUES = [
    ("", 0x88ED, "glBindBuffer", (0x88EB,), 0),  # PIXEL_PACK_BUFFER
    ("", 0x88EF, "glBindBuffer", (0x88EC,), 0),  # PIXEL_UNPACK_BUFFER
    ("", 0x8894, "glBindBuffer", (0x8892,), None),  # ARRAY_BUFFER
    ("", 0x8F36, "glBindBuffer", (0x8F36,), None),  # COPY_READ_BUFFER
    ("", 0x8F37, "glBindBuffer", (0x8F37,), None),  # COPY_WRITE_BUFFER
    ("ARB_draw_indirect", 0x8F43, "glBindBuffer", (0x8F3F,), None),  # DRAW_INDIRECT_BUFFER
    ("", 0x8CA6, "glBindFramebuffer", (0x8CA9,), None),  # DRAW_FRAMEBUFFER
    ("", 0x8CAA, "glBindFramebuffer", (0x8CA8,), None),  # READ_FRAMEBUFFER
    ("", 0x8CA7, "glBindRenderbuffer", (0x8D41,), None),
    ("", 0x85B5, "glBindVertexArray", (), None),
    ("", 0x8B8D, "glUseProgram", (), None),
    ("", 0x84E0, "glActiveTexture", (), None),
    ("", 0x8069, "glBindTexture", (0x0DE1,), None),  # TEXTURE_2D, of the unit that is active
    *(("", 0x0CF0 + k, "glPixelStorei", (0x0CF0 + k,), 4 * (k == 5)) for k in range(6)),  # UNPACK_...
    ("", 0x806D, "glPixelStorei", (0x806D,), 0),  # UNPACK_SKIP_IMAGES
    ("", 0x806E, "glPixelStorei", (0x806E,), 0),  # UNPACK_IMAGE_HEIGHT
    *(
        ("", 0x0D00 + k, "glPixelStorei", (0x0D00 + k,), 4 * (k == 5)) for k in range(6)
    ),  # PACK_..., last ALIGNMENT
    ("", 0x806B, "glPixelStorei", (0x806B,), 0),  # PACK_SKIP_IMAGES
    ("", 0x806C, "glPixelStorei", (0x806C,), 0),  # PACK_IMAGE_HEIGHT
    ("MESA_pack_invert", 0x8758, "glPixelStorei", (0x8758,), 0),  # last row first
    ("", 0x891C, "glClampColor", (0x891C,), 0x891D),  # CLAMP_READ_COLOR: FIXED_ONLY
    ("", 0x0B74, "glDepthFunc", (), 0x0201),  # LESS
    ("", 0x0B72, "glDepthMask", (), 1),
    ("", 0x0B45, "glCullFace", (), 0x0405),  # BACK
    ("", 0x0B46, "glFrontFace", (), 0x0901),  # CCW
    ("", 0x8F9E, "glPrimitiveRestartIndex", (), None),
    ("", 0x8E4F, "glProvokingVertex", (), 0x8E4E),  # LAST_VERTEX_CONVENTION
]
# How it is asked whether what a name was bound to is still there.
IS_THERE = {
    "glBindBuffer": "glIsBuffer",
    "glBindFramebuffer": "glIsFramebuffer",
    "glBindRenderbuffer": "glIsRenderbuffer",
    "glBindTexture": "glIsTexture",
    "glBindVertexArray": "glIsVertexArray",
    "glUseProgram": "glIsProgram",
}
# Switches that bear on what is drawn; all are off by default but MULTISAMPLE and DITHER.
MULTISAMPLE, DITHER = 0x809D, 0x0BD0
SWITCHES = [
    ("", (0x0B44, 0x0B71, 0x0B90, 0x0BF2, 0x0B20, 0x0B41)),  # culling, depth, stencil, logic, smooth edges
    ("", (0x2A01, 0x2A02, 0x8037, 0x8C89, 0x8642, 0x864F)),  # offsets, discard, point size, depth clamp
    ("", (MULTISAMPLE, 0x809E, 0x809F, 0x80A0, 0x8E51, DITHER)),  # samples: alpha to coverage, to one; masks
    ("", (0x8DB9, 0x8F9D, 0x884F, *range(0x3000, 0x3008))),  # sRGB, restart, seamless cubes, clip distances
    ("ARB_sample_shading", (0x8C36,)),
    ("ARB_ES3_compatibility", (0x8D69,)),  # PRIMITIVE_RESTART_FIXED_INDEX
    ("EXT_depth_bounds_test", (0x8890,)),
]
# What only contexts of the compatibility profile have, and what of it bears on drawing and reading.
OLD_VALUES = [("", 0x891B, "glClampColor", (0x891B,), 0)]  # CLAMP_FRAGMENT_COLOR, clear values too
OLD_SWITCHES = 0x0BC0, 0x0B42  # ALPHA_TEST, POLYGON_STIPPLE
SCALES = 0x0D14, 0x0D18, 0x0D1A, 0x0D1C, 0x0D1E  # of RED to DEPTH as pixels are transferred
TRANSFERS = [0x0D10, 0x0D11, 0x0D12, 0x0D13, *SCALES, *(scale + 1 for scale in SCALES)]  # and biases, maps
