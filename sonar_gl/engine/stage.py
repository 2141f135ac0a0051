"""The renderer and the beamformer of one sampling, and a cache of the few that a run uses."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from sonar_gl.acoustics.acoustics import Acoustics
from sonar_gl.beamform.beamformer import Beamformer, beam_shape, make_beamformer
from sonar_gl.beamform.bubbles import BubbleShadow, attenuate, find_echoes, find_shadow
from sonar_gl.beamform.kernels.views import view_index
from sonar_gl.beamform.workspace import Workspace
from sonar_gl.core.memory import ArrayPools, return_free_memory
from sonar_gl.core.worker import SecondThread
from sonar_gl.raster.engine import RasterEngine, Renderer
from sonar_gl.raster.views import MAX_SAMPLES, RenderWorkspace
from sonar_gl.sonar.fan import USUAL_WIDTHS, BeamShape, ColumnWidths, Fan, fitted_sampling
from sonar_gl.sonar.samples import ViewSamples
from sonar_gl.sonar.sampling import Sampling
from sonar_gl.sonar.sector import SHEAR
from sonar_gl.sonar.sonar import Sonar

MAX_STAGES = 48  # the levels of pings that choose their samples alone, of image sources at each halving
MAX_BYTES = 40e6  # of tables in all stages but the last two
# The memory of views is given back where so many in a row have so many times fewer samples than the largest before.
KEPT_VIEWS, MUCH_FEWER = 100, 4
EMPTY_SAMPLE = 0.37  # time of a sample that is drawn and met nothing, relative to one that met a body


class Coverage(NamedTuple):
    """What of a view takes time.

    share : of the fan's samples: those that met a body, and a little of the others that were drawn
    n_faces : that were drawn
    """

    share: float
    n_faces: int


WHOLE = Coverage(1.0, 0)  # of a view of which nothing is known


@dataclass(frozen=True, eq=False)
class Stage:
    """Draws and sums with one sampling; holds what every ping uses again.

    sampling : as asked for; `beamformer.fan.sampling` covers the whole aperture
    renderer : Renderer; None where a host draws
    """

    sampling: Sampling
    beamformer: Beamformer
    renderer: Renderer | None = None

    @property
    def fan(self) -> Fan:
        """The fan with these samples."""
        return self.beamformer.fan

    def draw(
        self,
        poses: Sequence,
        states: Sequence,
        with_bodies: bool = False,
        planes: Sequence | None = None,
        keep_last: bool = False,
    ) -> list[ViewSamples]:
        """Draw the views of some poses, attenuated behind bubbles; parameters as for `Renderer.render`."""
        views = self.renderer.render(poses, states, with_bodies, planes=planes, keep_last=keep_last)
        shadows, out = {}, []
        for view, pose, state in zip(views, poses, states, strict=True):
            bubbles = None if state is None else state.bubbles
            if bubbles is not None:
                key = id(bubbles), id(pose)  # further views of a ping have the same
                if key not in shadows:
                    shadows[key] = find_shadow(bubbles, pose, self.fan)
                view = with_bubbles(view, shadows[key])
            out.append(view)
        return out

    def coverage(self, view: ViewSamples) -> Coverage:
        """Return what of a view takes time; first asked for while its samples are valid."""
        n_counted = view.n_met + EMPTY_SAMPLE * (view.n_samples - view.n_met)
        return Coverage(n_counted / self.fan.n_samples, view.n_faces)


def with_bubbles(view: ViewSamples, shadow: BubbleShadow | None) -> ViewSamples:
    """Return a view attenuated behind bubbles, in place, and with their echoes."""
    index = view_index(view)
    attenuate(index, view.face_id, shadow)
    return replace(view, bubbles=find_echoes(index, shadow))


class StageCache:
    """The stages of a run by their sampling; the last few are kept. They share the memory that pings are drawn into.

    The samples of one stage stay valid until another one of the same shear draws, as if it were the same stage.

    engine : RasterEngine that draws
    sonar, acoustics, thread : of the run
    widths : of `make_fan`
    pools : of the arrays of pings, to share with other caches
    most_samples : of a view; more raise a SampleLimitError
    """

    def __init__(
        self,
        engine: RasterEngine,
        sonar: Sonar,
        acoustics: Acoustics,
        thread: SecondThread | None = None,
        widths: ColumnWidths = USUAL_WIDTHS,
        pools: ArrayPools | None = None,
        most_samples: int = MAX_SAMPLES,
    ):
        self.engine, self.sonar, self.acoustics, self.most_samples = engine, sonar, acoustics, most_samples
        self._thread, self._widths = thread, widths
        self._workspace = Workspace(pools)
        # by shear: the samples of both lattices are compared, so that neither may overwrite those of the other
        self._render_workspaces: dict[float, RenderWorkspace] = {}
        self._stages: dict[tuple, Stage] = {}
        # samples of the last views, and of the largest one whose memory is kept
        self._recent, self._room = deque(maxlen=KEPT_VIEWS), 0

    @property
    def pools(self) -> ArrayPools:
        """The pools of arrays that pings return."""
        return self._workspace.pools

    @cached_property
    def _beams(self) -> BeamShape:
        return beam_shape(self.sonar, self.acoustics)

    def stage(self, sampling: Sampling, shear: float = SHEAR) -> Stage:
        """Return the stage of a sampling and a shear of the lattice; inside `drawing`.

        Raises Error if there are more samples than fit.
        """
        key = sampling, shear
        if (found := self._stages.pop(key, None)) is not None:
            self._stages[key] = found  # the last one used is last
            return found
        made = self._stages[key] = self.make(sampling, shear)
        n_bytes = sum(stage.beamformer.n_bytes for stage in self._stages.values())
        while len(self._stages) > MAX_STAGES or (len(self._stages) > 2 and n_bytes > MAX_BYTES):
            n_bytes -= self._stages.pop(next(iter(self._stages))).beamformer.n_bytes
        return made

    def fitted(self, sampling: Sampling, shear: float = SHEAR) -> Sampling:
        """Return about as many samples, as wide as whole columns; see `fitted_sampling`."""
        return fitted_sampling(self.sonar, sampling, self._beams, shear, self._widths)

    def settle(self, n_samples: int, may_drop: bool = True) -> None:
        """Note how many samples a view has; give back the memory of larger ones if many in a row have far fewer.

        Each could give it back, but a view that has as many again would take the time to get it anew.

        may_drop : now; otherwise one of the next views gives it back
        """
        self._recent.append(n_samples)
        most = max(self._recent)
        if may_drop and MUCH_FEWER * most < self._room:
            self.drop_large()
            self._room = most
        self._room = max(self._room, most)

    def drop_large(self) -> None:
        """Give back the memory of large render targets, and what was freed; samples that were drawn stay valid."""
        for workspace in self._render_workspaces.values():
            workspace.drop_large()
        self.engine.collect()
        return_free_memory()

    def make(self, sampling: Sampling, shear: float = SHEAR) -> Stage:
        """Return a new stage, which is not kept."""
        beamformer = make_beamformer(
            self.sonar, self.acoustics, sampling, self._thread, shear, self._widths, self._workspace
        )
        if shear not in self._render_workspaces:
            beside = next(iter(self._render_workspaces.values()), None)
            self._render_workspaces[shear] = self.engine.make_workspace(self.most_samples, beside)
        renderer = self.engine.make_renderer(
            beamformer.fan, self.acoustics.specular, self._render_workspaces[shear], self._thread
        )
        return Stage(sampling, beamformer, renderer)
