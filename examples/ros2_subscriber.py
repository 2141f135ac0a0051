"""Prints the pings of `sonar-gl ros2`, and writes a picture of the first, without ROS.

    sonar-gl ros2 pylon
    python examples/ros2_subscriber.py [--out FOLDER]    # in another terminal; Ctrl-C ends it

Writes ros2_subscriber.png: the counts of a ping as a fan, as they came.
"""

import argparse
import itertools
import os
import queue
import sys
from contextlib import closing, suppress

import cv2
import numpy as np

import sonar_gl as sg
from sonar_gl.imaging.files import output_folder
from sonar_gl.ros import DdsTransport, ZenohTransport
from sonar_gl.ros.messages import message_types
from sonar_gl.ros.transport import Topic

MSGTYPE = "marine_acoustic_msgs/msg/ProjectedSonarImage"
BYTES = {0: 1, 2: 2}  # of a count: DTYPE_UINT8 and DTYPE_UINT16 of marine_acoustic_msgs/SonarImageData
AS_THEY_CAME = sg.Counts("power", exponent=1.0)  # the law that leaves counts as they are
PATCH_M, PATCH_BEAMS = 0.2, 5  # long and wide, of which the brightest is reported
PATIENCE_S = 10.0
HINT = (
    "nothing on {} yet: does sonar-gl ros2 run, with this transport and domain? Its first ping after an installation "
    "takes a minute or two, on one core some minutes"
)


def make_transport(options):
    """What carries the messages."""
    if options.transport == "zenoh":
        return ZenohTransport(options.router, options.domain, node="ping_reader")
    return DdsTransport(options.domain, node="ping_reader")


def ping_of(message):
    """The counts of a message as a Ping, as shares of full scale. Messages go range by range, port first."""
    n_bytes, n_bins = BYTES[message.image.dtype], len(message.ranges)
    counts = np.frombuffer(message.image.data, f"<u{n_bytes}").reshape(n_bins, message.image.beam_count)
    # frame sonar_beams: x down, y to port, z along the boresight
    azimuth_rad = np.array([np.arctan2(beam.y, beam.z) for beam in message.beam_directions])
    share = counts.T[::-1] / (256**n_bytes - 1)
    return sg.Ping(share.astype(np.float32), azimuth_rad[::-1], np.asarray(message.ranges, np.float64))


def brightest(ping):
    """Text about the brightest patch; of single bins, grains of speckle, automatic gain brings many to full scale."""
    half_bins = round(PATCH_M / 2 / ping.bin_size_m)
    share = cv2.blur(ping.intensity, (2 * half_bins + 1, PATCH_BEAMS), borderType=cv2.BORDER_REPLICATE)
    k = share.max(axis=0).argmax()  # the nearest, of several that are alike
    beam = share[:, k].argmax()
    side = "port" if ping.azimuth_rad[beam] > 0 else "starboard"
    return (
        f"brightest patch {share[beam, k]:.0%} of full scale, at {ping.range_m[k]:.2f} m and "
        f"{abs(np.degrees(ping.azimuth_rad[beam])):.1f}° to {side}"
    )


def describe(message, ping):
    """One line about a ping."""
    stamp, range_m = message.header.stamp, ping.range_m
    return (
        f"{message.header.frame_id} at {stamp.sec + stamp.nanosec / 1e9:.3f} s: {len(ping.azimuth_rad)} beams, "
        f"{len(range_m)} ranges from {range_m[0]:.2f} to {range_m[-1]:.2f} m; {brightest(ping)}"
    )


def main(options):
    """Print pings as they come, and paint the first."""
    picture, messages = output_folder(options.out) / "ros2_subscriber.png", queue.Queue()
    with closing(make_transport(options)) as transport:
        transport.subscribe(Topic.of_type(options.topic, MSGTYPE), messages.put)
        for number in itertools.count(1):
            try:
                data = messages.get(timeout=PATIENCE_S)
            except queue.Empty:
                if number == 1:
                    print(HINT.format(options.topic), file=sys.stderr)
                data = messages.get()
            message = message_types().decode(data, MSGTYPE)
            ping = ping_of(message)
            print(describe(message, ping), flush=True)
            if number == 1:
                fan = sg.fan_image(ping, height=600, counts=AS_THEY_CAME)
                sg.save_png(picture, sg.draw_axes(sg.colorize(fan), ping))
            if number == options.pings:
                break


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out", help="folder for the picture")
    parser.add_argument("--pings", type=int, help="number after which it ends")
    parser.add_argument("--topic", default="/sonar/projected_image")
    parser.add_argument("--transport", choices=("dds", "zenoh"), default="dds")
    parser.add_argument("--router", default="tcp/127.0.0.1:7447", help="of zenoh")
    parser.add_argument("--domain", type=int, default=os.environ.get("ROS_DOMAIN_ID", "").strip() or "0")
    try:
        with suppress(KeyboardInterrupt):
            main(parser.parse_args())
    except sg.Error as why:
        parser.exit(2, f"error: {why}\n")
