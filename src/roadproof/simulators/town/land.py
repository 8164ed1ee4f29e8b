"""The land as nodes: cells of ground with their baked pictures, pavements, kerbs and painted lines, country around."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, UInt8

from roadproof.simulators.town import textures
from roadproof.simulators.town.canvas import GRAIN_TILE_M
from roadproof.simulators.town.engine import Node, Texture, fill_texture, make_texture
from roadproof.simulators.town.ground import FINE_M, Ground, LitGround
from roadproof.simulators.town.meshes import Mesh, MeshBuilder
from roadproof.simulators.town.shading import Layer, mesh_node, rgba, shaded
from roadproof.simulators.town.streets import Streets
from roadproof.simulators.town.weather import Sky

CELL_M, CELL_MARGIN_M = 30.0, 1.0
STREET_M = 60.0
FAR_LAND_M, FAR_TILE_M = 520.0, 260.0
FAR_LAND = (0.36, 0.44, 0.24)

Placed = tuple[Node, Layer, Texture | None, Texture | None]
"""A node, how it is drawn, its texture and the picture of the ground on it."""


class Land:
    """The ground of one town and what lies flat on it."""

    def __init__(self, ground: Ground, streets: Streets, grains: dict[str, Texture]) -> None:
        self._ground, self._streets, self._grains = ground, streets, grains
        self._count = (round(ground.size_m[0] / CELL_M), round(ground.size_m[1] / CELL_M))
        self._pictures: dict[tuple[int, int], Texture] = {}

    def nodes(self, lit: LitGround) -> list[Placed]:
        """Everything in the light of one weather."""
        self._bake(lit)
        return [*self._cells(), *self._country(lit.sky), *self._pavements(), *self._stones(lit)]

    def _bake(self, lit: LitGround) -> None:
        """One picture of the ground per cell; coarser where nothing is paved."""
        n = round(CELL_M / FINE_M)
        levels = [min(255, round(v * 255 / textures.GRAIN_MEAN)) for v in range(256)] * 3
        for column in range(self._count[0]):
            for row in range(self._count[1]):
                box = (column * n, row * n, column * n + n, row * n + n)
                paved = lit.ground.hard.crop(box).getbbox() is not None
                image = lit.cell(column, row, CELL_M, CELL_MARGIN_M)
                picture = np.asarray((image if paved else image.reduce(4)).point(levels))
                if (column, row) in self._pictures:
                    fill_texture(self._pictures[column, row], picture)
                else:
                    self._pictures[column, row] = make_texture(picture)

    def _uv(self, points: Float[np.ndarray, "n 3"], cell: tuple[int, int]) -> Float[np.ndarray, "n 2"]:
        """Coordinates of points in the picture of a cell."""
        corner = np.array(self._ground.low_m) + np.array(cell) * CELL_M - CELL_MARGIN_M
        return (points[:, :2] - corner) / (CELL_M + 2 * CELL_MARGIN_M)

    def _cells(self) -> list[Placed]:
        low, made = self._ground.low_m, list[Placed]()
        for cell, picture in self._pictures.items():
            x, y = low[0] + cell[0] * CELL_M, low[1] + cell[1] * CELL_M
            corners = np.array([(x, y, 0), (x + CELL_M, y, 0), (x + CELL_M, y + CELL_M, 0), (x, y + CELL_M, 0)])
            builder = MeshBuilder()
            builder.quad(corners, corners[:, :2] / GRAIN_TILE_M)
            mesh = builder.build()
            node = mesh_node(mesh, ground_uv=self._uv(mesh.points, cell))
            made.append((node, Layer.GROUND, self._grains["asphalt"], picture))
        return made

    def _country(self, sky: Sky) -> list[Placed]:
        (x0, y0), (width, depth), far = self._ground.low_m, self._ground.size_m, FAR_LAND_M
        x1, y1 = x0 + width, y0 + depth
        builder = MeshBuilder()
        for a, b, c, d in (
            (x0 - far, y0 - far, x1 + far, y0), (x0 - far, y1, x1 + far, y1 + far),
            (x0 - far, y0, x0, y1), (x1, y0, x1 + far, y1),
        ):  # fmt: skip
            for u in np.arange(a, c, FAR_TILE_M):
                for v in np.arange(b, d, FAR_TILE_M):
                    s, t = min(u + FAR_TILE_M, c), min(v + FAR_TILE_M, d)
                    corners = np.array([(u, v, 0.0), (s, v, 0), (s, t, 0), (u, t, 0)])
                    builder.quad(corners, corners[:, :2] / 8.0, FAR_LAND)
        mesh = builder.build()
        node = mesh_node(mesh, shaded(mesh, sky, np.ones(len(mesh.points))))
        return [(node, Layer.FAR_LAND, self._grains["grass"], None)]

    def _pavements(self) -> list[Placed]:
        low, made = self._ground.low_m, list[Placed]()
        for (i, j), part in self._streets.pavement.cells(CELL_M):
            cell = (i - round(low[0] / CELL_M), j - round(low[1] / CELL_M))
            node = mesh_node(part, ground_uv=self._uv(part.points, cell))
            made.append((node, Layer.PAVEMENT, self._grains["slabs"], self._pictures[cell]))
        return made

    def _stones(self, lit: LitGround) -> list[Placed]:
        """Kerbs and painted lines."""
        return [
            (mesh_node(part, _streetlight(part, lit)), layer, None, None)
            for mesh, layer in ((self._streets.kerbs, Layer.PAVEMENT), (self._streets.paint, Layer.PAINT))
            for _, part in mesh.cells(STREET_M)
        ]


def _streetlight(mesh: Mesh, lit: LitGround) -> UInt8[np.ndarray, "n 4"]:
    """Light that follows the shadows on the ground."""
    sky, points = lit.sky, mesh.points[:, :2]
    facing = np.clip(mesh.normals @ sky.to_sun, 0, None)
    sunlit, open_sky = lit.sunlit_at(points), lit.open_sky_at(points)
    light = sky.light(facing, sunlit, open_sky * (0.6 + 0.4 * np.abs(mesh.normals[:, 2])))
    mirrored = np.array(lit.mirrored)
    share = lit.water_at(points)[:, None] * (mesh.normals[:, 2:] > 0.5) * (mesh.points[:, 2:] < 0.01)
    damp = 1 - 0.15 * sky.wetness
    return rgba(mesh.albedo * light * damp * (1 - share) + share * mirrored / 255)
