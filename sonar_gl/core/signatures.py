"""What `help` and editors show of the arguments of a class."""

import inspect
from typing import TypeVar

Class = TypeVar("Class", bound=type)  # as `type` alone, type checkers would lose the class that is decorated


def shown_by_fields(cls: Class) -> Class:
    """Have a dataclass with a `__new__` of its own show its fields as arguments, not those of `__new__`.

    >>> from dataclasses import dataclass
    >>> @shown_by_fields
    ... @dataclass
    ... class Level:
    ...     level_db: float = 0.0
    ...     def __new__(cls, *arguments, **fields):
    ...         return super().__new__(cls)
    >>> list(inspect.signature(Level).parameters)
    ['level_db']
    """
    _, *parameters = inspect.signature(cls.__init__).parameters.values()
    cls.__signature__ = inspect.Signature(parameters)
    return cls
