"""What a dry run says."""

import re

import pytest

from tests.support.batches import BOX, write_plain_job
from tests.support.command_line import WALL, run
from tests.support.inline_pool import use_inline_pool


@pytest.mark.slow
def test_a_dry_run_names_the_views_that_need_the_most_samples(hard):
    status, shown, _ = run("batch", hard, "--dry-run", "--workers", "9")
    lines = shown.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("level in tank.sdf: "))
    assert status == 0 and lines[at].endswith(" of 8 pings")
    assert lines[at + 1].startswith("  ping ") and "vehicle at '0 0 0 " in lines[at + 1]
    assert " samples for body 'rod', estimated error 0.0" in lines[at + 1]
    assert lines[at + 4].startswith("8 pings in 4 parts")
    rate, ms = re.fullmatch(
        r"speed: (\S+) pings a second in one process \((\S+) ms a ping, on .*; measured on this machine by pings 0, 7, "
        r"after all was compiled\)",
        lines[at + 6],
    ).groups()
    assert float(rate) * float(ms) == pytest.approx(1000, rel=0.02)  # of three figures, and of 0.1 ms
    one_s = re.match(r"time: (\S+) seconds for all pings in one process, ", lines[at + 7])[1]
    assert float(one_s) == pytest.approx(8e-3 * float(ms), rel=0.02)
    assert lines[at + 7].endswith(" at best in 4, if each has as many cores")  # no more processes than parts


@pytest.mark.parametrize(
    ("part", "more", "line"),
    [
        (
            4,
            "[ros]\n",
            "8 pings in 2 parts of 4, each a file of the bag (a larger pings_per_part makes fewer files)",
        ),
        pytest.param(8, "[ros]\n", "8 pings in 1 part", marks=pytest.mark.slow),
        (4, "", "8 pings in 2 parts of 4"),
    ],
)
def test_a_dry_run_says_of_how_many_files_a_bag_is(tmp_path, monkeypatch, part, more, line):
    use_inline_pool(monkeypatch)
    job = write_plain_job(tmp_path, 8, part, more)
    assert line in run("batch", job, "--dry-run", "--workers", "1")[1].splitlines()


def test_a_dry_run_counts_pings_in_which_a_body_has_no_clear_place(tmp_path, monkeypatch):
    use_inline_pool(monkeypatch)
    path = write_plain_job(tmp_path, 4, 4)
    boxes = BOX + BOX.replace("box_1", "box_2")
    (tmp_path / "tank.sdf").write_text(f'<sdf version="1.9"><world name="tank">{boxes}{WALL}</world></sdf>')
    text = path.read_text()
    path.write_text(text + '[[vary.bodies]]\nnames = ["box_*"]\napart = true\nclearance_m = 0.1\n')
    status, out, err = run("batch", path, "--dry-run", "--workers", "1")
    assert status == 0, err
    assert (
        "  4 of these 4 pings have a body without a clear place, which is absent, such as ping 0, sonar at "
        "'0 0 0 0 0 -0.2', 'box_2' (clearance_m)\n"
    ) in out
