"""Figures that stay clear of lane marks, by a map that brings every figure to one that does.

Around each straight piece of a mark lies a rectangle that reaches the keep-out's distance beyond the mark's paint. A
figure whose middle is in one of them is moved to the nearest place that is free; then every figure shrinks about its
middle until it touches none. In the axis n the figure scaled by t and a rectangle Q are apart where

    |n · (c − q)| ≥ h_Q(n) + t h(n),   h the half extent of each along n,

and they are apart at all where they are in one of the four axes normal to their edges. So the largest t is the least
over rectangles of the largest over axes: closed form, and differentiable in the figure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import KDTree
from torch import Tensor

from roadproof.constants import constant
from roadproof.errors import PatternError
from roadproof.paint.site import Site, half_edges_m, metres_per_px

LEAST_M = 0.1
"""A middle is at least so far from the keep-out, so that its figure is no speck."""

_ALIKE = 8
"""So many free cells may be as near as each other."""
_CELL_M = 0.1
_MOST_CANVAS_M = 100.0
_INSIDE = 1 - 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class KeepOut:
    """The map that brings figures to ones that stay clear of lane marks.

    Args:
        size_m: width and length of the canvas, metres.
        middle: middle of each rectangle around a mark, canvas metres, (q, 2).
        axes: unit vectors along and across each rectangle, (q, 2, 2).
        extents: half of each rectangle's length and width, metres, (q, 2).
        free: for every cell of the canvas, the nearest place where a figure's middle may lie, canvas metres, (r, c, 2).
    """

    size_m: tuple[float, float]
    middle: Float[Tensor, "q 2"]
    axes: Float[Tensor, "q 2 2"]
    extents: Float[Tensor, "q 2"]
    free: Float[Tensor, "r c 2"]

    def __call__(self, boxes: Float[Tensor, "*b k 5"]) -> Float[Tensor, "*b k 5"]:
        """Every figure's box, moved and shrunk where it has to be."""
        scale = constant(metres_per_px(self.size_m), boxes)
        boxes = torch.cat([self._moved(boxes, scale), boxes[..., 2:]], -1)
        share = self._share(boxes) * _INSIDE
        share = torch.where(share < 1, share, 1.0)[..., None]
        return torch.cat([boxes[..., :2], boxes[..., 2:4] * share, boxes[..., 4:]], -1)

    def _moved(self, boxes: Tensor, scale: Tensor) -> Float[Tensor, "*b k 2"]:
        """The middles, in px, of which those that are not free go to the nearest place that is."""
        middle = boxes[..., :2]
        at = (middle.detach() + 0.5) * scale
        rows, columns = self.free.shape[:2]
        cell = (at / _CELL_M).floor().long()
        x, y = cell[..., 0].clamp(0, columns - 1), cell[..., 1].clamp(0, rows - 1)
        free = self.free.to(boxes)[y, x] / scale - 0.5
        # The gradient passes as if nothing had been moved.
        free = free + (middle - middle.detach())
        return torch.where((self.clearance(at) < LEAST_M)[..., None], free, middle)

    def clearance(self, points: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b"]:
        """How far points are outside of all rectangles, in the larger of the two axes; negative inside of one."""
        beside = torch.einsum("...qi,qai->...qa", points[..., None, :] - self.middle.to(points), self.axes.to(points))
        return (beside.abs() - self.extents.to(points)).amax(-1).amin(-1)

    def _share(self, boxes: Tensor) -> Float[Tensor, "*b k"]:
        """The largest scale t of every figure at which it touches no rectangle."""
        centre, across, along = half_edges_m(boxes, self.size_m)
        middle, axes, extents = (each.to(boxes) for each in (self.middle, self.axes, self.extents))
        gap = (centre[..., None, :] - middle)[..., None, :]
        normals = torch.stack([_normal(across), _normal(along)], -2)[..., None, :, :].expand(*gap.shape[:-2], 2, 2)
        every = torch.cat([normals, axes.expand_as(normals)], -2)
        reach = (torch.einsum("...qni,qai->...qna", every, axes).abs() * extents[:, None, :]).sum(-1)
        apart = (every * gap).sum(-1).abs() - reach
        own = (every * across[..., None, None, :]).sum(-1).abs() + (every * along[..., None, None, :]).sum(-1).abs()
        return (apart / own.clamp_min(1e-9)).amax(-1).amin(-1)


def _normal(edge: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 2"]:
    """The unit vector normal to each edge."""
    turned = torch.stack([-edge[..., 1], edge[..., 0]], -1)
    return turned / turned.square().sum(-1, keepdim=True).clamp_min(1e-20).sqrt()


def keep_out(site: Site, distance_m: float) -> KeepOut | None:
    """The map that keeps a distance from all lane marks of a site, in metres; None if it has no marks.

    Raises:
        PatternError: no place on the canvas is so far from all marks, or it is larger than 100 m.
    """
    ends, widths, _ = site.segments
    assert site.size_m is not None
    if max(site.size_m) > _MOST_CANVAS_M:
        width_m, length_m = site.size_m
        raise PatternError(
            f"canvas is {width_m:g} m × {length_m:g} m, expected {_MOST_CANVAS_M:g} m at most with a keep-out; "
            "leave that out"
        )
    if not len(ends):
        return None
    along = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    unit = along / length[:, None]
    beyond = distance_m + widths / 2
    axes = np.stack([unit, np.stack([-unit[:, 1], unit[:, 0]], 1)], 1)
    extents = np.stack([length / 2 + beyond, beyond], 1)
    rows, columns = (max(1, int(np.ceil(extent / _CELL_M))) for extent in (site.size_m[1], site.size_m[0]))
    x, y = np.meshgrid((np.arange(columns) + 0.5) * _CELL_M, (np.arange(rows) + 0.5) * _CELL_M)
    cells = np.stack([x, y], -1)
    found = KeepOut(
        site.size_m, torch.tensor(ends.mean(1)), torch.tensor(axes), torch.tensor(extents), torch.tensor(cells)
    )
    clear = found.clearance(torch.tensor(cells))
    free = (clear >= LEAST_M).numpy()
    if not free.any():
        raise PatternError(
            f"a keep-out of {distance_m:g} m around lane marks leaves no place for paint on the canvas; expected at "
            f"most {max(0.0, distance_m + float(clear.max()) - LEAST_M):.2f} m here"
        )
    return replace(found, free=torch.tensor(_nearest(cells, free)))


def _nearest(cells: Float[np.ndarray, "r c 2"], free: Bool[np.ndarray, "r c"]) -> Float[np.ndarray, "r c 2"]:
    """For every cell, the nearest free cell."""
    places, found = cells[free], cells.copy()
    tree: Any = KDTree(places)
    _, nearest = tree.query(cells[~free], k=list(range(1, min(_ALIKE, len(places)) + 1)))
    # Of those equally near the first, row after row.
    near: np.ndarray = np.sort(nearest, 1)
    chosen = np.square(cells[~free][:, None] - places[near]).sum(-1).argmin(1)
    found[~free] = places[near[np.arange(len(near)), chosen]]
    return found
