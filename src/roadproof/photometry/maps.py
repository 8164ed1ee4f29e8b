"""Per-pixel gain and offset of a drive, from two drives over uniformly painted canvases.

What a smooth model cannot know, such as the shadow of a tree across the canvas, two pictures of every frame show: with
one light and one dark paint all over, seen = gain ⊙ painted + offset has two equations a pixel. The same two
pictures show where the canvas is seen, occlusion included.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from roadproof.errors import ColourError

_SEEN = 6 / 255
_BORDER_PX = 2

MOST_CLIPPED = 0.1
"""So much of what is seen of the white paint may be saturated, in the channel where most is."""


@dataclass(frozen=True, slots=True, eq=False)
class PixelMaps:
    """Light on every pixel of a drive at the controller's input, seen = gain ⊙ flat + offset.

    The flat colour is what the response of the recordings' `ColourTransform` makes of the painted one.

    Args:
        gain: gain of every pixel, (F, H, W, 3); 1 where the canvas is not seen.
        offset: offset of every pixel, (F, H, W, 3); 0 where the canvas is not seen.
        visible: share of the pixel through which the canvas is seen, (F, H, W), in [0, 1].
    """

    gain: Float[Tensor, "f h w 3"]
    offset: Float[Tensor, "f h w 3"]
    visible: Float[Tensor, "f h w"]

    def __post_init__(self) -> None:
        if self.gain.shape != self.offset.shape or self.gain.shape[:3] != self.visible.shape:
            shapes = [tuple(part.shape) for part in (self.gain, self.offset, self.visible)]
            raise ColourError(
                f"gain, offset and visible have shapes {shapes}, expected (F, H, W, 3) twice and (F, H, W)"
            )
        for name in ("gain", "offset", "visible"):
            if not bool(getattr(self, name).isfinite().all()):
                raise ColourError(f"{name} of the pixel maps has NaN or infinite values")
        if bool(((self.visible < 0) | (self.visible > 1)).any()):
            low, high = float(self.visible.min()), float(self.visible.max())
            raise ColourError(f"visible of the pixel maps goes from {low:g} to {high:g}, expected shares in [0, 1]")

    def at(self, frames: list[int] | slice) -> PixelMaps:
        """The maps of some frames, by their indices."""
        return PixelMaps(self.gain[frames], self.offset[frames], self.visible[frames])

    @staticmethod
    def joined(parts: Sequence[PixelMaps | None]) -> PixelMaps | None:
        """The maps of several drives, one after the other; None if one has none."""
        maps = [part for part in parts if part is not None]
        if len(maps) < len(parts):
            return None
        names = ("gain", "offset", "visible")
        return PixelMaps(*(torch.cat([getattr(part, name) for part in maps]) for name in names))


def pixel_maps_from_two_paints(
    light_frames: UInt8[Tensor, "f h w 3"], dark_frames: UInt8[Tensor, "g i j 3"]
) -> PixelMaps:
    """Gain, offset and visibility of every pixel, for the painted colour itself, from two replays of one drive.

    Pixels that the canvas fills only in part take gain and offset from their neighbours inside it. Where the edge of
    a shadow meets the edge of the canvas, the two cannot be told apart, and a few pixels are off.

    Args:
        light_frames: frames of the drive with the whole canvas painted white, (F, H, W, 3).
        dark_frames: the same frames with the whole canvas painted black, of the same shape.

    Raises:
        ColourError: frames of different shapes, no difference between them, or more of what is seen of the white
            paint is saturated than `MOST_CLIPPED`.
    """
    if light_frames.shape != dark_frames.shape:
        raise ColourError(
            f"light frames have shape {tuple(light_frames.shape)} and dark ones {tuple(dark_frames.shape)}; replay the "
            "same frames with both paints"
        )
    bright, dim = light_frames.float() / 255, dark_frames.float() / 255
    slope = bright - dim
    apart = slope.mean(-1)
    seen = apart > _SEEN
    if not bool(seen.any()):
        raise ColourError(
            "light and dark frames do not differ anywhere; check that the paint shows, and the same frames"
        )
    clipped = float((light_frames[seen] == 255).float().mean(0).max())
    if clipped > MOST_CLIPPED:
        raise ColourError(
            f"{clipped:.0%} of what is seen of the white paint is saturated in a channel, expected at most "
            f"{MOST_CLIPPED:.0%}: what lies between white and black could not be told; choose a darker weather or "
            "expose less"
        )
    inside = seen & ~_dilate(~seen)
    near = _dilate(inside, _BORDER_PX)
    known = torch.where(inside[..., None], torch.cat([slope, dim], -1), 0.0)
    filled = _filled(known, inside)
    expected = filled[..., :3].mean(-1)
    # More contrast than the neighbours have cannot come from a part of the pixel: it is lit better, and seen whole.
    own = inside | (seen & (~near | (apart >= expected)))
    border = (near & ~own)[..., None]
    gain = torch.where(own[..., None], slope, torch.where(border, filled[..., :3], 1.0))
    offset = torch.where(own[..., None], dim, torch.where(border, filled[..., 3:], 0.0))
    share = (apart / expected.clamp_min(_SEEN)).clamp(0.0, 1.0)
    visible = torch.where(own, 1.0, torch.where(border[..., 0], share, 0.0))
    return PixelMaps(gain, offset, visible)


def _dilate(mask: Tensor, radius_px: int = 1) -> Tensor:
    return max_pool2d(mask.float()[:, None], 2 * radius_px + 1, 1, radius_px)[:, 0] > 0


def _filled(values: Float[Tensor, "f h w c"], known: Tensor) -> Float[Tensor, "f h w c"]:
    """Means of the known values around each pixel, the nearest ring that has any."""
    filled = values
    for radius in range(_BORDER_PX, 0, -1):
        size = 2 * radius + 1
        share = avg_pool2d(known.float()[:, None], size, 1, radius)
        mean = avg_pool2d(values.permute(0, 3, 1, 2), size, 1, radius) / share.clamp_min(1e-6)
        filled = torch.where((share > 0).permute(0, 2, 3, 1), mean.permute(0, 2, 3, 1), filled)
    return filled
