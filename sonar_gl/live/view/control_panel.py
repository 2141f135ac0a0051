"""The panel with the controls: what moves the sonar, its settings, bodies, and files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from threading import Thread

from sonar_gl.acoustics.acoustics import PROFILES, Acoustics
from sonar_gl.analysis.terms import Price
from sonar_gl.core.errors import Error, closed_error
from sonar_gl.core.worker import Job
from sonar_gl.imaging.colormaps import OFFERED
from sonar_gl.live.key_motion import SPEED_M_S
from sonar_gl.live.session import LiveSession
from sonar_gl.live.settings import ENGINES, FORMS, LiveSettings, term_names
from sonar_gl.live.view.actions import Actions, tell
from sonar_gl.live.view.price_table import prices_html
from sonar_gl.live.view.scales import NumberScale, allowed_range_m, range_scale, shown_range_m
from sonar_gl.noise.settings import PRESETS
from sonar_gl.sonar.sonar import Sonar
from sonar_gl.sonar.sonar_files import presets

KEYS, CAMERA, TRAJECTORY = "keys and gizmo", "browser's camera", "trajectory"
NO_BODY = "none"
OTHER = "other"
COPY = "Copy"  # page.js has the same
OWN = " (given)"  # follows the name of a sonar that a preset has, too
MAX_OWN = 8  # sonars on offer beside the presets
PANEL_WIDTH = 330  # pixels of the page
SHORT_LABELS = {"volume reverberation": "volume reverb."}  # of terms whose names would wrap


class ControlPanel:
    """The panel on the right.

    on_mover : action of (client, one of KEYS, CAMERA and TRAJECTORY) when another one is chosen
    on_body : action of a body's name that was chosen; "" for none
    on_picture : action of whether the picture lies in the scene
    on_marks : action of whether lines of range and azimuth lie over the picture
    """

    def __init__(
        self,
        server,
        session: LiveSession,
        actions: Actions,
        on_mover: Callable,
        on_body: Callable[[str], None],
        on_picture: Callable[[bool], None],
        on_marks: Callable[[bool], None],
    ):
        self._gui, self._session, self._actions = server.gui, session, actions
        self._shown: list[tuple] = []  # handles, and what settings have each show
        self._sliders: list[tuple] = []  # handles, and what scale settings have each have
        self._terms: dict[str, object] = {}
        self._pricing: Thread | None = None
        self._priced: tuple | None = None  # what the prices on show are of
        self._is_closed = False
        self.speed_m_s = SPEED_M_S  # of the sonar while a key is held
        settings = session.settings
        self._sonars, self._n_given = dict(presets()), 0
        self._name_of_sonar(session.scene.sonar or settings.sonar)
        self._add_motion(on_mover)
        self._add_sonar(settings)
        self._add_display(settings, on_picture, on_marks)
        self._add_acoustics(settings)
        self._add_water()
        self._add_bodies(on_body)
        self._add_files()
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(PANEL_WIDTH)
        self.sync()

    def sync(self) -> None:
        """Have all controls show the settings that the session has."""
        settings = self._session.settings
        if self._priced is not None and self._priced != _priced_by(settings):
            self._prices.content, self._priced = "", None
        for slider, scale_of in self._sliders:
            scale = scale_of(settings)
            if (slider.min, slider.max, slider.step) != (scale.low, scale.high, scale.step):
                slider.min, slider.max, slider.step = scale.low, scale.high, scale.step
            if slider.precision != scale.decimals:
                slider.precision = scale.decimals
        for handle, shown in self._shown:
            self._actions.show(handle, shown(settings))
        is_recording = self._session.output.is_recording
        label = "Stop recording" if is_recording else "Record"
        if self._record.label != label:
            self._record.label = label

    def show_mover(self, mover: str) -> None:
        self._actions.show(self._mover, mover)

    def show_body(self, name: str) -> None:
        """Show which body is selected; "" for none."""
        self._actions.show(self._body, name or NO_BODY)

    def _name_of_sonar(self, sonar: Sonar) -> str:
        """Return the name by which the page offers a sonar, which may differ from a preset of its own name.

        Of those that are no presets the last ones are on offer, and the first.
        """
        for name, one in self._sonars.items():
            if one == sonar:
                return name
        own = [name for name in self._sonars if name not in presets()]
        if len(own) >= MAX_OWN:
            del self._sonars[own[1]]  # the first is that of the scene
        name = sonar.name
        if name in self._sonars:
            self._n_given += 1
            name += OWN if self._n_given == 1 else f"{OWN[:-1]} {self._n_given})"
        self._sonars[name] = sonar
        return name

    # ---- parts --------------------------------------------------------------------------------------------

    def _connect(self, handle, shown: Callable[[LiveSettings], object], change: Callable) -> None:
        """Have a control show a part of the settings, and change it."""
        self._shown.append((handle, shown))
        self._actions.connect(handle, change)

    def _add_number(
        self,
        scale: NumberScale,
        shown: Callable[[LiveSettings], float],
        change: Callable[[float], object],
        hint: str | None = None,
    ) -> None:
        """Add a slider that shows the number in force, also one beyond its ends, and refuses others beyond them."""

        def wide(settings: LiveSettings) -> NumberScale:
            return scale.holding(shown(settings))

        self._add_slider(wide, shown, lambda value: change(wide(self._session.settings).check(value)), hint)

    def _add_slider(self, scale_of: Callable, shown: Callable, change: Callable, hint: str | None) -> None:
        """Add a slider whose scale and number depend on the settings."""
        settings = self._session.settings
        scale = scale_of(settings)
        slider = self._gui.add_slider(
            scale.label, scale.low, scale.high, scale.step, shown(settings), hint=hint
        )
        slider.precision = scale.decimals
        self._sliders.append((slider, scale_of))
        self._connect(slider, shown, change)

    def _add_choice(
        self,
        label: str,
        options: tuple[str, ...],
        shown: Callable[[LiveSettings], str],
        change: Callable[[str], object],
        hint: str | None = None,
    ) -> None:
        """Add a dropdown that shows one of some names."""
        dropdown = self._gui.add_dropdown(
            label, options, initial_value=shown(self._session.settings), hint=hint
        )
        self._connect(dropdown, shown, change)

    def _add_motion(self, on_mover) -> None:
        gui = self._gui
        movers = (KEYS, CAMERA) + (() if self._session.track is None else (TRAJECTORY,))
        with gui.add_folder("Motion"):
            self._mover = gui.add_dropdown(
                "moved by",
                movers,
                initial_value=movers[-1] if self._session.track is not None else KEYS,
                hint="A camera is flown by the same keys and the mouse, and carries the sonar: that of the browser "
                "in which this is chosen.",
            )
            self._add_number(
                NumberScale("speed, m/s", 0.1, 10.0, 0.1, 1),
                lambda _settings: self.speed_m_s,
                lambda speed_m_s: setattr(self, "speed_m_s", speed_m_s),
                "Of the sonar while a key is held.",
            )
        self._actions.connect_from(self._mover, on_mover)

    def _add_sonar(self, settings: LiveSettings) -> None:
        gui, session = self._gui, self._session
        with gui.add_folder("Sonar"):
            shown = self._name_of_sonar(settings.sonar)
            sonar = gui.add_dropdown(
                "sonar",
                tuple(self._sonars),
                initial_value=shown,
                hint="'sonar-gl sonars' lists what each is.",
            )
            self._add_slider(
                range_scale,
                shown_range_m,
                lambda value: session.change(range_m=float(value)),
                "Up to the greatest that the sonar allows, where that is known.",
            )
            self._add_number(
                NumberScale("tolerance, %", 0.5, 20.0, 0.5, 1),
                lambda settings: round(100 * settings.tolerance, 6),
                lambda percent: session.change(tolerance=percent / 100),
                "Largest share of the echo that may lie in wrong bins.",
            )
            self._add_number(
                NumberScale("pings per s", 1.0, 60.0, 1.0, 0),
                lambda settings: settings.max_rate_hz,
                lambda rate_hz: session.change(max_rate_hz=rate_hz),
                "At most.",
            )
            self._add_choice(
                "engine",
                ENGINES,
                lambda settings: settings.engine or "auto",
                lambda name: session.change(engine=name),
                "What makes the pings: opengl, on a graphics card, or cpu; auto takes a card if there is one.",
            )
        self._shown.append((sonar, lambda settings: self._shown_sonar(sonar, settings.sonar)))
        self._actions.connect_from(sonar, self._change_sonar)

    def _change_sonar(self, client, name: str) -> None:
        """Take another sonar, at the range that is set, or else at one that it allows, and say so."""
        sonar, range_m = self._sonars[name], self._session.settings.device.range_max_m
        allowed_m = allowed_range_m(sonar, range_m)
        own = allowed_m == sonar.range_max_m  # no range beside that of the sonar in command lines
        self._session.change(sonar=sonar, range_m=None if own else allowed_m)
        if allowed_m != range_m:
            tell(client, "Range", f"{allowed_m:g} m, since {name} does not allow {range_m:g} m")

    def _shown_sonar(self, dropdown, sonar: Sonar) -> str:
        """Return what the dropdown shows for a sonar, and have it offer that."""
        name = self._name_of_sonar(sonar)
        if name not in dropdown.options:
            dropdown.options = tuple(self._sonars)
        return name

    def _add_display(self, settings: LiveSettings, on_picture, on_marks) -> None:
        gui, session = self._gui, self._session
        colormaps = tuple(dict.fromkeys((*OFFERED, settings.colormap)))
        with gui.add_folder("Display"):
            self._add_choice(
                "form",
                FORMS,
                lambda settings: settings.form,
                lambda name: session.change(form=name),
                "fan: as seen from above. polar: beams side by side, range upwards.",
            )
            self._add_choice(
                "colours",
                colormaps,
                lambda settings: settings.colormap,
                lambda name: session.change(colormap=name),
            )
            own = gui.add_checkbox(
                "gain of the device", settings.counts is None, hint="As the device sets it; else that below."
            )
            self._add_number(
                NumberScale("gain, dB", -40.0, 60.0, 1.0, 0),
                self._gain,
                lambda gain_db: session.change(gain_db=gain_db),
                "From echo to brightness. A change ends the gain of the device.",
            )
            picture = gui.add_checkbox(
                "picture in 3D", True, hint="On the upper face of the fan; none while the form is polar."
            )
            marks = gui.add_checkbox(
                "range marks", True, hint="Ranges and azimuths, on the page alone: files lack them."
            )
        self._actions.connect(picture, on_picture)
        self._actions.connect(marks, on_marks)
        self._connect(own, lambda settings: settings.counts is None, self._switch_gain)

    def _switch_gain(self, own: bool) -> None:
        if own:
            self._session.change(counts=None)
        else:
            self._session.change(gain_db=self._gain(self._session.settings))

    def _gain(self, settings: LiveSettings) -> float:
        """Return the gain of the slider, dB; where it is automatic that of the last ping, so that it can be changed."""
        law, frame = settings.law, self._session.frame
        if law.gain_percentile is not None and frame is not None:
            law = replace(law, gain_db=round(law.settle(frame.ping.intensity).gain_db), gain_percentile=None)
        return float(law.gain_db)

    def _add_acoustics(self, settings: LiveSettings) -> None:
        gui, session = self._gui, self._session
        with gui.add_folder("Acoustics and noise", expand_by_default=False):
            self._add_choice(
                "profile",
                tuple(PROFILES),
                lambda settings: settings.acoustics.profile,
                lambda name: session.change(acoustics=Acoustics(name, water=session.settings.water)),
                "Sets all terms below; each may be switched by itself after that.",
            )
            self._add_choice(
                "noise",
                (*PRESETS, OTHER),
                lambda settings: next(
                    (name for name, one in PRESETS.items() if one == settings.noise), OTHER
                ),
                self._change_noise,
            )
            for name in term_names():
                label = SHORT_LABELS.get(name, name)
                self._terms[name] = gui.add_checkbox(label, settings.is_on(name), hint=f"Term: {name}.")
            self._price = gui.add_button(
                "Price the terms", hint="What each changes and costs here; takes seconds."
            )
            self._prices = gui.add_html("")
        for name, handle in self._terms.items():
            self._connect(
                handle,
                lambda settings, name=name: settings.is_on(name),
                lambda on, name=name: session.switch(name, bool(on)),
            )
        self._actions.connect_button(self._price, self._find_prices)

    def _change_noise(self, name: str) -> None:
        if name != OTHER:
            self._session.change(noise=PRESETS[name])

    def _find_prices(self, client) -> None:
        """Have the terms priced in a thread, since that takes seconds."""
        if self._pricing is not None and self._pricing.is_alive():
            raise Error("terms are being priced already (wait until they are)")
        of, job = _priced_by(self._session.settings), Job(lambda: self._session.prices(self._check_open))

        def find():
            job.begin()
            # or says why there are none
            self._actions.ask(client, lambda: self._show_prices(job.result(), of))
            self._actions.ask(client, lambda: setattr(self._price, "disabled", False))

        self._price.disabled = True
        self._pricing = Thread(target=find, name="sonar_gl prices", daemon=True)
        self._pricing.start()

    def close(self) -> None:
        """End the pricing of terms at its next ping."""
        self._is_closed = True
        if self._pricing is not None:
            self._pricing.join()

    def _check_open(self) -> None:
        if self._is_closed:
            raise closed_error("page")

    def _show_prices(self, prices: list[Price], of: tuple) -> None:
        self._prices.content, self._priced = prices_html(prices), of

    def _add_water(self) -> None:
        gui, session = self._gui, self._session
        with gui.add_folder("Water", expand_by_default=False):
            for name, label, low, high, step, decimals in (
                ("temperature_c", "temperature, °C", 0.0, 35.0, 0.5, 1),
                ("salinity_psu", "salinity, psu", 0.0, 42.0, 0.5, 1),
                ("depth_m", "depth, m", 0.0, 1000.0, 1.0, 0),
            ):

                def shown(settings, name=name):
                    return float(getattr(settings.water, name))

                def change(value, name=name):
                    session.change(water=replace(session.settings.water, **{name: value}))

                self._add_number(NumberScale(label, low, high, step, decimals), shown, change)

    def _add_bodies(self, on_body) -> None:
        gui, names = self._gui, tuple(body.name for body in self._session.scene.bodies)
        with gui.add_folder("Bodies", expand_by_default=False):
            self._body = gui.add_dropdown(
                "selected", (NO_BODY, *names), initial_value=NO_BODY,
                hint="Its echoes are outlined, and it can be dragged in 3D. A click at it selects it, too.",
            )  # fmt: skip
            back = gui.add_button("Put all back")
        self._actions.connect(self._body, lambda name: on_body("" if name == NO_BODY else name))
        self._actions.connect_button(back, lambda _: self._session.reset_bodies())

    def _add_files(self) -> None:
        gui, output = self._gui, self._session.output
        with gui.add_folder("Files"):
            self._record = gui.add_button("Record", hint="NPZ of each ping, an MP4, and the poses as CSV.")
            picture = gui.add_button("Save picture", hint="PNG and NPZ of one ping, made anew.")
            line = gui.add_button("Command line", hint="Shows the command that makes the same picture.")
            job = gui.add_button("Add pose to job", hint="One more pose in a job file of 'sonar-gl batch'.")
        connect = self._actions.connect_button
        connect(self._record, self._switch_recording)
        connect(
            picture,
            lambda client: tell(client, "Picture saved", _place_text(output.save_picture(), ", .npz")),
        )
        connect(line, self._show_command_line)
        connect(job, lambda client: tell(client, "Pose added", f"to {_place_text(output.add_pose_to_job())}"))

    def _switch_recording(self, client) -> None:
        output = self._session.output
        if not output.is_recording:
            tell(client, "Recording", f"into {_place_text(output.start_recording())}")
        elif paths := output.stop_recording():
            missed = f"; {output.n_missed} came too quickly to be written" if output.n_missed else ""
            tell(client, "Recorded", f"{output.n_recorded} pings into {_place_text(paths[0].parent)}{missed}")
        else:
            tell(client, "Recorded", "no ping")

    def _show_command_line(self, client) -> None:
        text = self._session.output.command_line()
        with client.gui.add_modal("The same picture by a command") as modal:
            client.gui.add_text("command", text, multiline=True)
            client.gui.add_button(COPY)
            close = client.gui.add_button("Close")

        @close.on_click
        async def _(_event):
            modal.close()


def _place_text(path: Path, also: str = "") -> str:
    """Return where a file is, its name first: a note cuts off what is too long for a line."""
    return f"{path.name}{also} in {path.parent}"


def _priced_by(settings: LiveSettings) -> tuple:
    """Return what the prices of terms depend on, besides the terms themselves and the pose."""
    return settings.device, settings.tolerance, settings.water
