"""What each pixel of a camera shows: what kind of thing, and how far away it is.

Every triangle of the town is drawn in a flat colour that is its number. The plane of that triangle and the ray of the
pixel give the depth in closed form; what no triangle covers is the ground (z = 0) below the horizon and sky above it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from PIL import Image, ImageDraw

from roadproof.datatypes import VehicleState
from roadproof.errors import SimulatorError
from roadproof.geometry import CameraModel
from roadproof.roads.roadmap import RoadMap, Surface
from roadproof.simulators.town import textures
from roadproof.simulators.town.agent_nodes import figure, stride_at
from roadproof.simulators.town.air import dome
from roadproof.simulators.town.engine import (
    VERTEX,
    Node,
    Path,
    Screen,
    Texture,
    core,
    make_node,
    make_pipe,
    make_texture,
)
from roadproof.simulators.town.meshes import Mesh, MeshBuilder, Pose
from roadproof.simulators.town.renderer import CULL_M, whole
from roadproof.simulators.town.scenery import TREES, Scenery
from roadproof.simulators.town.screens import Screens
from roadproof.simulators.town.shading import Layer, dress
from roadproof.simulators.town.streets import KERB_M, build_streets
from roadproof.traffic.agents import Agents

# Six bits of the number in each channel, in the middle of four levels: rounding does not reach the next number.
BITS = 6
MAX_FACES = 2 ** (3 * BITS) - 1
FAR_M = 1000.0
PLAN_PIXEL_M, MAX_PLAN_PX = 0.1, 8192
GROUND_M, GROUND_PIECE_M = 120.0, 30.0


class Label(IntEnum):
    """Kinds of things."""

    SKY = 0
    ROAD = 1
    ROAD_LINE = 2
    SIDEWALK = 3
    TERRAIN = 4
    BUILDING = 5
    FURNITURE = 6
    VEGETATION = 7
    VEHICLE = 8
    PEDESTRIAN = 9


_OF_TEXTURE = {"hedge": Label.VEGETATION, "plain": Label.FURNITURE, "rail": Label.FURNITURE}
_OF_SURFACE = {
    Surface.OTHER: Label.TERRAIN,
    Surface.SIDEWALK: Label.SIDEWALK,
    Surface.SHOULDER: Label.ROAD,
    Surface.DRIVING: Label.ROAD,
}


@dataclass(frozen=True, slots=True, eq=False)
class LabelledPicture:
    """A camera's picture of kinds and distances.

    Args:
        labels: `Label` of each pixel.
        depth_m: distance along the optical axis, metres, at most 1000.
    """

    labels: UInt8[np.ndarray, "h w"]
    depth_m: Float[np.ndarray, "h w"]


class LabelScene:
    """The town as numbered faces, beside its picture in the `Renderer`."""

    def __init__(self, roads: RoadMap, scenery: Scenery) -> None:
        self._roads, self._plan = roads, _Plan(roads)
        self._pipe = make_pipe()
        self._root = core.NodePath("labels")
        self._screens = Screens(lambda camera: Screen(self._pipe, self._root, camera, whole(camera), 1, anywhere=True))
        self._planes: list[Float[np.ndarray, "t 4"]] = [np.array([[0.0, 0.0, 1.0, 0.0]])]
        self._labels: list[UInt8[np.ndarray, " t"]] = [np.array([Label.TERRAIN], np.uint8)]
        self._count = 1
        streets = build_streets(roads)
        self._add(streets.paint, Label.ROAD_LINE, Layer.PAINT)
        self._add(streets.pavement, Label.SIDEWALK, Layer.PAVEMENT)
        self._add(streets.kerbs, Label.SIDEWALK, Layer.PAVEMENT)
        for name, mesh in scenery.meshes.items():
            if not name.startswith("tree"):
                self._add(mesh, _OF_TEXTURE.get(name, Label.BUILDING), Layer.SOLID)
        for kind in range(TREES):
            if (mesh := scenery.meshes.get(f"tree{kind}")) is not None:
                self._add(mesh, Label.VEGETATION, Layer.CUT_OUT, make_texture(_cut_out(textures.tree(kind))))
        self._heaven = self._root.attach_new_node("heaven")
        sky = self._heaven.attach_new_node(_numbered(dome(), 0))
        dress(sky, Layer.SKY)
        # What lies below the road is hidden by it.
        self._ground = self._root.attach_new_node(_numbered(_around(), 0))
        dress(self._ground, Layer.GROUND)
        self._still = self._count
        self._agents = self._root.attach_new_node("agents")

    def close(self) -> None:
        """Give back everything that the scene holds."""
        self._screens.close()
        self._root.remove_node()

    def forget_views(self) -> None:
        """Give the memory of `look` back, until it is called again."""
        self._screens.close()

    def set_agents(self, cars: Agents, people: Agents) -> None:
        """Replace all cars and people."""
        self._agents.remove_node()
        self._agents = self._root.attach_new_node("agents")
        dress(self._agents, Layer.SOLID)
        self._planes, self._labels = [self._all_planes()[: self._still]], [np.concatenate(self._labels)[: self._still]]
        self._count = self._still
        raised = self._roads.surface_at(np.stack([people.x_m, people.y_m], axis=1)) == Surface.SIDEWALK
        heights = np.concatenate([np.zeros(len(cars)), np.where(raised, KERB_M, 0.0)]).tolist()
        for k, height in enumerate(heights):
            on_foot = k >= len(cars)
            agents, i = (people, k - len(cars)) if on_foot else (cars, k)
            mesh = figure(int(agents.look[i]), stride_at(float(agents.travelled_m[i])) if on_foot else None)
            pose = Pose(float(agents.x_m[i]), float(agents.y_m[i]), float(agents.yaw_rad[i]), height)
            placed = replace(mesh, points=pose.place(mesh.points))
            self._attach(self._agents, placed, Label.PEDESTRIAN if on_foot else Label.VEHICLE)

    def look(self, camera: CameraModel, state: VehicleState) -> LabelledPicture:
        """What the camera of a vehicle sees."""
        screen = self._screens.of(camera)
        x, y, z = screen.look_from(state)
        self._heaven.set_pos(x, y, z)
        self._ground.set_pos(x, y, 0.0)
        seen = screen.shoot().astype(np.int64) >> (8 - BITS)
        number = (seen[..., 0] << (2 * BITS)) | (seen[..., 1] << BITS) | seen[..., 2]
        origin, rays = _rays(camera, state)
        planes = self._all_planes()[number]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = (rays * planes[..., :3]).sum(axis=-1)
            depth = (planes[..., 3] - planes[..., :3] @ origin) / along
        labels = np.concatenate(self._labels)[number]
        ground = number == 0
        sky = ground & ~((along < 0) & (depth > 0) & (depth < FAR_M))
        labels[sky] = Label.SKY
        ground &= ~sky
        labels[ground] = self._plan((origin + depth[ground][:, None] * rays[ground])[:, :2])
        depth[sky] = FAR_M
        # Where rounding puts a pixel on the edge of a face that is seen from the side, its plane may be anywhere.
        return LabelledPicture(labels, np.clip(np.nan_to_num(depth, nan=FAR_M), 0.0, FAR_M))

    def _add(self, mesh: Mesh, label: Label, layer: Layer, texture: Texture | None = None) -> None:
        for _, part in mesh.cells(CULL_M):
            path = self._attach(self._root, part, label)
            if texture is not None:
                path.set_texture(texture)
            dress(path, layer)

    def _attach(self, parent: Path, mesh: Mesh, label: Label) -> Path:
        path = parent.attach_new_node(_numbered(mesh, self._count))
        self._count += len(mesh.triangles)
        if self._count > MAX_FACES:
            raise SimulatorError(f"the map has more than {MAX_FACES} faces, too many for depth pictures; cut it down")
        self._planes.append(_planes(mesh))
        self._labels.append(np.full(len(mesh.triangles), label, np.uint8))
        return path

    def _all_planes(self) -> Float[np.ndarray, "t 4"]:
        if len(self._planes) > 1:
            self._planes = [np.concatenate(self._planes)]
        return self._planes[0]


class _Plan:
    """The ground from above, as labels."""

    def __init__(self, roads: RoadMap) -> None:
        x0, y0, x1, y1 = roads.bounds_m
        self._low = np.array([x0, y0])
        self._pixel_m = max(PLAN_PIXEL_M, (x1 - x0) / MAX_PLAN_PX, (y1 - y0) / MAX_PLAN_PX)
        size = (math.ceil((x1 - x0) / self._pixel_m) + 1, math.ceil((y1 - y0) / self._pixel_m) + 1)
        plan = Image.new("L", size, Surface.OTHER)
        pen = ImageDraw.Draw(plan)
        for surface, outline in roads.paved():
            points = ((outline[:, :2] - self._low) / self._pixel_m).tolist()
            pen.polygon([(x, y) for x, y in points], fill=int(surface))
        self._labels = np.array([_OF_SURFACE[surface] for surface in Surface], np.uint8)[np.asarray(plan)]

    def __call__(self, points_m: Float[np.ndarray, "n 2"]) -> UInt8[np.ndarray, " n"]:
        """The label at each point."""
        at = np.round((points_m - self._low) / self._pixel_m).astype(np.int64)
        inside: Bool[np.ndarray, " n"] = np.all((at >= 0) & (at < self._labels.shape[::-1]), axis=1)
        column, row = np.where(inside, at.T, 0)
        return np.where(inside, self._labels[row, column], np.uint8(Label.TERRAIN))


def _around() -> Mesh:
    """The ground around a camera, in pieces."""
    builder = MeshBuilder()
    for x in np.arange(-GROUND_M, GROUND_M, GROUND_PIECE_M):
        for y in np.arange(-GROUND_M, GROUND_M, GROUND_PIECE_M):
            s, t = x + GROUND_PIECE_M, y + GROUND_PIECE_M
            builder.quad(np.array([(x, y, 0.0), (s, y, 0.0), (s, t, 0.0), (x, t, 0.0)]))
    return builder.build()


def _planes(mesh: Mesh) -> Float[np.ndarray, "t 4"]:
    """Unit normal n and offset d of each triangle: n·p = d on it."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return np.column_stack([normals, (normals * a).sum(axis=1)])


def _numbered(mesh: Mesh, first: int) -> Node:
    """A node whose triangles have their numbers as colours; all of `first` where that is 0."""
    triangles = mesh.triangles.reshape(-1)
    numbers = np.repeat(np.arange(len(mesh.triangles)) + first if first else np.zeros(len(mesh.triangles), int), 3)
    vertices = np.zeros(len(triangles), VERTEX)
    vertices["position"], vertices["uv"] = mesh.points[triangles], mesh.uv[triangles]
    vertices["colour"] = _colour(numbers)
    return make_node("faces", vertices, np.arange(len(triangles)).reshape(-1, 3))


def _colour(numbers: Int[np.ndarray, " n"]) -> UInt8[np.ndarray, "n 4"]:
    parts = [(numbers >> (k * BITS)) & (2**BITS - 1) for k in (2, 1, 0)]
    middle = 2 ** (7 - BITS)
    return np.stack([*((part << (8 - BITS)) + middle for part in parts), np.full(len(numbers), 255)], -1).astype(
        np.uint8
    )


def _cut_out(picture: UInt8[np.ndarray, "h w 4"]) -> UInt8[np.ndarray, "h w 4"]:
    """The outline alone: white where there is something."""
    white = np.full_like(picture, 255)
    white[..., 3] = picture[..., 3]
    return white


def _rays(camera: CameraModel, state: VehicleState) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "h w 3"]]:
    """The camera's place, and for each pixel the way it looks, 1 m along the optical axis."""
    projection = camera.image_from_world(state)
    inverse = np.linalg.inv(projection[:, :3])
    columns, rows = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    pixels = np.stack([columns, rows, np.ones_like(rows)], -1).astype(float)
    return -inverse @ projection[:, 3], pixels @ inverse.T
