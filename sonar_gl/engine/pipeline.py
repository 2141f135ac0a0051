"""One ping: draw, receive, assemble. `Simulator.ping` does the three in turn, `Simulator.pings` overlaps them.

Functions that draw need the engine: call them inside `Run.drawing`, as their docstrings say.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial, reduce

import numpy as np

from sonar_gl.acoustics.cross_talk import leak_between_beams
from sonar_gl.acoustics.pulse import matched_filter
from sonar_gl.beamform.beamformer import BeamEcho, ShadowedBackground
from sonar_gl.beamform.labels import BodySums, Labels, of_all_echo, without_faint, without_weaker
from sonar_gl.beamform.surface_reverberation import sum_surface
from sonar_gl.beamform.volume import sum_volume
from sonar_gl.beamform.water_surface import water_surface
from sonar_gl.core.errors import SampleLimitError
from sonar_gl.core.warn import warn_caller
from sonar_gl.core.worker import SecondThread
from sonar_gl.engine.flow import DrawnPing, FurtherStates, PingReport, PingSetup, ReceivedPing, Resolution
from sonar_gl.engine.instrument import Instrument
from sonar_gl.engine.level_search import ChosenView, LevelSearch
from sonar_gl.engine.motion import shown_in_motion
from sonar_gl.engine.multipath import DirectView, ImageSources, ImageSourceSamples, receive_images
from sonar_gl.engine.no_echo import NoEchoWarning
from sonar_gl.engine.provenance import SampleOrigin
from sonar_gl.engine.request import PingRequest
from sonar_gl.engine.run import Run
from sonar_gl.noise.noise import add_noise
from sonar_gl.ping import Ping, changed_powers
from sonar_gl.sonar.samples import ViewSamples


def make_ping(run: Run, request: PingRequest) -> Ping:
    """Return one transmission and what it brings back: the whole simulator on one screen."""
    with run.drawing():
        received, report = sample(run, run.resolve(request))
    return finish(run, received, report)


def sample(run: Run, setup: PingSetup) -> tuple[ReceivedPing, PingReport]:
    """Draw and receive a ping, again and again until its samples keep the tolerance, and report on it.

    Call it inside `Run.drawing`. Later pings do not depend on one that fails here.
    """
    before = run.choices, run.sampler.history
    try:
        with run.image_sampling.without_plan() if setup.request.alone else nullcontext():
            received = _sample_until_kept(run, run.with_later_bodies(setup))
            return received, run.report(received)
    except BaseException:
        run.choices, run.sampler.history = before
        raise


def draw(
    sources: ImageSources | None, setups: Sequence[PingSetup], resolution: Resolution, keep_last: bool = False
) -> list[DrawnPing]:
    """Draw the depth + normal pass of some pings, and of their image sources; call it inside `Run.drawing`.

    sources : ImageSources in the scene as it is now; None without multipath
    setups : of the pings; their bodies are those of the scene as it is now
    resolution : of all of them
    keep_last : samples that were drawn just before stay valid, as of `Renderer.render`
    """
    further = [further_states(setup) for setup in setups]
    poses, states = [setup.head_pose for setup in setups], [setup.state for setup in setups]
    for setup, more in zip(setups, further, strict=True):
        needed = more.needed
        poses += [setup.head_pose] * len(needed)
        states += needed
    drawn = resolution.stage.draw(poses, states, with_bodies=True, keep_last=keep_last)
    views, further_views = drawn[: len(setups)], iter(drawn[len(setups) :])
    images = draw_images(sources, resolution, views, setups)
    return [
        DrawnPing(setup, resolution, view, of_images, more.drawn(further_views))
        for setup, view, of_images, more in zip(setups, views, images, further, strict=True)
    ]


def receive(drawn: DrawnPing) -> ReceivedPing:
    """Sum the samples of a ping into beams and range bins. It needs no OpenGL, so that any thread may call it."""
    setup, beamformer = drawn.setup, drawn.resolution.stage.beamformer
    if setup.request.labels:
        direct, bodies = beamformer.sum_bodies(drawn.view, setup.gain)
        labels = label(drawn, bodies)
    else:
        direct, labels = beamformer.sum_view(drawn.view, setup.gain), None
    return receive_more(drawn, direct, labels)


def finish(run: Run, received: ReceivedPing, report: PingReport) -> Ping:
    """Assemble a ping of a scene; warn if it has no echo."""
    if report.no_echo is not None:
        warn_caller(report.no_echo, NoEchoWarning)
    return assemble(run.instrument, received, report.origin, run.world.thread, report.error_estimate)


def assemble(
    instrument: Instrument,
    received: ReceivedPing,
    origin: SampleOrigin,
    thread: SecondThread | None,
    error_estimate: float | None = None,
) -> Ping:
    """Return the finished ping, after the receiver's last steps: matched filter, motion, cross-talk, noise.

    Its `meta` records how it was made. Counts are not taken here, but by `Ping.counts`. The arrays of `received` may be
    overwritten.

    thread : does half of the matched filter and of the noise; None without one
    error_estimate : of the ping; None without one
    """
    request, found = received.drawn.setup.request, labels_of_all_echo(received)
    powers = filtered_powers(received, thread)
    labels, label_level_db = shown_labels(instrument, received, found, powers["intensity"])
    for array in (*powers.values(), *labels.values()):
        if array is not None:
            array.setflags(write=False)
    ping = ping_of(
        instrument, received, origin, label_level_db, error_estimate=error_estimate, **powers, **labels
    )
    ping = with_cross_talk(shown_in_motion(ping, request.velocity))
    if request.noise is None:
        return ping
    return add_noise(ping, request.noise, request.seed, request.number, thread)


def _sample_until_kept(run: Run, setup: PingSetup) -> ReceivedPing:
    """Draw and receive a ping until its samples, and those of its image sources, keep the tolerance."""
    if run.sampler.is_apart(setup):
        received, resolution = _sample_apart(run, setup)
    else:
        received, resolution = None, run.sampler.resolution_for(setup)
    while resolution is not None:
        before = received
        try:
            if resolution.finer_images:
                received = with_finer_images(run.image_sources, before, resolution)
            else:
                received = _sample_once(run, setup, resolution)
        except SampleLimitError as error:
            resolution = run.fewer_samples(error, received, resolution)
        else:  # a body may have come into view, or multipath may be sampled too coarsely
            resolution = run.review(received, before if resolution.finer_images else None)
    return received


def _sample_once(run: Run, setup: PingSetup, resolution: Resolution) -> ReceivedPing:
    """Draw and receive a ping once, and choose how finely its image sources are sampled."""
    sources = run.image_sources
    if sources is not None:
        halvings = run.image_sampling.begin(resolution.check, resolution.stage.fan.n_samples)
        resolution = replace(resolution, halvings=halvings)
    (drawn,) = draw(sources, [setup], resolution)
    affordable = run.sampler.affordable(drawn)
    if affordable.stage is not resolution.stage:
        (drawn,) = draw(sources, [setup], affordable)
    elif affordable is not resolution:
        drawn = replace(drawn, resolution=affordable)
    return receive(drawn)


def _sample_apart(run: Run, setup: PingSetup) -> tuple[ReceivedPing | None, Resolution | None]:
    """Receive a ping whose samples are chosen from this ping alone.

    Returns the ping, and the resolution with which it must be sampled again, None if it is good. Where its image
    sources need more samples than fit, there is no ping but only a coarser resolution.

    Raises SampleLimitError if the image sources do not fit, and the request is `alone`, so that no coarser resolution
    may take its place.
    """
    chosen = choose_samples(run.sampler.search, setup)
    tried, n_pings = chosen.tried, run.sampler.history.n_pings + 1
    run.sampler.follow(setup, chosen.plan, tried.echo.total, tried.coverage, n_pings)
    try:
        received = receive_chosen(run.image_sources, setup, chosen, run.image_sampling.begin_alone())
    except SampleLimitError as error:
        if setup.request.alone:
            raise
        return None, run.sampler.fewer_samples(error)
    return received, run.review(received)


def choose_samples(search: LevelSearch, setup: PingSetup) -> ChosenView:
    """Return the views of a ping with samples chosen from it alone."""
    return search.choose(setup, further_states(setup).needed)


def receive_chosen(
    sources: ImageSources | None, setup: PingSetup, chosen: ChosenView, halvings: int
) -> ReceivedPing:
    """Receive a ping whose samples were chosen from it alone, and draw its image sources."""
    tried, plan = chosen
    resolution = Resolution(tried.stage, halvings, is_final=True, plan=plan)
    (images,) = draw_images(sources, resolution, [tried.view], [setup])
    drawn = DrawnPing(setup, resolution, tried.view, images, further_states(setup).drawn(iter(tried.further)))
    return receive_more(drawn, tried.echo, None if tried.bodies is None else label(drawn, tried.bodies))


def with_finer_images(sources: ImageSources, received: ReceivedPing, resolution: Resolution) -> ReceivedPing:
    """Draw and sum the image sources of a ping once more, with more samples."""
    before = received.drawn
    (images,) = draw_images(sources, resolution, [before.view], [before.setup], before.images)
    drawn = replace(before, resolution=resolution, images=images)
    return replace(received, drawn=drawn, multipath=receive_multipath(drawn))


def draw_images(
    sources: ImageSources | None,
    resolution: Resolution,
    views: Sequence[ViewSamples],
    setups: Sequence[PingSetup],
    coarser: ImageSourceSamples | None = None,
) -> list[ImageSourceSamples | None]:
    """Draw the image sources of pings whose views were just drawn; None for each without multipath.

    coarser : as of `ImageSources.draw`
    """
    if sources is None:
        return [None] * len(setups)
    pings = [
        DirectView(view, setup.head_pose, setup.state, setup.gain)
        for view, setup in zip(views, setups, strict=True)
    ]
    return sources.draw(resolution.stage, resolution.halvings, pings, coarser)


def further_states(setup: PingSetup) -> FurtherStates:
    """Return what a ping draws beside the whole scene."""
    state = setup.state
    return FurtherStates(
        background=None if setup.background is None else state.only(setup.background[1:]),
        lobes=state.without_diffuse_echo() if setup.needs_lobes else None,
        texture=None if setup.texture is None else state.with_reflectivity(setup.texture),
    )


def receive_more(drawn: DrawnPing, direct: BeamEcho, labels: Labels | None) -> ReceivedPing:
    """Sum the echoes of a ping other than its direct one."""
    received = ReceivedPing(
        drawn,
        direct,
        multipath=receive_multipath(drawn),
        labels=labels,
        volume=receive_volume(drawn),
        surface=receive_surface(drawn),
        lobes=receive_part(drawn, drawn.further.lobes),
        texture=receive_part(drawn, drawn.further.texture),
        coverage=drawn.coverage,
    )
    if labels is None or not received.of_water:
        return received
    of_water = np.sum([echo.intensity for echo in received.of_water], axis=0)
    return replace(received, labels=without_weaker(labels, direct.intensity, of_water))


def receive_multipath(drawn: DrawnPing) -> BeamEcho | None:
    """Sum the image sources of a ping, if it has any."""
    return None if drawn.images is None else receive_images(drawn.images, drawn.setup.gain)


def receive_volume(drawn: DrawnPing) -> BeamEcho | None:
    """Sum the echo of the water in front of surfaces; None if it does not scatter."""
    setup = drawn.setup
    strength_db = setup.acoustics.volume_backscatter_db
    if strength_db is None:
        return None
    surface = water_surface(setup.head_pose, setup.surface_z_m)
    return sum_volume(drawn.resolution.stage.beamformer, drawn.view.sectors, setup.gain, strength_db, surface)


def receive_surface(drawn: DrawnPing) -> BeamEcho | None:
    """Sum the backscatter of the water's surface; None if it scatters nothing, or is out of reach."""
    setup, beamformer = drawn.setup, drawn.resolution.stage.beamformer
    sonar = beamformer.fan.sonar
    backscatter = setup.acoustics.surface_backscatter(sonar)
    surface = None if backscatter is None else water_surface(setup.head_pose, setup.surface_z_m)
    if surface is None or surface.height_m >= sonar.range_max_m:
        return None
    return sum_surface(beamformer, drawn.view.sectors, setup.gain, surface, backscatter)


def receive_part(drawn: DrawnPing, view: ViewSamples | None) -> BeamEcho | None:
    """Sum one part of the surfaces' echo by itself; None where the ping has no view of it.

    Bubbles attenuate this echo; their own echo is not in it.
    """
    if view is None:
        return None
    return drawn.resolution.stage.beamformer.sum_view(view.with_echo(), drawn.setup.gain)


def label(drawn: DrawnPing, bodies: BodySums) -> Labels:
    """Find the strongest body in each bin of a ping whose bodies were summed, and where it lies in shadow."""
    setup, beamformer = drawn.setup, drawn.resolution.stage.beamformer
    return beamformer.find_labels(bodies, setup.gain, setup.n_bodies, shadowed_background(drawn))


def shadowed_background(drawn: DrawnPing) -> ShadowedBackground | None:
    """Return the bodies on which others cast shadows; None for no shadows."""
    background = drawn.further.background
    if background is None:
        return None
    return ShadowedBackground(drawn.setup.background, background)


def labels_of_all_echo(received: ReceivedPing) -> Labels | None:
    """Return the labels of a ping, whose shares become those of all its echo; None without labels.

    Call it before `filtered_powers`, which adds the other echoes to the direct one in place.
    """
    labels = received.labels
    if labels is None:
        return None
    more = [echo.intensity for echo in received.others if echo.total]
    return of_all_echo(labels, received.direct.intensity, sum(more[1:], more[0])) if more else labels


def filtered_powers(received: ReceivedPing, thread: SecondThread | None) -> dict[str, np.ndarray | None]:
    """Return the powers of a ping after the matched filter, by the names of the fields of `Ping`.

    Each is (B, K) float32, linear, or None where the ping does not need it. The other echoes are added to the array of
    the direct one.
    """
    setup = received.drawn.setup

    def filtered(echo: BeamEcho | None) -> np.ndarray | None:
        if echo is None:
            return None
        return echo.intensity if setup.pulse is None else matched_filter(echo.intensity, setup.pulse, thread)

    intensity = filtered(reduce(BeamEcho.with_more, received.others, received.direct))
    coherent, texture = filtered(received.lobes), filtered(received.texture)
    # where the water has few scatterers, speckle needs their echo by itself
    volume = None if setup.acoustics.scatterer_density_m3 is None else filtered(received.volume)
    if texture is not None and coherent is not None:  # specular lobes are in both views
        texture = np.maximum(texture - coherent, 0)
    return {"intensity": intensity, "coherent": coherent, "texture_deviation": texture, "volume": volume}


def shown_labels(
    instrument: Instrument, received: ReceivedPing, labels: Labels | None, intensity: np.ndarray
) -> tuple[dict[str, np.ndarray], float | None]:
    """Return the labels of a ping by the names of the fields of `Ping`, and the least level that is labelled, dB.

    Without labels, return an empty table and None. The level is compared with the mean echo, so that labels do not
    depend on the seed of the noise. It is compared before the matched filter, too: the range side lobes of a bright
    body reach bins in which it has next to no echo.

    received : to whose direct echo `filtered_powers` added the others
    labels : with shares of all echo, or None; its arrays are overwritten
    intensity : (B, K) after the matched filter
    """
    if labels is None:
        return {}, None
    setup = received.drawn.setup
    label_level_db = setup.request.label_level_db
    if label_level_db is None:
        label_level_db = 10 * math.log10(instrument.sonar.counts.least_shown(intensity))
    least, level = 10 ** (label_level_db / 10), setup.acoustics.pulse_level(instrument.sonar)
    found = without_faint(labels, intensity, least)
    if setup.pulse is not None:  # the filter raises even echo by `level`
        found = without_faint(found, received.direct.intensity, least / level)
    return {**vars(found), "body_echo": found.body_echo * level}, label_level_db


def ping_of(
    instrument: Instrument,
    received: ReceivedPing,
    origin: SampleOrigin,
    label_level_db: float | None,
    **fields,
) -> Ping:
    """Return a ping with the record of how it was made.

    label_level_db : level from which on bins are labelled; None without labels
    fields : of `Ping`, what is not known from the other arguments: powers, labels and the estimated error
    """
    setup = received.drawn.setup
    time_s = None if setup.state is None else setup.state.time_s
    of_labels = {} if label_level_db is None else {"label_level_db": label_level_db}
    if setup.request.noise_hides_labels:  # as `add_noise` reads it, now or later
        of_labels["labels_above_noise"] = True
    meta = instrument.provenance.meta(
        origin,
        setup.acoustics,
        # as asdict, in a twentieth of its time
        sampling=dict(vars(received.drawn.resolution.stage.sampling)),
        seed=setup.request.seed,
        has_echo=received.total > 0,
        **({} if time_s is None else {"time_s": time_s}),
        **of_labels,
    )
    return Ping(
        azimuth_rad=instrument.azimuth_rad,
        range_m=instrument.range_m,
        pose=setup.request.pose,
        meta=meta,
        sonar=instrument.sonar,
        acoustics=setup.acoustics,
        **fields,
    )


def with_cross_talk(ping: Ping) -> Ping:
    """Return a ping with the cross-talk between the beams of its sonar, if its acoustics have it."""
    sonar = ping.sonar
    if not ping.acoustics.cross_talk or sonar.cross_talk_db is None:
        return ping
    leak = partial(leak_between_beams, level_db=sonar.cross_talk_db, spacing=sonar.cross_talk_beams)
    leaky = replace(ping, **changed_powers(ping, leak))
    if ping.share is None:
        return leaky
    # echo that leaks from other beams into a bin is not of the body that labels the bin
    before, after = ping.intensity, leaky.intensity
    share = ping.share * np.divide(before, after, out=np.ones_like(after), where=after > before)
    share.setflags(write=False)
    return replace(leaky, share=share)
