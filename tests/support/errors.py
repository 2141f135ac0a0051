"""What tests ask of errors."""

import pytest

from sonar_gl.core.errors import Error


def error_of(call, *arguments, **named) -> str:
    """Return the message of the Error that a call raises."""
    with pytest.raises(Error) as caught:
        call(*arguments, **named)
    return str(caught.value)
