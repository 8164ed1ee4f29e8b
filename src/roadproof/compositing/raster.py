"""Painting a picture of the canvas, rather than figures, into frames: for paint that has no parameters.

What `composite_own` computes in closed form for figures is sampled here: the tent that stands for a pixel's footprint
is represented by points of equal weight, and the canvas is looked up at each of them.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from roadproof.compositing.view import OwnViews
from roadproof.geometry import CANVAS_SIZE_PX

# A footprint is long along the road, which is down the picture.
SAMPLES_ACROSS, SAMPLES_DOWN = 4, 16


def composite_raster(
    paint: UInt8[np.ndarray, "400 400 4"], frames: Float[Tensor, "b 3 h w"], views: OwnViews
) -> Float[Tensor, "b 3 h w"]:
    """B pictures with the same picture of paint on the canvas of each.

    A pixel at the canvas' border sees the paint of that border beyond it too, since the share of the pixel that lies
    on the canvas is part of the views already.

    Args:
        paint: RGBA picture of the canvas with straight alpha; row 0 is the far edge.
        frames: bare pictures in [0, 1], (B, 3, H, W).
        views: the pixels of each picture through which the canvas shows.

    Returns:
        Pictures in [0, 1]; pixels outside the canvas are those of `frames` bit for bit.
    """
    seen = _averaged(_seen(paint, views), views)
    colours = (views.clean + views.gain * seen[..., :3] + views.bias * seen[..., 3:]).clamp(0.0, 1.0)
    return views.pasted(frames, colours)


def _seen(paint: UInt8[np.ndarray, "400 400 4"], views: OwnViews) -> Float[Tensor, "n 4"]:
    """Seen colour of each canvas pixel before gain and bias, times its alpha, and the alpha; row after row."""
    straight = torch.tensor(paint, device=views.clean.device, dtype=views.clean.dtype).flatten(0, 1) / 255
    alpha = straight[:, 3:]
    return torch.cat([views.response(straight[:, :3]) * alpha, alpha], 1)


def _averaged(levels: Float[Tensor, "n 4"], views: OwnViews) -> Float[Tensor, "b p 4"]:
    """The mean of the canvas' levels over each footprint."""
    footprints = views.footprints
    half = footprints.variance**0.5
    across, down = _tent_points(SAMPLES_ACROSS) * half, _tent_points(SAMPLES_DOWN) * half
    offsets = torch.cartesian_prod(across, down).to(footprints.centre)
    points = footprints.centre[:, 0, :, None] + offsets @ footprints.jacobian[:, 0].mT
    x, y = points.round().long().clamp(0, CANVAS_SIZE_PX - 1).unbind(-1)
    at = y * CANVAS_SIZE_PX + x
    return levels.index_select(0, at.flatten()).view(*at.shape, 4).mean(2)


def _tent_points(count: int) -> Float[Tensor, " n"]:
    """Points that share a tent on [−1, 1] evenly: the middles of equal parts of its area."""
    share = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    return torch.where(share < 0.5, (2 * share).sqrt() - 1, 1 - (2 - 2 * share).sqrt())
