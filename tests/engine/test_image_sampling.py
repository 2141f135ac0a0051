"""The rules by which image sources are sampled, for made-up pings."""

from types import SimpleNamespace

import numpy as np
import pytest

from sonar_gl.beamform.beamformer import BeamEcho
from sonar_gl.engine.image_sampling import PINGS_BEFORE_FINER, ImageSampling, MultipathEcho
from sonar_gl.engine.multipath import COARSEST, BodySamples
from sonar_gl.raster.views import MAX_CHOSEN_SAMPLES

TOLERANCE, MANY = 0.05, 1e9


def echo_of(halvings, rows=100.0, difference=0.0, on_image=MANY, n_samples=1000):
    """Return an echo with as much multipath as direct echo, of one body.

    Parameters
    ----------
    rows : of `ImageSourceSamples`
    difference : of the multipath from 1, relative
    on_image : samples on the body as images see it
    n_samples : of the sonar's own view, however rows are halved
    """
    multipath, direct = (BeamEcho(np.full((1, 1), one, np.float32), one) for one in (1 + difference, 1.0))
    seen, imaged = (BodySamples(np.array([n]), np.array([1.0])) for n in (MANY, on_image))
    own = SimpleNamespace(fan=SimpleNamespace(n_samples=n_samples))
    images = SimpleNamespace(halvings=halvings, rows=rows, direct=seen, expected=seen, imaged=imaged, own=own)
    return MultipathEcho(images, multipath, direct, 0.5 * TOLERANCE)


def reviewed(halvings, coarser=True, **more) -> int:
    """Return how often rows are halved after a ping that follows no other, compared with one of half as many rows."""
    difference = more.pop("difference", 0.0)
    sampling, echo = ImageSampling(TOLERANCE, each_alone=True), echo_of(halvings, **more)
    sampling.begin_alone()
    sampling.review(echo, echo_of(COARSEST, 50.0, difference) if coarser else None)
    return sampling.choice.halvings


def test_of_more_samples_than_the_direct_echo_has_the_whole_error_counts():
    """Else 0.7 of it, as that of the direct echo beside has room."""
    errors = [
        echo_of(halvings).error_against(echo_of(halvings + 1, 50.0, 0.1)).error
        for halvings in (1, 0, -1, -3, -5)
    ]
    np.testing.assert_allclose(np.divide(errors, errors[-1]), [0.7, 0.7, 1, 1, 1], rtol=1e-12)


@pytest.mark.parametrize(("own", "chosen"), [(3, 2), (1, 0), (0, -2), (-1, -3), (-2, -4), (-3, -5)])
def test_a_comparison_asks_for_twice_the_samples_and_of_more_than_the_direct_echo_for_four_times(own, chosen):
    """However many the error asks for: estimates from few samples are rough."""
    assert reviewed(own, difference=1.0) == chosen
    assert reviewed(own) >= own  # there is no error


def test_a_step_ends_where_no_more_samples_fit():
    n_samples = MAX_CHOSEN_SAMPLES // 2  # four times as many as of the direct echo, or 2^-halvings
    assert reviewed(-2, difference=1.0, n_samples=n_samples) == -3


def test_few_samples_on_what_images_see_end_the_halvings():
    """20 of them err by 0.27, more than the tolerance of the whole echo, 0.1, and less than a body's own may, 0.5."""
    assert reviewed(0) == COARSEST
    assert reviewed(0, on_image=20.0) == 0
    assert reviewed(0, on_image=5.0) == -2


def test_only_a_comparison_asks_for_more_samples_than_those_of_the_direct_echo():
    assert reviewed(COARSEST, coarser=False, on_image=5.0) == 0
    assert reviewed(0, coarser=False, on_image=5.0) == 0


def test_as_a_sonar_moves_samples_get_finer_by_one_halving_at_a_time():
    """Four times as many in each of some pings took eighty times the median. Coarser ones do not wait."""
    sampling, coarser = ImageSampling(TOLERANCE, each_alone=False), echo_of(COARSEST, 50.0, 1.0)
    sampling.begin(check=False, n_samples=1000)
    sampling.review(echo_of(1), coarser)
    used = []
    for _ in range(PINGS_BEFORE_FINER + 5):
        used.append(sampling.begin(check=False, n_samples=1000))
        sampling.review(echo_of(used[-1]), coarser)
    assert used == [0] + [-1] * (PINGS_BEFORE_FINER + 1) + [-2] * 3
    sampling.review(echo_of(-2), echo_of(COARSEST, 50.0))  # without a difference, and so without an error
    assert sampling.begin(check=False, n_samples=1000) == COARSEST
    used = []
    sampling.review(echo_of(-2), coarser)
    for n_samples in (1000, 1000, 1999, 8000):
        used.append(sampling.begin(check=False, n_samples=n_samples))
        sampling.review(echo_of(used[-1]), coarser)
    assert used == [2, 2, 2, 3]
