"""Painting rectangles, with the gradient worked out by hand.

The same values as `composite.blend` over `coverage`, computed in pieces that stay in the cache and recomputed in the
backward pass instead of stored. A step of an attack then costs little more than the controller's own forward and
backward pass, without a compiler.

With S̃(t) = t (1 − |t|/2) on [−1, 1] and S̃′(t) = 1 − |t| (zero where t was clamped),

    C_u = S̃(t₁) + S̃(t₂),   t₁ = (w/2 − u)/σ_u,   t₂ = (w/2 + u)/σ_u,   M = C_u C_v

    ∂C_u/∂u  = (S̃′(t₂) − S̃′(t₁))/σ_u
    ∂C_u/∂w  = (S̃′(t₂) + S̃′(t₁))/(2 σ_u)
    ∂C_u/∂σ² = −(S̃′(t₁) t₁ + S̃′(t₂) t₂)/(2 σ_u²)

and for the visibilities V_k = M_k T_k, with D_k = ∂L/∂V_k and what is seen through figure k, S_{k+1} = D_k M_k +
(1 − M_k) S_k, S_0 = 0, each adjoint is ∂L/∂M_k = T_k (D_k − S_k): compositing again, from the bottom up.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.compositing.view import CanvasView
from roadproof.coverage import MIN_VARIANCE, axis_rows

_PIECE = 1 << 18
"""Figure-pixels handled at once on a CPU: few enough for its caches, enough to keep two cores busy (measured)."""


class PaintedRectangles(torch.autograd.Function):
    """Colours of the canvas' pixels, (B, P, 3), from boxes (B, K, 5) and seen colours (B, K, 3)."""

    @staticmethod
    def forward(ctx: Any, boxes: Tensor, seen: Tensor, view: CanvasView) -> Tensor:  # noqa: ANN401
        """Paint, piece by piece."""
        painted = torch.empty(len(boxes), *view.clean.shape, device=boxes.device, dtype=boxes.dtype)
        for piece in _pieces(boxes, view):
            masks = _Masks(boxes, view.footprints.features[:, piece]).masks
            through = _shown_through(masks)
            visibility = masks.mul_(through[:, 1:])
            colour = (visibility.mT @ seen).mul_(view.gain[piece])
            share = 1 - through[:, 0, :, None]
            painted[:, piece] = colour.add_(view.clean[piece]).addcmul_(share, view.bias[piece])
        ctx.save_for_backward(boxes, seen, painted)
        ctx.view = view
        return painted.clamp(0.0, 1.0)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, None]:  # noqa: ANN401
        """Recompute each piece and collect the gradients of boxes and seen colours."""
        boxes, seen, painted = ctx.saved_tensors
        view: CanvasView = ctx.view
        grad_rows = torch.zeros(4, *boxes.shape[:2], 6, device=boxes.device, dtype=boxes.dtype)
        grad_halves = torch.zeros(2, *boxes.shape[:2], device=boxes.device, dtype=boxes.dtype)
        grad_seen = torch.zeros_like(seen)
        seen_and_one = torch.cat([seen, torch.ones_like(seen[..., :1])], -1)
        for piece in _pieces(boxes, view):
            features = view.footprints.features[:, piece]
            parts = _Masks(boxes, features)
            raw = painted[:, piece]
            grad = torch.where((raw >= 0) & (raw <= 1), grad_outputs[0][:, piece], 0.0)
            grad_colour = grad * view.gain[piece]
            grad_share = (grad * view.bias[piece]).sum(-1, keepdim=True)
            grad_visibility = seen_and_one @ torch.cat([grad_colour, grad_share], -1).mT
            through = _shown_through(parts.masks)
            grad_seen += (parts.masks * through[:, 1:]) @ grad_colour
            grad_masks = _masks_adjoint(grad_visibility, parts.masks, through)
            for axis, (own, other) in enumerate(((parts.u, parts.v), (parts.v, parts.u))):
                grad_at, grad_half, grad_variance = own.adjoint(grad_masks * other.share)
                grad_rows[axis] += grad_at @ features.T
                grad_rows[axis + 2] += grad_variance @ features.T
                grad_halves[axis] += grad_half.sum(-1)
        with torch.enable_grad():
            leaf = boxes.detach().requires_grad_()
            rows = axis_rows(leaf).movedim(-2, 0)
            halves = leaf[..., 2:4].movedim(-1, 0) / 2
        grads = cast("tuple[Tensor]", torch.autograd.grad((rows, halves), leaf, (grad_rows, grad_halves)))
        return grads[0], grad_seen, None


def _pieces(boxes: Tensor, view: CanvasView) -> Iterator[slice]:
    """Runs of pixels small enough for the cache; on a GPU all at once, up to its memory's comfort."""
    figures = boxes.shape[0] * boxes.shape[1]
    size = max((_PIECE if boxes.device.type == "cpu" else _PIECE << 8) // figures, 1024)
    for start in range(0, len(view.clean), size):
        yield slice(start, start + size)


class _Axis:
    """One side of the boxes: where each footprint is between its two edges."""

    def __init__(self, at: Tensor, variance: Tensor, half: Tensor) -> None:
        self.sharpness = variance.clamp_min_(MIN_VARIANCE).rsqrt_()
        scaled_at, scaled_half = at * self.sharpness, half * self.sharpness
        self.from_high = (scaled_half - scaled_at).clamp_(-1.0, 1.0)
        self.from_low = scaled_half.add_(scaled_at).clamp_(-1.0, 1.0)
        self.share = _tent(self.from_high).add_(_tent(self.from_low))

    def adjoint(self, grad: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """From ∂L/∂share to ∂L/∂at, ∂L/∂half and ∂L/∂variance."""
        high, low = 1 - self.from_high.abs(), 1 - self.from_low.abs()
        scaled = grad * self.sharpness
        stretch = (high * self.from_high).addcmul_(low, self.from_low).mul_(scaled).mul_(self.sharpness)
        return (low - high).mul_(scaled), high.add_(low).mul_(scaled), stretch.mul_(-0.5)


def _tent(t: Tensor) -> Tensor:
    return torch.addcmul(t, t, t.abs(), value=-0.5)


class _Masks:
    """Coverage of each rectangle, (B, K, n), and the two factors it is made of."""

    def __init__(self, boxes: Tensor, features: Float[Tensor, "6 n"]) -> None:
        rows = axis_rows(boxes).movedim(-2, 0)
        at_u, at_v, variance_u, variance_v = (rows.reshape(-1, 6) @ features).view(*rows.shape[:-1], -1)
        self.u = _Axis(at_u, variance_u, boxes[..., 2:3] / 2)
        self.v = _Axis(at_v, variance_v, boxes[..., 3:4] / 2)
        self.masks = self.u.share * self.v.share


def _shown_through(masks: Tensor) -> Tensor:
    """T_{−1}, T_0 … T_{K−1}: the bare road, then what each figure shows through, (B, K + 1, n)."""
    batch, figures, pixels = masks.shape
    through = masks.new_empty(batch, figures + 1, pixels)
    through[:, figures] = 1.0
    for k in range(figures - 1, -1, -1):
        torch.addcmul(through[:, k + 1], through[:, k + 1], masks[:, k], value=-1.0, out=through[:, k])
    return through


def _masks_adjoint(grad_visibility: Tensor, masks: Tensor, through: Tensor) -> Tensor:
    grad_masks = torch.empty_like(masks)
    beneath = torch.zeros_like(masks[:, 0])
    for k in range(masks.shape[1]):
        gain = grad_visibility[:, k] - beneath
        torch.mul(gain, through[:, k + 1], out=grad_masks[:, k])
        beneath.addcmul_(gain, masks[:, k])
    return grad_masks
