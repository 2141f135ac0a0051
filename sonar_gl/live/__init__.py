"""The sonar as a device that runs: emulators that speak the protocols of real sonars, and topics of ROS 2."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "dds_transport": ["DdsTransport"],
        "foxglove_transport": ["FoxgloveTransport"],
        "publisher": ["Publisher"],
        "publisher_settings": ["PoseSource", "PublisherSettings"],
        "zenoh_transport": ["ZenohTransport"],
    },
)
