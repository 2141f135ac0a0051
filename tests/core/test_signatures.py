"""What `help` and editors show of the arguments of public classes."""

import inspect
from dataclasses import fields, is_dataclass

import pytest

import sonar_gl as sg

DATACLASSES = [name for name in sg.__all__ if is_dataclass(getattr(sg, name))]


@pytest.mark.parametrize("name", DATACLASSES)
def test_dataclasses_show_their_fields(name):
    shown = inspect.signature(getattr(sg, name)).parameters
    assert list(shown) == [field.name for field in fields(getattr(sg, name)) if field.init]
