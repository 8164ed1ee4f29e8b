"""What stands along the roads of a map: houses, trees, lamps, guard rails, parked cars. One seed, one town."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from roadproof.errors import ScenarioError
from roadproof.roads.lanes import Lane
from roadproof.roads.polylines import interpolated, polyline_stations
from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.town.meshes import FACE, UNIT, Mesh, MeshBuilder, Pose, Rgb
from roadproof.simulators.town.models import CAR_HALF_M, PAINTS, Body, car

SEED = 40
MARGIN_M = 45.0
GRID_M = 0.5
LEVEL_M = 0.02
STOREY_M, SHOP_M = 3.1, 3.6
FACADES, SHOPS, TREES = 7, 4, 5
ROOFS: tuple[Rgb, ...] = ((0.62, 0.36, 0.27), (0.52, 0.30, 0.24), (0.36, 0.36, 0.38), (0.46, 0.34, 0.28))
_JOINED_M = 2.6
POST: Rgb = (0.24, 0.26, 0.27)


@dataclass(frozen=True, slots=True)
class Solid:
    """Something one can hit: a box, `half_m` from its middle along and across, from the ground up.

    Boxes with the same `thing` are one object, which is hit once, such as the pieces of a guard rail.
    """

    name: str
    pose: Pose
    half_m: tuple[float, float]
    height_m: float
    casts_shadow: bool = True
    thing: str = ""

    @property
    def corners(self) -> Float[np.ndarray, "4 2"]:
        """Its footprint, counter-clockwise."""
        return edge_corners(self.pose, *self.half_m)

    def apart_m(self, x_m: float, y_m: float) -> float:
        """How far a place is from the footprint, metres; 0 inside."""
        c, s = math.cos(self.pose.yaw_rad), math.sin(self.pose.yaw_rad)
        dx, dy = x_m - self.pose.x_m, y_m - self.pose.y_m
        along, across = abs(c * dx + s * dy) - self.half_m[0], abs(c * dy - s * dx) - self.half_m[1]
        return math.hypot(max(along, 0.0), max(across, 0.0))


@dataclass(frozen=True, slots=True)
class Tree:
    """A tree: where, and how tall."""

    x_m: float
    y_m: float
    height_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Scenery:
    """All that stands beside the roads.

    Args:
        meshes: the meshes by the name of their texture.
        trees: the trees, cut-outs of which the trunk is solid.
        solids: the things that one can hit, or that cast shadows.
        paved: outlines of drives and forecourts, world x, y in metres.
    """

    meshes: dict[str, Mesh]
    trees: tuple[Tree, ...]
    solids: tuple[Solid, ...]
    paved: tuple[Float[np.ndarray, "n 2"], ...]


@dataclass(slots=True)
class _Site:
    """The plan while the town is being built: what is taken, and what was put there."""

    low: Float[np.ndarray, " 2"]
    taken: Image.Image
    rng: np.random.Generator
    builders: dict[str, MeshBuilder] = field(default_factory=dict[str, MeshBuilder])
    trees: list[Tree] = field(default_factory=list[Tree])
    solids: list[Solid] = field(default_factory=list[Solid])
    paved: list[np.ndarray] = field(default_factory=list[np.ndarray])

    def builder(self, texture: str) -> MeshBuilder:
        return self.builders.setdefault(texture, MeshBuilder())

    def pixels(self, points: np.ndarray) -> list[tuple[float, float]]:
        return [(float(x), float(y)) for x, y in (points[:, :2] - self.low) / GRID_M]

    def free(self, corners: np.ndarray) -> bool:
        """Nothing stands inside the outline and it lies within the plan."""
        points = np.array(self.pixels(corners))
        left, top = np.floor(points.min(axis=0)).astype(int) - 1
        right, bottom = np.ceil(points.max(axis=0)).astype(int) + 2
        if left < 0 or top < 0 or right > self.taken.width or bottom > self.taken.height:
            return False
        mask = Image.new("1", (right - left, bottom - top), 0)
        ImageDraw.Draw(mask).polygon([(x - left, y - top) for x, y in points], fill=1, outline=1)
        window = np.asarray(self.taken.crop((left, top, right, bottom)))
        return not bool((window[np.asarray(mask)] > 0).any())

    def take(self, corners: np.ndarray) -> None:
        ImageDraw.Draw(self.taken).polygon(self.pixels(corners), fill=255, outline=255)


@lru_cache(maxsize=2)
def build_scenery(roads: RoadMap) -> Scenery:
    """Fill the land beside the roads of a map; kept, so that the next call is free.

    Raises:
        ScenarioError: a road is not at height 0, as all of the town is.
    """
    _check_level(roads)
    x0, y0, x1, y1 = roads.bounds_m
    low = np.array([x0 - MARGIN_M, y0 - MARGIN_M])
    size = (int((x1 - x0 + 2 * MARGIN_M) / GRID_M) + 1, int((y1 - y0 + 2 * MARGIN_M) / GRID_M) + 1)
    site = _Site(low, Image.new("L", size, 0), np.random.default_rng(SEED))
    pen = ImageDraw.Draw(site.taken)
    for lane in roads.lanes:
        pen.polygon(site.pixels(np.concatenate([lane.left, lane.right[::-1]])), fill=255, outline=255)
    for area in roads.junctions:
        pen.polygon(site.pixels(area.outline), fill=255, outline=255)
    edges = [_Edge(lane) for lane in _outermost(roads)]
    for edge in edges:
        _rails(site, edge)
    for edge in edges:
        _houses(site, edge)
    for edge in edges:
        _lamps(site, edge)
        _street_trees(site, edge)
    _scattered_trees(site, (x0, y0, x1, y1))
    for tree in site.trees:
        site.solids.append(Solid("tree", Pose(tree.x_m, tree.y_m), (0.2, 0.2), 3.0, casts_shadow=False))
    meshes = {name: builder.build() for name, builder in site.builders.items()}
    return Scenery(meshes, tuple(site.trees), tuple(site.solids), tuple(site.paved))


def _check_level(roads: RoadMap) -> None:
    for lane in roads.lanes:
        heights = lane.centre[:, 2]
        if abs(height := float(heights[np.abs(heights).argmax()])) > LEVEL_M:
            raise ScenarioError(
                f"road {lane.road} of the map is at height {height:.2f} m, but the town is level and draws roads at "
                "height 0 alone; take <elevation> out of the map, or drive it in CARLA"
            )


def _outermost(roads: RoadMap) -> list[Lane]:
    """The lane furthest out on each side of each road, outside junctions."""
    last: dict[tuple[str, int, bool], Lane] = {}
    for lane in roads.lanes:
        if lane.junction is None and lane.length_m > 3.0:
            key = (lane.road, lane.section, lane.number > 0)
            if key not in last or abs(lane.number) > abs(last[key].number):
                last[key] = lane
    return list(last.values())


class _Edge:
    """The outer border of a road side, with the land on its right."""

    def __init__(self, lane: Lane) -> None:
        self.lane = lane
        self.points = lane.right
        self.stations = polyline_stations(lane.right)
        self.length_m = float(self.stations[-1])

    def pose(self, station_m: float, right_m: float) -> Pose:
        """A place beside the edge, turned along it."""
        s = min(max(station_m, 0.3), self.length_m - 0.3)
        (x0, y0), (x1, y1) = interpolated(np.array([s - 0.3, s + 0.3]), self.stations, self.points[:, :2]).tolist()
        yaw = math.atan2(y1 - y0, x1 - x0)
        return Pose((x0 + x1) / 2, (y0 + y1) / 2, yaw).ahead(station_m - s, -right_m)

    def turn_per_m(self, station_m: float) -> float:
        """Curvature, positive to the left: the land on the right is then outside the bend."""
        a, b = self.pose(station_m - 3, 0.0).yaw_rad, self.pose(station_m + 3, 0.0).yaw_rad
        return ((b - a + math.pi) % (2 * math.pi) - math.pi) / 6


def _rails(site: _Site, edge: _Edge) -> None:
    """Guard rails outside bends, in pieces of two metres; what has no gap is one rail."""
    rail, post = site.builder("rail"), site.builder("concrete")
    reserved: list[Float[np.ndarray, "4 2"]] = []
    for station in np.arange(1.0, edge.length_m - 1.0, 2.0):
        if edge.turn_per_m(float(station)) < 1 / 60:
            continue
        a, b = edge.pose(float(station) - 1.0, 0.4), edge.pose(float(station) + 1.0, 0.4)
        pose = Pose((a.x_m + b.x_m) / 2, (a.y_m + b.y_m) / 2, math.atan2(b.y_m - a.y_m, b.x_m - a.x_m))
        half = math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) / 2 + 0.02
        if not site.free(edge_corners(pose.ahead(0.0, -0.7), half, 0.2)):
            continue
        rail.box((-half, -0.05, 0.45), (half, 0.05, 0.80), pose, tile_m=(2.0, 0.35), faces="yYZ")
        post.box((-0.07, -0.14, 0.0), (0.07, -0.04, 0.76), pose, (0.42, 0.42, 0.41))
        # Nothing but rails stands there yet.
        joined = (
            each.thing
            for each in reversed(site.solids)
            if math.hypot(each.pose.x_m - pose.x_m, each.pose.y_m - pose.y_m) < _JOINED_M
        )
        thing = next(joined, f"guard rail {len(site.solids)}")
        site.solids.append(Solid("guard rail", pose, (half, 0.08), 0.80, thing=thing))
        reserved.append(edge_corners(pose.ahead(0.0, -3.0), half + 0.5, 3.4))
    for corners in reserved:
        site.take(corners)


def edge_corners(pose: Pose, half_along_m: float, half_across_m: float) -> Float[np.ndarray, "4 2"]:
    """Corners of a rectangle round a pose."""
    a, b = half_along_m, half_across_m
    return pose.place(np.array([(-a, -b, 0), (a, -b, 0), (a, b, 0), (-a, b, 0)], float))[:, :2]


def _houses(site: _Site, edge: _Edge) -> None:
    """Town houses or cottages side by side along an edge, with gaps, drives and hedges."""
    rng = site.rng
    urban = rng.random() < 0.62
    station = rng.uniform(0.5, 4.0)
    while station < edge.length_m - 4:
        width = float(rng.uniform(11, 19) if urban else rng.uniform(9, 13))
        depth = float(rng.uniform(9, 13) if urban else rng.uniform(8, 10))
        setback = float(rng.uniform(0.4, 1.6) if urban else rng.uniform(4.5, 7.0))
        pose = edge.pose(station + width / 2, setback + depth / 2)
        if not site.free(edge_corners(pose, width / 2 + 0.3, depth / 2 + 0.3)):
            station += 3.0
            continue
        site.take(edge_corners(pose, width / 2 + 0.4, depth / 2 + 0.4))
        if urban:
            _town_house(site, pose, width, depth, int(rng.integers(2, 5)))
            gap = float(rng.choice([0.6, 0.6, 1.5, 6.5, 9.0]))
        else:
            _cottage(site, pose, width, depth)
            gap = float(rng.uniform(5.0, 8.0))
        if gap > 4.5:
            _drive(site, edge, station + width + gap / 2, gap, setback + 5.5)
        station += width + gap


def _walls(
    builder: MeshBuilder,
    pose: Pose,
    half: tuple[float, float],
    z: tuple[float, float],
    repeat: tuple[float, float],
    tint: Rgb,
) -> None:
    """Four walls with whole repeats of a texture, darker at the foot."""
    (a, b), (z0, z1) = half, z
    ring = [(-a, -b), (a, -b), (a, b), (-a, b)]
    up = max(0.5, round((z1 - z0) / repeat[1] * 2) / 2)
    for (x0, y0), (x1, y1) in zip(ring, ring[1:] + ring[:1], strict=True):
        across = max(1.0, round(math.hypot(x1 - x0, y1 - y0) / repeat[0], 0))
        corners = pose.place(np.array([(x0, y0, z0), (x1, y1, z0), (x1, y1, z1), (x0, y0, z1)]))
        foot = 0.72 if z0 < 0.5 else 0.93
        shade = np.array([[foot], [foot], [1.0], [1.0]]) * np.array(tint)
        builder.tiles(corners, across, up, shade)


def _town_house(site: _Site, pose: Pose, width: float, depth: float, storeys: int) -> None:
    """Shops below, flats above, a cornice and a flat roof, or a tiled one."""
    rng, half = site.rng, (width / 2, depth / 2)
    top = SHOP_M + STOREY_M * storeys
    shade = float(rng.uniform(0.86, 1.0))
    tint: Rgb = (shade, shade, shade)
    facade = int(rng.integers(FACADES))
    if rng.random() < 0.75:
        _walls(site.builder(f"shop{rng.integers(SHOPS)}"), pose, half, (0.0, SHOP_M), (8.0, SHOP_M), tint)
    else:
        _walls(site.builder(f"facade{facade}"), pose, half, (0.0, SHOP_M), (7.5, 2 * STOREY_M), tint)
    _walls(site.builder(f"facade{facade}"), pose, half, (SHOP_M, top), (7.5, 2 * STOREY_M), tint)
    stone, (a, b) = site.builder("concrete"), half
    for out, low, high, grey in (
        (0.12, SHOP_M - 0.12, SHOP_M + 0.12, (0.74, 0.72, 0.70)),
        (0.25, top - 0.1, top + 0.4, (0.80, 0.78, 0.74)),
    ):
        stone.box((-a - out, -b - out, low), (a + out, b + out, high), pose, grey, faces="xXyYZz")
    if rng.random() < 0.5:
        _gable(site, pose, (a + 0.2, b + 0.2), top + 0.35, 2.6, ROOFS[int(rng.integers(len(ROOFS)))])
    site.solids.append(Solid("building", pose, half, top + 0.4))


def _cottage(site: _Site, pose: Pose, width: float, depth: float) -> None:
    """A house of one or two storeys under a gable, with a chimney and a hedge in front."""
    rng, (a, b) = site.rng, (width / 2, depth / 2)
    top = STOREY_M * int(rng.integers(1, 3))
    facade = int(rng.choice([0, 1, 2, 3, 5, 6]))
    _walls(site.builder(f"facade{facade}"), pose, (a, b), (0.0, top), (7.5, 2 * STOREY_M), (1.0, 1.0, 1.0))
    rise = 0.42 * depth
    _gable(site, pose, (a + 0.35, b + 0.45), top - 0.1, rise, ROOFS[int(rng.integers(len(ROOFS)))])
    chimney = pose.ahead(float(rng.uniform(-0.5, 0.5)) * a, 0.25 * b)
    site.builder("concrete").box((-0.4, -0.4, top), (0.4, 0.4, top + rise + 0.7), chimney, (0.60, 0.44, 0.38))
    site.solids.append(Solid("building", pose, (a, b), top + 0.5 * rise))
    if rng.random() < 0.7:
        front = pose.ahead(0.0, b + 3.2)
        if site.free(edge_corners(front, a - 0.2, 0.5)):
            site.take(edge_corners(front, a, 0.6))
            site.builder("hedge").box((-a, -0.4, 0.0), (a, 0.4, 1.05), front, tile_m=(2.0, 1.05))
            site.solids.append(Solid("hedge", front, (a, 0.4), 1.05))


def _gable(site: _Site, pose: Pose, half: tuple[float, float], z: float, rise: float, tint: Rgb) -> None:
    """A roof whose ridge runs along the street, with walls in its ends."""
    a, b = half
    roof = site.builder("roof")
    for side in (-1.0, 1.0):
        corners = np.array(
            [(-a * -side, side * b, z), (a * -side, side * b, z), (a * -side, 0, z + rise), (-a * -side, 0, z + rise)]
        )
        roof.quad(pose.place(corners), albedo=tint)
    for side in (-1.0, 1.0):
        x = side * (a - 0.3)
        triangle = pose.place(np.array([(x, -side * b, z), (x, side * b, z), (x, 0, z + rise)]))
        outward = pose.rotation @ np.array([side, 0.0, 0.0])
        order = np.array([[0, 1, 2]])
        site.builder("concrete").add(triangle, outward, np.zeros((3, 2)), (0.80, 0.76, 0.70), order)


def _drive(site: _Site, edge: _Edge, station: float, gap: float, length: float) -> None:
    """A paved drive beside a house, with a car on it more often than not."""
    pose = edge.pose(station, length / 2)
    half = min(gap / 2 - 0.4, 2.6)
    corners = edge_corners(pose, half, length / 2 - 0.05)
    if not site.free(edge_corners(pose, half, length / 2 - 0.7)):
        return
    site.paved.append(corners)
    site.take(corners)
    rng = site.rng
    if rng.random() < 0.75:
        inwards = pose.yaw_rad - math.pi / 2 + (math.pi if rng.random() < 0.5 else 0.0)
        spot = Pose(pose.x_m, pose.y_m, inwards + float(rng.uniform(-0.05, 0.05)))
        body, paint = Body(int(rng.integers(3))), PAINTS[int(rng.integers(len(PAINTS)))]
        mesh = car(body, paint)
        site.builder("plain").add(
            spot.place(mesh.points), mesh.normals @ spot.rotation.T, mesh.uv, mesh.albedo, mesh.triangles
        )
        site.solids.append(Solid("parked car", spot, CAR_HALF_M, 1.4))


def _lamps(site: _Site, edge: _Edge) -> None:
    """Street lamps at the back of every sidewalk on the right of the road's direction, or where it has no other."""
    if edge.lane.kind != "sidewalk" or edge.lane.number > 0:
        return
    metal = site.builder("plain")
    for station in np.arange(9.0, edge.length_m - 4.0, 27.0):
        foot = edge.pose(float(station), -0.35)
        metal.tube([(0.13, 1.3), (1.0, 1.0), (6.4, 0.6)], 0.085, foot, POST, 6)
        arm = foot.ahead(0.0, 0.75)
        metal.box((-0.05, -0.8, 6.33), (0.05, 0.8, 6.42), arm, POST, faces="xXzZ")
        head = foot.ahead(0.0, 1.7)
        metal.box((-0.14, -0.36, 6.28), (0.14, 0.36, 6.40), head, (0.34, 0.36, 0.37), faces="xXyYZ")
        metal.box((-0.11, -0.32, 6.26), (0.11, 0.32, 6.28), head, (0.92, 0.91, 0.84), faces="z")
        site.solids.append(Solid("lamp post", foot, (0.12, 0.12), 6.4))


def _street_trees(site: _Site, edge: _Edge) -> None:
    rng = site.rng
    for station in np.arange(4.0, edge.length_m - 3.0, 10.0):
        pose = edge.pose(float(station + rng.uniform(-2, 2)), float(rng.uniform(0.9, 2.4)))
        if rng.random() < 0.8 and site.free(edge_corners(pose, 0.7, 0.7)):
            _plant(site, pose, float(rng.uniform(5.0, 7.8)))


def _scattered_trees(site: _Site, bounds: tuple[float, float, float, float]) -> None:
    """Trees on the open land, in loose groves."""
    rng = site.rng
    low, high = np.array(bounds[:2]) - MARGIN_M + 4, np.array(bounds[2:]) + MARGIN_M - 4
    wanted = int(0.0016 * float(np.prod(high - low)))
    for _ in range(wanted):
        pose = Pose(*(float(v) for v in rng.uniform(low, high)))
        if site.free(edge_corners(pose, 2.2, 2.2)):
            _plant(site, pose, float(rng.uniform(6.0, 11.0)))


def _plant(site: _Site, pose: Pose, height_m: float) -> None:
    rng = site.rng
    builder = site.builder(f"tree{rng.integers(TREES)}")
    first = float(rng.uniform(0, math.pi))
    half = height_m * 0.5
    for k in range(3):
        turn = first + k * math.pi / 3
        dx, dy = math.cos(turn) * half, math.sin(turn) * half
        x, y = pose.x_m, pose.y_m
        corners = np.array(
            [(x - dx, y - dy, 0.0), (x + dx, y + dy, 0.0), (x + dx, y + dy, height_m), (x - dx, y - dy, height_m)]
        )
        shade = np.array([[0.82], [0.82], [1.0], [1.0]]) * np.ones(3)
        builder.add(corners, np.array([0.0, 0.0, 1.0]), UNIT, shade, FACE)
    site.trees.append(Tree(pose.x_m, pose.y_m, height_m))
    site.take(edge_corners(pose, 1.2, 1.2))
