"""Finds what lies at or near a point, through a grid of cells: exact answers from few candidates.

Each cell lists the shapes whose box, grown by a margin, touches it; a query looks at the list of its own cell only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

Points = Float[np.ndarray, "n 2"]


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Lists of shapes by cell: the shapes of cell k are `members[offsets[k]:offsets[k + 1]]`, in rising order."""

    origin_m: Float[np.ndarray, " 2"]
    cell_m: float
    columns: int
    rows: int
    offsets: Int[np.ndarray, " c"]
    members: Int[np.ndarray, " m"]

    @classmethod
    def over(cls, low_m: Points, high_m: Points, *, cell_m: float, margin_m: float) -> Grid:
        """A grid over boxes given by their corners, each grown by a margin."""
        origin = low_m.min(axis=0) - margin_m
        first = np.floor((low_m - margin_m - origin) / cell_m).astype(np.intp)
        last = np.floor((high_m + margin_m - origin) / cell_m).astype(np.intp)
        columns, rows = (int(n) + 1 for n in last.max(axis=0))
        spans = last - first + 1
        counts = spans.prod(axis=1)
        shape = np.repeat(np.arange(len(low_m)), counts)
        rank = np.arange(len(shape)) - np.repeat(np.cumsum(counts) - counts, counts)
        column = first[shape, 0] + rank % spans[shape, 0]
        row = first[shape, 1] + rank // spans[shape, 0]
        cell = row * columns + column
        order = np.argsort(cell, kind="stable")
        offsets = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=columns * rows))])
        return cls(origin, cell_m, columns, rows, offsets, shape[order])

    def near(self, x_m: float, y_m: float) -> Int[np.ndarray, " k"]:
        """The shapes listed for the cell of one point; none outside the grid."""
        column, row = int((x_m - self.origin_m[0]) // self.cell_m), int((y_m - self.origin_m[1]) // self.cell_m)
        if not (0 <= column < self.columns and 0 <= row < self.rows):
            return self.members[:0]
        cell = row * self.columns + column
        return self.members[self.offsets[cell] : self.offsets[cell + 1]]

    def pairs(self, points_m: Points) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
        """All (point, shape) to be looked at for many points."""
        at = np.floor((points_m - self.origin_m) / self.cell_m)
        size = np.array([self.columns, self.rows])
        inside: Bool[np.ndarray, " n"] = np.all((at >= 0) & (at < size), axis=1)
        column, row = np.where(inside, at.T, 0.0).astype(np.intp)
        cell = row * self.columns + column
        counts = np.where(inside, self.offsets[cell + 1] - self.offsets[cell], 0)
        point = np.repeat(np.arange(len(points_m)), counts)
        rank = np.arange(len(point)) - np.repeat(np.cumsum(counts) - counts, counts)
        return point, self.members[self.offsets[cell[point]] + rank]


@dataclass(frozen=True, slots=True, eq=False)
class TriangleIndex:
    """Which triangles hold a point; each triangle has a code, and the largest code wins."""

    corners: Float[np.ndarray, "t 3 2"]
    edges: Float[np.ndarray, "t 3 2"]
    codes: Int[np.ndarray, " t"]
    grid: Grid

    @classmethod
    def of(
        cls, corners: Float[np.ndarray, "t 3 2"], codes: Int[np.ndarray, " t"], *, cell_m: float = 2.0
    ) -> TriangleIndex:
        """An index over triangles of either winding."""
        edges = np.roll(corners, -1, axis=1) - corners
        grid = Grid.over(corners.min(axis=1), corners.max(axis=1), cell_m=cell_m, margin_m=1e-6)
        return cls(corners, edges, codes, grid)

    def __call__(self, points_m: Points) -> Int[np.ndarray, " n"]:
        """The largest code among the triangles that hold each point; 0 where there is none."""
        codes = np.zeros(len(points_m), dtype=self.codes.dtype)
        point, triangle = self.grid.pairs(points_m)
        held = _holds(self.corners[triangle], self.edges[triangle], points_m[point])
        np.maximum.at(codes, point[held], self.codes[triangle[held]])
        return codes


def _holds(
    corners: Float[np.ndarray, "k 3 2"], edges: Float[np.ndarray, "k 3 2"], points: Float[np.ndarray, "k 2"]
) -> Bool[np.ndarray, " k"]:
    reach = points[:, None] - corners
    side = edges[..., 0] * reach[..., 1] - edges[..., 1] * reach[..., 0]
    return np.logical_or((side >= -1e-9).all(axis=1), (side <= 1e-9).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class SegmentIndex:
    """Line segments with an owner each, to be found by points within a reach of them."""

    start: Float[np.ndarray, "s 2"]
    along: Float[np.ndarray, "s 2"]
    length_m: Float[np.ndarray, " s"]
    owner: Int[np.ndarray, " s"]
    station_m: Float[np.ndarray, " s"]
    grid: Grid

    @classmethod
    def of(cls, lines: list[Float[np.ndarray, "_ 3"]], *, reach_m: float, cell_m: float = 4.0) -> SegmentIndex:
        """An index over the segments of polylines; segments without length are left out.

        Args:
            lines: polylines; their place in the list is the owner of their segments.
            reach_m: points nearer than this to a segment are sure to find it.
            cell_m: side of a cell.
        """
        start = np.concatenate([line[:-1, :2] for line in lines])
        step = np.concatenate([np.diff(line[:, :2], axis=0) for line in lines])
        length = np.linalg.norm(step, axis=1)
        owner = np.repeat(np.arange(len(lines)), [len(line) - 1 for line in lines])
        total = np.cumsum(length) - length
        first = np.searchsorted(owner, np.arange(len(lines)))
        station = total - total[first][owner]
        keep = length > 1e-6
        start, step, length, owner, station = (a[keep] for a in (start, step, length, owner, station))
        grid = Grid.over(
            np.minimum(start, start + step), np.maximum(start, start + step), cell_m=cell_m, margin_m=reach_m
        )
        return cls(start, step / length[:, None], length, owner, station, grid)

    def candidates(self, x_m: float, y_m: float) -> Int[np.ndarray, " k"]:
        """Segments worth looking at for a point: those near it, or all where none is."""
        near = self.grid.near(x_m, y_m)
        return near if len(near) else np.arange(len(self.owner))
