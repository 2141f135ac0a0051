"""Runs an example as its readers do, then pings what it pinged without its host: for test_examples.py.

python -m tests.support.run_example NAME FOLDER [KEYWORD=NUMBER ...]  # in CAPITALS: its constants
"""

import sys
from importlib import import_module
from itertools import count
from pathlib import Path

import numpy as np
import pytest

import sonar_gl as sg
from tests.support.main_lobe import receive_main_lobe

ROOT = Path(__file__).resolve().parents[2]
# by embedding modes 1 to 4, as an example's main names them
PINGS = ("ping", "drawn_ping", "texture_ping", "depth_ping")


def main(name, folder, *options):
    sys.path.insert(0, str(ROOT / "examples"))
    example, keywords = import_module(name), dict(option.split("=") for option in options)
    if name == "window_host":  # nobody sits at the keyboard, and a frame takes what it ought to
        clock, held = count(), example.glfw.KEY_UP
        example.glfw.get_time = lambda: next(clock) / 60
        example.glfw.get_key = lambda window, key: int(key == held)
    numbers = {key: int(value) for key, value in keywords.items()}
    for key in filter(str.isupper, numbers):
        assert hasattr(example, key), key
        setattr(example, key, numbers[key])
    found = example.main(folder, **{key: value for key, value in numbers.items() if key.islower()})

    pings = {key: found[key] for key in PINGS if key in found}
    # the samples are those of the host's last ping, which hung on those before
    sampling = sg.Sampling(**next(iter(pings.values())).meta["sampling"])
    settings = {"pose": found["pose"], "bodies": found.get("bodies"), "labels": True}
    with sg.Simulator(found["scene"], found["sonar"], sampling=sampling) as simulator:
        pings["alone"] = simulator.ping(**settings)
    with pytest.MonkeyPatch.context() as monkeypatch:
        receive_main_lobe(monkeypatch)
        with sg.Simulator(found["scene"], found["sonar"], sampling=sampling) as simulator:
            pings["main_lobe"] = simulator.ping(**settings)
    for key, ping in pings.items():
        sg.save_npz(Path(folder) / f"{key}.npz", ping)
    np.save(Path(folder) / "names.npy", [body.name for body in found["scene"].bodies])


if __name__ == "__main__":
    main(*sys.argv[1:])
