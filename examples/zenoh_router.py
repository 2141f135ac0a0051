"""A router of zenoh at 127.0.0.1, in place of ROS's rmw_zenohd, by which programs on this machine find each other.

pip install eclipse-zenoh                            # or sonar_gl's extra 'live'
python examples/zenoh_router.py                      # Ctrl-C ends it
"""

import argparse
import json
import time
from contextlib import suppress

import zenoh


def main(options):
    """Listen until Ctrl-C."""
    config = zenoh.Config()
    settings = {
        "mode": "router",
        "listen/endpoints": [f"tcp/127.0.0.1:{options.port}"],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
        # as rmw_zenohd: peers exchange messages directly, once they have found each other
        "routing/router/peers_failover_brokering": False,
    }
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    with zenoh.open(config):
        print(f"zenoh router at tcp/127.0.0.1:{options.port}; Ctrl-C ends it", flush=True)
        while True:
            time.sleep(1.0)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--port", type=int, default=7447)
    found = parser.parse_args()
    try:
        with suppress(KeyboardInterrupt):
            main(found)
    except zenoh.ZError as why:
        parser.exit(
            2, f"error: a router must be able to listen at port {found.port}; does one run? (got {why})\n"
        )
