"""Random numbers of a job: each use has a stream of its own, and no draw depends on how many there are of another."""

from __future__ import annotations

import numpy as np

# never renumber: the bytes of data sets would change
VARY_STREAM, NOISE_STREAM, VIEWS_STREAM, CLEARANCE_STREAM, PATH_STREAM = 101, 102, 103, 104, 105


def generator(seed: int, *stream: int) -> np.random.Generator:
    """Return the generator of a stream, which is one of those above, and numbers that part it further."""
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(seed, spawn_key=stream)))


def seed_of(dtype: type[np.unsignedinteger], seed: int, *stream: int) -> int:
    """Return the seed, a number of this type, of what draws in its own way; the stream is as for `generator`."""
    return int(np.random.SeedSequence(seed, spawn_key=stream).generate_state(1, dtype)[0])
