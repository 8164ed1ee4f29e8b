"""Finds what lies at or near a point: k-d trees name the few shapes that can, and exact tests decide among them."""

from __future__ import annotations

import math
from itertools import chain
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

Points = Float[np.ndarray, "n 2"]

SMALL_M = 4.0
"""Pieces of lanes are smaller and many, those of junctions larger and few: each have a tree of their own."""


SHORTEST_M = 1e-6
"""Segments that are not longer have no direction."""


class TriangleIndex:
    """Which triangles hold a point; each triangle has a code, and the largest code wins.

    Args:
        corners: world x, y of each triangle's corners, metres, in either winding.
        codes: the code of each triangle, above 0.
    """

    def __init__(self, corners: Float[np.ndarray, "t 3 2"], codes: Int[np.ndarray, " t"]) -> None:
        self._corners, self._codes = corners, codes
        self._edges = np.roll(corners, -1, axis=1) - corners
        middles = corners.mean(axis=1)
        reach_m = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1) + 1e-6
        sizes = (np.flatnonzero(reach_m <= SMALL_M), np.flatnonzero(reach_m > SMALL_M))
        self._trees: list[tuple[Int[np.ndarray, " k"], Any, float]]
        self._trees = [(mine, KDTree(middles[mine]), float(reach_m[mine].max())) for mine in sizes if len(mine)]

    def __call__(self, points_m: Points) -> Int[np.ndarray, " n"]:
        """The largest code among the triangles that hold each point; 0 where there is none."""
        codes = np.zeros(len(points_m), dtype=self._codes.dtype)
        for mine, tree, reach_m in self._trees:
            near: list[list[int]] = list(tree.query_ball_point(points_m, reach_m))
            point = np.repeat(np.arange(len(points_m)), [len(found) for found in near])
            triangle = mine[np.fromiter(chain.from_iterable(near), np.intp, len(point))]
            held = _holds(self._corners[triangle], self._edges[triangle], points_m[point])
            np.maximum.at(codes, point[held], self._codes[triangle[held]])
        return codes


def _holds(
    corners: Float[np.ndarray, "k 3 2"], edges: Float[np.ndarray, "k 3 2"], points: Float[np.ndarray, "k 2"]
) -> Bool[np.ndarray, " k"]:
    reach = points[:, None] - corners
    side = edges[..., 0] * reach[..., 1] - edges[..., 1] * reach[..., 0]
    return np.logical_or((side >= -1e-9).all(axis=1), (side <= 1e-9).all(axis=1))


class SegmentIndex:
    """The segments of polylines, those without length left out.

    Args:
        lines: polylines, (n, 3) metres each; `owner` is a line's place in this list.

    Attributes:
        start: x and y of each segment's first point.
        along: direction of each segment, of length 1.
        length_m: length of each segment seen from above.
        owner: index of the line that each segment belongs to.
        stretch: how much longer each segment is than seen from above; 1 on a flat road.
        station_m: arc length from the beginning of its line up to each segment, along slopes.
    """

    def __init__(self, lines: list[Float[np.ndarray, "_ 3"]]) -> None:
        start = np.concatenate([line[:-1, :2] for line in lines])
        step = np.concatenate([np.diff(line[:, :2], axis=0) for line in lines])
        length = np.linalg.norm(step, axis=1)
        owner = np.repeat(np.arange(len(lines)), [len(line) - 1 for line in lines])
        sloped = np.linalg.norm(np.concatenate([np.diff(line, axis=0) for line in lines]), axis=1)
        total = np.cumsum(sloped) - sloped
        station = total - total[np.searchsorted(owner, np.arange(len(lines)))][owner]
        keep = length > SHORTEST_M
        self.start: Float[np.ndarray, "s 2"] = start[keep]
        self.along: Float[np.ndarray, "s 2"] = step[keep] / length[keep, None]
        self.length_m: Float[np.ndarray, " s"] = length[keep]
        self.stretch: Float[np.ndarray, " s"] = sloped[keep] / length[keep]
        self.owner: Int[np.ndarray, " s"] = owner[keep]
        self.station_m: Float[np.ndarray, " s"] = station[keep]
        self._tree: Any = KDTree(self.start + 0.5 * step[keep])
        self._half_m = 0.5 * float(self.length_m.max())

    def within(self, x_m: float, y_m: float, beyond_m: float) -> Int[np.ndarray, " k"]:
        """Indices of the segments near a point, in rising order: all with D² ≤ d² + beyond_m², and maybe a few others.

        D is a segment's distance from the point, d that of the nearest segment.

        Args:
            x_m: world x, metres.
            y_m: world y, metres.
            beyond_m: how far beyond the nearest segment others still count as near, by the rule above, metres.
        """
        nearest_m: float = self._tree.query((x_m, y_m))[0]
        reach_m = math.hypot(nearest_m, beyond_m) + self._half_m
        return np.array(self._tree.query_ball_point((x_m, y_m), reach_m, return_sorted=True), np.intp)
