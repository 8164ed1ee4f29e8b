"""Painting rectangles on a GPU: one pass over the canvas' pixels to paint them, one to go back.

The same values as `composite.blend` over `coverage`, from the equations of `compiled`. Operation by operation a pixel
is read and written some hundred times on its way there and back, which takes a GPU longer than a small controller does.
Here it is read once: masks are worked out anew where they are needed, and each block of pixels adds up its own share of
the gradients, so that the same numbers are added in the same order every time.

A figure comes as twelve numbers (b for its pattern, k for its place in it), a pixel as fourteen:

    figures (b, k, 12)   as `CanvasPixels.figures` gives them
    pixels (v, 14, p)    x, y, and xx, 2·xy, yy of its footprint; clean colour, gain and bias, three each; v is 1, or b
                         where each pattern has pixels of its own
"""

# Triton ships no type information, and reads the source of its kernels itself.
# ruff: noqa: ANN001, ANN202
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportInvalidTypeForm=false

from __future__ import annotations

import importlib
from typing import Any, cast, no_type_check

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.compositing.view import CanvasPixels
from roadproof.coverage import MIN_VARIANCE
from roadproof.patterns import Pattern

triton: Any = importlib.import_module("triton")
tl: Any = importlib.import_module("triton.language")

BLOCK = 256
"""Pixels that one program paints."""

OPTIONS = {"enable_fp_fusion": True}
"""How kernels are compiled; some of Triton warn where it is left to them."""

_LEAST = tl.constexpr(MIN_VARIANCE)
# Numbers of a figure; then where its size and its colour begin.
_FIGURE, _HALF, _COLOUR = tl.constexpr(12), tl.constexpr(7), tl.constexpr(9)
# Numbers of a pixel; then where its clean colour, its gain and its bias begin.
_PIXEL = 14
_CLEAN, _GAIN, _BIAS = tl.constexpr(5), tl.constexpr(8), tl.constexpr(11)


def try_out(device: torch.device) -> None:
    """Paint a pixel and go back, for which Triton needs all that it ever needs.

    Raises:
        Exception: whatever keeps Triton from it, such as a missing C compiler or an old GPU.
    """
    # Whoever asks first may do so without gradients.
    with torch.inference_mode(mode=False), torch.enable_grad():
        figures = torch.ones(1, 1, _FIGURE.value, device=device, requires_grad=True)
        cast("Tensor", _Painted.apply(figures, torch.ones(1, _PIXEL, 1, device=device))).sum().backward()


def painted(pattern: Pattern, view: CanvasPixels) -> Float[Tensor, "*b p 3"]:
    """Colours of the canvas' pixels with rectangles painted, differentiable in their boxes and colours."""
    batch, figures = pattern.boxes.shape[:-2], view.figures(pattern)
    pixels = _numbered(view)
    assert len(pixels) in (1, len(figures)), "pixels of one view, or of one for each pattern"
    colours = cast("Tensor", _Painted.apply(figures, pixels))
    return colours.view(*batch, *colours.shape[1:])


def _numbered(view: CanvasPixels) -> Float[Tensor, "v 14 p"]:
    """The fourteen numbers of each pixel."""
    many = view.clean.shape[-2]
    features = view.footprints.features.reshape(-1, 6, many)
    lights = (each.mT.reshape(-1, 3, many) for each in (view.clean, view.gain, view.bias))
    return torch.cat([features[:, :2], features[:, 3:], *lights], 1)


class _Painted(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, figures: Tensor, pixels: Tensor) -> Tensor:  # noqa: ANN401
        colours = figures.new_empty(len(figures), pixels.shape[-1], 3)
        # Triton launches where torch is, not where the numbers are.
        with torch.cuda.device_of(figures):
            _paint[_grid(figures, pixels)](figures, pixels, colours, *_sizes(figures, pixels), **OPTIONS)
        ctx.save_for_backward(figures, pixels)
        return colours

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:  # noqa: ANN401
        figures, pixels = ctx.saved_tensors
        blocks, batch = _grid(figures, pixels)
        through = figures.new_empty(*figures.shape[:2], pixels.shape[-1])
        shares = figures.new_empty(batch, blocks, *figures.shape[1:])
        grad = grad_outputs[0].contiguous()
        with torch.cuda.device_of(figures):
            _unpaint[blocks, batch](figures, pixels, grad, through, shares, *_sizes(figures, pixels), **OPTIONS)
        return shares.sum(1), None


def _grid(figures: Tensor, pixels: Tensor) -> tuple[int, int]:
    return -(-pixels.shape[-1] // BLOCK), len(figures)


def _sizes(figures: Tensor, pixels: Tensor) -> tuple[int, int, int, int]:
    """Pixels, numbers from one pattern's pixels to the next one's, figures of a pattern, pixels of a program."""
    many = pixels.shape[-1]
    return many, _PIXEL * many if len(pixels) > 1 else 0, figures.shape[1], BLOCK


@triton.jit
@no_type_check
def _clipped(values, least):
    """Values between the least and 1; NaN stays."""
    values = tl.maximum(values, least, propagate_nan=tl.PropagateNan.ALL)
    return tl.minimum(values, 1.0, propagate_nan=tl.PropagateNan.ALL)


@triton.jit
@no_type_check
def _tent(t):
    t = _clipped(t, -1.0)
    return t * (1.0 - 0.5 * tl.abs(t))


@triton.jit
@no_type_check
def _slope(t):
    return tl.maximum(1.0 - tl.abs(t), 0.0)


@triton.jit
@no_type_check
def _numbers3(place, step, inside):
    """Three numbers of each pixel, rows of pixels or neighbours."""
    red, green = tl.load(place, mask=inside, other=0.0), tl.load(place + step, mask=inside, other=0.0)
    return red, green, tl.load(place + 2 * step, mask=inside, other=0.0)


@triton.jit
@no_type_check
def _footprint(here, many, inside):
    """x, y, and xx, 2·xy, yy of each pixel."""
    xx, xy2, yy = _numbers3(here + 2 * many, many, inside)
    return tl.load(here, mask=inside, other=0.0), tl.load(here + many, mask=inside, other=0.0), xx, xy2, yy


@triton.jit
@no_type_check
def _axis(edge, half, variance):
    """Along one axis: distances to both edges, 1/σ, and the share between the edges."""
    sharp = 1.0 / tl.sqrt(tl.maximum(variance, _LEAST))
    low, high = half - edge, half + edge
    return low, high, sharp, _tent(low * sharp) + _tent(high * sharp)


@triton.jit
@no_type_check
def _in_figure(figure, x, y, xx, xy2, yy):
    """Pixels in a figure's axes: u, v, and σ² along them."""
    c, s, cc, cs, ss = (
        tl.load(figure),
        tl.load(figure + 1),
        tl.load(figure + 4),
        tl.load(figure + 5),
        tl.load(figure + 6),
    )
    u, v = c * x + s * y + tl.load(figure + 2), c * y - s * x + tl.load(figure + 3)
    return u, v, cc * xx + cs * xy2 + ss * yy, ss * xx - cs * xy2 + cc * yy


@triton.jit
@no_type_check
def _painted_above(
    figures, footprint, through_at, pixels, inside, keep: tl.constexpr, count: tl.constexpr, block: tl.constexpr
):
    """Lay the figures over each other from the top: colours and share of the paint that is seen.

    With `keep`, what of each figure is not under others is written down for the way back.
    """
    x, y, xx, xy2, yy = _footprint(footprint, pixels, inside)
    through = tl.full((block,), 1.0, tl.float32)
    red, green, blue = through * 0.0, through * 0.0, through * 0.0
    for j in range(count):
        k = count - 1 - j
        figure = figures + k * _FIGURE
        u, v, variance_u, variance_v = _in_figure(figure, x, y, xx, xy2, yy)
        _, _, _, share_u = _axis(u, tl.load(figure + _HALF), variance_u)
        _, _, _, share_v = _axis(v, tl.load(figure + _HALF + 1), variance_v)
        mask = share_u * share_v
        if keep:
            tl.store(through_at + k * pixels, through, mask=inside)
        shown = mask * through
        red += shown * tl.load(figure + _COLOUR)
        green += shown * tl.load(figure + _COLOUR + 1)
        blue += shown * tl.load(figure + _COLOUR + 2)
        through *= 1.0 - mask
    return red, green, blue, 1.0 - through


@triton.jit
@no_type_check
def _composed(here, red, green, blue, share, many, inside):
    """Eq. composite, not clipped yet, from colours and share of the paint that is seen."""
    clean_r, clean_g, clean_b = _numbers3(here + _CLEAN * many, many, inside)
    gain_r, gain_g, gain_b = _numbers3(here + _GAIN * many, many, inside)
    bias_r, bias_g, bias_b = _numbers3(here + _BIAS * many, many, inside)
    red, green = clean_r + gain_r * red + bias_r * share, clean_g + gain_g * green + bias_g * share
    return red, green, clean_b + gain_b * blue + bias_b * share


@triton.jit
@no_type_check
def _paint(figures, pixels, colours, many, apart, count: tl.constexpr, block: tl.constexpr):
    """Colours of the pixels, clipped to [0, 1]."""
    b = tl.program_id(1).to(tl.int64)
    p = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    inside = p < many
    here = pixels + b * apart + p
    red, green, blue, share = _painted_above(
        figures + b * count * _FIGURE, here, here, many, inside, False, count, block
    )
    red, green, blue = _composed(here, red, green, blue, share, many, inside)
    there = colours + (b * many + p) * 3
    tl.store(there, _clipped(red, 0.0), mask=inside)
    tl.store(there + 1, _clipped(green, 0.0), mask=inside)
    tl.store(there + 2, _clipped(blue, 0.0), mask=inside)


@triton.jit
@no_type_check
def _unpaint(figures, pixels, grad, through, shares, many, apart, count: tl.constexpr, block: tl.constexpr):
    """Each block's share of the gradient of every number of the figures."""
    b, blocks = tl.program_id(1).to(tl.int64), tl.num_programs(0)
    p = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    inside = p < many
    here, figures = pixels + b * apart + p, figures + b * count * _FIGURE
    through += b * count * many + p
    red, green, blue, share = _painted_above(figures, here, through, many, inside, True, count, block)
    red, green, blue = _composed(here, red, green, blue, share, many, inside)
    gain_r, gain_g, gain_b = _numbers3(here + _GAIN * many, many, inside)
    bias_r, bias_g, bias_b = _numbers3(here + _BIAS * many, many, inside)
    grad_r, grad_g, grad_b = _numbers3(grad + (b * many + p) * 3, 1, inside)
    # What was clipped has no gradient.
    grad_r = tl.where((red >= 0.0) & (red <= 1.0), grad_r, 0.0)
    grad_g = tl.where((green >= 0.0) & (green <= 1.0), grad_g, 0.0)
    grad_b = tl.where((blue >= 0.0) & (blue <= 1.0), grad_b, 0.0)
    on_share = grad_r * bias_r + grad_g * bias_g + grad_b * bias_b
    grad_r, grad_g, grad_b = grad_r * gain_r, grad_g * gain_g, grad_b * gain_b
    x, y, xx, xy2, yy = _footprint(here, many, inside)
    below = on_share * 0.0
    for k in range(count):
        figure = figures + k * _FIGURE
        u, v, variance_u, variance_v = _in_figure(figure, x, y, xx, xy2, yy)
        low_u, high_u, sharp_u, share_u = _axis(u, tl.load(figure + _HALF), variance_u)
        low_v, high_v, sharp_v, share_v = _axis(v, tl.load(figure + _HALF + 1), variance_v)
        mask, above = share_u * share_v, tl.load(through + k * many, mask=inside, other=0.0)
        paint = (
            grad_r * tl.load(figure + _COLOUR)
            + grad_g * tl.load(figure + _COLOUR + 1)
            + grad_b * tl.load(figure + _COLOUR + 2)
        )
        seen = paint + on_share
        on_mask = above * (seen - below)
        below = seen * mask + (1.0 - mask) * below
        on_u, on_half_u, on_variance_u = _back(on_mask * share_v, low_u, high_u, sharp_u, variance_u)
        on_v, on_half_v, on_variance_v = _back(on_mask * share_u, low_v, high_v, sharp_v, variance_v)
        at = shares + ((b * blocks + tl.program_id(0)) * count + k) * _FIGURE
        tl.store(at, tl.sum(on_u * x + on_v * y, 0))
        tl.store(at + 1, tl.sum(on_u * y - on_v * x, 0))
        tl.store(at + 2, tl.sum(on_u, 0))
        tl.store(at + 3, tl.sum(on_v, 0))
        tl.store(at + 4, tl.sum(on_variance_u * xx + on_variance_v * yy, 0))
        tl.store(at + 5, tl.sum((on_variance_u - on_variance_v) * xy2, 0))
        tl.store(at + 6, tl.sum(on_variance_u * yy + on_variance_v * xx, 0))
        tl.store(at + 7, tl.sum(on_half_u, 0))
        tl.store(at + 8, tl.sum(on_half_v, 0))
        shown = above * mask
        tl.store(at + 9, tl.sum(shown * grad_r, 0))
        tl.store(at + 10, tl.sum(shown * grad_g, 0))
        tl.store(at + 11, tl.sum(shown * grad_b, 0))


@triton.jit
@no_type_check
def _back(on_share, low, high, sharp, variance):
    """From the gradient of a share along one axis: those of u, of half the size, and of σ²."""
    on_low, on_high = on_share * _slope(low * sharp), on_share * _slope(high * sharp)
    on_sharp = on_low * low + on_high * high
    on_variance = tl.where(variance >= _LEAST, -0.5 * on_sharp * sharp * sharp * sharp, 0.0)
    return (on_high - on_low) * sharp, (on_low + on_high) * sharp, on_variance
