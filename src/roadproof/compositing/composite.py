"""Painting a pattern into recorded frames, differentiably: the forward process of the paper (eq. composite).

With the visibility V_k of figure k in a pixel (`patterns.visibilities`), the share s of the pixel that lies on the
canvas, and the colour transform seen = gain ⊙ response(painted) + offset,

    I(n; Φ) = (1 − s ∑_k V_k) I(n) + s ∑_k V_k (gain ⊙ r_k + offset)  =  I + A ⊙ ∑_k V_k r_k + B ∑_k V_k

where A = s·gain and B = s·(offset − I) are fixed for every pixel. So only pixels inside the canvas' projection are
computed, and a figure costs one multiply-add a pixel once its visibility is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.compositing.variation import Looks
from roadproof.compositing.view import CanvasPixels, CanvasView, OwnViews, fuses, view_canvas
from roadproof.coverage import Shape
from roadproof.errors import PatternError
from roadproof.geometry import CameraModel, CropResize
from roadproof.homographies import Homographies
from roadproof.patterns import Pattern, coverages, visibilities
from roadproof.photometry import AffineResponse, ColourTransform


def composite(pattern: Pattern, view: CanvasView) -> Float[Tensor, "*b f 3 h w"]:
    """The frames of a view with a pattern (or a batch of patterns) painted on the canvas.

    Differentiable in the pattern's boxes and colours, exactly.

    Args:
        pattern: one pattern or a batch of them, on the device and in the precision of the view.
        view: F frames and the pixels through which the canvas shows.

    Returns:
        Frames in [0, 1], (*b, F, 3, H, W); pixels of the bare road are copied bit for bit.
    """
    batch, figures = pattern.boxes.shape[:-2], len(pattern.shapes)
    flat = Pattern(pattern.shapes, pattern.boxes.reshape(-1, figures, 5), pattern.colours.reshape(-1, figures, 3))
    frames = Compositor([view], len(flat.boxes))([flat])
    return frames.view(*batch, *view.clean_frames.shape)


def covered_share(
    pattern: Pattern, image_from_canvas: Homographies, view: CropResize, *, camera: CameraModel | None = None
) -> Float[np.ndarray, "f h w"]:
    """Share of every pixel that a pattern covers, in [0, 1]: what is white on a black road is paint.

    Args:
        pattern: one pattern, whatever its colours.
        image_from_canvas: one homography per frame, canvas px to camera px.
        view: crop and resize that made the frames from the camera picture.
        camera: camera of the frames, of which only the lens counts; None for a pinhole.

    Raises:
        GeometryError: no frame shows the canvas.
    """
    black = np.zeros((len(image_from_canvas), view.height_px, view.width_px, 3), np.uint8)
    dark = view_canvas(black, image_from_canvas, view, ColourTransform(AffineResponse.identity()), camera=camera)
    white = Pattern(pattern.shapes, pattern.boxes, torch.ones_like(pattern.colours))
    return composite(white, dark)[:, 0].numpy()


class Compositor:
    """Composites batches of patterns into several views at once, over and over, into one batch of frames.

    The frames are kept between calls and only the canvas' pixels are written anew, so each call overwrites what the
    last one returned: use a result, backward pass included, before asking for the next.

    Args:
        views: sets of frames with their view of the canvas, all frames of one size.
        copies: number of patterns painted into each view.
    """

    def __init__(self, views: Sequence[CanvasView], copies: int) -> None:
        self._views = tuple(views)
        self._copies = copies
        self._frames = self._bare()
        self._known = self._written

    def __call__(self, patterns: Sequence[Pattern], looks: Looks | None = None) -> Float[Tensor, "n 3 h w"]:
        """The composited frames in [0, 1], view after view and, in each view, pattern after pattern.

        Args:
            patterns: one batch of `copies` patterns for each view.
            looks: looks given to the patterns in turn, of which only the wear is used; None for fresh paint.

        Raises:
            PatternError: a batch has another number of patterns.
        """
        if others := [len(each.boxes) for each in patterns if len(each.boxes) != self._copies]:
            raise PatternError(f"a view is given {others[0]} patterns, expected the compositor's {self._copies}")
        if self._written != self._known:
            # A controller has written into the frames that it was given.
            self._frames = self._bare()
        if looks is None and all(map(_compiles, patterns, self._views)):
            return self._compiled(patterns)
        colours = [canvas_colours(pattern, view) for pattern, view in zip(patterns, self._views, strict=True)]
        if looks is not None:
            colours = [
                _worn(colour, view.clean, looks.left(view.footprints.centre[None], self._copies))
                for colour, view in zip(colours, self._views, strict=True)
            ]
        return cast("Tensor", _Pasted.apply(self, *colours))

    @property
    def _written(self) -> int:
        """How often the frames have been written to; of inference tensors nobody counts it."""
        return 0 if self._frames.is_inference() else self._frames._version  # noqa: SLF001

    def _bare(self) -> Float[Tensor, "n h w 3"]:
        return torch.cat([view.frames.repeat(self._copies, 1, 1, 1) for view in self._views])

    def _compiled(self, patterns: Sequence[Pattern]) -> Float[Tensor, "n 3 h w"]:
        # It is compiled when it is first wanted.
        from roadproof.compositing.compiled import Place, painted_into

        places, first = list[Place](), 0
        for view in self._views:
            places.append(Place(view.index[None], torch.tensor([len(view.index)]), first, len(view.frames)))
            first += self._copies * len(view.frames)
        painted = painted_into(self._frames.flatten(1, 2).mT, patterns, self._views, places)
        self._known = self._written
        return painted.view(*painted.shape[:2], *self._frames.shape[1:3])

    def slots(self, frames: Tensor) -> list[Float[Tensor, "c p 3"]]:
        """For each view the flattened pixels of its share of a batch of frames, (copies, F·H·W, 3), as a view of it."""
        counts = [self._copies * len(view.frames) for view in self._views]
        parts = cast("tuple[Tensor, ...]", frames.split(counts))
        return [part.reshape(self._copies, -1, 3) for part in parts]

    def paste(self, colours: Sequence[Tensor]) -> Float[Tensor, "n 3 h w"]:
        """Write the colours of the canvas' pixels, one (copies, P, 3) a view, into the frames."""
        for slot, view, colour in zip(self.slots(self._frames), self._views, colours, strict=True):
            slot.index_copy_(1, view.index, colour)
        self._known = self._written
        return self._frames.permute(0, 3, 1, 2)

    def pick(self, frames: Float[Tensor, "n 3 h w"]) -> list[Tensor]:
        """The canvas' pixels of a batch of frames, one (copies, P, 3) per view: the transpose of `paste`."""
        slots = self.slots(frames.permute(0, 2, 3, 1))
        return [slot.index_select(1, view.index) for slot, view in zip(slots, self._views, strict=True)]


class _Pasted(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, compositor: Compositor, *colours: Tensor) -> Tensor:  # noqa: ANN401
        ctx.compositor = compositor
        return compositor.paste(colours)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401
        return (None, *ctx.compositor.pick(grad_outputs[0]))


def composite_own(
    pattern: Pattern, frames: Float[Tensor, "b 3 h w"], views: OwnViews, looks: Looks | None = None
) -> Float[Tensor, "b 3 h w"]:
    """B pictures with a pattern of its own painted into each, differentiable in the patterns.

    Args:
        pattern: batch of B patterns, one for each picture.
        frames: bare pictures in [0, 1], (B, 3, H, W).
        views: the pixels of each picture through which the canvas shows.
        looks: looks given to the patterns in turn, of which only the wear is used; None for fresh paint.
    """
    if looks is None and _compiles(pattern, views) and not frames.requires_grad:
        from roadproof.compositing.compiled import Place, painted_into

        place = Place(views.pixel, views.valid.sum(1))
        return painted_into(frames.flatten(2).clone(), [pattern], [views], [place]).view_as(frames)
    colours = canvas_colours(pattern, views)
    if looks is not None:
        colours = _worn(colours, views.clean, looks.left(views.footprints.centre[:, 0], len(frames)))
    # A copy is written where its pixel is, with the same colour; the gradient goes to the pixel alone.
    colours = torch.where(views.valid[..., None], colours, colours.detach())
    return views.pasted(frames, colours)


def _worn(colours: Tensor, clean: Tensor, left: Float[Tensor, "b p"]) -> Tensor:
    """Colours of the canvas' pixels with worn paint, through which the bare road shows."""
    return torch.lerp(clean.expand_as(colours), colours, left[..., None].to(colours))


def canvas_colours(pattern: Pattern, view: CanvasPixels) -> Float[Tensor, "*b p 3"]:
    """Colours of the canvas' pixels with the pattern painted, differentiable in its boxes and colours."""
    if set(pattern.shapes) == {Shape.RECTANGLE} and fuses(view.clean):
        # Triton may be missing.
        from roadproof.compositing.fused import painted as painted_on_gpu

        return painted_on_gpu(pattern, view)
    if view.dense:
        return dense_colours(pattern, view)
    if _compiles(pattern, view):
        from roadproof.compositing.compiled import painted

        return painted(pattern, view)
    return blend(visibilities(coverages(pattern, view.footprints)), view.response(pattern.colours), view)


def _compiles(pattern: Pattern, view: CanvasPixels) -> bool:
    """Whether passes compiled for the processor paint a pattern."""
    here = view.clean.dtype == torch.float32 and view.clean.device.type == "cpu"
    return here and not view.dense and len(set(pattern.shapes)) == 1


def dense_colours(pattern: Pattern, view: CanvasPixels) -> Float[Tensor, "*b p 3"]:
    """What `canvas_colours` gives, from the masks of all figures in all pixels, without asking the device for a number.

    So it multiplies figure by figure: the gradient of a cumulative product asks whether a factor is 0.
    """
    masks = coverages(pattern, view.footprints)
    through, seen = torch.ones_like(masks[..., 0, :]), list[Tensor]()
    for mask in reversed(masks.unbind(-2)):
        seen.append(mask * through)
        through = through * (1 - mask)
    return blend(torch.stack(seen[::-1], -2), view.response(pattern.colours), view)


def blend(visibility: Float[Tensor, "*b k p"], seen: Float[Tensor, "*b k 3"], view: CanvasPixels) -> Tensor:
    """Eq. composite on the canvas' pixels, (*b, P, 3), clipped to [0, 1], as plain tensor operations."""
    share = visibility.sum(-2)[..., None]
    return (view.clean + view.gain * (visibility.mT @ seen) + view.bias * share).clamp(0.0, 1.0)
