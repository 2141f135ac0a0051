"""Whether pings are identical."""

import numpy as np

from sonar_gl.ping import BIN_LABELS

ARRAYS = ("intensity", "azimuth_rad", "range_m", "pose", *BIN_LABELS, "body_echo")


def check_same(one, other):
    """Check that all arrays, the meta and the estimates of two pings are identical."""
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert one.meta == other.meta
    assert one.error_estimate == other.error_estimate


def check_all_same(pings, others):
    """Check that as many pings are identical, one by one."""
    for one, other in zip(pings, others, strict=True):
        check_same(one, other)
