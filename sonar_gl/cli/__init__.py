"""The command line, `sonar-gl`.

`main` declares the commands and their options. The module that does the work of a command is loaded when the command
runs, as an attribute of this package: `sonar-gl --help` loads no library but click.
"""

import gc

import lazy_loader

from sonar_gl.core.collector import CollectorPause

_load, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=[
        "batch",
        "batch_compilation",
        "doctor",
        "driver_report",
        "emulate",
        "listings",
        "plan",
        "render",
        "ros2",
        "scene_report",
        "system_checks",
        "verify",
        "view",
    ],
)


def __getattr__(name):
    """Load a module, and have Python's garbage collector pass over all that was loaded with it.

    It would else go through the objects of modules, a hundred thousand that stay, again and again: a tenth of the time
    of a command that makes one ping.
    """
    pause = CollectorPause()
    try:
        module = _load(name)
        gc.freeze()  # before the pause ends: these objects would be the first that it goes through
        return module
    finally:
        pause.end()
