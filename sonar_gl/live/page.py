"""The web page of a live session."""

from __future__ import annotations

import contextlib
import io
import socket
import time
from threading import Lock, Thread

from sonar_gl.core.errors import Error
from sonar_gl.core.extras import missing_extra
from sonar_gl.live.frame import LiveFrame
from sonar_gl.live.session import LiveSession
from sonar_gl.live.view.actions import Actions
from sonar_gl.live.view.browser_state import BrowserState
from sonar_gl.live.view.control_panel import CAMERA, KEYS, TRAJECTORY, ControlPanel
from sonar_gl.live.view.ping_panel import PingPanel
from sonar_gl.live.view.scene_nodes import SceneNodes, camera_sonar_pose

STEP_S = 1 / 30  # between two moves of a sonar by keys
KEYS_S = 1.0  # after which held keys count as released, if the browser tells no more of them
PLANE_S = 0.2  # between two pictures in the scene, which cost more than those in the panel


class ViewerPage:
    """Serves the page until it is closed. Several browsers may show it; what one changes, all see.

    Parameters
    ----------
    session : LiveSession, which pings while a browser shows the page
    host : address to listen at
    port : to listen at; 0 for any that is free

    Attributes
    ----------
    url : address of the page

    Raises
    ------
    Error
        if viser is missing, or something else uses the port.
    """

    def __init__(self, session: LiveSession, host: str = "127.0.0.1", port: int = 8080):
        try:
            import viser
        except ImportError as why:
            raise missing_extra("live", f"the page needs viser (got no module {why.name})") from None
        _check_listenable(host, port)
        self._session, self._is_closed = session, False
        with contextlib.redirect_stdout(io.StringIO()):  # a box with its address
            self._server = viser.ViserServer(host=host, port=port, label="sonar-gl view", verbose=False)
        # viser's page may ask its server for a tunnel to a public address; this one never leaves the machine
        self._server.request_share_url = lambda *_, **__: None
        self.url = f"http://{host}:{self._server.get_port()}"
        self._listener, self._frame, self._frame_lock = None, None, Lock()
        self._browsers: dict[int, tuple[BrowserState, float]] = {}
        self._carrier = None  # id of the browser whose camera carries the sonar
        self._mover = KEYS if session.track is None else TRAJECTORY
        self._shown_number, self._plane_at_s, self._pointer = -1, 0.0, None
        self._actions = Actions(self._sync)
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._nodes = SceneNodes(self._server, session, self._actions, self._select, self._click)
        self._ping_panel = PingPanel(self._server, session, self._actions)
        self._controls = ControlPanel(
            self._server, session, self._actions, self._move_by, self._select, self._lay_picture
        )
        self._connect_browsers()
        self._thread = Thread(target=self._serve, name="sonar_gl page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving; browsers keep the last picture. A second call does nothing. The session goes on."""
        if self._is_closed:
            return
        self._is_closed = True
        self._actions.ask(None, None)
        self._thread.join()
        if self._listener is not None:
            self._listener.close()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    # ---- browsers -------------------------------------------------------------------------------------------

    def _connect_browsers(self) -> None:
        server = self._server

        @server.on_client_connect
        async def _(client):
            self._actions.ask(client, lambda: self._welcome(client))

            @client.camera.on_update
            async def _(camera):
                if self._carrier == client.client_id:
                    pose = camera_sonar_pose(camera)
                    self._actions.ask(client, lambda: self._session.set_pose(pose))

        @server.on_client_disconnect
        async def _(client):
            self._actions.ask(None, lambda: self._forget(client))

        @self._ping_panel.browser_state.on_update
        async def _(event):
            if event.client is not None:
                state = BrowserState.read(self._ping_panel.browser_state.value)
                self._actions.ask(event.client, lambda: self._note(event.client_id, state))

    def _welcome(self, client) -> None:
        self._nodes.look_from_behind(client.camera, self._session.pose)
        if self._listener is None:
            self._listener = self._session.listen(self._take)

    def _forget(self, client) -> None:
        self._browsers.pop(client.client_id, None)
        if self._carrier == client.client_id:
            self._carry(None)
        if self._listener is not None and not self._server.get_clients():
            self._listener.close()
            self._listener = None

    def _note(self, client_id: int, state: BrowserState) -> None:
        """Take note of a browser's pointer and keys."""
        before, _ = self._browsers.get(client_id, (BrowserState(), 0.0))
        self._browsers[client_id] = state, time.monotonic()
        if state.pointer is not None or before.pointer is not None:
            self._pointer = state.pointer
            self._read()
        if state.clicked is not None and state.clicks != before.clicks:
            self._click(state.clicked)

    # ---- actions --------------------------------------------------------------------------------------------

    def _move_by(self, client, mover: str) -> None:
        """Choose what moves the sonar."""
        if mover == TRAJECTORY:
            self._session.play()
        elif self._session.state().is_following:
            self._session.set_pose(self._session.pose)
        self._mover = mover
        self._carry(client if mover == CAMERA else None)

    def _carry(self, client) -> None:
        """Have a browser's camera carry the sonar; None for no camera."""
        before = self._carrier
        self._carrier = None
        if client is not None:
            pose = self._session.pose
            client.camera.up_direction = (0.0, 0.0, 1.0)
            client.camera.position = pose[:3, 3]
            client.camera.look_at = pose[:3, 3] + 3.0 * pose[:3, 0]
            self._carrier = client.client_id
        elif before is not None:
            self._mover = KEYS if self._mover == CAMERA else self._mover
            for other in self._server.get_clients().values():
                if other.client_id == before:
                    self._nodes.look_from_behind(other.camera, self._session.pose)
        self._nodes.show_gizmo(self._carrier is None)
        self._ping_panel.switch_keys(self._carrier is None)

    def _select(self, name: str) -> None:
        """Select a body, or none by "" and by the one that is selected."""
        name = "" if name == self._session.highlighted else name
        self._session.highlight(name)
        self._nodes.select(name)

    def _lay_picture(self, visible) -> None:
        self._nodes.shows_picture, self._plane_at_s = bool(visible), 0.0

    def _click(self, place: tuple[float, float]) -> None:
        """Mark the surface whose echo a place of the picture shows, and say what stands there."""
        frame = self._session.frame
        self._pointer = place
        reading = self._read()
        if reading is None:
            self._nodes.highlight(None)
        else:
            self._nodes.highlight(self._session.surface_of(frame, reading.beam, reading.bin), reading.range_m)

    def _read(self):
        """Show what stands under the pointer, and return it."""
        frame, reading = self._session.frame, None
        if self._pointer is not None:
            (right, down), (height, width) = self._pointer, frame.picture.shape[:2]
            reading = self._session.at(
                frame, min(int(down * height), height - 1), min(int(right * width), width - 1)
            )
        self._ping_panel.read(reading)
        return reading

    def _sync(self) -> None:
        self._controls.sync()
        self._controls.show_mover(self._mover)
        self._controls.show_body(self._session.highlighted)

    # ---- the page's thread ----------------------------------------------------------------------------------

    def _take(self, frame: LiveFrame) -> None:
        """Take a frame from the session; the page's thread shows it."""
        with self._frame_lock:
            self._frame = frame
        self._actions.ask(None, None)

    def _serve(self) -> None:
        moved_s = time.monotonic()
        settings = None
        while not self._is_closed:
            self._actions.do(STEP_S)
            now_s = time.monotonic()
            if now_s - moved_s >= STEP_S:
                self._move_by_keys(min(now_s - moved_s, 0.25), now_s)
                moved_s = now_s
            with self._frame_lock:
                frame, self._frame = self._frame, None
            if frame is None:
                continue
            if frame.settings is not settings:
                settings = frame.settings
                self._sync()
            self._show(frame, now_s)

    def _move_by_keys(self, dt_s: float, now_s: float) -> None:
        keys = {
            key for state, told_s in self._browsers.values() if now_s - told_s < KEYS_S for key in state.keys
        }
        if keys and self._carrier is None:
            self._session.move(
                keys, dt_s, self._controls.steps.speed_m_s, self._controls.steps.turn_rate_rad_s
            )
            if self._mover != KEYS:
                self._mover = KEYS
                self._sync()

    def _show(self, frame: LiveFrame, now_s: float) -> None:
        with self._server.atomic():
            self._ping_panel.show(frame, self._session.state())
            self._nodes.show(frame, self._session.pose)
            if now_s - self._plane_at_s >= PLANE_S:
                self._plane_at_s = now_s
                self._nodes.show_picture(frame)


def _check_listenable(host: str, port: int) -> None:
    """Raise Error unless one can listen there: viser would take another port, or wait for ever."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(address)
    except (OSError, OverflowError) as why:
        raise Error(
            f"the page must be able to listen at {host}:{port} (got {getattr(why, 'strerror', None) or why}; "
            "another --port may be free)"
        ) from None
