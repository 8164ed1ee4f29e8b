"""The town as it is seen: meshes, light and textures put together for the software renderer, drawn back to front.

The renderer has neither shaders nor fog nor alpha that can be trusted on edges, so all light is baked: into pictures of
the ground, a cell at a time, and into vertex colours. Haze is a row of translucent cards.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from roadproof.datatypes import VehicleState, Weather
from roadproof.geometry import (
    CameraModel,
    CanvasPlacement,
    CropResize,
)
from roadproof.simulators.town import textures
from roadproof.simulators.town.air import dome, haze_cards, rain_card
from roadproof.simulators.town.canvas import (
    GRAIN_TILE_M,
    road_patch,
)
from roadproof.simulators.town.canvas_node import CanvasNode
from roadproof.simulators.town.engine import (
    VERTEX,
    Node,
    Path,
    Screen,
    Texture,
    core,
    fill_texture,
    ground_stage,
    make_node,
    make_pipe,
    make_texture,
)
from roadproof.simulators.town.ground import FINE_M, LitGround, build_ground, light_ground
from roadproof.simulators.town.layers import Layer, dress
from roadproof.simulators.town.meshes import Mesh, MeshBuilder, joined
from roadproof.simulators.town.models import PAINTS, Body, car, person
from roadproof.simulators.town.roadmap import RoadMap
from roadproof.simulators.town.scenery import FACADES, SHOPS, TREES, Scenery
from roadproof.simulators.town.shading import rgba, shaded, turned
from roadproof.simulators.town.streets import KERB_M, build_streets
from roadproof.simulators.town.weather import SKIES, Sky, sky_picture

CELL_M, CELL_MARGIN_M = 30.0, 1.0
CULL_M = 60.0
NEAR_SEEN_M = 65.0
NEAR_GRID_M = 4.0
HIDDEN_DEPTH = 4.0
FAR_LAND_M = 520.0
HEADINGS = 8
PERSON_LOOKS = 12
STRIDES = (-1.0, -0.4, 0.4, 1.0)
FRAME, PICTURE = 0, 1
RAIN_VARIANTS = 6


ATLAS_COLUMNS = 4
SOLID_TEXTURES: dict[str, Callable[[], UInt8[np.ndarray, "h w c"]]] = {
    **{f"facade{kind}": functools.partial(textures.facade, kind) for kind in range(FACADES)},
    **{f"shop{kind}": functools.partial(textures.shop_front, kind) for kind in range(SHOPS)},
    "concrete": textures.concrete,
    "roof": textures.roof_tiles,
    "hedge": textures.hedge,
    "rail": textures.guard_rail,
    "plain": textures.plain,
}
FURNITURE = ("plain", "hedge", "rail")


NEAR_LAYERS = (Layer.PAINT, Layer.PAVEMENT, Layer.SMALL)


@dataclass(frozen=True, slots=True)
class Actor:
    """A car or someone on foot, as it is drawn.

    Args:
        person: on foot rather than a car.
        look: picks shape and colours.
        x_m: world x of its middle.
        y_m: world y.
        yaw_rad: where it is turned.
        raised: on the pavement rather than on the road.
        walked_m: how far it has gone, for the step of its feet.
    """

    person: bool
    look: int
    x_m: float
    y_m: float
    yaw_rad: float
    raised: bool = False
    walked_m: float = 0.0

    @property
    def z_m(self) -> float:
        """Height of what it stands on."""
        return KERB_M if self.raised else 0.0

    @property
    def stride(self) -> int:
        """Which of `STRIDES` its legs show: two steps are 1.5 m."""
        return (0, 1, 2, 3, 2, 1)[int(self.walked_m / 1.5 * 6) % 6]


class Renderer:
    """Draws one town from one camera."""

    def __init__(self, roads: RoadMap, scenery: Scenery, camera: CameraModel, crop: CropResize) -> None:
        self._camera, self._crop = camera, crop
        self._pipe = make_pipe()
        self._root = core.NodePath("town")
        self._streets = build_streets(roads)
        self._scenery = scenery
        self._ground = build_ground(roads, scenery, CELL_M)
        self._grain = textures.asphalt_grain()
        self._textures = _static_textures(self._grain)
        walls = {name: mesh for name, mesh in scenery.meshes.items() if name not in FURNITURE}
        furniture = {name: mesh for name, mesh in scenery.meshes.items() if name in FURNITURE}
        self._walls, self._furniture = (_with_atlas(meshes, list(SOLID_TEXTURES)) for meshes in (walls, furniture))
        self._trees = _with_atlas(scenery.meshes, [f"tree{kind}" for kind in range(TREES)])
        self._stage = ground_stage()
        self._screens: dict[int, Screen] = {}
        self._views: dict[CameraModel, Screen] = {}
        self._weather: Weather | None = None
        self._lit: LitGround
        self._lit_nodes: Path = None
        self._shown_from: tuple[int, int] | None = None
        self._districts: dict[tuple[int, int, bool], Path] = {}
        self._land = _CellTextures(self._ground.size_m)
        self._crops = ((crop, 2), (whole(camera), 2))
        self._canvas = CanvasNode(self._root, camera, self._crops)
        self._follow = self._root.attach_new_node("follow")
        self._haze = self._root.attach_new_node("haze")
        self._drops: list[Path] = []
        self._sky_texture: Texture = None
        self._actors: list[_ActorNode] = []
        self._models: dict[tuple[bool, int, int], list[Node]] = {}

    def set_weather(self, weather: Weather) -> None:
        """Bake the light of a weather into everything; nothing happens where it is that weather already."""
        if weather is self._weather:
            return
        self._weather, sky = weather, SKIES[weather]
        self._lit = light_ground(self._ground, self._scenery, sky)
        self._land.bake(self._lit)
        if self._lit_nodes is not None:
            self._lit_nodes.remove_node()
        self._lit_nodes = self._root.attach_new_node("lit")
        self._districts.clear()
        self._shown_from = None
        self._build_land(sky)
        self._build_streets(sky)
        self._build_scenery(sky)
        self._build_air(sky)
        self._models.clear()
        self._canvas.forget()

    def set_canvas(self, placement: CanvasPlacement, pattern: UInt8[np.ndarray, "400 400 4"] | None) -> None:
        """Lay the canvas and paint a pattern on it."""
        self._canvas.lay(placement, lambda: road_patch(self._lit, placement, self._grain, self._streets.paint))
        self._canvas.paint(pattern)

    def set_actors(self, actors: Sequence[Actor]) -> None:
        """Replace all cars and people; afterwards `move_actors` moves as many."""
        for node in self._actors:
            node.remove()
        self._actors = [_ActorNode(self, self._root, actor) for actor in actors]
        self.move_actors(actors)

    def move_actors(self, actors: Sequence[Actor]) -> None:
        """Put the cars and people of `set_actors` where they are now."""
        for node, actor in zip(self._actors, actors, strict=True):
            node.move(actor)

    def frame(self, state: VehicleState, tick: int = 0) -> UInt8[np.ndarray, "h w 3"]:
        """The controller's input, rendered at twice its resolution; `tick` moves the rain."""
        return self._shoot(FRAME, state, tick)

    def picture(self, state: VehicleState, tick: int = 0) -> UInt8[np.ndarray, "h w 3"]:
        """The full camera picture, rendered at twice its resolution."""
        return self._shoot(PICTURE, state, tick)

    def view(self, camera: CameraModel, state: VehicleState, tick: int = 0) -> UInt8[np.ndarray, "h w 3"]:
        """The picture of any camera, for worlds without a canvas."""
        if camera not in self._views:
            self._views[camera] = Screen(self._pipe, self._root, camera, whole(camera), 2)
        screen = self._views[camera]
        self._aim(screen, state, tick)
        return screen.shoot()

    def _shoot(self, which: int, state: VehicleState, tick: int) -> UInt8[np.ndarray, "h w 3"]:
        crop, magnified = self._crops[which]
        if which not in self._screens:
            self._screens[which] = Screen(self._pipe, self._root, self._camera, crop, magnified)
        screen = self._screens[which]
        self._aim(screen, state, tick)
        self._canvas.see(state, which)
        return screen.shoot()

    def close(self) -> None:
        """Give everything back."""
        for screen in (*self._screens.values(), *self._views.values()):
            screen.close()
        self._screens.clear()
        self._views.clear()
        self._root.remove_node()
        self._models.clear()
        self._actors.clear()

    def models(self, actor: Actor, stride: int) -> list[Node]:
        """Nodes of an actor's mesh, lit for each heading, in the sun and then in the shade."""
        look = actor.look % PERSON_LOOKS if actor.person else actor.look % (len(Body) * len(PAINTS))
        key = (actor.person, look, stride)
        if key not in self._models:
            if actor.person:
                mesh = person(look, STRIDES[stride])
            else:
                mesh = car(Body(look % len(Body)), PAINTS[look // len(Body)])
            sky = self._lit.sky
            self._models[key] = [
                _node(mesh, shaded(turned(mesh, 2 * math.pi * k / HEADINGS), sky, np.full(len(mesh.points), sun)))
                for sun in (1.0, 0.0)
                for k in range(HEADINGS)
            ]
        return self._models[key]

    def texture(self, name: str) -> Texture:
        """One of the town's own textures."""
        return self._textures[name]

    def in_shade(self, x_m: float, y_m: float) -> bool:
        """Whether the sun is hidden at a place."""
        low, plane = self._ground.low_m, self._lit.sunlit
        row = min(max(int((y_m - low[1]) * 4), 0), plane.shape[0] - 1)
        column = min(max(int((x_m - low[0]) * 4), 0), plane.shape[1] - 1)
        return bool(plane[row, column] < 128)

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
            if k == tick * 5 % RAIN_VARIANTS:
                drop.show()
            else:
                drop.hide()

    def _build_land(self, sky: Sky) -> None:
        """Cells of ground, and the country around the town."""
        low, (columns, rows) = self._ground.low_m, self._land.count
        for column in range(columns):
            for row in range(rows):
                x, y = low[0] + column * CELL_M, low[1] + row * CELL_M
                corners = np.array([(x, y, 0), (x + CELL_M, y, 0), (x + CELL_M, y + CELL_M, 0), (x, y + CELL_M, 0)])
                builder = MeshBuilder()
                builder.quad(corners, corners[:, :2] / GRAIN_TILE_M)
                mesh = builder.build()
                node = _node(mesh, np.full((4, 4), 255, np.uint8), self._land.uv(mesh.points, (column, row), low))
                self._attach(node, Layer.GROUND, self._textures["asphalt"], self._land.textures[column, row])
        x0, y0 = low
        x1, y1 = x0 + self._ground.size_m[0], y0 + self._ground.size_m[1]
        far = FAR_LAND_M
        builder = MeshBuilder()
        for a, b, c, d in (
            (x0 - far, y0 - far, x1 + far, y0), (x0 - far, y1, x1 + far, y1 + far),
            (x0 - far, y0, x0, y1), (x1, y0, x1 + far, y1),
        ):  # fmt: skip
            for u in np.arange(a, c, 260.0):
                for v in np.arange(b, d, 260.0):
                    s, t = min(u + 260.0, c), min(v + 260.0, d)
                    corners = np.array([(u, v, 0.0), (s, v, 0), (s, t, 0), (u, t, 0)])
                    builder.quad(corners, corners[:, :2] / 8.0, (0.36, 0.44, 0.24))
        mesh = builder.build()
        self._attach(_node(mesh, shaded(mesh, sky, np.ones(len(mesh.points)))), Layer.FAR_LAND, self._textures["grass"])

    def _build_streets(self, sky: Sky) -> None:
        streets, low = self._streets, self._ground.low_m
        for (i, j), part in streets.pavement.cells(CELL_M):
            cell = (i - round(low[0] / CELL_M), j - round(low[1] / CELL_M))
            node = _node(part, np.full((len(part.points), 4), 255, np.uint8), self._land.uv(part.points, cell, low))
            self._attach(node, Layer.PAVEMENT, self._textures["slabs"], self._land.textures[cell])
        for _, part in streets.kerbs.cells(CULL_M):
            self._attach(_node(part, self._streetlight(part, sky)), Layer.PAVEMENT, self._textures["plain"])
        for _, part in streets.paint.cells(CULL_M):
            self._attach(_node(part, self._streetlight(part, sky)), Layer.PAINT, self._textures["plain"])

    def _streetlight(self, mesh: Mesh, sky: Sky) -> UInt8[np.ndarray, "n 4"]:
        """Light that follows the shadows on the ground."""
        facing = np.clip(mesh.normals @ sky.to_sun, 0, None)
        points = mesh.points[:, :2]
        sunlit, open_sky = self._lit.sunlit_at(points), self._lit.open_sky_at(points)
        light = sky.light(facing, sunlit, open_sky * (0.6 + 0.4 * np.abs(mesh.normals[:, 2])))
        mirrored = np.array(self._lit.mirrored)
        share = self._lit.water_at(points)[:, None] * (mesh.normals[:, 2:] > 0.5) * (mesh.points[:, 2:] < 0.01)
        damp = 1 - 0.15 * sky.wetness
        return rgba(mesh.albedo * light * damp * (1 - share) + share * mirrored / 255)

    def _build_scenery(self, sky: Sky) -> None:
        for layer, name, mesh in (
            (Layer.SOLID, "solids", self._walls),
            (Layer.SMALL, "solids", self._furniture),
            (Layer.CUT_OUT, "trees", self._trees),
        ):
            for node in _lit_nodes(mesh, sky):
                self._attach(node, layer, self._textures[name])

    def _attach(self, node: Node, layer: Layer, texture: Texture, ground: Texture | None = None) -> None:
        path = self._district(node, layer).attach_new_node(node)
        path.set_texture(texture)
        if ground is not None:
            path.set_texture(self._stage, ground)
        dress(path, layer)

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
            if dx * dx + dy * dy < reach * reach:
                district.show()
            else:
                district.hide()

    def _build_air(self, sky: Sky) -> None:
        for old in (*self._follow.get_children(), *self._haze.get_children()):
            old.remove_node()
        heaven = self._follow.attach_new_node(_node(*dome()))
        self._sky_texture = make_texture(sky_picture(sky), repeat=True, mipmaps=False)
        heaven.set_texture(self._sky_texture)
        dress(heaven, Layer.SKY)
        tangent = 1.3 * math.tan(math.radians(self._camera.fov_deg) / 2)
        for mesh, colours in haze_cards(sky, tangent, self._camera.up_m):
            card = self._haze.attach_new_node(_node(mesh, colours))
            card.set_texture(self._textures["plain"])
            dress(card, Layer.HAZE)
        self._drops = []
        if sky.drops:
            texture = make_texture(textures.rain_streaks(sky.drops), repeat=True, mipmaps=False)
            for k in range(RAIN_VARIANTS):
                mesh, colours = rain_card(tangent, k)
                drop = self._haze.attach_new_node(_node(mesh, colours))
                drop.set_texture(texture)
                dress(drop, Layer.RAIN)
                self._drops.append(drop)


def whole(camera: CameraModel) -> CropResize:
    """All of a camera's picture."""
    return CropResize(
        left_px=0, top_px=0, right_px=camera.width_px, bottom_px=camera.height_px,
        width_px=camera.width_px, height_px=camera.height_px,
    )  # fmt: skip


class _CellTextures:
    """One baked picture of the ground per cell; coarser where nothing is paved."""

    def __init__(self, size_m: tuple[float, float]) -> None:
        self.count = (round(size_m[0] / CELL_M), round(size_m[1] / CELL_M))
        self.textures: dict[tuple[int, int], Texture] = {}

    def bake(self, lit: LitGround) -> None:
        n = round(CELL_M / FINE_M)
        levels = [min(255, round(v * 255 / textures.GRAIN_MEAN)) for v in range(256)] * 3
        for column in range(self.count[0]):
            for row in range(self.count[1]):
                paved = lit.ground.hard.crop((column * n, row * n, column * n + n, row * n + n)).getbbox() is not None
                image = lit.cell(column, row, CELL_M, CELL_MARGIN_M)
                picture = np.asarray((image if paved else image.reduce(4)).point(levels))
                if (column, row) in self.textures:
                    fill_texture(self.textures[column, row], picture)
                else:
                    self.textures[column, row] = make_texture(picture)

    def uv(
        self, points: Float[np.ndarray, "n 3"], cell: tuple[int, int], low: tuple[float, float]
    ) -> Float[np.ndarray, "n 2"]:
        """Coordinates of points in the picture of a cell."""
        corner = np.array(low) + np.array(cell) * CELL_M - CELL_MARGIN_M
        return (points[:, :2] - corner) / (CELL_M + 2 * CELL_MARGIN_M)


class _ActorNode:
    """One car or person in the scene, with the dark spot below it."""

    def __init__(self, renderer: Renderer, root: Path, actor: Actor) -> None:
        self._renderer = renderer
        self._holder = core.PandaNode("actor")
        self._path = root.attach_new_node(self._holder)
        self._path.set_texture(renderer.texture("plain"))
        dress(self._path, Layer.SOLID)
        half = np.array((0.42, 0.42) if actor.person else (2.55, 1.25))
        builder = MeshBuilder()
        builder.quad(np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)]) * np.append(half, 1))
        self._shade = self._path.attach_new_node(_node(builder.build(), np.full((4, 4), 255, np.uint8)))
        self._shade.set_texture(renderer.texture("shade"))
        dress(self._shade, Layer.PAVEMENT_SHADE if actor.raised else Layer.SHADE)
        self._raised = actor.raised
        self._shown: Node = None

    def move(self, actor: Actor) -> None:
        self._path.set_pos_hpr(actor.x_m, actor.y_m, actor.z_m, math.degrees(actor.yaw_rad), 0.0, 0.0)
        if actor.raised != self._raised:
            self._raised = actor.raised
            dress(self._shade, Layer.PAVEMENT_SHADE if actor.raised else Layer.SHADE)
        stride = actor.stride if actor.person else 0
        heading = round(actor.yaw_rad / (2 * math.pi / HEADINGS)) % HEADINGS
        shade = HEADINGS if self._renderer.in_shade(actor.x_m, actor.y_m) else 0
        wanted = self._renderer.models(actor, stride)[heading + shade]
        if wanted is not self._shown:
            if self._shown is not None:
                self._holder.remove_child(self._shown)
            self._holder.add_child(wanted)
            self._shown = wanted

    def remove(self) -> None:
        self._path.remove_node()


def _static_textures(grain: UInt8[np.ndarray, "g g 3"]) -> dict[str, Texture]:
    """Textures that are the same in all weathers: the ground's grains, and what the scenery uses."""
    made = {
        "asphalt": make_texture(grain, repeat=True),
        "slabs": make_texture(textures.slab_grain(), repeat=True),
        "grass": make_texture(textures.grass_grain(), repeat=True),
        "plain": make_texture(textures.plain(), mipmaps=False),
        "shade": make_texture(textures.contact_shadow(), mipmaps=False),
    }
    made["solids"] = make_texture(textures.atlas([maker() for maker in SOLID_TEXTURES.values()], ATLAS_COLUMNS))
    trees = [textures.tree(kind) for kind in range(TREES)]
    made["trees"] = make_texture(textures.atlas(trees, ATLAS_COLUMNS))
    return made


def _with_atlas(meshes: Mapping[str, Mesh], names: Sequence[str]) -> Mesh:
    """The meshes of some textures as one, with the coordinates of the atlas they share."""
    parts = [
        dataclasses.replace(mesh, uv=textures.atlas_uv(mesh.uv, i, ATLAS_COLUMNS, len(names)))
        for i, name in enumerate(names)
        if (mesh := meshes.get(name)) is not None
    ]
    return joined(parts)


def _node(mesh: Mesh, colours: UInt8[np.ndarray, "n 4"], ground_uv: Float[np.ndarray, "n 2"] | None = None) -> Node:
    vertices = np.zeros(len(mesh.points), VERTEX)
    vertices["position"], vertices["uv"], vertices["colour"] = mesh.points, mesh.uv, colours
    if ground_uv is not None:
        vertices["ground_uv"] = ground_uv.round(5)
    return make_node("mesh", vertices, mesh.triangles)


def _lit_nodes(mesh: Mesh, sky: Sky) -> list[Node]:
    return [_node(part, shaded(part, sky, np.ones(len(part.points)))) for _, part in mesh.cells(CULL_M)]
