"""Fires an Oculus or `sonar-gl emulate oculus`, prints its results, and writes a picture of the first.

    sonar-gl emulate oculus pylon
    python examples/oculus_client.py [--out FOLDER]      # in another terminal; Ctrl-C ends it

Writes oculus_client.png: the counts of a ping as a fan, as they came.

The layout of messages is that of thirdparty/Oculus/Oculus.h of github.com/apl-ocean-engineering/liboculus, in its first
version: little-endian, packed without gaps.
"""

import argparse
import itertools
import socket
import struct
from contextlib import suppress

import cv2
import numpy as np

import sonar_gl as sg
from sonar_gl.imaging.files import output_folder

OCULUS_ID, FIRE, RESULT = 0x4F53, 0x15, 0x23
# mark, source, destination, type of the message, version, bytes that follow, spare
HEADER = struct.Struct("<HHHHHIH")
# mode, ping rate, network speed, gamma, flags, range, gain in per cent, speed of sound, salinity
SETTINGS = struct.Struct("<5B4d")
# number, status, frequency, temperature, pressure, speed of sound, start time, size of a count, length of a bin,
# bins, beams, offset of the image, its bytes, bytes of the message; bearings follow
RESULT_BODY = struct.Struct("<II4dIBdHHIII")
LOW_FREQUENCY, TEN_PINGS_A_SECOND = 1, 0
RANGE_IN_METRES, SIMPLE_RESULT, GAIN_ASSISTANCE = 0x01, 0x08, 0x10  # flags
GAMMA = 127  # counts go as the square root of amplitude
AS_THEY_CAME = sg.Counts("power", exponent=1.0)  # the law that leaves counts as they are
PATCH_M, PATCH_BEAMS = 0.2, 5  # long and wide, of which the brightest is reported
PATIENCE_S = 30.0


def fire_message(range_m):
    """What sets the sonar pinging."""
    flags = RANGE_IN_METRES | SIMPLE_RESULT | GAIN_ASSISTANCE
    settings = SETTINGS.pack(LOW_FREQUENCY, TEN_PINGS_A_SECOND, 0xFF, GAMMA, flags, range_m, 50.0, 0.0, 0.0)
    return HEADER.pack(OCULUS_ID, 0, 0, FIRE, 1, len(settings), 0) + settings


def read_exactly(connection, size):
    """So many bytes of a connection."""
    data = b""
    while len(data) < size:
        part = connection.recv(size - len(data))
        if not part:
            raise ConnectionError("the sonar has closed the connection")
        data += part
    return data


def next_result(connection):
    """The next result, whole; messages of other types are skipped."""
    while True:
        head = read_exactly(connection, HEADER.size)
        mark, _, _, kind, version, size, _ = HEADER.unpack(head)
        if mark != OCULUS_ID:
            raise ConnectionError("this is no Oculus")
        message = head + read_exactly(connection, size)
        if kind == RESULT and version == 2:
            raise ConnectionError("results of version 2, which another program asks for, are not read here")
        if kind == RESULT:
            return message


def ping_of(message):
    """(number, start time in nanoseconds modulo 2**32, Ping of the counts as shares of full scale)."""
    begin = HEADER.size + SETTINGS.size
    number, *_, start_ns, size_code, bin_size_m, n_bins, n_beams, offset, image_bytes, _ = (
        RESULT_BODY.unpack_from(message, begin)
    )
    # hundredths of a degree, positive to starboard
    bearings = np.frombuffer(message, "<i2", n_beams, begin + RESULT_BODY.size)
    azimuth_rad = -np.radians(bearings[::-1] / 100)
    n_bytes = size_code + 1
    rows = np.frombuffer(message, np.uint8, image_bytes, offset).reshape(n_bins, -1)
    # a row begins with the gain of its range, where that is asked for
    counts = rows[:, -n_beams * n_bytes :].copy().view(f"<u{n_bytes}")
    share = counts.T[::-1] / (256**n_bytes - 1)
    range_m = (np.arange(n_bins) + 0.5) * bin_size_m
    return number, start_ns, sg.Ping(share.astype(np.float32), azimuth_rad, range_m)


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


def describe(number, ping):
    """One line about a ping."""
    range_m = ping.range_m
    return (
        f"ping {number}: {len(ping.azimuth_rad)} beams, {len(range_m)} ranges from {range_m[0]:.2f} to "
        f"{range_m[-1]:.2f} m; {brightest(ping)}"
    )


def main(options):
    """Print results as they come, and paint the first."""
    picture, before_ns = output_folder(options.out) / "oculus_client.png", None
    with socket.create_connection((options.host, options.port), PATIENCE_S) as connection:
        connection.sendall(fire_message(options.range))
        for count in itertools.count(1):
            number, start_ns, ping = ping_of(next_result(connection))
            # a difference of times that begin anew
            later = (
                "" if before_ns is None else f"; {(start_ns - before_ns) % 2**32 / 1e6:.0f} ms after the last"
            )
            print(describe(number, ping) + later, flush=True)
            before_ns = start_ns
            if count == 1:
                fan = sg.fan_image(ping, height=600, counts=AS_THEY_CAME)
                sg.save_png(picture, sg.draw_axes(sg.colorize(fan), ping))
            if count == options.pings:
                break


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", default="out", help="folder for the picture")
    parser.add_argument("--pings", type=int, help="number after which it ends")
    parser.add_argument("--range", type=float, default=25.0, help="metres")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=52100)
    found = parser.parse_args()
    try:
        with suppress(KeyboardInterrupt):
            main(found)
    except TimeoutError:  # of the connection, or of its results
        parser.exit(
            2, f"error: an Oculus must answer at {found.host}:{found.port}; is --range beyond its limit?\n"
        )
    except (OSError, OverflowError) as why:
        parser.exit(2, f"error: an Oculus must answer at {found.host}:{found.port} (got {why})\n")
    except sg.Error as why:
        parser.exit(2, f"error: {why}\n")
