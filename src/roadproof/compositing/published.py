"""Compositing as the paper's authors released it, to compare with: binary masks, nearest canvas pixel, whole frames.

Kept to their conventions on purpose: picture coordinates without the half-pixel shift, corners cut to integers, no
antialiasing, colours cut to 8 bits, figures blended one after another over every frame. Its shape gradients come from
`local_gradients`: pairs of whole renderings with one parameter rounded down and up.

References:
    "Computing Adversarial Perturbations" of the paper; shape_fly_simulator.py and main.py of the released code.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from roadproof.coverage import Shape, polygon_vertices
from roadproof.geometry import CANVAS_SIZE_PX, CropResize
from roadproof.patterns import Pattern, boxes_from_published
from roadproof.photometry import ColourTransform

RANGES = (180.0, 380.0, 100.0, 70.0)
"""Ranges of the four published shape parameters: rotation, position, width, length."""

_OFF_CANVAS = CANVAS_SIZE_PX**2


@dataclass(frozen=True, slots=True, eq=False)
class PublishedView:
    """Frames, and for every pixel of them the canvas pixel it is painted with.

    Args:
        frames: clean frames, (F, H, W, 3), in [0, 1].
        lookup: index into the flattened canvas for every pixel of every frame, the canvas' size where there is none.
        colour: painted → seen; its flat response alone is used.
    """

    frames: Float[Tensor, "f h w 3"]
    lookup: Int[Tensor, "f h w"]
    colour: ColourTransform


def view_canvas_published(
    frames: UInt8[np.ndarray, "f h w 3"],
    image_from_canvas: Float[np.ndarray, "f 3 3"],
    view: CropResize,
    colour: ColourTransform,
    *,
    device: torch.device | str = "cpu",
) -> PublishedView:
    """Prepare frames for compositing as published."""
    lookup = torch.as_tensor(nearest_canvas_pixels(image_from_canvas, view), device=device)
    return PublishedView(torch.tensor(frames, device=device).float() / 255, lookup, colour)


def nearest_canvas_pixels(image_from_canvas: Float[np.ndarray, "f 3 3"], view: CropResize) -> Int[np.ndarray, "f h w"]:
    """The canvas pixel nearest to where every input pixel looks, row-major; CANVAS_SIZE_PX² where it is off the canvas.

    Convention:
        Input pixel (i, j) is taken to look along camera pixel (left + i·sx, top + j·sy): the corner of its footprint,
        not its middle, as the released code does.
    """
    sx = (view.right_px - view.left_px) / view.width_px
    sy = (view.bottom_px - view.top_px) / view.height_px
    columns, rows = np.meshgrid(np.arange(view.width_px), np.arange(view.height_px))
    rays = np.stack([view.left_px + columns * sx, view.top_px + rows * sy, np.ones_like(rows, float)]).reshape(3, -1)
    # float32 as in the released code: the rounding below would differ in a few pixels otherwise.
    mapped = np.linalg.inv(image_from_canvas) @ rays.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = np.round(mapped[:, 0] / mapped[:, 2]), np.round(mapped[:, 1] / mapped[:, 2])
    on_canvas = (mapped[:, 2] > 0) & (x >= 0) & (x < CANVAS_SIZE_PX) & (y >= 0) & (y < CANVAS_SIZE_PX)
    index = np.where(on_canvas, y * CANVAS_SIZE_PX + x, _OFF_CANVAS).astype(np.int64)
    return index.reshape(len(image_from_canvas), view.height_px, view.width_px)


def composite_published(pattern: Pattern, view: PublishedView) -> Float[Tensor, "f h w 3"]:
    """Whole frames with one pattern of rectangles, the figures blended one after another."""
    seen = view.colour.response(pattern.colours).clamp(0, 1)
    frames = view.frames
    for box, colour in zip(pattern.boxes, seen.mul(255).floor() / 255, strict=True):
        mask = canvas_mask(box).to(frames.dtype).flatten()
        alpha = torch.cat([mask, mask.new_zeros(1)])[view.lookup][..., None]
        frames = alpha * colour + (1 - alpha) * frames
    return frames


def canvas_mask(box: Float[Tensor, "5"]) -> Tensor:
    """Which canvas pixels a rectangle paints: corners cut to integers, edges included, (400, 400) of bool."""
    corners = polygon_vertices(Shape.RECTANGLE, box).trunc()
    line = torch.arange(CANVAS_SIZE_PX, device=box.device, dtype=box.dtype)
    points = torch.stack([line.expand(CANVAS_SIZE_PX, -1), line[:, None].expand(-1, CANVAS_SIZE_PX)], -1)
    edges = corners.roll(-1, 0) - corners
    offsets = points[..., None, :] - corners
    return (edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= 0).all(-1)


def local_gradients(
    values: Float[Tensor, "k 4"],
    colours: Float[Tensor, "k 3"],
    view: PublishedView,
    frame_gradients: Float[Tensor, "f h w 3"],
    *,
    step: float,
) -> tuple[Float[Tensor, "k 4"], Float[Tensor, "k 3"]]:
    """The paper's gradients: shapes by local linearisation, colours through the visible masks.

    Each shape parameter θ lies between neighbours θ⁻ ≤ θ ≤ θ⁺ of a grid of width `step`; the frame is taken to be
    linear between its renderings at both, all other parameters as they are: 8 K renderings of all frames.

    Args:
        values: published shape parameters (see `patterns.boxes_from_published`).
        colours: paint, RGB in [0, 1].
        view: the frames.
        frame_gradients: ∂L/∂I at the actual frames.
        step: grid width in px and degrees; 10, then 1, as published.

    Returns:
        ∂L/∂values and ∂L/∂colours.
    """
    shapes = (Shape.RECTANGLE,) * len(values)
    grads = torch.zeros_like(values)
    for k in range(len(values)):
        for j, span in enumerate(RANGES):
            low = (values[k, j] / step).floor().clamp_max((span / step) - 1) * step
            ends: list[Tensor] = []
            for end in (low, low + step):
                moved = values.clone()
                moved[k, j] = end
                ends.append(composite_published(Pattern(shapes, boxes_from_published(moved), colours), view))
            grads[k, j] = ((ends[1] - ends[0]) * frame_gradients).sum() / step
    return grads, _colour_gradients(values, colours, view, frame_gradients)


def _colour_gradients(values: Tensor, colours: Tensor, view: PublishedView, frame_gradients: Tensor) -> Tensor:
    """Eq. cgrad: ∂L/∂x_k = ∑ Cᵀ ∑ V_k ∂L/∂I."""
    leaf = colours.detach().requires_grad_()
    with torch.enable_grad():
        seen = view.colour.response(leaf)
    on_seen = torch.zeros_like(colours)
    bare = torch.ones_like(view.frames[..., 0])
    for k, box in reversed(list(enumerate(boxes_from_published(values)))):
        mask = canvas_mask(box).to(bare.dtype).flatten()
        visible = torch.cat([mask, mask.new_zeros(1)])[view.lookup] * bare
        bare = bare - visible
        on_seen[k] = (visible[..., None] * frame_gradients).sum((0, 1, 2))
    (gradient,) = torch.autograd.grad(seen, leaf, on_seen)
    return gradient
