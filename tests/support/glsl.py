"""Calls of functions in the shader files: their results are written to a texture and read back."""

import moderngl
import numpy as np

from sonar_gl.core.data_files import data_folder
from sonar_gl.gl import context as gl
from sonar_gl.gl.shaders import load_shader

SIDE = 64
KINDS = {1: "float", 2: "vec2", 3: "vec3"}


def call(file, inputs, expression, components=1):
    """Evaluate a GLSL expression for SIDE² sets of inputs.

    Parameters
    ----------
    file : shader file with the functions that the expression calls
    inputs : dict from the inputs' names to (SIDE²,) or (SIDE², 2 or 3) float32
    components : of the expression's value

    Returns
    -------
    (SIDE², components) float32
    """
    columns = {name: np.float32(value).reshape(SIDE * SIDE, -1) for name, value in inputs.items()}
    kinds = {name: KINDS[column.shape[1]] for name, column in columns.items()}
    context = gl.create_context()
    with context:
        program = context.program(
            vertex_shader="#version 330 core\n"
            + "".join(f"in {kind} in_{name}; flat out {kind} {name};\n" for name, kind in kinds.items())
            + "void main() {"
            + "".join(f" {name} = in_{name};" for name in kinds)
            + f"""
            gl_Position = vec4((gl_VertexID % {SIDE} + 0.5) / {SIDE / 2} - 1.0,
                               (gl_VertexID / {SIDE} + 0.5) / {SIDE / 2} - 1.0, 0.0, 1.0); }}""",
            fragment_shader="#version 330 core\n"
            + load_shader(file, data_folder("shaders"), {})[0]
            + "".join(f"flat in {kind} {name};\n" for name, kind in kinds.items())
            + f"out {KINDS[components]} result;\nvoid main() {{ result = {expression}; }}",
        )
        frame = context.simple_framebuffer((SIDE, SIDE), components, dtype="f4")
        frame.use()
        layout = [
            (context.buffer(column), f"{column.shape[1]}f", f"in_{name}") for name, column in columns.items()
        ]
        context.vertex_array(program, layout).render(moderngl.POINTS, vertices=SIDE * SIDE)
        out = np.frombuffer(frame.read(components=components, dtype="f4"), np.float32)
        assert context.error == "GL_NO_ERROR"
    context.release()
    return out.reshape(-1, components)
