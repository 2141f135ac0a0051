"""The state of a scene in one ping: where bodies and bubbles are, and what bodies reflect at most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from sonar_gl.scene.scene import Body


@dataclass(frozen=True, eq=False)
class SceneState:
    """The poses of a scene's n bodies, which of them are present, and the bubbles, in one ping.

    poses : (n, 4, 4) float64 world_from_body
    present : (n,) bool
    bubbles : (m, 4) x, y, z in the world and radius, metres, of the bubbles of all plumes; None without
        plumes
    time_s : time of the ping, seconds; None if it was not given
    reflectivity : (n,) float32, replaces the bodies' own, and multiplies that of bodies with one value per
        face; None leaves them as they are
    """

    poses: np.ndarray
    present: np.ndarray
    bubbles: np.ndarray | None = None
    time_s: float | None = None
    reflectivity: np.ndarray | None = None

    @cached_property
    def echo_hash(self) -> int:
        """A hash of what determines the echo: where bodies and bubbles are, and what bodies reflect."""
        arrays = self.present, self.poses, self.reflectivity, self.bubbles
        # plus 0, since -0.0 has other bytes
        return hash(tuple(None if one is None else (one + 0).tobytes() for one in arrays))

    def only(self, mask: np.ndarray) -> SceneState:
        """Return this state without the bodies for which the (n,) mask is False."""
        return replace(self, present=self.present & mask)

    def with_absent(self, n: int) -> SceneState:
        """Return this state with n more bodies, which are absent."""
        poses = np.concatenate([self.poses, np.tile(np.eye(4), (n, 1, 1))])
        mu = self.reflectivity
        if mu is not None:
            mu = np.append(mu, np.ones(n, mu.dtype))
        return replace(self, poses=poses, present=np.append(self.present, np.zeros(n, bool)), reflectivity=mu)

    def without_diffuse_echo(self) -> SceneState:
        """Return this state with bodies that return their specular lobes alone."""
        return replace(self, reflectivity=np.zeros(len(self.poses), np.float32))

    def is_without_diffuse_echo_of(self, other: SceneState) -> bool:
        """Return whether this is `other.without_diffuse_echo()`, made of the same arrays."""
        is_same = self.poses is other.poses and self.present is other.present
        return is_same and self.reflectivity is not None and not self.reflectivity.any()

    def with_reflectivity(self, reflectivity: np.ndarray) -> SceneState:
        """Return this state with other reflectivity of the (n,) bodies, as the attribute."""
        return replace(self, reflectivity=np.asarray(reflectivity, np.float32))

    def without_bubbles(self) -> SceneState:
        """Return this state without bubbles."""
        return replace(self, bubbles=None)


class GreatestReflectivity(NamedTuple):
    """The greatest reflectivity of any face, of each of n bodies.

    own : (n,) float64, that of the bodies themselves
    per_unit : (n,) float64, that of bodies whose state has 1
    """

    own: np.ndarray
    per_unit: np.ndarray

    @staticmethod
    def of(bodies: Sequence[Body]) -> GreatestReflectivity:
        """Return that of these bodies."""
        own = np.array([np.max(body.reflectivity) for body in bodies], np.float64)
        by_face = np.array([np.ndim(body.reflectivity) > 0 for body in bodies], bool)
        return GreatestReflectivity(own, np.where(by_face, own, 1.0))

    def in_state(self, state: SceneState) -> np.ndarray:
        """Return (n,) float64, with the reflectivity that the state has in place of the bodies' own."""
        return self.own if state.reflectivity is None else self.per_unit * state.reflectivity
