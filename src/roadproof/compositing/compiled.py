"""Painting figures on a CPU: one pass over the canvas' pixels to paint them, one to go back, compiled by Numba.

The same values as `composite.blend` over `coverage`. Operation by operation a pixel is read and written some hundred
times on its way there and back; here it is read once, and a figure that does not reach it costs a look at how far off
it is. Masks are worked out anew on the way back: those of rectangles here, on the way, those of other shapes by a pass
of their own (`compositing.masks`). Pixels are taken in blocks, by as many threads as torch has, and each block adds up
its own share of the gradients: the same numbers are added in the same order whoever takes them.

With S̃(t) = t (1 − |t|/2) on [−1, 1] and its slope S̃′(t) = 1 − |t| (zero where t was clamped), the edges of a rectangle
along one axis at distances d = w/2 ± u from a pixel, and σ across them,

    C_u = S̃(t₁) + S̃(t₂),   t = d/σ_u,   M = C_u C_v
    ∂M/∂d  = C_v S̃′(t)/σ_u
    ∂M/∂σ² = −C_v ∑ S̃′(t) t / (2 σ_u²)

and for the visibilities V_k = M_k T_k, with D_k = ∂L/∂V_k and what is seen through figure k, S_{k+1} = D_k M_k +
(1 − M_k) S_k, S_0 = 0, each adjoint is ∂L/∂M_k = T_k (D_k − S_k): compositing again, from the bottom up.

A figure comes as twelve numbers (`CanvasPixels.figures`), pixels as their `CanvasPixels` have them, with a leading
dimension of 1, or of B where each pattern has pixels of its own.
"""

# ruff: noqa: ANN001, ANN202
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast, no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from roadproof.compiling import Kernel, inline, run
from roadproof.compositing.masks import BLOCK, COVERS
from roadproof.compositing.tents import interval_share, slope, tent
from roadproof.compositing.view import CanvasPixels
from roadproof.coverage import MIN_VARIANCE, Shape
from roadproof.errors import PatternError
from roadproof.patterns import Pattern

_ZERO, _HALF, _ONE, _LEAST = np.float32(0), np.float32(0.5), np.float32(1), np.float32(MIN_VARIANCE)
_NAN, _NUMBERS = np.float32(np.nan), 12


class Place(NamedTuple):
    """Where the P pixels of a view lie in the pictures that are painted.

    Args:
        pixel: index of each pixel in a pattern's pictures, flattened, (1, P), or (B, P) where each of B patterns has
            pixels of its own.
        counted: how many pixels of each row count, (1,) or (B,); the rest fill it up.
        first: the first of the view's pictures.
        each: how many pictures a pattern has.
    """

    pixel: Int[Tensor, "w p"]
    counted: Int[Tensor, " w"]
    first: int = 0
    each: int = 1


def painted(pattern: Pattern, view: CanvasPixels) -> Float[Tensor, "*b p 3"]:
    """Colours of the canvas' pixels with figures painted, differentiable as in `painted_into`."""
    batch, many = pattern.boxes.shape[:-2], view.clean.shape[-2]
    colours = view.clean.new_empty(batch.numel(), many, 3)
    rows = view.clean.shape[:-2].numel()
    place = Place(torch.arange(many).expand(rows, -1), torch.full((rows,), many))
    return painted_into(colours.mT, [pattern], [view], [place]).mT.view(*batch, many, 3)


def painted_into(
    pictures: Float[Tensor, "n 3 q"],
    patterns: Sequence[Pattern],
    views: Sequence[CanvasPixels],
    places: Sequence[Place],
) -> Float[Tensor, "n 3 q"]:
    """Pictures with figures painted in the canvas' pixels of some views, differentiable once in boxes and colours.

    Widths and lengths are above 0, and what is known of the pixels is finite.

    Args:
        pictures: N flattened pictures of float32; they are written to, and what is returned shares their memory.
        patterns: a batch of patterns for each view, all their figures of one shape.
        views: what the pictures show of the canvas.
        places: where the pixels of each view lie in the pictures.

    Raises:
        PatternError: a view has another number of pictures, or of rows of pixels, than its patterns need.
    """
    figures, shapes = list[Tensor](), list[Shape]()
    for pattern, view, place in zip(patterns, views, places, strict=True):
        figures.append(view.figures(pattern))
        shapes.append(pattern.shapes[0])
        rows = view.clean.shape[:-2].numel()
        end, room = place.first + len(figures[-1]) * place.each, len(pictures)
        if end > room or rows not in (1, len(figures[-1])):
            raise PatternError(f"{len(figures[-1])} patterns do not fit {room} pictures with {rows} rows of pixels")
    canvases = [_Canvas(*each) for each in zip(shapes, views, places, strict=True)]
    return cast("Tensor", _Painted.apply((pictures, canvases), *figures))


class _Canvas(NamedTuple):
    """What is painted on with figures of one shape."""

    shape: Shape
    view: CanvasPixels
    place: Place

    @property
    def blocks(self) -> int:
        """How many parts its pixels are taken in."""
        return -(-self.place.pixel.shape[1] // BLOCK)

    @property
    def features(self) -> Float[Tensor, "w 6 p"]:
        """The features of its pixels' footprints."""
        return self.view.footprints.features.reshape(-1, 6, self.view.clean.shape[-2]).contiguous()

    def outlined(self, figures: Tensor, masks: Tensor) -> tuple[Tensor | float, ...]:
        """What a kernel of masks is told."""
        footprints = self.view.footprints
        jacobian = footprints.jacobian.reshape(len(self.features), -1, 4).contiguous()
        return figures.contiguous(), self.features, jacobian, self.place.counted, footprints.side, masks

    def masks(self, figures: Tensor) -> Float[Tensor, "b k p"]:
        """The figures' masks; empty where they are rectangles."""
        if self.shape not in COVERS:
            return figures.new_empty(len(figures), 0, 0)
        cover, _ = COVERS[self.shape]
        masks = figures.new_empty(*figures.shape[:2], self.place.pixel.shape[1])
        run(cover, self.outlined(figures, masks), self.blocks)
        return masks

    def told(self, figures: Tensor, masks: Tensor, pictures: Float[Tensor, "n 3 q"]) -> tuple[Tensor | int, ...]:
        """What a kernel is told; pictures as one row of numbers, and how far apart those of each dimension are.

        A kernel is compiled once for all orders of a picture's numbers: channels first as channels last.
        """
        view, many = self.view, self.view.clean.shape[-2]
        lights = (each.reshape(-1, many, 3) for each in (view.clean, view.gain, view.bias))
        strides = pictures.stride()
        extent = sum((size - 1) * stride for size, stride in zip(pictures.shape, strides, strict=True)) + 1
        row = pictures.detach().as_strided((extent if pictures.numel() else 0,), (1,))
        given = (figures, masks, self.features, *lights, self.place.pixel, self.place.counted)
        own = (each.contiguous() for each in given)
        return *own, self.place.first, self.place.each, row, pictures.shape[2], *strides

    def gradient(self, figures: Tensor, on_pictures: Float[Tensor, "n 3 q"]) -> Float[Tensor, "b k 12"]:
        """The gradient of the figures' numbers from that of the pictures."""
        masks = self.masks(figures)
        shares = torch.empty(self.blocks, *figures.shape, dtype=torch.float64)
        run(_unpaint, (*self.told(figures, masks, on_pictures), shares), self.blocks)
        if self.shape in COVERS:
            # The masks hold their own gradient now.
            _, uncover = COVERS[self.shape]
            run(uncover, (*self.outlined(figures, masks), shares), self.blocks)
        return shares.sum(0).to(figures.dtype)


class _Painted(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, on: tuple[Tensor, Sequence[_Canvas]], *figures: Tensor) -> Tensor:  # noqa: ANN401
        # What is painted on is out of sight of what takes the gradients.
        pictures, ctx.canvases = on
        ctx.save_for_backward(*figures)
        for each, canvas in zip(figures, ctx.canvases, strict=True):
            run(_paint, canvas.told(each, canvas.masks(each), pictures), canvas.blocks)
        torch.autograd.graph.increment_version(pictures)
        return pictures.detach()

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  # the decorator has no names for arguments
        ctx: Any,  # noqa: ANN401
        *grad_outputs: Tensor,
    ) -> tuple[Tensor | None, ...]:
        wanted = zip(ctx.needs_input_grad[1:], ctx.saved_tensors, ctx.canvases, strict=True)
        gradients = (canvas.gradient(each, grad_outputs[0]) if wants else None for wants, each, canvas in wanted)
        return None, *gradients


# Numbers are asked for one by one: a view of a row of them would be counted at every pixel, which takes longer than
# all else.


@inline
@no_type_check
def _in_figure(figures, b, k, x, y, xx, xy, yy):
    """A pixel in a figure's axes: u, v, and σ² along them."""
    c, s = figures[b, k, 0], figures[b, k, 1]
    cc, cs, ss = figures[b, k, 4], figures[b, k, 5], figures[b, k, 6]
    u, v = c * x + s * y + figures[b, k, 2], c * y - s * x + figures[b, k, 3]
    return u, v, cc * xx + cs * xy + ss * yy, ss * xx - cs * xy + cc * yy


@inline
@no_type_check
def _mask(figures, b, k, x, y, xx, xy, yy):
    """How much of a pixel a rectangle covers."""
    u, v, variance_u, variance_v = _in_figure(figures, b, k, x, y, xx, xy, yy)
    half_u, half_v = figures[b, k, 7], figures[b, k, 8]
    deep_u, deep_v = half_u - abs(u), half_v - abs(v)
    reach_u, reach_v = np.sqrt(max(variance_u, _LEAST)), np.sqrt(max(variance_v, _LEAST))
    if deep_u <= -reach_u or deep_v <= -reach_v:
        return _ZERO
    if deep_u >= reach_u and deep_v >= reach_v:
        return _ONE
    return interval_share(u, half_u, reach_u) * interval_share(v, half_v, reach_v)


@inline
@no_type_check
def _laid(figures, masked, given, b, p, x, y, xx, xy, yy, masks, above):
    """Lay the figures over each other from the top: colours and share of the paint that is seen in a pixel.

    What each figure covers of it, and what of that is not under others, is written down for the way back.
    """
    through, red, green, blue = _ONE, _ZERO, _ZERO, _ZERO
    for k in range(len(masks) - 1, -1, -1):
        mask = given[b, k, p] if masked else _mask(figures, b, k, x, y, xx, xy, yy)
        masks[k], above[k] = mask, through
        if mask != _ZERO:
            shown = mask * through
            red += shown * figures[b, k, 9]
            green += shown * figures[b, k, 10]
            blue += shown * figures[b, k, 11]
            through *= _ONE - mask
    return red, green, blue, _ONE - through


@inline
@no_type_check
def _composed(clean, gain, bias, w, p, red, green, blue, share):
    """Eq. composite, not clipped yet, from colours and share of the paint that is seen."""
    red = clean[w, p, 0] + gain[w, p, 0] * red + bias[w, p, 0] * share
    green = clean[w, p, 1] + gain[w, p, 1] * green + bias[w, p, 1] * share
    return red, green, clean[w, p, 2] + gain[w, p, 2] * blue + bias[w, p, 2] * share


@inline
@no_type_check
def _are_numbers(figures, b):
    """Whether all numbers of a pattern are finite: distances of others compare with nothing."""
    known = True
    for k in range(figures.shape[1]):
        for number in range(_NUMBERS):
            known &= np.isfinite(figures[b, k, number])
    return known


@Kernel
@no_type_check
def _paint(
    figures, given, features, clean, gain, bias, pixels, counted, first, each, row, size, to_next, to_channel, to_pixel,
    block,
):  # fmt: skip
    """Colours of a block of pixels, clipped to [0, 1]; NaN where a figure is."""
    masked = given.shape[1] > 0
    masks, above = np.empty(figures.shape[1], np.float32), np.empty(figures.shape[1], np.float32)
    for b in range(figures.shape[0]):
        w = b if clean.shape[0] > 1 else 0
        known = _are_numbers(figures, b)
        for p in range(block * BLOCK, min(counted[w], (block + 1) * BLOCK)):
            x, y = features[w, 0, p], features[w, 1, p]
            xx, xy, yy = features[w, 3, p], features[w, 4, p], features[w, 5, p]
            red, green, blue, share = _laid(figures, masked, given, b, p, x, y, xx, xy, yy, masks, above)
            red, green, blue = _composed(clean, gain, bias, w, p, red, green, blue, share)
            at = np.uint32(pixels[w, p])
            picture, pixel = at // np.uint32(size), at % np.uint32(size)
            at = (first + b * each + np.int64(picture)) * to_next + np.int64(pixel) * to_pixel
            row[at] = min(_ONE, max(_ZERO, red)) if known else _NAN
            row[at + to_channel] = min(_ONE, max(_ZERO, green)) if known else _NAN
            row[at + 2 * to_channel] = min(_ONE, max(_ZERO, blue)) if known else _NAN


@Kernel
@no_type_check
def _unpaint(
    figures, given, features, clean, gain, bias, pixels, counted, first, each, row, size, to_next, to_channel, to_pixel,
    shares, block,
):  # fmt: skip
    """A block's share of the gradient of every number of the figures."""
    many, masked = figures.shape[1], given.shape[1] > 0
    masks, above = np.empty(many, np.float32), np.empty(many, np.float32)
    added = np.empty((many, _NUMBERS), np.float64)
    for b in range(figures.shape[0]):
        w = b if clean.shape[0] > 1 else 0
        added[:] = 0.0
        for p in range(block * BLOCK, min(counted[w], (block + 1) * BLOCK)):
            x, y = features[w, 0, p], features[w, 1, p]
            xx, xy, yy = features[w, 3, p], features[w, 4, p], features[w, 5, p]
            red, green, blue, share = _laid(figures, masked, given, b, p, x, y, xx, xy, yy, masks, above)
            if share == _ZERO:
                if masked:
                    given[b, :, p] = _ZERO
                continue
            # What was clipped has no gradient.
            at = np.uint32(pixels[w, p])
            picture, pixel = at // np.uint32(size), at % np.uint32(size)
            at = (first + b * each + np.int64(picture)) * to_next + np.int64(pixel) * to_pixel
            on_red, on_green, on_blue = row[at], row[at + to_channel], row[at + 2 * to_channel]
            red, green, blue = _composed(clean, gain, bias, w, p, red, green, blue, share)
            if red < _ZERO or red > _ONE:
                on_red = _ZERO
            if green < _ZERO or green > _ONE:
                on_green = _ZERO
            if blue < _ZERO or blue > _ONE:
                on_blue = _ZERO
            on_share = on_red * bias[w, p, 0] + on_green * bias[w, p, 1] + on_blue * bias[w, p, 2]
            on_red, on_green, on_blue = on_red * gain[w, p, 0], on_green * gain[w, p, 1], on_blue * gain[w, p, 2]
            below = _ZERO
            for k in range(many):
                mask = masks[k]
                if mask == _ZERO:
                    continue
                paint = on_red * figures[b, k, 9] + on_green * figures[b, k, 10] + on_blue * figures[b, k, 11]
                seen = paint + on_share
                on_mask = above[k] * (seen - below)
                below = seen * mask + (_ONE - mask) * below
                shown = above[k] * mask
                added[k, 9] += shown * on_red
                added[k, 10] += shown * on_green
                added[k, 11] += shown * on_blue
                if masked:
                    given[b, k, p] = on_mask if mask < _ONE else _ZERO
                    continue
                if mask == _ONE or on_mask == _ZERO:
                    continue
                u, v, variance_u, variance_v = _in_figure(figures, b, k, x, y, xx, xy, yy)
                sharp_u, sharp_v = _ONE / np.sqrt(max(variance_u, _LEAST)), _ONE / np.sqrt(max(variance_v, _LEAST))
                low_u, high_u = (figures[b, k, 7] - u) * sharp_u, (figures[b, k, 7] + u) * sharp_u
                low_v, high_v = (figures[b, k, 8] - v) * sharp_v, (figures[b, k, 8] + v) * sharp_v
                on_u, on_v = on_mask * (tent(low_v) + tent(high_v)), on_mask * (tent(low_u) + tent(high_u))
                on_low_u, on_high_u = on_u * slope(low_u), on_u * slope(high_u)
                on_low_v, on_high_v = on_v * slope(low_v), on_v * slope(high_v)
                spread_u, spread_v = _ZERO, _ZERO
                if variance_u >= _LEAST:
                    spread_u = -_HALF * (on_low_u * low_u + on_high_u * high_u) * sharp_u * sharp_u
                if variance_v >= _LEAST:
                    spread_v = -_HALF * (on_low_v * low_v + on_high_v * high_v) * sharp_v * sharp_v
                on_u, on_v = (on_high_u - on_low_u) * sharp_u, (on_high_v - on_low_v) * sharp_v
                added[k, 0] += on_u * x + on_v * y
                added[k, 1] += on_u * y - on_v * x
                added[k, 2] += on_u
                added[k, 3] += on_v
                added[k, 4] += spread_u * xx + spread_v * yy
                added[k, 5] += (spread_u - spread_v) * xy
                added[k, 6] += spread_u * yy + spread_v * xx
                added[k, 7] += (on_low_u + on_high_u) * sharp_u
                added[k, 8] += (on_low_v + on_high_v) * sharp_v
        for k in range(many):
            for number in range(_NUMBERS):
                shares[block, b, k, number] = added[k, number]
