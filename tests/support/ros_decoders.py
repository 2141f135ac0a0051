"""Decoders of messages in CDR that know nothing of a type but the definition that its topic states."""

from __future__ import annotations

import re

import numpy as np
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sonar_gl.ros.transport import Topic


def by_rosbags(topic: Topic, message: bytes):
    """Return a message as rosbags decodes it."""
    store, types = get_typestore(Stores.EMPTY), {}
    first, *others = re.split(r"\n=+\nMSG: ", topic.definition)
    types |= get_types_from_msg(first, topic.msgtype)
    for other in others:
        name, _, text = other.partition("\n")
        package, _, kind = name.strip().rpartition("/")
        types |= get_types_from_msg(text, f"{package.removesuffix('/msg')}/msg/{kind}")
    store.register(types)
    assert store.hash_rihs01(topic.msgtype) == topic.type_hash
    return store.deserialize_cdr(message, topic.msgtype)


def by_mcap(topic: Topic, message: bytes):
    """Return a message as mcap decodes it."""
    schema = Schema(1, topic.definition.encode(), "ros2msg", topic.msgtype)
    return DecoderFactory().decoder_for("cdr", schema)(message)


DECODERS = by_rosbags, by_mcap


def check_projected_image(message, ping, time_ns: int) -> None:
    """Check each field of a ProjectedSonarImage against the ping that it was made of, 8 bits to a count."""
    stamp, info, image = message.header.stamp, message.ping_info, message.image
    assert (stamp.sec, stamp.nanosec) == divmod(time_ns, 10**9)
    assert message.header.frame_id == "sonar_beams"
    assert (info.frequency, info.sound_speed) == (900e3, 1500.0)
    n_beams, n_bins = ping.intensity.shape
    np.testing.assert_array_equal(info.tx_beamwidths, np.full(n_beams, np.radians(20.0), np.float32))
    np.testing.assert_array_equal(info.rx_beamwidths, np.full(n_beams, np.radians(1.0), np.float32))
    directions = np.array([[d.x, d.y, d.z] for d in message.beam_directions])
    azimuth = ping.azimuth_rad[::-1]  # port first, y to port, z forward
    expected = np.stack([0 * azimuth, np.sin(azimuth), np.cos(azimuth)], axis=1)
    np.testing.assert_allclose(directions, expected, atol=1e-15)  # rounding of the products with 0 and 1
    np.testing.assert_array_equal(message.ranges, ping.range_m.astype(np.float32))
    assert (image.is_bigendian, image.dtype, image.beam_count) == (False, 0, n_beams)
    counts = np.frombuffer(bytes(image.data), np.uint8).reshape(n_bins, n_beams)
    np.testing.assert_array_equal(counts, ping.counts()[::-1].T)
    assert len(np.unique(counts)) > 100  # not one number everywhere
