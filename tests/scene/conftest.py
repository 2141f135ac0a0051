"""Readers of scenes without the user's environment."""

import os
import warnings

import pytest

from sonar_gl.core.errors import Error
from sonar_gl.scene.sdf.reader import read_sdf
from sonar_gl.scene.sdf.resources import SEARCH_PATHS
from tests.support.sdf_texts import write


@pytest.fixture(autouse=True)
def no_environment(monkeypatch, tmp_path):
    """Readers of scenes find nothing by the variables of the shell or in the user's home."""
    for key in (*SEARCH_PATHS, "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(key, raising=False)
    monkeypatch.setenv("GZ_FUEL_CACHE_PATH", str(tmp_path / "gz"))
    monkeypatch.setenv("IGN_FUEL_CACHE_PATH", str(tmp_path / "ign"))


@pytest.fixture
def read_text(tmp_path):
    """A function that reads a world with these elements; warnings are errors unless a test catches them."""

    def read(inside, world=True, **options):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return read_sdf(write(tmp_path / "a.sdf", inside, world), **options)

    return read


@pytest.fixture
def message_of(tmp_path):
    """A function that returns the error message of a world with these elements, without the folder."""

    def message(inside, world=True, **options):
        with pytest.raises(Error) as caught:
            read_sdf(write(tmp_path / "a.sdf", inside, world), **options)
        return str(caught.value).replace(f"{tmp_path}{os.sep}", "")

    return message
