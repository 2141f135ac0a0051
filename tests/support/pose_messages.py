"""Messages of other programs about poses, as bytes."""

from __future__ import annotations

import numpy as np
from trimesh.transformations import quaternion_from_matrix

from sonar_gl.ros.messages import message_types


def _parts(matrix, x=None, quaternion=None):
    """Return the position or translation, and the quaternion w x y z, with what a test changes."""
    place = [matrix[0, 3] if x is None else x, *matrix[1:3, 3]]
    return [float(n) for n in place], [
        float(n) for n in (quaternion_from_matrix(matrix) if quaternion is None else quaternion)
    ]


def _pose(matrix, **changes):
    types = message_types()
    place, (w, x, y, z) = _parts(matrix, **changes)
    return types.make(
        "geometry_msgs/Pose",
        types.make("geometry_msgs/Point", *place),
        types.make("geometry_msgs/Quaternion", x, y, z, w),
    )


def pose_stamped(matrix, frame="world", **changes):
    """Return the bytes of a geometry_msgs/PoseStamped."""
    types = message_types()
    header = types.header(0, frame)
    return types.encode(types.make("geometry_msgs/PoseStamped", header, _pose(matrix, **changes)))


def odometry(matrix, frame="world", time_ns=0, **changes):
    """Return the bytes of a nav_msgs/Odometry."""
    types = message_types()
    zero = types.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
    twist = types.make(
        "geometry_msgs/TwistWithCovariance", types.make("geometry_msgs/Twist", zero, zero), np.zeros(36)
    )
    placed = types.make("geometry_msgs/PoseWithCovariance", _pose(matrix, **changes), np.zeros(36))
    return types.encode(
        types.make("nav_msgs/Odometry", types.header(time_ns, frame), "base_link", placed, twist)
    )


def transforms(*links):
    """Return the bytes of a tf2_msgs/TFMessage of (parent, child, matrix) or (parent, child, matrix, changes)."""
    types = message_types()
    made = []
    for parent, child, matrix, *changes in links:
        place, (w, x, y, z) = _parts(matrix, **(changes[0] if changes else {}))
        transform = types.make(
            "geometry_msgs/Transform",
            types.make("geometry_msgs/Vector3", *place),
            types.make("geometry_msgs/Quaternion", x, y, z, w),
        )
        made.append(types.make("geometry_msgs/TransformStamped", types.header(0, parent), child, transform))
    return types.encode(types.transforms(made))
