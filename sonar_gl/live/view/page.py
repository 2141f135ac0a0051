"""The web page of a live session."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Mapping
from threading import Lock, Thread

from sonar_gl.core.closing import Closable
from sonar_gl.core.errors import Error
from sonar_gl.core.extras import missing_extra
from sonar_gl.core.hosts import check_host
from sonar_gl.live.frame import LiveFrame, Reading
from sonar_gl.live.session import LiveSession
from sonar_gl.live.view.actions import Actions, tell
from sonar_gl.live.view.browser_state import BrowserState
from sonar_gl.live.view.control_panel import CAMERA, KEYS, TRAJECTORY, ControlPanel
from sonar_gl.live.view.origin import own_page_alone
from sonar_gl.live.view.ping_panel import PingPanel
from sonar_gl.live.view.scene_nodes import SceneNodes

logger = logging.getLogger(__name__)

STEP_S = 1 / 30  # between two moves of a sonar by keys
LONGEST_STEP_S = 0.25  # that keys move the sonar by, after the page was busy
SILENT_S = 1.0  # after which a browser that sends no state is taken to be busy: its keys count as released
READ_S = 0.25  # from one read-out under a pointer to the next, at least: each may take one more ping
NUMBERS_S = 0.2  # between two changes of the numbers, which nobody could read faster
NODES_S = 0.05  # between two changes of the scene, at least; a picture in it costs more than one in the panel
FRAMES = 6  # of the scene that a browser could draw between two changes: pictures wait while it draws
LONGEST_NODES_S = 1.5  # between two changes of the scene for slow browsers, at most


class ViewerPage(Closable):
    """Serves the page until it is closed. Several browsers may show it; what one changes, all see.

    Raises Error if viser is missing, or the host is no address of this machine.

    session : which pings while a browser shows the page
    host : address to listen at
    port : to listen at; 0 for any that is free. If another program has it, the page takes a later one

    url : address of the page
    server : viser.ViserServer, to which programs may add nodes and controls of their own
    marked : Surface that the last click in the picture has marked; None for none
    """

    def __init__(self, session: LiveSession, host: str = "127.0.0.1", port: int = 8080):
        viser = load_viser()
        check_host(host)  # for another viser would wait for ever
        self._session, self._is_closed = session, False
        with _quiet_viser(), own_page_alone(host):
            self.server = viser.ViserServer(host=host, port=port, label="sonar-gl view", verbose=False)
        with contextlib.ExitStack() as opened:
            opened.callback(self._stop_server)
            self._build(host)
            opened.pop_all()
        self._thread = Thread(target=self._serve, name="sonar_gl page", daemon=True)
        self._thread.start()

    def _build(self, host: str) -> None:
        server, session = self.server, self._session
        # viser's page may ask its server for a tunnel to a public address; this one never leaves the machine
        server.request_share_url = lambda *_, **__: None
        self.url = f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"
        self._listener, self._frame, self._frame_lock = None, None, Lock()
        self._browsers: dict[int, tuple[BrowserState, float]] = {}  # by id, and when they told it
        self._carrier = None  # id of the browser whose camera carries the sonar
        self._reader = None  # id of the browser whose pointer has moved last
        self._moved_s = time.monotonic()
        self._nodes_at_s = self._numbers_at_s = self._may_read_s = 0.0
        self._read, self._shown_settings, self._problem = (None, None), None, ""
        self.marked = None
        self._actions = Actions(self._sync)
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._nodes = SceneNodes(server, session, self._actions, self._select)
        self._ping_panel = PingPanel(server, session, self._actions, self._select)
        self._controls = ControlPanel(
            server, session, self._actions, self._move_by, self._select, self._lay_picture, self._lay_marks
        )
        self._connect_browsers()

    def close(self) -> None:
        """Stop serving; browsers keep the last picture. A second call does nothing. The session goes on."""
        if self._is_closed:
            return
        self._is_closed = True
        self._actions.ask(None, None)
        self._thread.join()
        self._controls.close()
        if self._listener is not None:
            self._listener.close()
        self._stop_server()

    def _stop_server(self) -> None:
        with _quiet_viser():
            self.server.stop()

    # ---- browsers -------------------------------------------------------------------------------------------

    def _connect_browsers(self) -> None:
        server = self.server

        @server.on_client_connect
        async def _(client):
            self._actions.ask(client, lambda: self._welcome(client))

            @client.camera.on_update
            async def _(camera):
                if self._carrier == client.client_id:
                    self._actions.ask(
                        client,
                        lambda: self._session.set_pose(self._nodes.camera_pose(camera)),
                        ("camera", client.client_id),
                    )

        @server.on_client_disconnect
        async def _(client):
            self._actions.ask(None, lambda: self._forget(client))

        @self._ping_panel.browser_state.on_update
        async def _(event):
            if event.client is not None:
                state = BrowserState.read(self._ping_panel.browser_state.value)
                self._actions.ask(
                    event.client, lambda: self._note(event.client_id, state), ("state", event.client_id)
                )

    def _welcome(self, client) -> None:
        if client.client_id not in self.server.get_clients():  # it has gone before its turn; viser would warn
            return
        if self._listener is None:
            self._listener = self._session.listen(self._take)
        self._nodes.look_from_behind(client.camera, self._session.pose)

    def _forget(self, client) -> None:
        self._browsers.pop(client.client_id, None)
        if self._reader == client.client_id:
            self._reader = None
        if self._carrier == client.client_id:
            self._carry(None)
        if self._listener is not None and not self.server.get_clients():
            self._listener.close()
            self._listener = None
            if self._session.output.is_recording:
                logger.warning(
                    "the last browser has gone, and the recording into %s goes on until a browser stops it or this "
                    "program ends",
                    self._session.output.recording_folder,
                )

    def _note(self, client_id: int, state: BrowserState) -> None:
        # clicks count since the page was loaded, which may be before a connection that was lost
        before, _ = self._browsers.get(client_id, (state, 0.0))
        self._browsers[client_id] = state, time.monotonic()
        if state.pointer is not None and (state.pointer != before.pointer or self._reader is None):
            self._reader = client_id
        if state.clicked is not None and state.clicks != before.clicks:
            self._click(state.clicked)

    # ---- actions --------------------------------------------------------------------------------------------

    def _move_by(self, client, mover: str) -> None:
        if mover == TRAJECTORY:
            self._session.play()
        elif self._session.state().is_following:
            self._session.set_pose(self._session.pose)
        self._carry(client if mover == CAMERA else None)

    def _carry(self, client) -> None:
        """Have a browser's camera carry the sonar; None for no camera."""
        before = self._carrier
        self._carrier = None
        if client is not None:
            self._nodes.look_ahead(client.camera, self._session.pose)
            self._carrier = client.client_id
        elif before is not None:
            for other in self.server.get_clients().values():
                if other.client_id == before:
                    self._nodes.look_from_behind(other.camera, self._session.pose)
        self._nodes.show_gizmo(self._carrier is None)
        self._ping_panel.switch_keys(self._carrier is None)

    def _select(self, name: str) -> None:
        self._session.highlight(name)
        self._nodes.select(name)

    def _lay_picture(self, visible) -> None:
        self._nodes.shows_picture = bool(visible)

    def _lay_marks(self, visible) -> None:
        self._ping_panel.shows_marks = bool(visible)

    def _click(self, place: tuple[float, float]) -> None:
        """Mark the surface whose echo a place of the picture shows."""
        frame = self._session.frame
        reading = self._reading(frame, place)
        self.marked = None
        if reading is not None:
            self.marked = self._session.surface_of(frame, reading.beam, reading.bin)
        self._nodes.mark(self.marked, 0.0 if reading is None else reading.range_m)
        self._ping_panel.show_click(reading, self.marked)

    def _reading(self, frame: LiveFrame, place: tuple[float, float]) -> Reading | None:
        """Return what stands at a place of a frame's picture."""
        (right, down), (height, width) = place, frame.picture.shape[:2]
        return self._session.at(
            frame, min(int(down * height), height - 1), min(int(right * width), width - 1)
        )

    def _sync(self) -> None:
        self._show_mover()
        self._controls.sync()
        self._controls.show_body(self._session.highlighted)
        self._ping_panel.show_selected(self._session.highlighted)

    def _show_mover(self) -> None:
        is_following = self._session.state().is_following
        if is_following and self._carrier is not None:
            self._carry(None)  # the trajectory has been played, or the time bar moved
        mover = KEYS if self._carrier is None else CAMERA
        self._controls.show_mover(TRAJECTORY if is_following else mover)

    # ---- the page's thread ----------------------------------------------------------------------------------

    def _take(self, frame: LiveFrame) -> None:
        """Take a frame from the session; the page's thread shows it."""
        with self._frame_lock:
            self._frame = frame
        self._actions.ask(None, None)

    def _serve(self) -> None:
        while not self._is_closed:
            self._try(self._actions.do, STEP_S)
            now_s = time.monotonic()
            # of browsers that have told their state lately, by id
            states = {
                client_id: state
                for client_id, (state, told_s) in self._browsers.items()
                if now_s - told_s < SILENT_S
            }
            for part in (self._move_by_keys, self._show_frame, self._show_pointer, self._show_state):
                self._try(part, now_s, states)

    def _try(self, part, *values) -> None:
        """Do a part of what the thread does; if it fails, the others go on."""
        try:
            part(*values)
        except Exception as why:
            if str(why) != self._problem:  # not thirty times a second
                logger.exception("the page failed in a part of its work, and goes on")
            self._problem = str(why)

    def _move_by_keys(self, now_s: float, states: Mapping[int, BrowserState]) -> None:
        dt_s = now_s - self._moved_s
        if dt_s < STEP_S:
            return
        self._moved_s = now_s
        keys = {key for state in states.values() for key in state.keys}
        if keys and self._carrier is None:
            self._session.move(keys, min(dt_s, LONGEST_STEP_S), self._controls.speed_m_s)

    def _show_frame(self, now_s: float, states: Mapping[int, BrowserState]) -> None:
        with self._frame_lock:
            frame, self._frame = self._frame, None
        if frame is None or not states:
            return
        if frame.settings is not self._shown_settings:
            self._shown_settings = frame.settings
            self._sync()
        self._ping_panel.show(frame)
        slowest_s = max(state.frame_s for state in states.values())
        if now_s - self._nodes_at_s < max(NODES_S, min(FRAMES * slowest_s, LONGEST_NODES_S)):
            return
        self._nodes_at_s = now_s
        with self.server.atomic():
            self._nodes.show(frame, self._session.pose)
            self._nodes.show_picture(frame)

    def _show_pointer(self, now_s: float, states: Mapping[int, BrowserState]) -> None:
        """Show what stands under the pointer that has moved last, once it has moved, or there is another frame."""
        place = states[self._reader].pointer if self._reader in states else None
        frame = None if place is None else self._session.frame
        if (place, frame) == self._read or (place is not None and now_s < self._may_read_s):
            return
        self._read = place, frame
        try:
            self._ping_panel.read(None if place is None else self._reading(frame, place))
        finally:
            # other work gets as much time as read-outs, which wait for pings
            end_s = time.monotonic()
            self._may_read_s = end_s + max(READ_S, end_s - now_s)

    def _show_state(self, now_s: float, states: Mapping[int, BrowserState]) -> None:
        """Show what the session does, which may change without a frame, and end a recording that has failed."""
        if now_s - self._numbers_at_s < NUMBERS_S:
            return
        self._numbers_at_s = now_s
        output = self._session.output
        if output.problem and not output.is_recording:
            try:
                output.stop_recording()
            except Error as why:
                for client in self.server.get_clients().values():
                    tell(client, "Recording", str(why), is_problem=True)
            self._sync()
        if states:
            self._ping_panel.show_numbers(self._session.frame, self._session.state())
            self._show_mover()


def load_viser():
    """Return the module viser, which takes a second to import; raise Error if it is missing."""
    try:
        import viser
    except ImportError as why:
        raise missing_extra("live", f"the page needs viser (got no module {why.name})") from None
    return viser


@contextlib.contextmanager
def _quiet_viser():
    """Have viser print nothing, such as a box with its address; the output of the process stays as it is."""
    from rich import get_console  # of viser, which prints by it

    console = get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
