"""Objects that hold threads, ports or graphics memory until they are closed."""

from __future__ import annotations

from typing import TypeVar

from sonar_gl.core.errors import Error

Own = TypeVar("Own", bound="Closable")


class Closable:
    """An object that a `with` block closes at its end, and that cannot be copied or pickled."""

    def close(self) -> None:
        """Give back what it holds."""
        raise NotImplementedError

    def __enter__(self: Own) -> Own:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    def __reduce__(self):  # in place of what copy and pickle say of a lock
        raise Error(
            f"a {type(self).__name__} cannot be copied or pickled, since its threads and memory belong to it and to "
            "its process; make another one with the same arguments"
        )
