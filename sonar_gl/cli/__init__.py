"""The command line, `sonar-gl`.

`main` declares the commands and their options. The module that does the work of a command is loaded when the command
runs, as an attribute of this package: `sonar-gl --help` loads no library but click.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submodules=[
        "batch",
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
        "warm_up_batch",
    ],
)
