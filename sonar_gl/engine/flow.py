"""What flows along the pipeline of a ping: request -> setup -> drawn -> received -> Ping."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.beamform.beamformer import BeamEcho
from sonar_gl.beamform.labels import Labels
from sonar_gl.engine.multipath import ImageSourceSamples
from sonar_gl.engine.provenance import SampleOrigin
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.stage import WHOLE, Coverage, Stage
from sonar_gl.scene.state import SceneState
from sonar_gl.sonar.samples import ViewSamples
from sonar_gl.sonar.sampling import WORST_BODY, Sampling


@dataclass(frozen=True, eq=False)
class PingSetup:
    """A request, resolved in the scene.

    head_pose : (4, 4) world_from_head, from which the fan is drawn: the request's pose with the tilt of the head
    state : SceneState; None where a host draws
    acoustics : Acoustics in the ping's own water
    gain : (K,) float32 of each bin, linear power: the two-way transmission loss and the TVG
    pulse : weights of the matched filter, (n,) float32; None for a pulse shorter than a bin
    n_bodies : the highest number of a body; those that were added to the scene later have none in this ping
    background : bool by number, from 0 on, for shadows; or None
    surface_z_m : height of the water's surface, metres; None = out of reach
    needs_lobes : the specular lobes are received by themselves, too: speckle spares them
    texture : (n,) reflectivity of bodies in a view that returns the deviation of their texture; None without texture
    n_plumes : those of the scene
    """

    request: PingRequest
    head_pose: np.ndarray
    state: SceneState | None
    acoustics: Acoustics
    gain: np.ndarray
    pulse: np.ndarray | None
    n_bodies: int
    background: np.ndarray | None = None
    surface_z_m: float | None = None
    needs_lobes: bool = False
    texture: np.ndarray | None = None
    n_plumes: int = 0


@dataclass(frozen=True)
class Plan:
    """The samples that were chosen for a tolerance.

    level : sampling level
    error_estimate : the error stays below, in 95 of 100 cases
    worst_body_estimate : the relative error of any body's own echo likewise
    worst_body : number of that body, 0 for none
    met : whether the tolerance is met
    n_samples : samples of the whole fan, with those beyond field of view and aperture
    raised_for : sampling level for which no check has been made, and the estimate was raised; None for that of a check
    """

    sampling: Sampling
    level: int
    error_estimate: float
    worst_body_estimate: float
    worst_body: int
    met: bool
    n_samples: int
    raised_for: int | None = None

    @property
    def bound(self) -> float:
        """The estimated error; if the tolerance is not met, the larger of it and what breaks the promise of a body.

        It is above the tolerance if and only if the plan is not met.
        """
        bodies = 0.0 if self.met else self.worst_body_estimate / WORST_BODY
        return max(self.error_estimate, bodies)


@dataclass(frozen=True, eq=False)
class Resolution:
    """How finely a ping is sampled.

    stage : Stage of the direct view
    halvings : how often rows are halved for image sources; None without any, and until that is chosen
    check : the error of this ping is to be estimated
    is_final : the ping is good whatever a check would say: these samples have just been chosen for it
    finer_images : image sources alone are to be drawn once more, since they were sampled too coarsely
    plan : Plan of this ping, if its samples were chosen from it alone; or None
    """

    stage: Stage
    halvings: int | None = None
    check: bool = False
    is_final: bool = False
    finer_images: bool = False
    plan: Plan | None = None


class FurtherViews(NamedTuple):
    """Views from the pose of a ping beside that of the whole scene; None where the ping does not need one.

    background : the background bodies alone, for shadows
    lobes : returns the specular lobes alone
    texture : returns the deviation of the texture, and lobes
    """

    background: ViewSamples | None = None
    lobes: ViewSamples | None = None
    texture: ViewSamples | None = None


class FurtherStates(NamedTuple):
    """The SceneState of each of FurtherViews, or None."""

    background: SceneState | None = None
    lobes: SceneState | None = None
    texture: SceneState | None = None

    @property
    def needed(self) -> list[SceneState]:
        """Those that are not None, in their order."""
        return [state for state in self if state is not None]

    def drawn(self, views: Iterator[ViewSamples]) -> FurtherViews:
        """Return the views of these states, which it takes from `views` in their order."""
        return FurtherViews(*[None if state is None else next(views) for state in self])


NO_FURTHER_VIEWS = FurtherViews()


@dataclass(frozen=True, eq=False)
class DrawnPing:
    """The samples of a ping.

    view : ViewSamples of the sonar
    images : ImageSourceSamples; None without multipath
    """

    setup: PingSetup
    resolution: Resolution
    view: ViewSamples
    images: ImageSourceSamples | None = None
    further: FurtherViews = NO_FURTHER_VIEWS

    @cached_property
    def coverage(self) -> Coverage:
        """As of `Stage.coverage`; first asked for while the samples are valid."""
        return self.resolution.stage.coverage(self.view)


@dataclass(frozen=True, eq=False)
class ReceivedPing:
    """The echo of a ping in beams and bins.

    direct : BeamEcho of surfaces and bubbles
    multipath : BeamEcho by way of planar reflectors; None without any
    labels : Labels, or None
    volume : BeamEcho of the water itself; None in clear water
    surface : BeamEcho of the water's surface; None if it scatters nothing, or is out of reach
    lobes : BeamEcho of the specular lobes, a part of `direct`; None where the ping does not need them
    texture : BeamEcho of the texture's deviation, with lobes; None where the ping does not need it
    coverage : Coverage
    """

    drawn: DrawnPing
    direct: BeamEcho
    multipath: BeamEcho | None = None
    labels: Labels | None = None
    volume: BeamEcho | None = None
    surface: BeamEcho | None = None
    lobes: BeamEcho | None = None
    texture: BeamEcho | None = None
    coverage: Coverage = WHOLE

    @property
    def of_water(self) -> list[BeamEcho]:
        """Echoes of no body, beside which weaker bodies have no labels: those of the water and of its surface."""
        return [echo for echo in (self.volume, self.surface) if echo is not None]

    @property
    def others(self) -> list[BeamEcho]:
        """All echoes but the direct one, in the order in which they are added to it."""
        return self.of_water if self.multipath is None else [self.multipath, *self.of_water]

    @property
    def total(self) -> float:
        """The sum of the echo of surfaces, bodies' and the water's, and bubbles, also by way of reflectors."""
        others = self.multipath, self.surface
        return self.direct.total + sum(echo.total for echo in others if echo is not None)


class PingReport(NamedTuple):
    """What a ping tells beside its echo.

    error_estimate : estimated error; None without one
    no_echo : why there is no echo; None if there is one, or where several pings before it have been explained
    """

    origin: SampleOrigin
    error_estimate: float | None
    no_echo: str | None
