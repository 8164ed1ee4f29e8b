"""Compositing as published, to compare with: as the authors' code has it, or as the paper's text says.

`BinaryView` keeps to the code on purpose: picture coordinates without the half-pixel shift, nearest canvas pixel,
corners cut to integers, no antialiasing, colours cut to 8 bits, black figures drawn as they are. `AntialiasedView` has
the fractional masks of the text. Both give the colours of the canvas' pixels for any visibility of the figures, which
is what a local linearisation needs (`attacks.published`).

References:
    "Computing Adversarial Perturbations" of the paper; shape_fly_simulator.py and main.py of the released code.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from roadproof.compositing.view import CanvasView
from roadproof.coverage import Shape, coverage, polygon_vertices
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CropResize
from roadproof.homographies import Homographies
from roadproof.photometry import ColourTransform

_OFF_CANVAS = CANVAS_SIZE_PX**2

Change: TypeAlias = tuple[Int[Tensor, " q"], Float[Tensor, "2 q"]]
"""Some of the canvas' pixels, and two masks there."""


@dataclass(frozen=True, slots=True, eq=False)
class BinaryView:
    """Frames as the released code paints them.

    Args:
        frames: clean frames in [0, 1], (F, H, W, 3).
        index: index of the canvas' pixels in the flattened frames, (P,).
        lookup: canvas pixel that paints each of the canvas' picture pixels, as a row-major index, (P,).
        colour: transform from painted to seen, of which only the response is used; None draws paint unchanged.
    """

    frames: Float[Tensor, "f h w 3"]
    index: Int[Tensor, " p"]
    lookup: Int[Tensor, " p"]
    colour: ColourTransform | None

    def masks(self, boxes: Float[Tensor, "*b 5"]) -> Float[Tensor, "*b p"]:
        """1 for each pixel whose canvas pixel the rectangle covers, 0 for the others."""
        return canvas_mask(boxes).flatten(-2)[..., self.lookup].to(self.frames.dtype)

    def changes(self, pairs: Float[Tensor, "n 2 5"]) -> Iterator[Change]:
        """For each pair of rectangles, the pixels in which their masks differ, and both masks there."""
        canvas = canvas_mask(pairs).flatten(-2)
        for both, differ in zip(canvas, (canvas[:, 0] ^ canvas[:, 1])[:, self.lookup], strict=True):
            changed = differ.nonzero()[:, 0]
            yield changed, both[:, self.lookup[changed]].to(self.frames.dtype)

    def pixels(
        self, visibility: Float[Tensor, "*b k q"], colours: Float[Tensor, "k 3"], among: Int[Tensor, " q"] | None = None
    ) -> Float[Tensor, "*b q 3"]:
        """Colours of the canvas' pixels; gradients ignore clipping and rounding, as the released code does."""
        seen = colours if self.colour is None else self.colour.response(colours)
        cut = seen.detach().clamp(0, 1).mul(255).floor() / 255
        seen = seen + (cut - seen).detach()
        clean = self.frames.reshape(-1, 3)[self.index if among is None else self.index[among]]
        return visibility.mT @ seen + (1 - visibility.sum(-2))[..., None] * clean


@dataclass(frozen=True, slots=True, eq=False)
class AntialiasedView:
    """Frames painted with the fractional masks of the paper's text.

    Args:
        view: clean frames and the pixels through which the canvas shows.
    """

    view: CanvasView

    @property
    def frames(self) -> Float[Tensor, "f h w 3"]:
        """Clean frames, in [0, 1]."""
        return self.view.frames

    @property
    def index(self) -> Int[Tensor, " p"]:
        """Where in the flattened frames the canvas' pixels are."""
        return self.view.index

    def masks(self, boxes: Float[Tensor, "*b 5"]) -> Float[Tensor, "*b p"]:
        """The share of each pixel that a rectangle covers, antialiased."""
        return coverage(Shape.RECTANGLE, boxes[..., None, :], self.view.footprints)[..., 0, :]

    def changes(self, pairs: Float[Tensor, "n 2 5"]) -> Iterator[Change]:
        """For each pair of rectangles, the pixels in which their masks differ, and both masks there."""
        for both in self.masks(pairs):
            changed = (both[0] != both[1]).nonzero()[:, 0]
            yield changed, both[:, changed]

    def pixels(
        self, visibility: Float[Tensor, "*b k q"], colours: Float[Tensor, "k 3"], among: Int[Tensor, " q"] | None = None
    ) -> Float[Tensor, "*b q 3"]:
        """Colours of the canvas' pixels (eq. composite)."""
        view, which = self.view, slice(None) if among is None else among
        share, seen = visibility.sum(-2)[..., None], view.response(colours)
        painted = view.gain[which] * (visibility.mT @ seen) + view.bias[which] * share
        return (view.clean[which] + painted).clamp(0.0, 1.0)


MaskedView: TypeAlias = BinaryView | AntialiasedView
"""Frames and the P pixels of theirs through which the canvas shows, painted by masks."""


def view_canvas_published(
    frames: UInt8[np.ndarray, "f h w 3"],
    image_from_canvas: Homographies,
    view: CropResize,
    colour: ColourTransform | None,
    *,
    camera: CameraModel | None = None,
    device: torch.device | str = "cpu",
) -> BinaryView:
    """Prepare frames for compositing as the released code does."""
    lookup = torch.as_tensor(nearest_canvas_pixels(image_from_canvas, view, camera), device=device).flatten()
    index = (lookup < _OFF_CANVAS).nonzero()[:, 0]
    return BinaryView(torch.tensor(frames, device=device).float() / 255, index, lookup[index], colour)


def nearest_canvas_pixels(
    image_from_canvas: Homographies, view: CropResize, camera: CameraModel | None = None
) -> Int[np.ndarray, "f h w"]:
    """The canvas pixel nearest to where every input pixel looks, row-major; CANVAS_SIZE_PX² where it is off the canvas.

    Convention:
        Input pixel (i, j) is taken to look along camera pixel (left + i·sx, top + j·sy): the corner of its footprint,
        not its middle, as the released code does.
    """
    sx = (view.right_px - view.left_px) / view.width_px
    sy = (view.bottom_px - view.top_px) / view.height_px
    columns, rows = np.meshgrid(np.arange(view.width_px), np.arange(view.height_px))
    rays = np.stack([view.left_px + columns * sx, view.top_px + rows * sy, np.ones_like(rows, float)]).reshape(3, -1)
    if camera is not None:
        rays = camera.undistorted(rays[:2].T)[0].T
    # float32 as in the released code: the rounding below would differ in a few pixels otherwise.
    mapped = np.linalg.inv(image_from_canvas) @ rays.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = np.round(mapped[:, 0] / mapped[:, 2]), np.round(mapped[:, 1] / mapped[:, 2])
    on_canvas = (mapped[:, 2] > 0) & (x >= 0) & (x < CANVAS_SIZE_PX) & (y >= 0) & (y < CANVAS_SIZE_PX)
    index = np.where(on_canvas, y * CANVAS_SIZE_PX + x, _OFF_CANVAS).astype(np.int64)
    return index.reshape(len(image_from_canvas), view.height_px, view.width_px)


def pasted(view: MaskedView, pixels: Float[Tensor, "p 3"]) -> Float[Tensor, "f h w 3"]:
    """Whole frames with the given colours in the canvas' pixels."""
    return view.frames.reshape(-1, 3).index_copy(0, view.index, pixels).view_as(view.frames)


def canvas_mask(boxes: Float[Tensor, "*b 5"]) -> Tensor:
    """Which canvas pixels a rectangle paints: corners cut to integers, edges included, (*b, 400, 400) of bool."""
    corners = polygon_vertices(Shape.RECTANGLE, boxes).trunc()
    line = torch.arange(CANVAS_SIZE_PX, device=boxes.device, dtype=boxes.dtype)
    edges = corners.roll(-1, -2) - corners
    # Whole numbers below 2²⁴: each side is exact, so comparing them is comparing their difference with 0.
    down = edges[..., 0, None] * (line - corners[..., 1, None])
    along = edges[..., 1, None] * (line - corners[..., 0, None])
    inside = down[..., 0, :, None] >= along[..., 0, None, :]
    for edge in range(1, corners.shape[-2]):
        inside &= down[..., edge, :, None] >= along[..., edge, None, :]
    return inside
