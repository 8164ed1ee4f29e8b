"""Painting rectangles on a CPU: one pass over the canvas' pixels to paint them, one to go back, compiled by Numba.

The same values as `composite.blend` over `coverage`. Operation by operation a pixel is read and written some hundred
times on its way there and back; here it is read once, and a figure that does not reach it costs a look at how far off
it is. Masks are worked out anew on the way back. Pixels are taken in blocks, by as many threads as torch has, and each
block adds up its own share of the gradients: the same numbers are added in the same order whoever takes them.

With S̃(t) = t (1 − |t|/2) on [−1, 1] and its slope S̃′(t) = 1 − |t| (zero where t was clamped), the edges of a figure
along one axis at distances d = w/2 ± u from a pixel, and σ across them,

    C_u = S̃(t₁) + S̃(t₂),   t = d/σ_u,   M = C_u C_v
    ∂M/∂d  = C_v S̃′(t)/σ_u
    ∂M/∂σ² = −C_v ∑ S̃′(t) t / (2 σ_u²)

and for the visibilities V_k = M_k T_k, with D_k = ∂L/∂V_k and what is seen through figure k, S_{k+1} = D_k M_k +
(1 − M_k) S_k, S_0 = 0, each adjoint is ∂L/∂M_k = T_k (D_k − S_k): compositing again, from the bottom up.

A figure comes as twelve numbers (`CanvasPixels.rectangles`), pixels as their `CanvasPixels` have them, with a leading
dimension of 1, or of B where each pattern has pixels of its own.
"""

# ruff: noqa: ANN001, ANN202
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from typing import Any, cast, no_type_check

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from roadproof.compiling import Kernel, inline, run
from roadproof.compositing.view import CanvasPixels
from roadproof.coverage import MIN_VARIANCE
from roadproof.patterns import Pattern

BLOCK = 1 << 14
"""Pixels that are taken at once."""

_ZERO, _HALF, _ONE, _LEAST = np.float32(0), np.float32(0.5), np.float32(1), np.float32(MIN_VARIANCE)
_NUMBERS = 12


def painted(pattern: Pattern, view: CanvasPixels) -> Float[Tensor, "*b p 3"]:
    """Colours of the canvas' pixels with rectangles painted, differentiable once in their boxes and colours.

    Widths and lengths are above 0, and what is known of the pixels is finite.
    """
    batch, count = pattern.boxes.shape[:-2], len(pattern.shapes)
    figures = view.rectangles(pattern.boxes.reshape(-1, count, 5), pattern.colours.reshape(-1, count, 3))
    many = view.clean.shape[-2]
    features = view.footprints.features.reshape(-1, 6, many)
    lights = (each.reshape(-1, many, 3) for each in (view.clean, view.gain, view.bias))
    colours = cast("Tensor", _Painted.apply(figures, features, *lights))
    return colours.view(*batch, *colours.shape[1:])


class _Painted(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, figures: Tensor, *pixels: Tensor) -> Tensor:  # noqa: ANN401
        colours = figures.new_empty(len(figures), pixels[0].shape[-1], 3)
        run(_paint, (figures, *pixels, colours), _blocks(colours.shape[1]))
        # Distances of figures that are not finite compare with nothing.
        nowhere = ~figures.isfinite().flatten(1).all(1)
        if bool(nowhere.any()):
            colours[nowhere] = torch.nan
        ctx.save_for_backward(figures, *pixels)
        return colours

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]  # the decorator has no names for arguments
        ctx: Any,  # noqa: ANN401
        *grad_outputs: Tensor,
    ) -> tuple[Tensor | None, ...]:
        figures, *pixels = ctx.saved_tensors
        many = pixels[0].shape[-1]
        shares = torch.empty(_blocks(many), *figures.shape, dtype=torch.float64)
        run(_unpaint, (figures, *pixels, grad_outputs[0], shares), len(shares))
        return shares.sum(0).to(figures.dtype), None, None, None, None


def _blocks(many: int) -> int:
    return -(-many // BLOCK)


@inline
@no_type_check
def _tent(t):
    t = min(_ONE, max(-_ONE, t))
    return t * (_ONE - _HALF * abs(t))


@inline
@no_type_check
def _slope(t):
    return max(_ONE - abs(t), _ZERO)


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
    """How much of a pixel a figure covers."""
    u, v, variance_u, variance_v = _in_figure(figures, b, k, x, y, xx, xy, yy)
    half_u, half_v = figures[b, k, 7], figures[b, k, 8]
    deep_u, deep_v = half_u - abs(u), half_v - abs(v)
    reach_u, reach_v = np.sqrt(max(variance_u, _LEAST)), np.sqrt(max(variance_v, _LEAST))
    if deep_u <= -reach_u or deep_v <= -reach_v:
        return _ZERO
    if deep_u >= reach_u and deep_v >= reach_v:
        return _ONE
    share_u = _tent((half_u - u) / reach_u) + _tent((half_u + u) / reach_u)
    return share_u * (_tent((half_v - v) / reach_v) + _tent((half_v + v) / reach_v))


@inline
@no_type_check
def _laid(figures, b, x, y, xx, xy, yy, masks, above):
    """Lay the figures over each other from the top: colours and share of the paint that is seen in a pixel.

    What each figure covers of it, and what of that is not under others, is written down for the way back.
    """
    through, red, green, blue = _ONE, _ZERO, _ZERO, _ZERO
    for k in range(len(masks) - 1, -1, -1):
        mask = _mask(figures, b, k, x, y, xx, xy, yy)
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


@Kernel
@no_type_check
def _paint(figures, features, clean, gain, bias, colours, block):
    """Colours of a block of pixels, clipped to [0, 1]."""
    many, count = clean.shape[1], figures.shape[1]
    masks, above = np.empty(count, np.float32), np.empty(count, np.float32)
    for b in range(figures.shape[0]):
        w = b if clean.shape[0] > 1 else 0
        for p in range(block * BLOCK, min(many, (block + 1) * BLOCK)):
            x, y = features[w, 0, p], features[w, 1, p]
            xx, xy, yy = features[w, 3, p], features[w, 4, p], features[w, 5, p]
            red, green, blue, share = _laid(figures, b, x, y, xx, xy, yy, masks, above)
            red, green, blue = _composed(clean, gain, bias, w, p, red, green, blue, share)
            colours[b, p, 0] = min(_ONE, max(_ZERO, red))
            colours[b, p, 1] = min(_ONE, max(_ZERO, green))
            colours[b, p, 2] = min(_ONE, max(_ZERO, blue))


@Kernel
@no_type_check
def _unpaint(figures, features, clean, gain, bias, grad, shares, block):
    """A block's share of the gradient of every number of the figures."""
    many, count = clean.shape[1], figures.shape[1]
    masks, above = np.empty(count, np.float32), np.empty(count, np.float32)
    added = np.empty((count, _NUMBERS), np.float64)
    for b in range(figures.shape[0]):
        w = b if clean.shape[0] > 1 else 0
        added[:] = 0.0
        for p in range(block * BLOCK, min(many, (block + 1) * BLOCK)):
            x, y = features[w, 0, p], features[w, 1, p]
            xx, xy, yy = features[w, 3, p], features[w, 4, p], features[w, 5, p]
            red, green, blue, share = _laid(figures, b, x, y, xx, xy, yy, masks, above)
            if share == _ZERO:
                continue
            # What was clipped has no gradient.
            on_red, on_green, on_blue = grad[b, p, 0], grad[b, p, 1], grad[b, p, 2]
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
            for k in range(count):
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
                if mask == _ONE or on_mask == _ZERO:
                    continue
                u, v, variance_u, variance_v = _in_figure(figures, b, k, x, y, xx, xy, yy)
                sharp_u, sharp_v = _ONE / np.sqrt(max(variance_u, _LEAST)), _ONE / np.sqrt(max(variance_v, _LEAST))
                low_u, high_u = (figures[b, k, 7] - u) * sharp_u, (figures[b, k, 7] + u) * sharp_u
                low_v, high_v = (figures[b, k, 8] - v) * sharp_v, (figures[b, k, 8] + v) * sharp_v
                on_u, on_v = on_mask * (_tent(low_v) + _tent(high_v)), on_mask * (_tent(low_u) + _tent(high_u))
                on_low_u, on_high_u = on_u * _slope(low_u), on_u * _slope(high_u)
                on_low_v, on_high_v = on_v * _slope(low_v), on_v * _slope(high_v)
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
        for k in range(count):
            for number in range(_NUMBERS):
                shares[block, b, k, number] = added[k, number]
