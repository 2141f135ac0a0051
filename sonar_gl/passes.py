"""A scene drawn and summed with one sampling, and the samplings of a run."""

from __future__ import annotations

import numpy as np

from sonar_gl.acoustics import Acoustics
from sonar_gl.fan import Sampling, rung_sampling
from sonar_gl.gpu import SceneOnGpu
from sonar_gl.hearing import Hearing
from sonar_gl.lattice import SHEAR
from sonar_gl.lookup import lookup
from sonar_gl.plumes import screen
from sonar_gl.render import Renderer
from sonar_gl.sonar import Sonar

KEPT = 6  # what is in use, the half of it, and what a search for others tries


class Views(list):
    """(sector, (R, C, 4) plane and echo, (R, C) body) of each sector of a ping; `bubbles` and `background`.

    bubbles : of `plumes.screen`, which has weakened the echo behind them, or None
    gain : (K,) float32 in the ping's own water, or None
    background : Views of some bodies alone, or None
    """

    def __init__(self, views, bubbles=None, gain=None):
        super().__init__(views)
        self.bubbles, self.gain, self.background = bubbles, gain, None


class Pass(Hearing):
    """The depth + normal pass of a fan and the sums over its samples; owns what both use again.

    Attributes
    ----------
    renderer

    Raises
    ------
    Error
        if the samples do not fit the driver's limits.
    """

    def __init__(
        self, gpu: SceneOnGpu, sonar: Sonar, acoustics: Acoustics, sampling, shear=SHEAR, widest=0.5
    ):
        super().__init__(sonar, acoustics, sampling, shear, widest)
        self.renderer = Renderer(gpu.context, gpu, self.fan, acoustics.specular)

    def views(self, pose, labels: bool = False, whole: bool = False, where=None) -> Views:
        """Draw from `pose`; see `Renderer`."""
        self.renderer.render([pose], [where], labels, whole)
        return self._behind_bubbles([pose], [where])[0]

    def views_of(self, poses, wheres, labels: bool = False, planes=None) -> list[Views]:
        """The same of several poses, drawn at once; none of it is written to by the next drawing."""
        self.renderer.turn()
        self.renderer.render(poses, wheres, labels, planes=planes)
        return self._behind_bubbles(poses, wheres)

    def last_views(self) -> list[list]:
        """The views of each of the poses that were drawn last."""
        n, views = len(self.fan.sectors), list(self.renderer.views())
        return [views[k : k + n] for k in range(0, len(views), n)]

    def _behind_bubbles(self, poses, wheres) -> list[Views]:
        """What was drawn last, of each pose as its plumes let it be heard."""
        out = []
        for drawn, views, pose, where in zip(
            self.renderer.drawn, self.last_views(), poses, wheres, strict=True
        ):
            heard = None
            if where is not None and where.bubbles is not None:
                heard = screen(lookup(drawn), where.bubbles, pose, self.fan)
            out.append(Views(views, heard, where and where.gain))
        return out

    def gain_of(self, views: Views) -> np.ndarray:
        """(K,) float32 of a ping."""
        return self.gain if views.gain is None else views.gain

    def intensity(self, views: Views) -> np.ndarray:
        """(B, K) float32, of surfaces and bubbles, with the gain."""
        gain = self.gain_of(views)
        out = self.reducer.intensity(views, gain)
        if views.bubbles is not None:
            whole = self.reducer.total
            out += self.reducer.sum_points(views.bubbles, gain, not self.box)
            self.reducer.total += whole
        return out


class Passes:
    """The passes of a run by their sampling: the last few are kept.

    Parameters
    ----------
    gpu, sonar, acoustics : as for `Pass`
    widest : of `make_fan`

    Attributes
    ----------
    drawn : of `Acoustics.drawn_sonar`
    """

    def __init__(self, gpu: SceneOnGpu, sonar: Sonar, acoustics: Acoustics, widest: float = 0.5):
        self.gpu, self.sonar, self.acoustics, self.widest = gpu, sonar, acoustics, widest
        self.drawn = acoustics.drawn_sonar(sonar)
        self.kept: dict[tuple, Pass] = {}

    def of(self, sampling: Sampling, shear: float = SHEAR) -> Pass:
        """The pass of a sampling and a shear; its context must be current."""
        key = sampling, shear
        made_of = self.gpu, self.sonar, self.acoustics, sampling, shear, self.widest
        found = self.kept.pop(key, None) or Pass(*made_of)
        self.kept[key] = found  # the last one used is last
        while len(self.kept) > KEPT:
            self.kept.pop(next(iter(self.kept))).reducer.close()
        return found

    def warm(self):
        """Have shaders and sums compiled, which happens when first used, so that all pings cost alike."""
        few = Pass(self.gpu, self.sonar, self.acoustics, rung_sampling(self.sonar, 180.0))
        few.intensity(few.views(np.eye(4), whole=True))
        few.reducer.close()

    def close(self):
        """End the reducers' threads."""
        for one in self.kept.values():
            one.reducer.close()


class Fixed:
    """Samples that were given: nothing to choose, nothing promised.

    Attributes
    ----------
    now : the Pass that made the last ping, or will make the next
    plan, tolerance : None
    """

    plan = tolerance = warning = None

    def __init__(self, passes: Passes, sampling: Sampling):
        self.now = passes.of(sampling)

    def sense(self, pose, labels: bool, where=None, look: bool = False):
        """(views, intensity) of a ping."""
        views = self.now.views(pose, labels, where=where)
        return views, self.now.intensity(views)

    def fix(self, spots):
        """Nothing: they are."""

    def due(self, pose, where=None):
        """No: nobody looks."""
        return False

    def changed(self, whole):
        """No."""
        return False

    def estimate(self, pose):
        """None: nobody looks."""
