"""Which bodies are the background, on which others throw shadows."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sonar_gl.types import Error, nearest_names


class Background:
    """Bodies of a scene by name, such as its floor and walls.

    Parameters
    ----------
    names : of bodies, exactly
    known : dict from the names of all bodies to their places in the scene

    Raises
    ------
    Error
        if they are no names of bodies.
    """

    def __init__(self, names, known: dict):
        if isinstance(names, str) or not isinstance(names, Iterable):
            raise Error(f"background must be several names of bodies (got {names!r}; make [name] of one)")
        names = [str(name) for name in names]
        for name in names:
            if name not in known:
                hint = nearest_names(name, known) if known else "there are none"
                raise Error(f"background must be bodies of the scene (got {name!r}; {hint})")
        self.places = np.array([known[name] for name in names], int)

    def mask(self, n_bodies: int) -> np.ndarray:
        """(n_bodies + 1,) bool by number."""
        out = np.zeros(n_bodies + 1, bool)
        out[1 + self.places] = True
        return out

    def alone(self, where):
        """Whereabouts without the other bodies."""
        return replace(where, shown=where.shown & self.mask(len(where.shown))[1:])


def labels_of(labels: bool, background, known: dict):
    """What is asked of labels: False, True, or the Background that shadows are looked for on."""
    if background is None:
        return bool(labels)
    if not labels:
        raise Error("background must come with labels=True (got labels=False; shadows are labels)")
    return Background(background, known)
