"""A page in the browser that shows a scene and the pings of a sonar in it, and moves the sonar."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np

from sonar_gl.core.checks import check_function, check_kind, check_whole_number
from sonar_gl.core.closing import Closable
from sonar_gl.core.errors import Error
from sonar_gl.core.hosts import is_local
from sonar_gl.core.listeners import Listener
from sonar_gl.core.load_numba import load_numba
from sonar_gl.core.pose_track import PoseTrack
from sonar_gl.core.poses import read_poses
from sonar_gl.core.warn import warn_caller
from sonar_gl.live.command_line import SceneSource
from sonar_gl.live.output import DEFAULT_FOLDER
from sonar_gl.live.session import LiveSession
from sonar_gl.live.settings import LiveSettings
from sonar_gl.live.view.page import ViewerPage, load_viser
from sonar_gl.ping import Ping
from sonar_gl.scene.load import load_scene
from sonar_gl.scene.scene import Scene
from sonar_gl.scene.sonar_sensor import DEFAULT_SONAR
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import load_sonar

PORT = 8080
WAIT_S = 0.2  # between looks at whether a callback has failed


class LiveView(Closable):
    """A page and the session behind it. Use it in a `with` block, or call `close()`.

    Raises Error if the extra `live` is missing, or the page cannot listen there.

    Parameters
    ----------
    session : LiveSession, which is closed with the page
    host, port : to listen at; if the port is taken, the page takes another
    on_ping : function (Ping), called with each ping in a thread of its own; None for none
    """

    def __init__(
        self, session: LiveSession, host: str, port: int, on_ping: Callable[[Ping], None] | None = None
    ):
        self.session = session
        self._listener: Listener | None = None
        with ExitStack() as opened:
            opened.callback(session.close)
            with suppress(Error):  # then of read-outs, which say so in the page
                # compiles what only read-outs take, once after an installation: later the page would stand still
                session.reading(session.frame, 0, 0)
            try:
                self._page = ViewerPage(session, host, port)
            except OSError as why:
                raise Error(
                    f"the page must be able to listen at {host}:{port} (got {why.strerror or why}; is another program "
                    "using the port?)"
                ) from None
            opened.callback(self._page.close)
            if on_ping is not None:
                self._listener = session.listen(lambda frame: on_ping(frame.ping))
            opened.pop_all()

    @property
    def url(self) -> str:
        """Address of the page."""
        return self._page.url

    def wait(self, duration_s: float | None = None) -> None:
        """Wait until Ctrl-C, the end of the session, or so many seconds; raise what `on_ping` has raised."""
        left_s = np.inf if duration_s is None else duration_s
        try:
            while left_s > 0:
                if self._listener is not None and self._listener.is_closed:
                    break
                # in short steps, since Ctrl-C does not end a long wait on all systems
                step_s = min(WAIT_S, left_s)
                if self.session.wait_closed(step_s):
                    break
                left_s -= step_s
        except KeyboardInterrupt:
            pass
        if self._listener is not None and self._listener.failure is not None:
            raise self._listener.failure

    def close(self) -> None:
        """Close the page and the session; a second call does nothing."""
        self._page.close()
        self.session.close()

    def __repr__(self):
        return f"<LiveView at {self.url}{', closed' if self.session.wait_closed(0) else ''}>"


def warn_of_host(host: str) -> None:
    """Warn of an address that other machines may reach."""
    if not is_local(host):
        warn_caller(f"any machine that reaches {host} can see this page, and move its sonar")


def view(
    scene: Scene | str | Path,
    sonar: Sonar | str | None = None,
    pose: np.ndarray | str | Path | None = None,
    on_ping: Callable[[Ping], None] | None = None,
    host: str = "127.0.0.1",
    port: int = PORT,
    folder: str | Path = DEFAULT_FOLDER,
    block: bool = True,
    **settings,
) -> LiveView:
    """Open a page that shows a scene and the pings of a sonar in it. Needs the extra `live`.

    Parameters
    ----------
    scene : Scene, or a text of `load_scene`
    sonar : Sonar, or a text of `load_sonar`; None for the scene's, or else preset p900-45
    pose : (4, 4) world_from_sonar; or the path of a file of poses, a trajectory; None for the scene's
    on_ping : function (Ping), not async, called with each ping in a thread of its own. A slow one misses pings. Pings
        are made only while a browser is there, or a function
    host, port : to listen at; other machines can reach addresses other than 127.0.0.1. If the port is taken, the page
        takes another
    folder : of the files that the page writes
    block : whether to return only after Ctrl-C; a notebook says False, and closes the view that it gets, also before
        its cell runs again: a view stays open when nothing refers to it any more
    settings : fields of `sonar_gl.live.settings.LiveSettings`, such as range_m=20.0, tolerance=0.02 or noise="none"

    Returns
    -------
    LiveView, which is closed if `block`

    Raises
    ------
    Error
        if the extra is missing, or an argument is wrong. Exceptions of `on_ping` are raised again if `block`.
    """
    load_numba()
    if on_ping is not None:
        check_function("on_ping", on_ping, "a Ping")
    check_kind("host", host, str, "such as 127.0.0.1, which this machine alone reaches")
    check_whole_number("port", port, 0, 65535)  # viser would wait for ever at another
    name = None if isinstance(scene, Scene) else str(scene)
    scene = scene if name is None else load_scene(scene)
    text = sonar if isinstance(sonar, str) else None
    if not isinstance(sonar, Sonar):
        sonar = scene.sonar or load_sonar(DEFAULT_SONAR) if sonar is None else load_sonar(sonar)
    source = None if name is None else SceneSource(name, sonar=text, loaded=None if text is None else sonar)
    track = None
    if isinstance(pose, (str, Path)):
        times_s, poses = read_poses(pose)
        track, pose = PoseTrack(poses, times_s), None
    wanted = LiveSettings(sonar).changed(**settings)
    load_viser()  # after the user's mistakes, and before the first ping
    warn_of_host(host)
    opened = LiveView(LiveSession(scene, wanted, pose, track, folder, source), host, port, on_ping)
    if block:
        with opened, suppress(KeyboardInterrupt):  # which may come before `wait` has begun
            print(f"the page is at {opened.url}; Ctrl-C ends it")
            opened.wait()
    return opened
