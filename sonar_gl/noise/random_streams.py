"""Independent streams of random numbers, one for each noise term of each ping."""

from __future__ import annotations

import numpy as np

from sonar_gl.core.checks import check_whole_number

# Stream numbers are part of every noisy ping's bytes: never renumber them.
STREAMS = {
    "speckle": 1,
    "gaussian": 2,
    "salt_and_pepper": 3,
    "cloud": 4,
    "texture": 5,
    "receiver": 6,
    "interference": 7,
    "dropped_beams": 8,
    "scatterers": 9,
}


def stream(seed: int, ping_number: int, term: str, *more: int) -> np.random.Generator:
    """Return the random generator of one noise term of one ping.

    Streams are independent, so switching a term on or off leaves the numbers of the others as they are.

    seed, ping_number : whole numbers, 0 or more
    term : a key of `STREAMS`
    more : whole numbers, 0 or more, that select a stream within the term

    >>> bool(stream(7, 0, "speckle").random() == stream(7, 0, "speckle").random())
    True
    """
    key = check_whole_number("ping_number", ping_number), STREAMS[term], *more
    sequence = np.random.SeedSequence(check_whole_number("seed", seed), spawn_key=key)
    return np.random.Generator(np.random.SFC64(sequence))
