"""A 2D imaging-sonar simulator: the fan of beams is a depth + normal pass in OpenGL, headless.

import sonar_gl as sg

scene, sonar = sg.load_scene("pylon"), sg.load_sonar("p900-45")
with sg.Simulator(scene, sonar) as simulator:
    ping = simulator.ping(scene.sonar_pose)
sg.save_png("pylon.png", sg.colorize(sg.fan_image(ping)))
"""

from importlib import import_module

from sonar_gl._version import __version__

# Names load their modules when first used, so that `import sonar_gl` stays quick.
_HOMES = {
    "acoustics": ("Acoustics",),
    "axes": ("draw_axes",),
    "bubbles": ("Bubbles",),
    "camera": ("Camera",),
    "embed": ("ping_from_depth",),
    "export": ("load_npz", "save_animation", "save_npz", "save_png"),
    "fan": ("Sampling",),
    "image": ("colorize", "fan_image"),
    "load": ("bundled_scenes", "load_scene"),
    "noise": ("Noise",),
    "reference": ("reference_ping",),
    "rigid": ("pose",),
    "scene": ("Body", "Scene"),
    "paper": ("demarco_image",),
    "simulator": ("Simulator",),
    "sonar": ("Sonar", "load_sonar", "presets"),
    "maps": ("textured_body",),
    "types": ("Error", "GBuffer", "Ping"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = ["__version__", *sorted(_HOME_OF)]


def __getattr__(name):
    if name in _HOME_OF:
        value = getattr(import_module(f"sonar_gl.{_HOME_OF[name]}"), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'sonar_gl' has no attribute {name!r}")


def __dir__():
    return sorted({*globals(), *__all__})
