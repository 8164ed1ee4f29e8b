"""Which pixels of pictures are computed: those that show the canvas, or all, where shapes may not depend on numbers."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Int
from torch import Tensor


class Packed(NamedTuple):
    """Which of their pixels are computed of R pictures.

    Args:
        own: index of each pixel among those asked about, (R, P).
        valid: which of them are to be painted, (R, P).
        real: which of them lie where paint could be, so that their numbers mean something, (R, P) or (R, 1).
    """

    own: Int[Tensor, "r p"]
    valid: Bool[Tensor, "r p"]
    real: Bool[Tensor, "r _"]


def packed_pixels(touches: Bool[Tensor, "r n"]) -> Packed | None:
    """The pixels that show the canvas, as many as the picture has that shows most; None if none shows any."""
    counts = touches.sum(1)
    most = int(counts.max())
    if most == 0:
        return None
    _, pixel = touches.nonzero(as_tuple=True)
    # Rows are filled up with copies of their last pixel, which are painted as it is.
    start = counts.cumsum(0) - counts
    number = torch.arange(most, device=touches.device)
    place = start[:, None] + torch.minimum(number, (counts[:, None] - 1).clamp_min(0))
    # A picture without any canvas has no pixel to copy: what stands for it must only be finite.
    return Packed(pixel[place.clamp_max(len(pixel) - 1)], number < counts[:, None], (counts > 0)[:, None])


def all_pixels(touches: Bool[Tensor, "r n"]) -> Packed:
    """All pixels, whether they show the canvas or not."""
    own = torch.arange(touches.shape[1], device=touches.device).expand_as(touches)
    return Packed(own, touches, touches)
