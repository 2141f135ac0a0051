"""Random streams are independent of one another, and the same key gives the same numbers."""

import pytest

from sonar_gl.core.errors import Error
from sonar_gl.noise.noise import add_noise
from sonar_gl.noise.random_streams import STREAMS, stream
from sonar_gl.noise.settings import Noise
from tests.support.even_ping import even_ping


def test_stream_numbers_never_change():
    """Each noisy ping's bytes depend on them."""
    numbers = {"speckle": 1, "gaussian": 2, "salt_and_pepper": 3, "cloud": 4}
    numbers |= {"texture": 5, "receiver": 6, "interference": 7, "dropped_beams": 8}
    assert numbers | {"scatterers": 9} == STREAMS, "add a new stream here, and keep the numbers of the others"


def test_first_numbers_of_streams_never_change():
    assert stream(0, 0, "speckle").bit_generator.random_raw() == 3503594916310552525
    assert stream(7, 3, "texture", 1, 2).bit_generator.random_raw() == 11501054001911140744


def test_each_term_of_a_ping_has_the_stream_of_its_seed_and_number(monkeypatch):
    keys = set()

    def noted(seed, ping_number, term, *further):
        keys.add((seed, ping_number, term))
        return stream(seed, ping_number, term, *further)

    monkeypatch.setattr("sonar_gl.noise.field.stream", noted)
    monkeypatch.setattr("sonar_gl.noise.noise.stream", noted)
    noise = Noise(ambient_db=-60, interference_lines=1, gaussian=0.1, salt_and_pepper=0.1, dropped_beams=0.1)
    for one in (
        noise,
        Noise(speckle=True),
    ):  # speckle and the receiver's noise together are one field, of speckle
        add_noise(even_ping(), one, seed=7, ping_number=3)
    terms = "speckle", "receiver", "interference", "gaussian", "salt_and_pepper", "dropped_beams"
    assert keys == {(7, 3, term) for term in terms}


def test_terms_have_different_streams():
    assert len({stream(5, 0, term).random() for term in STREAMS}) == len(STREAMS)


def test_large_seeds_do_not_collide_with_ping_numbers():
    keys = [(0, 1), (1 << 32, 0), (1 << 32, 1), (1, 0), (0, 1 << 32)]
    assert len({stream(seed, number, "speckle").random() for seed, number in keys}) == len(keys)


def test_seeds_are_whole_numbers():
    with pytest.raises(Error) as caught:
        stream(1.5, 0, "speckle")
    assert str(caught.value) == "seed must be a whole number, 0 or more (got 1.5)"
