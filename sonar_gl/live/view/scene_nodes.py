"""The 3D part of the page: bodies, the sonar and its fan, and what can be clicked and dragged there."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from trimesh.transformations import quaternion_from_matrix, quaternion_matrix

from sonar_gl.core.poses import pose as make_pose
from sonar_gl.embed.camera import SONAR_FROM_OPTICAL
from sonar_gl.imaging.fan_image import FanGeometry, fan_geometry
from sonar_gl.live.frame import LiveFrame, Surface
from sonar_gl.live.session import LiveSession
from sonar_gl.live.view.actions import Actions
from sonar_gl.live.view.browser_meshes import BrowserMesh, browser_meshes
from sonar_gl.live.view.outline import (
    SELECTED_COLOR,
    PicturePixels,
    PictureSector,
    fan_arcs,
    fan_outline,
    round_step,
)
from sonar_gl.sonar.sonar import Sonar

# Colours of bodies in turn, RGB: stone and steel first, and none that a picture or a gizmo has.
BODY_COLORS = ((140, 126, 104), (120, 142, 158), (150, 128, 140), (128, 150, 128), (160, 146, 110))
FAN_COLOR = (255, 176, 64)
SURFACE_COLOR = (255, 48, 160)
SONAR_COLOR = (255, 140, 0)
WATER_TOP, WATER_BOTTOM = (38, 88, 116), (4, 18, 32)
WATER_LIGHT = (205, 222, 232)  # what the water scatters: without it, walls would be black
GIZMO_PIXELS = 90.0  # of the screen: length of an arrow
# pixels of the picture in the scene up to the last range; PNGs, which are clear outside the fan
PLANE_HEIGHT = 320
# The page's origin is a multiple of it, metres: viser drops moves that are small beside the distance from the origin,
# in UTM those of metres.
SITE_STEP_M = 1000.0


def pose_of(wxyz, position) -> np.ndarray:
    """Return the (4, 4) pose of a node."""
    out = quaternion_matrix(wxyz)
    out[:3, 3] = position
    return out


def put(node, pose: np.ndarray) -> None:
    node.position, node.wxyz = pose[:3, 3], quaternion_from_matrix(pose)


class PicturePart(NamedTuple):
    """A part of the picture in the scene, and its node.

    It takes no clicks: the gizmo of the sonar and bodies lie below it.
    """

    pixels: PicturePixels
    node: object


class SceneNodes:
    """The nodes of viser's scene that show a session, relative to an origin near the first pose of its sonar.

    on_body : action of a body's name that was clicked
    """

    def __init__(self, server, session: LiveSession, actions: Actions, on_body: Callable[[str], None]):
        self._server, self._session, self._actions = server, session, actions
        self._pose, self._fan_extent, self._selected = None, None, ""
        self._origin_m = SITE_STEP_M * np.round(session.pose[:3, 3] / SITE_STEP_M)
        self._pictures: list[PicturePart] = []
        self._picture_extent = None  # what these depend on
        self._is_dragging = self._is_dragging_body = False
        scene = server.scene
        blend = np.linspace(0, 1, 64)[:, None, None]
        water = (1 - blend) * WATER_TOP + blend * WATER_BOTTOM
        scene.set_background_image(np.broadcast_to(water, (64, 2, 3)).astype(np.uint8), format="png")
        meshes = browser_meshes(session.scene)
        scene.configure_environment_map(None)
        scene.configure_default_lights(cast_shadow=False)
        scene.add_light_ambient("/lights/water", color=WATER_LIGHT, intensity=1.6)
        self._body_clicked: dict[str, Callable] = {}
        self._bodies = {
            mesh.name: self._add_body(number, mesh, on_body) for number, mesh in enumerate(meshes)
        }
        self._middles = {mesh.name: make_pose(*mesh.middle) for mesh in meshes}
        self._home = {mesh.name: mesh.pose for mesh in meshes}
        self._poses = dict(self._home)
        self._sonar = scene.add_frame("/sonar", show_axes=False)
        self._outline = self._arcs = self._housing = self._surface = None
        self._gizmo = self._add_gizmo("/move_sonar")
        put(self._gizmo, self._on_page(session.pose))
        self._body_gizmo = self._add_gizmo("/move_body", visible=False)
        self._center = np.eye(4)
        self._connect_gizmos()
        self.shows_picture = True
        if session.track is not None:
            self._add_path()

    # ---- what the page tells ------------------------------------------------------------------------------

    def show(self, frame: LiveFrame, pose: np.ndarray) -> None:
        """Show the sonar, its fan and the bodies as they were at a ping, and the gizmo where the sonar is now."""
        device = frame.settings.device
        elevations = device.elevation_fov_deg, device.tilt_deg
        extent = device.fan_edges_rad, elevations, device.range_min_m, device.range_max_m
        if extent != self._fan_extent:
            self._draw_fan(device)
            self._fan_extent = extent
        if self._pose is None or not np.array_equal(self._pose, frame.pose):
            put(self._sonar, self._on_page(frame.pose))
            self._pose = frame.pose
        if not (self._is_dragging or self._actions.waits(id(self._gizmo))):
            now, at = pose_of(self._gizmo.wxyz, self._gizmo.position), self._on_page(pose)
            if not np.allclose(now, at, rtol=0.0, atol=1e-6):
                put(self._gizmo, at)
        for name, node in self._bodies.items():
            world_from_body = frame.bodies.get(name, self._home[name])
            if world_from_body is not self._poses[name]:
                node.visible = world_from_body is not None
                if world_from_body is not None:
                    put(node, self._on_page(world_from_body @ self._middles[name]))
                self._poses[name] = world_from_body
                if name == self._selected and not self._is_dragging_body:
                    self._follow_body()

    def show_picture(self, frame: LiveFrame) -> None:
        """Lay the fan image of a frame into the scene; nothing of a polar picture."""
        if not self.shows_picture or frame.settings.form != "fan":
            for part in self._pictures:
                part.node.visible = False
            return
        geometry, device = fan_geometry(frame.ping, frame.picture.shape[0]), frame.settings.device
        extent = geometry, device.elevation_fov_deg, device.tilt_deg
        if extent != self._picture_extent:
            self._add_pictures(geometry, device, frame.picture)
            self._picture_extent = extent
            return
        for part in self._pictures:
            part.node.image = _with_alpha(part.pixels, frame.picture)
            part.node.visible = True

    def mark(self, surface: Surface | None, range_m: float) -> None:
        """Mark the points of a surface at a range, or none."""
        if self._surface is not None:
            self._surface.remove()
            self._surface = None
        if surface is not None and len(surface.points_m):
            first = surface.points_m[0]  # browsers have no float64
            self._surface = self._server.scene.add_point_cloud(
                "/surface",
                (surface.points_m - first).astype(np.float32),
                SURFACE_COLOR,
                point_size=max(0.02, 0.006 * range_m),
                point_shape="circle",
                precision="float32",
                position=first - self._origin_m,
            )

    def select(self, name: str) -> None:
        """Mark a body, and give it a gizmo; "" for none."""
        if name == self._selected:
            return
        for number, (other, node) in enumerate(self._bodies.items()):
            node.color = _selected_color(number) if other == name else _color(number)
            # a node that is clicked takes the pointer from the gizmo that is inside or behind it
            if other == name:
                node.remove_click_callback()
            elif other == self._selected:
                node.on_click(self._body_clicked[other])
        self._selected = name
        if name in self._bodies:
            self._center = self._middles[name]
            self._follow_body()
        self._body_gizmo.visible = name in self._bodies  # last: from now on it can be dragged

    def show_gizmo(self, visible: bool) -> None:
        """Show the sonar's gizmo or hide it, as while a browser's camera carries the sonar."""
        self._gizmo.visible = self._sonar.visible = visible

    def look_from_behind(self, camera, pose: np.ndarray) -> None:
        """Have a camera look over the sonar into the scene."""
        far_m = self._session.settings.device.range_max_m
        ahead = np.array([pose[0, 0], pose[1, 0], 0.0])
        ahead = ahead / np.linalg.norm(ahead) if np.linalg.norm(ahead) > 1e-6 else np.array([1.0, 0.0, 0.0])
        # to starboard a little, so that the fan is not seen edge on
        side = np.array([ahead[1], -ahead[0], 0.0])
        at_m = self._on_page(pose)[:3, 3]
        place = at_m - 0.28 * far_m * ahead + 0.14 * far_m * side + [0.0, 0.0, 0.36 * far_m]
        camera.up_direction = (0.0, 0.0, 1.0)
        camera.position = place
        camera.look_at = at_m + 0.42 * far_m * ahead - [0.0, 0.0, 0.08 * far_m]

    def look_ahead(self, camera, pose: np.ndarray) -> None:
        at_m = self._on_page(pose)[:3, 3]
        camera.up_direction = (0.0, 0.0, 1.0)
        camera.position = at_m
        camera.look_at = at_m + 3.0 * pose[:3, 0]

    def camera_pose(self, camera) -> np.ndarray:
        """Return the (4, 4) pose of a sonar that looks as a browser's camera does."""
        out = self._in_world(pose_of(camera.wxyz, camera.position))
        out[:3, :3] = out[:3, :3] @ SONAR_FROM_OPTICAL.T
        return out

    def _on_page(self, pose: np.ndarray) -> np.ndarray:
        """Return a (4, 4) pose in the world as the page has it."""
        out = np.array(pose)
        out[:3, 3] -= self._origin_m
        return out

    def _in_world(self, pose: np.ndarray) -> np.ndarray:
        """Return a (4, 4) pose on the page as the world has it."""
        out = np.array(pose)
        out[:3, 3] += self._origin_m
        return out

    # ---- nodes --------------------------------------------------------------------------------------------

    def _add_body(self, number: int, mesh: BrowserMesh, on_body) -> object:
        node = self._server.scene.add_mesh_simple(
            f"/bodies/{number}",
            mesh.vertices,
            mesh.faces,
            color=_color(number),
            flat_shading=True,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
        put(node, self._on_page(mesh.pose @ make_pose(*mesh.middle)))

        async def clicked(event):
            self._actions.ask(event.client, lambda: on_body(mesh.name))

        node.on_click(clicked)
        self._body_clicked[mesh.name] = clicked
        return node

    def _draw_fan(self, device: Sonar) -> None:
        for node in (self._outline, self._arcs, self._housing):
            if node is not None:
                node.remove()
        scene, far_m = self._server.scene, device.range_max_m
        self._outline = scene.add_line_segments(
            "/sonar/outline", fan_outline(device), FAN_COLOR, thickness=2.0, thickness_units="screen"
        )
        arcs = fan_arcs(device, round_step(far_m / 5))
        self._arcs = scene.add_line_segments(
            "/sonar/ranges", arcs, (150, 110, 60), thickness=1.0, thickness_units="screen"
        )
        size = 0.02 * far_m
        self._housing = scene.add_box(
            "/sonar/housing", SONAR_COLOR, dimensions=(size, 1.4 * size, 0.8 * size)
        )

    def _add_gizmo(self, name: str, visible: bool = True) -> object:
        """Add a gizmo that is as large on the screen however far it is."""
        return self._server.scene.add_transform_controls(
            name, scale=GIZMO_PIXELS, fixed=True, depth_test=False, visible=visible
        )

    def _add_pictures(self, geometry: FanGeometry, device: Sonar, picture: np.ndarray) -> None:
        before, self._pictures = self._pictures, []
        for part in before:
            part.node.remove()
        rows, elevation_rad = min(geometry.height, PLANE_HEIGHT), math.radians(device.elevation_fov_deg) / 2
        for number, sector in enumerate(PictureSector.all_of(geometry, elevation_rad, rows)):
            pixels = sector.pixels()
            node = self._server.scene.add_image(
                f"/sonar/picture_{number}",
                _with_alpha(pixels, picture),
                sector.width_m,
                sector.height_m,
                format="png",
                cast_shadow=False,
                receive_shadow=False,
            )
            put(node, device.sonar_from_head @ sector.head_from_picture)
            self._pictures.append(PicturePart(pixels, node))

    def _connect_gizmos(self) -> None:
        gizmo, body_gizmo = self._gizmo, self._body_gizmo

        @gizmo.on_update
        async def _(event):
            self._is_dragging = event.phase != "end"
            place = gizmo.wxyz, gizmo.position
            self._actions.ask(
                event.client, lambda: self._session.set_pose(self._in_world(pose_of(*place))), id(gizmo)
            )

        @body_gizmo.on_update
        async def _(event):
            self._is_dragging_body = event.phase != "end"
            name, center, place = self._selected, self._center, (body_gizmo.wxyz, body_gizmo.position)
            self._actions.ask(
                event.client,
                lambda: self._session.move_body(
                    name, self._in_world(pose_of(*place)) @ np.linalg.inv(center)
                ),
                (id(body_gizmo), name),
            )

    def _follow_body(self) -> None:
        """Put the gizmo of the selected body where that is now."""
        pose = self._session.bodies().get(self._selected)
        if pose is not None:
            put(self._body_gizmo, self._on_page(pose @ self._center))

    def _add_path(self) -> None:
        track = self._session.track
        times_s = np.linspace(0, track.duration_s, 200)
        points = np.array([track.at(time_s)[:3, 3] for time_s in times_s])
        first = points[0].copy()
        points = (points - first).astype(np.float32)
        self._server.scene.add_line_segments(
            "/path",
            np.stack([points[:-1], points[1:]], 1),
            (90, 200, 160),
            thickness=2.0,
            thickness_units="screen",
            position=first - self._origin_m,
        )


def _with_alpha(pixels: PicturePixels, picture: np.ndarray) -> np.ndarray:
    """Return a part of a picture, (h, w, 4) uint8 RGBA: dark water lets the scene through, echoes do not."""
    colors = pixels.of(picture)
    alpha = (pixels.cover * np.maximum(120, colors.max(2))).astype(np.uint8)
    return np.dstack([colors, alpha])


def _color(number: int) -> tuple[int, int, int]:
    return BODY_COLORS[number % len(BODY_COLORS)]


def _selected_color(number: int) -> tuple[int, int, int]:
    """Return half the colour of a body, since a floor all of another colour would drown the scene."""
    return tuple((own + marked) // 2 for own, marked in zip(_color(number), SELECTED_COLOR, strict=True))
