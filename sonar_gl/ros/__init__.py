"""ROS 2 without ROS: messages, bags, and live topics.

`messages` makes, encodes and decodes messages, for bags and topics alike. `bag` writes recordings. A `publisher` makes
the pings of a sonar at its rate (`ping_schedule`) and sends them. `message_inputs` follows poses and times that other
programs send. A `transport` carries the messages: `dds_transport`, whose nodes ROS lists by `discovery`;
`zenoh_transport`, by the conventions of `rmw_zenoh`; `foxglove_transport` for viewers. An `inbox` has what arrives.
"""

import lazy_loader

# names are in `__init__.pyi`, for type checkers, too
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
