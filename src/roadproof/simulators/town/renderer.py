"""The town as it is seen: land, scenery, agents, canvas and air put together for the renderer, back to front.

The software renderer has neither shaders nor fog nor alpha that can be trusted on edges, so all light is baked: into
pictures of the ground, a cell at a time, and into vertex colours. Haze is a row of translucent cards.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import UInt8

from roadproof.datatypes import VehicleState, Weather
from roadproof.geometry import CameraModel, CanvasPlacement, CropResize
from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.town import textures
from roadproof.simulators.town.agent_nodes import AgentNodes
from roadproof.simulators.town.air import dome, haze_cards, rain_card
from roadproof.simulators.town.canvas import road_patch
from roadproof.simulators.town.canvas_node import CanvasNode
from roadproof.simulators.town.engine import (
    Graphics,
    Node,
    Path,
    Screen,
    Texture,
    core,
    ground_stage,
    make_pipe,
    make_texture,
)
from roadproof.simulators.town.ground import LitGround, build_ground, light_ground
from roadproof.simulators.town.land import CELL_M, Land
from roadproof.simulators.town.materials import split_by_atlas, static_textures
from roadproof.simulators.town.scenery import Scenery
from roadproof.simulators.town.screens import Screens
from roadproof.simulators.town.shading import Layer, dress, mesh_node, shaded
from roadproof.simulators.town.streets import build_streets
from roadproof.simulators.town.weather import SKIES, Sky, sky_picture
from roadproof.traffic.agents import Agents

CULL_M = 60.0
NEAR_SEEN_M = 65.0
NEAR_GRID_M = 4.0
HIDDEN_DEPTH = 4.0
FRAME, PICTURE = 0, 1
RAIN_VARIANTS = 6
KEPT_PATCHES = 16
NEAR_LAYERS = (Layer.PAINT, Layer.PAVEMENT, Layer.SMALL)


class Renderer:
    """Draws one town from one camera."""

    def __init__(
        self,
        roads: RoadMap,
        scenery: Scenery,
        camera: CameraModel,
        crop: CropResize,
        graphics: Graphics = Graphics.SOFTWARE,
    ) -> None:
        self._camera, self._graphics = camera, graphics
        self._pipe = make_pipe(graphics)
        self._root = core.NodePath("town")
        self._streets = build_streets(roads)
        self._scenery = scenery
        self._ground = build_ground(roads, scenery, CELL_M)
        self._grain = textures.asphalt_grain()
        self._textures = static_textures(self._grain)
        self._walls, self._furniture, self._trees = split_by_atlas(scenery.meshes)
        self._land = Land(self._ground, self._streets, self._textures)
        self._stage = ground_stage()
        self._screens: dict[int, Screen] = {}
        self._views = Screens(lambda camera: Screen(self._pipe, self._root, camera, whole(camera), 2, anywhere=True))
        self._painted: dict[CanvasPlacement, UInt8[np.ndarray, "400 400 4"]] = {}
        self._patches: dict[tuple[CameraModel, CanvasPlacement], CanvasNode] = {}
        self._laid: dict[tuple[CameraModel, CanvasPlacement], UInt8[np.ndarray, "400 400 4"]] = {}
        self._weather: Weather | None = None
        self._lit: LitGround
        self._lit_nodes: Path = None
        self._shown_from: tuple[int, int] | None = None
        self._districts: dict[tuple[int, int, bool], Path] = {}
        self._crops = ((crop, 2), (whole(camera), 2))
        self._canvas = CanvasNode(self._root, camera, self._crops, graphics)
        self._agents = AgentNodes(self._root, roads, camera, self._textures["shade"])
        self._follow = self._root.attach_new_node("follow")
        self._haze = self._root.attach_new_node("haze")
        self._drops: list[Path] = []

    def set_weather(self, weather: Weather) -> None:
        """Bake the light of a weather into everything; nothing happens where it is that weather already."""
        if weather is self._weather:
            return
        self._weather, sky = weather, SKIES[weather]
        self._lit = light_ground(self._ground, self._scenery, sky)
        if self._lit_nodes is not None:
            self._lit_nodes.remove_node()
        self._lit_nodes = self._root.attach_new_node("lit")
        self._districts.clear()
        self._shown_from = None
        for node, layer, texture, ground in self._land.nodes(self._lit):
            self._attach(node, layer, texture, ground)
        self._build_scenery(sky)
        self._build_air(sky)
        self._agents.relight(self._lit)
        self._canvas.forget()
        for patch in self._patches.values():
            patch.forget()
        self._laid.clear()

    def set_canvas(self, placement: CanvasPlacement, pattern: UInt8[np.ndarray, "400 400 4"] | None) -> None:
        """Lay the canvas and paint a pattern on it."""
        self._canvas.lay(placement, lambda: road_patch(self._lit, placement, self._grain, self._streets.paint))
        self._canvas.paint(pattern)

    def paint_road(self, paints: Mapping[CanvasPlacement, UInt8[np.ndarray, "400 400 4"]]) -> None:
        """Paint places of the road for `view`; those painted before and not given are bare again."""
        self._painted = dict(paints)

    def set_agents(self, cars: Agents, people: Agents) -> None:
        """Show these cars and people, and no others, from now on."""
        self._agents.populate(cars, people)

    def frame(self, state: VehicleState, tick: int = 0) -> UInt8[np.ndarray, "h w 3"]:
        """The controller's input, rendered at twice its resolution; `tick` moves the rain."""
        return self._shoot(FRAME, state, tick)

    def picture(self, state: VehicleState, tick: int = 0) -> UInt8[np.ndarray, "h w 3"]:
        """The full camera picture, rendered at twice its resolution."""
        return self._shoot(PICTURE, state, tick)

    def view(self, camera: CameraModel, state: VehicleState, tick: int = 0) -> UInt8[np.ndarray, "h w 3"]:
        """The picture of any camera, with the places of `paint_road` instead of a canvas."""
        screen = self._views.of(camera)
        self._aim(screen, state, tick)
        self._agents.see(state, everybody=True)
        self._see_patches(camera, state)
        return screen.shoot()

    def close(self) -> None:
        """Give back everything that the renderer holds."""
        for screen in self._screens.values():
            screen.close()
        self._screens.clear()
        self._views.close()
        self._root.remove_node()

    def forget_views(self) -> None:
        """Give the memory of `view` back, until it is called again."""
        self._views.close()
        for patch in self._patches.values():
            patch.close()
        self._patches.clear()
        self._laid.clear()

    def _shoot(self, which: int, state: VehicleState, tick: int) -> UInt8[np.ndarray, "h w 3"]:
        crop, magnified = self._crops[which]
        if which not in self._screens:
            self._screens[which] = Screen(self._pipe, self._root, self._camera, crop, magnified)
        screen = self._screens[which]
        self._aim(screen, state, tick)
        self._agents.see(state)
        self._canvas.see(state, which)
        return screen.shoot()

    def _see_patches(self, camera: CameraModel, state: VehicleState) -> None:
        """Lay the painted places near a camera that is anywhere, and shape them for its view."""
        for patch in self._patches.values():
            patch.hide()
        # How fine a copy of the paint suits a row depends on the height above the road.
        up_m = max(round(camera.up_m + state.z_m, 1), 0.1)
        raised = replace(camera, up_m=up_m)
        below = replace(state, z_m=camera.up_m + state.z_m - up_m)
        seen = 0
        for place, pattern in self._painted.items():
            if math.hypot(place.x_m - state.x_m, place.y_m - state.y_m) > NEAR_SEEN_M + place.length_m:
                continue
            key = (raised, place)
            # Taken out and put back, so that the first are those unused for longest.
            patch = self._patches.pop(key, None)
            self._patches[key] = patch or CanvasNode(self._root, raised, ((whole(raised), 2),), self._graphics)
            seen += 1
            if self._laid.get(key) is not pattern:
                self._patches[key].lay(place, partial(road_patch, self._lit, place, self._grain, self._streets.paint))
                self._patches[key].paint(pattern)
                self._laid[key] = pattern
            self._patches[key].see(below, 0)
        for key in list(self._patches)[: -max(seen, KEPT_PATCHES)]:
            self._patches.pop(key).close()
            self._laid.pop(key, None)

    def _aim(self, screen: Screen, state: VehicleState, tick: int) -> None:
        x, y, z = screen.look_from(state)
        # A grid, so that what is shown depends on the place alone and is seldom decided anew.
        place = (round(x / NEAR_GRID_M), round(y / NEAR_GRID_M))
        if place != self._shown_from:
            self._shown_from = place
            self._show_near(place[0] * NEAR_GRID_M, place[1] * NEAR_GRID_M)
        self._follow.set_pos(x, y, z)
        self._haze.set_pos_hpr(x, y, z, math.degrees(state.yaw_rad) - 90.0, 0.0, 0.0)
        for k, drop in enumerate(self._drops):
            (drop.show if k == tick * 5 % RAIN_VARIANTS else drop.hide)()

    def _build_scenery(self, sky: Sky) -> None:
        for layer, name, mesh in (
            (Layer.SOLID, "solids", self._walls),
            (Layer.SMALL, "solids", self._furniture),
            (Layer.CUT_OUT, "trees", self._trees),
        ):
            for _, part in mesh.cells(CULL_M):
                node = mesh_node(part, shaded(part, sky, np.ones(len(part.points))))
                self._attach(node, layer, self._textures[name])

    def _attach(self, node: Node, layer: Layer, texture: Texture | None, ground: Texture | None = None) -> None:
        path = self._district(node, layer).attach_new_node(node)
        if texture is not None:
            path.set_texture(texture)
        if ground is not None:
            path.set_texture(self._stage, ground)
        dress(path, layer)
        if layer is Layer.GROUND and self._graphics is Graphics.EGL:
            # OpenGL keeps no depth where it tests none.
            path.set_attrib(core.DepthTestAttrib.make(core.RenderAttrib.M_always))

    def _district(self, node: Node, layer: Layer) -> Path:
        """The parent of the nodes of a part of town, of which small things are seen from near only."""
        middle = node.get_bounds().get_approx_center()
        key = (math.floor(middle.x / CULL_M), math.floor(middle.y / CULL_M), layer in NEAR_LAYERS)
        if key not in self._districts:
            self._districts[key] = self._lit_nodes.attach_new_node("district")
        return self._districts[key]

    def _show_near(self, x_m: float, y_m: float) -> None:
        """Leave out what is too small or too deep in the haze to be seen."""
        farthest = HIDDEN_DEPTH / self._lit.sky.density_per_m
        for (column, row, small), district in self._districts.items():
            dx = max(abs(x_m - (column + 0.5) * CULL_M) - CULL_M / 2, 0)
            dy = max(abs(y_m - (row + 0.5) * CULL_M) - CULL_M / 2, 0)
            reach = min(farthest, NEAR_SEEN_M) if small else farthest
            (district.show if dx * dx + dy * dy < reach * reach else district.hide)()

    def _build_air(self, sky: Sky) -> None:
        for old in (*self._follow.get_children(), *self._haze.get_children()):
            old.remove_node()
        heaven = self._follow.attach_new_node(mesh_node(dome()))
        heaven.set_texture(make_texture(sky_picture(sky), repeat=True, mipmaps=False))
        dress(heaven, Layer.SKY)
        tangent = 1.3 * math.tan(math.radians(self._camera.fov_deg) / 2)
        for card in haze_cards(sky, tangent, self._camera.up_m):
            dress(self._haze.attach_new_node(mesh_node(*card)), Layer.HAZE)
        self._drops = []
        if sky.drops:
            texture = make_texture(textures.rain_streaks(sky.drops), repeat=True, mipmaps=False)
            for k in range(RAIN_VARIANTS):
                drop = self._haze.attach_new_node(mesh_node(rain_card(tangent, k)))
                drop.set_texture(texture)
                dress(drop, Layer.RAIN)
                self._drops.append(drop)


def whole(camera: CameraModel) -> CropResize:
    """All of a camera's picture."""
    return CropResize(
        left_px=0, top_px=0, right_px=camera.width_px, bottom_px=camera.height_px,
        width_px=camera.width_px, height_px=camera.height_px,
    )  # fmt: skip
