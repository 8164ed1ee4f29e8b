"""Triangles with what is needed to light them: points, normals, texture coordinates, albedo, occlusion.

Convention:
    Metres, z up, triangles counter-clockwise seen from outside. Albedo is in display levels / 255.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

Points = Float[np.ndarray, "n 3"]
Rgb = tuple[float, float, float]
WHITE: Rgb = (1.0, 1.0, 1.0)
UNIT = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
FACE = np.array([[0, 1, 2], [0, 2, 3]])
BOX_FACES = "xXyYzZ"
BOX = np.array(
    [
        [(0, 1, 0), (0, 0, 0), (0, 0, 1), (0, 1, 1)], [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)],
        [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)], [(1, 1, 0), (0, 1, 0), (0, 1, 1), (1, 1, 1)],
        [(0, 1, 0), (1, 1, 0), (1, 0, 0), (0, 0, 0)], [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)],
    ],
    float,
)  # fmt: skip
"""Corners of the faces of a box, 0 low and 1 high, counter-clockwise seen from outside."""


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """A finished mesh.

    Args:
        points: (n, 3) metres.
        normals: (n, 3), unit length.
        uv: (n, 2) texture coordinates.
        albedo: (n, 3) display levels / 255.
        triangles: (t, 3) indices of the points, counter-clockwise seen from outside.
    """

    points: Points
    normals: Points
    uv: Float[np.ndarray, "n 2"]
    albedo: Points
    triangles: Int[np.ndarray, "t 3"]

    def part(self, chosen: Int[np.ndarray, "k 3"]) -> Mesh:
        """The mesh of some of its triangles."""
        used, inverse = np.unique(chosen, return_inverse=True)
        return Mesh(self.points[used], self.normals[used], self.uv[used], self.albedo[used], inverse.reshape(-1, 3))

    def cells(self, size_m: float) -> list[tuple[tuple[int, int], Mesh]]:
        """The mesh cut (between triangles) along a grid of `size_m`, in a fixed order."""
        if not len(self.triangles):
            return []
        middle = np.floor(self.points[self.triangles].mean(axis=1)[:, :2] / size_m).astype(int)
        keys, owner = np.unique(middle, axis=0, return_inverse=True)
        owner = owner.reshape(-1)
        return [((int(k[0]), int(k[1])), self.part(self.triangles[owner == i])) for i, k in enumerate(keys)]


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one."""
    builder = MeshBuilder()
    for mesh in meshes:
        builder.add(mesh.points, mesh.normals, mesh.uv, mesh.albedo, mesh.triangles)
    return builder.build()


def lofted(rings: int, sides: int) -> Int[np.ndarray, "t 3"]:
    """Triangles between rings of points, each of which ends with its first point once more."""
    ring, side = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    first = (ring * (sides + 1) + side).ravel()
    above = first + sides + 1
    return np.concatenate([np.stack([first, first + 1, above + 1], -1), np.stack([first, above + 1, above], -1)])


class MeshBuilder:
    """Collects faces; `build` joins them."""

    def __init__(self) -> None:
        self._parts: list[tuple[np.ndarray, ...]] = []
        self._count = 0

    def add(
        self, points: np.ndarray, normals: np.ndarray, uv: np.ndarray, albedo: np.ndarray | Rgb, triangles: np.ndarray
    ) -> None:
        """Add vertices and triangles; normals and albedo may be one row for all."""
        n = len(points)
        self._parts.append(
            (
                np.asarray(points, float),
                np.broadcast_to(np.asarray(normals, float), (n, 3)),
                np.asarray(uv, float),
                np.broadcast_to(np.asarray(albedo, float), (n, 3)),
                np.asarray(triangles, int).reshape(-1, 3) + self._count,
            )
        )
        self._count += n

    def quad(self, corners: np.ndarray, uv: np.ndarray | None = None, albedo: np.ndarray | Rgb = WHITE) -> None:
        """A flat face of four corners, counter-clockwise from the lower left."""
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = np.asarray(corners, float)[:3].tolist()
        # By hand: numpy takes twenty times as long for three numbers, and a town has thousands of faces.
        (ux, uy, uz), (vx, vy, vz) = (bx - ax, by - ay, bz - az), (cx - ax, cy - ay, cz - az)
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        length = max(math.sqrt(x * x + y * y + z * z), 1e-9)
        self.add(corners, np.array([x / length, y / length, z / length]), UNIT if uv is None else uv, albedo, FACE)

    def quads(self, corners: Float[np.ndarray, "f 4 3"], uv: np.ndarray, albedo: np.ndarray | Rgb) -> None:
        """Flat faces; texture coordinates are (f, 4, 2), albedo is one for all or (f · 4, 3)."""
        (ux, uy, uz), (vx, vy, vz) = ((corners[:, k] - corners[:, 0]).T for k in (1, 2))
        normal = np.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx], axis=-1)
        normal /= np.maximum(np.sqrt((normal * normal).sum(axis=1, keepdims=True)), 1e-9)
        triangles = (FACE + np.arange(len(corners))[:, None, None] * 4).reshape(-1, 3)
        self.add(corners.reshape(-1, 3), normal.repeat(4, axis=0), uv.reshape(-1, 2), albedo, triangles)

    def tiles(self, corners: np.ndarray, across: float, up: float, albedo: np.ndarray | Rgb = WHITE) -> None:
        """A flat face with repeats of a texture, each repeat its own quad so that textures can share one picture.

        Args:
            corners: the four corners, counter-clockwise from the lower left.
            across: how many repeats lie along the lower edge.
            up: how many repeats lie along the left edge.
            albedo: one colour for the whole face, or one for each corner.
        """
        if across == up == 1.0:
            self.quad(corners, albedo=albedo)
            return
        values = np.empty((4, 6))
        values[:, :3], values[:, 3:] = corners, albedo
        columns, rows = (np.arange(math.ceil(n - 1e-6)) for n in (across, up))
        i, j = columns.repeat(len(rows))[:, None], np.tile(rows, len(columns))[:, None]
        u, v = UNIT[:, 0] * np.minimum(1.0, across - i), UNIT[:, 1] * np.minimum(1.0, up - j)
        x, y = ((i + u) / across)[..., None], ((j + v) / up)[..., None]
        low = values[0] * (1 - x) + values[1] * x
        parts = low * (1 - y) + (values[3] * (1 - x) + values[2] * x) * y
        self.quads(parts[..., :3], np.stack([u, v], axis=-1), parts[..., 3:].reshape(-1, 3))

    def box(
        self,
        low: tuple[float, float, float],
        high: tuple[float, float, float],
        pose: Pose,
        albedo: Rgb = WHITE,
        *,
        tile_m: tuple[float, float] | None = None,
        faces: str = "xXyYZ",
    ) -> None:
        """A box in the axes of `pose`.

        Args:
            low: the box's lower corner in its own axes, metres.
            high: the box's upper corner in its own axes, metres.
            pose: the pose of the box's axes in the world.
            albedo: the colour of all faces.
            tile_m: size of one repeat of the texture, of which whole ones fit each side; None puts one on each face.
            faces: the faces to make: x, X, y, Y, z, Z for the low and high sides.
        """
        share = BOX[[BOX_FACES.index(face) for face in faces]]
        corners = np.array(low) * (1.0 - share) + np.array(high) * share
        placed = pose.place(corners.reshape(-1, 3)).reshape(-1, 4, 3)
        if tile_m is None:
            self.quads(placed, np.broadcast_to(UNIT, (len(placed), 4, 2)), albedo)
            return
        for local, face in zip(corners, placed, strict=True):
            across = max(1.0, round(float(np.linalg.norm(local[1] - local[0])) / tile_m[0], 0))
            up = max(1.0, round(float(np.linalg.norm(local[2] - local[1])) / tile_m[1], 0))
            self.tiles(face, across, up, albedo)

    def tube(self, rings: list[tuple[float, float]], radius: float, pose: Pose, albedo: Rgb, sides: int = 8) -> None:
        """A round body along z: rings are (height, share of the radius)."""
        angle = np.linspace(0, 2 * math.pi, sides + 1)
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        points = np.concatenate(
            [np.column_stack([radius * share * circle, np.full(sides + 1, height)]) for height, share in rings]
        )
        outward = np.tile(np.column_stack([circle, np.zeros(sides + 1)]), (len(rings), 1))
        triangles = lofted(len(rings), sides)
        self.add(pose.place(points), outward @ pose.rotation.T, np.zeros((len(points), 2)), albedo, triangles)

    def ribbon(
        self,
        left: Points,
        right: Points,
        albedo: np.ndarray | Rgb = WHITE,
        *,
        uv: np.ndarray | None = None,
    ) -> None:
        """A strip between two polylines of as many points; seen from the side that has `left` on its left."""
        n = len(left)
        points = np.concatenate([left, right])
        along, across = np.gradient(left, axis=0), right - left
        normal = np.cross(across, along)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        i = np.arange(n - 1)
        triangles = np.concatenate([np.stack([i, i + n, i + n + 1], -1), np.stack([i, i + n + 1, i + 1], -1)])
        coordinates = np.zeros((2 * n, 2)) if uv is None else uv
        self.add(points, np.concatenate([normal, normal]), coordinates, albedo, triangles)

    def build(self) -> Mesh:
        """The mesh of all faces, rounded so that it is the same on every machine."""
        if not self._parts:
            empty = np.zeros((0, 3))
            return Mesh(empty, empty, np.zeros((0, 2)), empty, np.zeros((0, 3), int))
        points, normals, uv, albedo, triangles = (np.concatenate(column) for column in zip(*self._parts, strict=True))
        return Mesh(points.round(4), normals.round(4), uv.round(5), albedo.round(4), triangles)


@dataclass(frozen=True, slots=True)
class Pose:
    """A place on the ground and a heading."""

    x_m: float
    y_m: float
    yaw_rad: float = 0.0
    z_m: float = 0.0

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """World from local axes."""
        s, c = math.sin(self.yaw_rad), math.cos(self.yaw_rad)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def place(self, points: np.ndarray) -> Points:
        """World points from local ones."""
        return points @ self.rotation.T + np.array([self.x_m, self.y_m, self.z_m])

    def ahead(self, forward_m: float, left_m: float = 0.0) -> Pose:
        """The pose moved in its own axes."""
        s, c = math.sin(self.yaw_rad), math.cos(self.yaw_rad)
        return Pose(
            self.x_m + c * forward_m - s * left_m, self.y_m + s * forward_m + c * left_m, self.yaw_rad, self.z_m
        )


ORIGIN = Pose(0.0, 0.0)
