"""A simulator of 2D imaging sonars (forward-looking sonars), by OpenGL or on the CPU, without a display.

import sonar_gl as sg

scene, sonar = sg.load_scene("pylon"), sg.load_sonar("p900-45")
with sg.Simulator(scene, sonar) as simulator:
    ping = simulator.ping(scene.sonar_pose)
sg.save_png("pylon.png", sg.colorize(sg.fan_image(ping)))
"""

import os

import lazy_loader

from sonar_gl._version import __version__

if not os.path.exists(os.path.splitext(__file__)[0] + ".pyi"):
    raise ImportError(
        "sonar_gl must lie in a folder with all of its files, as pip installs it (got no __init__.pyi beside "
        f"{__file__}; unpack a zip archive; have PyInstaller take all files by --collect-all sonar_gl)"
    )
# A name of `__init__.pyi` loads its module when it is first used, so that `import sonar_gl` stays fast.
__getattr__, _, _lazy_names = lazy_loader.attach_stub(__name__, __file__)
__all__ = [*_lazy_names, "__version__"]
__dir__ = __all__.copy  # that of lazy_loader leaves out the version
