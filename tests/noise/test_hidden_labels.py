"""Labels that the receiver's noise hides: by its mean power in each bin, whatever the noise of a ping is."""

import math
from dataclasses import replace

import numpy as np
import pytest

import sonar_gl as sg
from sonar_gl.noise.hidden_labels import without_hidden_labels
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.receiver import absolute_levels, common_noise_pattern
from sonar_gl.noise.reception import receiver_power
from sonar_gl.ping import BIN_LABELS, Ping
from tests.support.even_ping import even_ping

HERE = np.eye(4)
SELF_NOISE, DEFAULT_LEVEL = sg.Noise(self_noise=True), {"labels_above_noise": True}
PER_BIN = [name for name in BIN_LABELS if name != "shadow"]
LEVEL = 1e-3


def labelled_ping(n_beams=16, n_bins=256, meta=DEFAULT_LEVEL, **settings) -> Ping:
    """Return a ping whose mean echo rises from bin to bin from 1e-5 to 1, the same in each beam, of one body each."""
    settings = {"self_noise_db": 10 * math.log10(LEVEL)} | settings
    ping, random = even_ping(n_beams, n_bins, pose=HERE, **settings), np.random.default_rng(1)
    shape = ping.intensity.shape
    labels = {name: random.random(shape, np.float32) for name in PER_BIN}
    labels |= {
        "share": np.ones(shape, np.float32),
        "body_id": random.integers(1, 4, shape, np.uint16),
        "shadow": random.random(shape) < 0.5,
    }
    intensity = np.repeat(np.geomspace(1e-5, 1.0, n_bins, dtype=np.float32)[None], n_beams, 0)
    arrays = {"intensity": intensity, "body_echo": np.arange(4.0), **labels}
    for array in arrays.values():
        array.setflags(write=False)
    return replace(ping, meta=dict(meta), **arrays)


def assert_labels_above(found: Ping, ping: Ping, power) -> None:
    """Check bit for bit that bins whose echo is at least `power` have the labels of `ping`, and no others have some."""
    is_above = ping.intensity >= np.broadcast_to(np.asarray(power, np.float32), ping.intensity.shape)
    assert 0 < is_above.sum() < is_above.size
    for name in PER_BIN:
        array = getattr(ping, name)
        wanted = np.where(is_above, array, array.dtype.type(BIN_LABELS[name]))
        got = getattr(found, name)
        np.testing.assert_array_equal(got, wanted)
        assert got.dtype == array.dtype and not got.flags.writeable
    assert found.shadow is ping.shadow and found.body_echo is ping.body_echo


@pytest.mark.parametrize(
    "noise", [SELF_NOISE, sg.Noise.physical(), sg.Noise(speckle=True, looks=3, self_noise=True)]
)
def test_bins_whose_mean_echo_is_weaker_than_the_noise_have_no_label(noise):
    ping = labelled_ping()
    before = {name: getattr(ping, name).copy() for name in PER_BIN}
    found = add_noise(ping, noise, seed=1)
    assert_labels_above(found, ping, LEVEL)
    for name, array in before.items():  # the caller's ping stays as it is
        np.testing.assert_array_equal(getattr(ping, name), array)


def test_an_echo_as_strong_as_the_noise_is_labelled():
    ping = labelled_ping()
    power = receiver_power(ping, SELF_NOISE)
    for factor, is_labelled in ((1.0, True), (1 - 2**-23, False)):
        even = replace(ping, intensity=np.repeat(power * np.float32(factor), len(ping.intensity), 0))
        assert ((add_noise(even, SELF_NOISE, 0).body_id > 0) == is_labelled).all()


def test_the_levels_of_all_noises_of_the_receiver_count_after_the_tvg():
    acoustics = sg.Acoustics.physical(tvg_k=30.0).meta()
    ping = labelled_ping(source_level_db=170.0, bandwidth_hz=100e3, self_noise_db=-45.0, **acoustics)
    thermal_db = absolute_levels(ping.sonar, ping.acoustics).thermal_noise_db
    tvg, total = ping.acoustics.tvg(ping.range_m, ping.sonar), 0.0
    for noise, level_db in (
        ({"self_noise": True}, -45.0),
        ({"thermal_noise": True}, thermal_db),
        ({"ambient_db": -48.0}, -48.0),
    ):
        alone = 10 ** (level_db / 10)
        np.testing.assert_allclose(receiver_power(ping, sg.Noise(**noise)), [alone * tvg], rtol=1e-6)
        total += alone
    noise = sg.Noise(self_noise=True, thermal_noise=True, ambient_db=-48.0)
    power = receiver_power(ping, noise)
    assert power.dtype == np.float32 and power.shape == (1, 256)
    np.testing.assert_allclose(power, [total * tvg], rtol=1e-6)
    assert_labels_above(add_noise(ping, noise, 3), ping, power)


def test_noise_that_channels_have_in_common_hides_labels_by_beam():
    ping = labelled_ping(n_beams=65, common_noise_db=-10.0, common_noise_width_deg=6.0)
    pattern = common_noise_pattern(ping.azimuth_rad, 6.0)
    power = receiver_power(ping, SELF_NOISE)
    np.testing.assert_allclose(power, (LEVEL + 0.1 * pattern)[:, None].repeat(256, 1), rtol=1e-6)
    found = add_noise(ping, SELF_NOISE, 1)
    assert_labels_above(found, ping, power)
    labelled = (found.body_id > 0).sum(axis=1)
    assert labelled[32] < 0.6 * labelled[0] and labelled[32] == labelled.min()
    ambient = sg.Noise(ambient_db=10 * math.log10(LEVEL))  # which channels do not have in common
    assert_labels_above(add_noise(ping, ambient, 1), ping, LEVEL)


def test_mean_power_is_that_of_many_pings():
    """Of nothing but noise; 5 standard errors of the mean of 16 x 200 exponential values, one in ten independent."""
    ping = labelled_ping(common_noise_db=-30.0, **sg.Acoustics.physical().meta())
    silent = replace(ping, intensity=np.zeros_like(ping.intensity))
    mean = np.mean([add_noise(silent, SELF_NOISE, 1, number).intensity for number in range(200)], axis=0)
    ratio = mean / receiver_power(ping, SELF_NOISE)
    assert ratio.mean() == pytest.approx(1, abs=5 * math.sqrt(10 / (200 * ratio.size)))


def test_labels_depend_neither_on_seed_nor_on_number():
    ping = labelled_ping()
    first = add_noise(ping, sg.Noise.physical(), seed=1)
    for seed, number in ((2, 0), (1, 1)):
        other = add_noise(ping, sg.Noise.physical(), seed, number)
        assert (other.intensity != first.intensity).any()
        for name in PER_BIN:
            np.testing.assert_array_equal(getattr(other, name), getattr(first, name))


@pytest.mark.parametrize(
    "noise",
    [
        sg.Noise(speckle=True),
        sg.Noise.demarco2015(),
        sg.Noise(gaussian=0.5),
        sg.Noise(interference_lines=5.0, interference_db=0.0),
        sg.Noise(dropped_beams=0.5),
    ],
)
def test_noise_that_no_receiver_adds_hides_no_labels(noise):
    ping = labelled_ping()
    found = add_noise(ping, noise, 1)
    assert receiver_power(ping, noise) is None and (found.intensity != ping.intensity).any()
    assert all(getattr(found, name) is getattr(ping, name) for name in BIN_LABELS)
    assert add_noise(ping, sg.Noise(), 1) is ping and add_noise(ping, None, 1) is ping


def test_the_echo_of_the_body_alone_counts():
    """What others return in its bin, by far side lobes or multipath, does not lift it above the noise."""
    ping = labelled_ping()
    share = np.full_like(ping.share, 0.25)
    found = add_noise(replace(ping, share=share), SELF_NOISE, 1)
    is_above = 0.25 * ping.intensity >= receiver_power(ping, SELF_NOISE)
    assert 0 < is_above.sum() < (add_noise(ping, SELF_NOISE, 1).body_id > 0).sum()
    np.testing.assert_array_equal(found.body_id, np.where(is_above, ping.body_id, 0))


@pytest.mark.parametrize("meta", [{}, {"label_level_db": -40.0}, {"labels_above_noise": False}])
def test_labels_by_a_stated_level_and_of_older_files_stay(meta):
    ping = labelled_ping(meta=meta)
    found = add_noise(ping, SELF_NOISE, 1)
    assert all(getattr(found, name) is getattr(ping, name) for name in BIN_LABELS)
    assert without_hidden_labels(ping, receiver_power(ping, SELF_NOISE)) is ping


def test_the_first_noise_of_several_decides():
    """The mean echo is not known after it: labels would depend on its seed."""
    ping = labelled_ping()
    once = add_noise(ping, SELF_NOISE, 1)
    twice = add_noise(once, sg.Noise(ambient_db=0.0), 1)
    for name in PER_BIN:
        np.testing.assert_array_equal(getattr(twice, name), getattr(once, name))


def test_pings_with_few_labels_or_none():
    ping = labelled_ping()
    bare = replace(ping, **dict.fromkeys(BIN_LABELS))
    assert add_noise(bare, SELF_NOISE, 1).body_id is None
    found = add_noise(replace(bare, body_id=ping.body_id), SELF_NOISE, 1)
    np.testing.assert_array_equal(
        found.body_id, np.where(ping.intensity < np.float32(LEVEL), 0, ping.body_id)
    )
    assert found.share is None and found.shadow is None
    strong = replace(ping, intensity=np.ones_like(ping.intensity))
    assert (
        without_hidden_labels(strong, receiver_power(strong, SELF_NOISE)) is strong
    )  # nothing is hidden, nothing copied


def test_labels_that_may_be_written_and_lie_otherwise_in_memory():
    ping = labelled_ping()
    other = replace(ping, body_id=np.array(ping.body_id, np.int64), share=np.asfortranarray(ping.share))
    assert_labels_above(add_noise(other, SELF_NOISE, 1), other, LEVEL)
    assert other.share.flags.writeable  # still the caller's


@pytest.mark.parametrize("n_beams, n_bins", [(1, 1), (1, 7), (5, 1)])
def test_pings_of_one_beam_or_bin(n_beams, n_bins):
    ping = labelled_ping(n_beams, n_bins, common_noise_db=-30.0, **sg.Acoustics.physical().meta())
    power = receiver_power(ping, SELF_NOISE)
    for factor, is_labelled in ((1.01, True), (0.99, False)):
        one = replace(ping, intensity=power * np.float32(factor))
        assert ((add_noise(one, SELF_NOISE, 0).body_id > 0) == is_labelled).all()


@pytest.mark.parametrize("lacks", ["sonar", "acoustics"])
def test_a_ping_without_sonar_or_acoustics(lacks):
    """Without acoustics there is no TVG; without a sonar the level of self-noise is unknown, as without labels."""
    ping = replace(labelled_ping(**sg.Acoustics.physical().meta()), **{lacks: None})
    if lacks == "sonar":
        with pytest.raises(sg.Error, match="must have a sonar for the level of its self-noise"):
            add_noise(ping, SELF_NOISE, 1)
        ping = replace(ping, acoustics=None)
    ambient = sg.Noise(ambient_db=10 * math.log10(LEVEL))
    assert_labels_above(add_noise(ping, ambient, 1), ping, LEVEL)


def test_noise_of_a_ping_that_was_saved(tmp_path):
    ping = labelled_ping()
    sonar = sg.load_sonar("p900-45,n_beams=16,n_bins=256")
    ping = replace(ping, sonar=replace(sonar, self_noise_db=-30.0))
    with sg.Simulator(sg.load_scene("pylon"), ping.sonar, sampling=sg.Sampling(2, 60)) as simulator:
        quiet = simulator.ping(sg.load_scene("pylon").sonar_pose, labels=True)
        noisy = simulator.ping(sg.load_scene("pylon").sonar_pose, SELF_NOISE, 1, labels=True)
    sg.save_npz(tmp_path / "quiet.npz", quiet)
    again = add_noise(sg.load_npz(tmp_path / "quiet.npz"), SELF_NOISE, 1)
    assert (noisy.body_id > 0).sum() < (quiet.body_id > 0).sum()
    for name in ("intensity", *PER_BIN):
        np.testing.assert_array_equal(getattr(again, name), getattr(noisy, name))
    assert again.meta == noisy.meta
