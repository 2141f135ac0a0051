"""Settings that are taken back if no ping can be made with them."""

from sonar_gl.live.settings import LiveSettings, SettingsTrial

FIRST = LiveSettings("p900-45")
SECOND, THIRD = FIRST.changed(range_m=5.0), FIRST.changed(range_m=6.0)


def test_new_settings_that_fail_give_way_to_the_last_ones_that_worked():
    trial = SettingsTrial(FIRST)
    trial.change(SECOND)
    trial.succeed(SECOND)
    trial.change(THIRD)
    assert trial.fail(THIRD, "too many samples")  # the old ones may be tried at once
    assert (trial.settings, trial.problem) == (SECOND, "too many samples")
    trial.succeed(SECOND)
    assert trial.problem == "too many samples"  # still why these are not the ones that were asked for
    trial.change(THIRD)
    assert (trial.settings, trial.problem) == (THIRD, "")


def test_settings_that_came_while_others_failed_stay():
    trial = SettingsTrial(FIRST)
    trial.change(SECOND)
    trial.change(THIRD)  # while a ping is tried with the second
    assert trial.fail(SECOND, "too many samples")
    assert (trial.settings, trial.problem) == (THIRD, "")


def test_settings_that_worked_before_stay_though_a_ping_fails():
    trial = SettingsTrial(FIRST)
    assert not trial.fail(FIRST, "the mesh is gone")  # to try at once would fail again
    assert (trial.settings, trial.problem) == (FIRST, "the mesh is gone")
    trial.succeed(FIRST)
    assert trial.problem == ""
