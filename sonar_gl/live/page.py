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
SILENT_S = 1.0  # after which a browser that sends no state is taken to be busy: its keys count as released
READ_S = 0.5  # between two read-outs under a pointer that rests
NODES_S = 0.05  # between two changes of the scene, at least; a picture in it costs more than one in the panel
FRAMES = 6  # of the scene that a browser could draw between two changes: pictures wait while it draws


class ViewerPage:
    """Serves the page until it is closed. Several browsers may show it; what one changes, all see.

    Parameters
    ----------
    session : LiveSession, which pings while a browser shows the page
    host : address to listen at
    port : to listen at; 0 for any that is free. If another program has it, the page takes a later one

    Attributes
    ----------
    url : address of the page
    server : viser.ViserServer, to which programs may add nodes and controls of their own
    marked : Surface that the last click in the picture has marked; None for none

    Raises
    ------
    Error
        if viser is missing, or the host is no address of this machine.
    """

    def __init__(self, session: LiveSession, host: str = "127.0.0.1", port: int = 8080):
        viser = load_viser()
        _check_host(host)
        self._session, self._is_closed = session, False
        with contextlib.redirect_stdout(io.StringIO()):  # a box with its address
            self.server = viser.ViserServer(host=host, port=port, label="sonar-gl view", verbose=False)
        # viser's page may ask its server for a tunnel to a public address; this one never leaves the machine
        self.server.request_share_url = lambda *_, **__: None
        self.url = f"http://{host}:{self.server.get_port()}"
        self._listener, self._frame, self._frame_lock = None, None, Lock()
        self._browsers: dict[int, tuple[BrowserState, float]] = {}
        self._carrier = None  # id of the browser whose camera carries the sonar
        self._mover = KEYS if session.track is None else TRAJECTORY
        self._nodes_at_s, self._read_at_s, self._pointer = 0.0, 0.0, None
        self.marked = None
        self._actions = Actions(self._sync)
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._nodes = SceneNodes(self.server, session, self._actions, self._select, self._click)
        self._ping_panel = PingPanel(self.server, session, self._actions)
        self._controls = ControlPanel(
            self.server, session, self._actions, self._move_by, self._select, self._lay_picture
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
            self.server.stop()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    # ---- browsers -------------------------------------------------------------------------------------------

    def _connect_browsers(self) -> None:
        server = self.server

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
        if self._listener is not None and not self.server.get_clients():
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
            for other in self.server.get_clients().values():
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
        self._nodes.shows_picture = bool(visible)

    def _click(self, place: tuple[float, float]) -> None:
        """Mark the surface whose echo a place of the picture shows, and say what stands there."""
        frame = self._session.frame
        self._pointer = place
        reading = self._read()
        if reading is None:
            self.marked = None
        else:
            self.marked = self._session.surface_of(frame, reading.beam, reading.bin)
        self._nodes.mark(self.marked, 0.0 if reading is None else reading.range_m)

    def _read(self):
        """Show what stands under the pointer, and return it."""
        frame, reading = self._session.frame, None
        self._read_at_s = time.monotonic()
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
            if not any(now_s - told_s < SILENT_S for _, told_s in self._browsers.values()):
                continue
            if frame.settings is not settings:
                settings = frame.settings
                self._sync()
            self._show(frame, now_s)
            if self._pointer is not None and now_s - self._read_at_s >= READ_S:
                self._actions.ask(None, self._read)

    def _move_by_keys(self, dt_s: float, now_s: float) -> None:
        keys = {
            key
            for state, told_s in self._browsers.values()
            if now_s - told_s < SILENT_S
            for key in state.keys
        }
        if keys and self._carrier is None:
            self._session.move(
                keys, dt_s, self._controls.steps.speed_m_s, self._controls.steps.turn_rate_rad_s
            )
            if self._mover != KEYS:
                self._mover = KEYS
                self._sync()

    def _show(self, frame: LiveFrame, now_s: float) -> None:
        self._ping_panel.show(frame, self._session.state())
        slowest_s = max((state.frame_s for state, _ in self._browsers.values()), default=0.0)
        if now_s - self._nodes_at_s < max(NODES_S, FRAMES * slowest_s):
            return
        self._nodes_at_s = now_s
        with self.server.atomic():
            self._nodes.show(frame, self._session.pose)
            self._nodes.show_picture(frame)


def load_viser():
    """Return the module viser, which takes a second to import; raise Error if it is missing."""
    try:
        import viser
    except ImportError as why:
        raise missing_extra("live", f"the page needs viser (got no module {why.name})") from None
    return viser


def _check_host(host: str) -> None:
    """Raise Error unless one can listen at an address, for which viser would wait for ever."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as trial:
            trial.bind(address)
    except (OSError, UnicodeError) as why:
        raise Error(
            f"the host must be an address of this machine (got {host!r}: {getattr(why, 'strerror', None) or why}; "
            "127.0.0.1 is reached from this machine alone)"
        ) from None
