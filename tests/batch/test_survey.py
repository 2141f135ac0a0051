"""What a dry run finds out about a job: what its pings cost, need and show."""

import re
import shutil
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

import sonar_gl as sg
from sonar_gl.batch import dry_run as dry_run_module
from sonar_gl.batch import parts
from sonar_gl.batch import survey as survey_module
from sonar_gl.batch.steps import begin, create_store
from sonar_gl.batch.survey import survey, try_pings
from sonar_gl.core.warn import warn_caller
from sonar_gl.engine import sequence
from sonar_gl.engine.flow import Plan
from sonar_gl.engine.level_search import LevelSearch
from sonar_gl.sonar.sampling import ToleranceWarning
from tests.support.batches import BOX, LABELS, MORE, make_all, open_batch, write_job, write_plain_job
from tests.support.command_line import WALL, run
from tests.support.inline_pool import use_inline_pool


def test_a_survey_says_what_decides_the_samples_of_each_ping(tmp_path, monkeypatch):
    """The whole, or a body that is nearer to its bound of five times the tolerance. It warns of nothing."""
    batch, poses = open_batch(write_job(tmp_path, 3, ""), tmp_path / "out"), []
    needs = [(0.04, 0.15, 1, True, 100), (0.02, 0.15, 1, True, 200), (0.02, 0.6, 2, False, 300)]

    def choose(search, setup):
        number = round(setup.request.time_s / 0.2)
        poses.append(setup.head_pose)
        warn_caller("the tolerance cannot be met", ToleranceWarning)
        plan = Plan(sg.Sampling(1, 8), 3, *needs[number])
        return SimpleNamespace(echo=SimpleNamespace(total=float(number))), plan

    monkeypatch.setattr(LevelSearch, "choose", choose)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = survey(batch, 0)
    one, other, *_ = (body.name for body in batch.requests.scenes[0].bodies)
    expected = [
        (100, 0.04, "", False, ""),
        (200, 0.02, one, True, ""),
        (300, pytest.approx(0.12), other, True, ""),
    ]
    sonars = list(batch.requests.sonars)
    assert found == [(number, name, *view) for name in sonars for number, view in enumerate(expected)]
    mounts = batch.requests.mounts.values()
    np.testing.assert_array_equal(
        poses, [one.vehicle_pose @ mount for mount in mounts for one in batch.requests]
    )


def test_a_survey_that_fails_has_reported_its_warnings(tmp_path, monkeypatch):
    batch, reports = open_batch(write_job(tmp_path, 3, ""), tmp_path / "out"), []

    def choose(search, setup):
        warn_caller("the water is cold")
        raise sg.Error("the samples do not fit")

    monkeypatch.setattr(LevelSearch, "choose", choose)
    with pytest.raises(sg.Error, match="do not fit"):
        survey(batch, 0, lambda *told: reports.append(told))
    sonar, scene = next(iter(batch.requests.sonars)), batch.requests.job.scenes[0]
    assert reports == [("warning", f"warning: {sonar} in {scene}: the water is cold")]


def test_a_dry_run_of_many_scenes_makes_pings_of_some_of_them(tmp_path, monkeypatch):
    """All would take longer than the job, as of random scenes with few pings each."""
    use_inline_pool(monkeypatch)
    monkeypatch.setattr(survey_module, "MOST_SCENES", 3)
    monkeypatch.setattr(dry_run_module, "other_unit_text", lambda _scene: "it is large")
    path = write_plain_job(tmp_path, 2, 2, LABELS)
    names = [f"tank_{number}.sdf" for number in range(5)]
    for name in names:
        shutil.copy(tmp_path / "tank.sdf", tmp_path / name)
    path.write_text(path.read_text().replace('["tank.sdf"]', str(names)))
    status, out, err = run("batch", path, "--dry-run", "--workers", "1")
    assert status == 0, err
    assert "\nwhat follows is of 3 of the 5 scenes, spread over the job\n" in out
    for line in (r"level in tank_(.).sdf: .*, of 2 pings", r"  labels of 2 pings"):
        assert len(re.findall(f"(?m)^{line}", out)) == 3, out
    assert re.findall(r"(?m)^level in tank_(.)", out) == ["0", "2", "4"]
    assert re.findall(r"(?m)^warning: tank_(.).sdf: it is large$", err) == list("01234")
    assert "10 pings in 5 parts of 2\n" in out and "by 6 pings spread over the job: 0, 1, 4, .., 9," in out


@pytest.mark.slow
@pytest.mark.parametrize(("n_scenes", "more"), [(1, 0), (2, 0), (2, 20)])
def test_the_cost_of_a_ping_is_that_of_pings_spread_over_the_job(tmp_path, monkeypatch, n_scenes, more):
    """By a clock that a ping n advances by n milliseconds, and a thousand times as much the first time.

    more : further pings before them, of the second scene alone
    """
    path, now_s, made = write_job(tmp_path, 40, MORE.replace("[coco]\nheight = 100", "")), [0.0], []
    shutil.copy(tmp_path / "tank.sdf", tmp_path / "pool.sdf")
    text = path.read_text().replace("pings_per_part = 4", "pings_per_part = 12")
    text = text.replace('["tank.sdf"]', str(["tank.sdf", "pool.sdf"][:n_scenes]))
    if more:
        at = text.index("[[poses]]")
        poses = text[at : text.index("[[vary.bodies]]")].replace("n_pings = 40", f"n_pings = {more}")
        text = f'{text[:at]}{poses}scenes = ["pool.sdf"]\n{text[at:]}'
    path.write_text(text)
    batch = open_batch(path, tmp_path / "out")
    number_at = {request.time_s: request.number for request in batch.requests}
    begin(batch).save(batch.folder)
    create_store(batch)

    def timed(run, requests):
        requests = list(requests)
        for number in (number_at[request.time_s] for request in requests):
            now_s[0] += number * (1e-3 if made.count(number) >= 2 else 1.0) / 2  # two sonars
            made.append(number)
        return sequence.make_pings(run, iter(requests))

    monkeypatch.setattr(parts, "make_pings", timed)
    monkeypatch.setattr(survey_module.time, "perf_counter", lambda: now_s[0])
    cost = try_pings(batch)
    numbers = np.arange(more + 40 * n_scenes)
    is_first = (numbers >= more) & (numbers < more + 40)
    n_each = 12 if n_scenes == 1 else 8  # of two scenes a chunk of each, more than half a part
    of_scenes = [numbers[is_first], numbers[~is_first]][:n_scenes]
    expected = [one[np.linspace(0, len(one) - 1, n_each).round().astype(int)] for one in of_scenes]
    expected = np.sort(np.concatenate(expected))
    assert cost.numbers == tuple(expected.tolist())
    assert all(made.count(number) == 4 for number in expected) and len(made) == 4 * len(expected)
    weights = np.where(is_first[expected], 40, 40 + more)  # pings of each scene
    assert cost.seconds_per_ping == pytest.approx(1e-3 * np.average(expected, weights=weights), rel=1e-9)
    batch.close()


@pytest.mark.slow
def test_a_dry_run_says_how_often_each_class_is_seen_in_each_scene(tmp_path):
    """As the labels of the finished batch do; a class without a body in a scene is none that could be seen there."""
    path = write_plain_job(tmp_path, 8, 4, LABELS)  # more pings than a part has
    (tmp_path / "pool.sdf").write_text(f'<sdf version="1.9"><world name="pool">{WALL}</world></sdf>')
    text = path.read_text().replace('["tank.sdf"]', '["pool.sdf", "tank.sdf"]')
    text = text.replace('target = ["box*"]', 'target = ["box*"]\nbehind = ["lost"]')
    text = text.replace('"wall", "floor"', '"wall"')  # the floor is of no class
    path.write_text(text.replace("[labels]", '[[vary.bodies]]\nnames = ["box_1"]\nthere = 0.3\n[labels]'))
    lost = BOX.replace("box_1", "lost").replace("3 0.3 -0.3", "-3 0 0")
    tank = (tmp_path / "tank.sdf").read_text()
    (tmp_path / "tank.sdf").write_text(tank.replace("</world>", lost + "</world>"))
    text = path.read_text()
    path.write_text(text.replace('"shadow", ', ""))
    batch = open_batch(path, tmp_path / "trial")
    begin(batch).save(batch.folder)
    create_store(batch)
    n_outputs = len(batch.maker.outputs)
    tried = try_pings(batch)
    assert len(batch.maker.outputs) == n_outputs
    batch.close()
    make_all(path, tmp_path / "out")
    found = xr.open_dataset(tmp_path / "out" / "pings.zarr")
    assert found.attrs["classes"] == ["fixed", "target", "behind"]
    bins = [(found.class_id == number).sum(("beam", "range")).values for number in (1, 2, 3)]
    assert len(tried.numbers) == 2 * 4  # of each scene no more than a part has
    in_pool, in_tank = tried.seen
    assert (in_tank.scene, in_tank.sonar, in_tank.n_pings) == (1, "level", 8) and in_pool.scene == 0
    fixed, target = (one[8:] for one in bins[:2])
    assert not bins[2].any() and 0 < (target > 0).sum() <= 4  # else the median of all is much the same
    assert in_tank.classes == [
        ("behind", 0, 0),
        ("target", (target > 0).sum(), int(np.median(target[target > 0]))),
        ("fixed", 8, int(np.median(fixed))),
    ]
    assert in_pool.classes == [("fixed", 8, int(np.median(bins[0][:8])))]
    shown = run("batch", path, "--dry-run", "--workers", "1")[1]
    lines = [line for line in shown.splitlines() if line.startswith("  labels of")]
    assert len(lines) == 2 and lines[1].startswith(
        "  labels of 8 pings, with the median of their bins: behind in none, target in "
    )
    path.write_text(text[: text.index("[labels]")])
    assert "labels of" not in run("batch", path, "--dry-run", "--workers", "1")[1]
