"""Public names of sonar_gl.ros: this file is both what type checkers read and what `__init__.py` loads lazily."""

from .dds_transport import DdsTransport
from .foxglove_transport import FoxgloveTransport
from .publisher import Publisher
from .publisher_settings import PoseSource, PublisherSettings
from .zenoh_transport import ZenohTransport

__all__ = [
    "DdsTransport",
    "FoxgloveTransport",
    "PoseSource",
    "Publisher",
    "PublisherSettings",
    "ZenohTransport",
]
