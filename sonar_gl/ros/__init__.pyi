"""Public names of sonar_gl.ros: this file is both what type checkers read and what `__init__.py` loads lazily."""

# with `as`, since Jedi, which completes names in editors, takes others in a stub for its own
from .dds_transport import DdsTransport as DdsTransport
from .foxglove_transport import FoxgloveTransport as FoxgloveTransport
from .publisher import Publisher as Publisher
from .publisher_settings import PoseSource as PoseSource
from .publisher_settings import PublisherSettings as PublisherSettings
from .zenoh_transport import ZenohTransport as ZenohTransport

__all__ = [
    "DdsTransport",
    "FoxgloveTransport",
    "PoseSource",
    "Publisher",
    "PublisherSettings",
    "ZenohTransport",
]
