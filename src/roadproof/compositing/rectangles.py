"""Painting rectangles, with the gradient worked out by hand.

The same values as `composite.blend` over `coverage`, but masks and their gradients are computed only where a figure is:
the canvas' pixels are kept in short runs with a bounding box each, and a run whose box a figure does not touch costs
nothing but that test. A step of an attack then costs little more than the controller's own forward and backward pass.

With S̃(t) = t (1 − |t|/2) on [−1, 1] and its slope S̃′(t) = 1 − |t| (zero where t was clamped), the four edges of a
figure, at distances d = ±u + w/2, ±v + l/2 from a pixel, and σ across them,

    C_u = S̃(t₁) + S̃(t₂),   t = d/σ_u,   M = C_u C_v
    ∂M/∂d  = C_v S̃′(t)/σ_u
    ∂M/∂σ² = −C_v ∑ S̃′(t) t / (2 σ_u²)

and for the visibilities V_k = M_k T_k, with D_k = ∂L/∂V_k and what is seen through figure k, S_{k+1} = D_k M_k +
(1 − M_k) S_k, S_0 = 0, each adjoint is ∂L/∂M_k = T_k (D_k − S_k): compositing again, from the bottom up.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.compositing.runs import RUN, Runs
from roadproof.coverage import MIN_VARIANCE, axis_rows

_PIECE = 1 << 18
"""Figure-pixels handled at once on a CPU: few enough for its caches, enough to keep two cores busy (measured)."""


class PaintedRectangles(torch.autograd.Function):
    """Colours of the canvas' pixels, (B, p, 3), from boxes (B, K, 5) and seen colours (B, K, 3).

    The p pixels are those of the runs, whose last is filled up.
    """

    @staticmethod
    def forward(ctx: Any, boxes: Tensor, seen: Tensor, whole: Runs) -> Tensor:  # noqa: ANN401
        """Colours of the canvas' pixels, painted piece by piece."""
        rows = _edge_rows(boxes)
        painted = torch.empty(len(boxes), len(whole) * RUN, 3, device=boxes.device, dtype=boxes.dtype)
        within = torch.empty(len(boxes), 3, len(whole) * RUN, device=boxes.device, dtype=torch.bool)
        ctx.edges = []
        for pixels, runs in _pieces(boxes, whole):
            edges = _Edges(rows, runs)
            masks = edges.masks()
            through = _shown_through(masks)
            colour = seen.mT @ masks.mul_(through[:, 1:])
            raw = torch.addcmul(runs.clean, colour, runs.gain).addcmul_(1 - through[:, :1], runs.bias)
            clamped = raw.clamp(0.0, 1.0)
            torch.eq(raw, clamped, out=within[..., pixels])
            painted[:, pixels] = clamped.mT
            ctx.edges.append(edges)
        ctx.save_for_backward(boxes, seen, within)
        ctx.runs = whole
        return painted

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, Tensor, None]:  # noqa: ANN401
        """Lay the figures over each other again and collect the gradients of boxes and seen colours."""
        boxes, seen, within = ctx.saved_tensors
        grad_painted = grad_outputs[0].mT.contiguous()
        grad_rows = torch.zeros(*boxes.shape[:2], 6, 6, device=boxes.device, dtype=boxes.dtype)
        grad_seen = torch.zeros_like(seen)
        for (pixels, runs), edges in zip(_pieces(boxes, ctx.runs), ctx.edges, strict=True):
            masks = edges.masks()
            through = _shown_through(masks)
            grad = torch.where(within[..., pixels], grad_painted[..., pixels], 0.0)
            grad_colour = grad * runs.gain
            grad_seen += (masks * through[:, 1:]) @ grad_colour.mT
            grad_visibility = (seen @ grad_colour).add_(grad.mul_(runs.bias).sum(1, keepdim=True))
            grad_rows += edges.adjoint(_masks_adjoint(grad_visibility, masks, through))
        with torch.enable_grad():
            leaf = boxes.detach().requires_grad_()
            rows = _edge_rows(leaf)
        (grad_boxes,) = cast("tuple[Tensor]", torch.autograd.grad(rows, leaf, grad_rows))
        return grad_boxes, grad_seen, None


def _pieces(boxes: Tensor, runs: Runs) -> Iterator[tuple[slice, Runs]]:
    """Runs few enough for the cache; on a GPU all at once, up to its memory's comfort."""
    figures = boxes.shape[0] * boxes.shape[1]
    size = max((_PIECE if boxes.device.type == "cpu" else _PIECE << 8) // figures // RUN, 128)
    for start in range(0, len(runs), size):
        yield slice(start * RUN, (start + size) * RUN), runs.part(slice(start, start + size))


def _edge_rows(boxes: Float[Tensor, "b k 5"]) -> Float[Tensor, "b k 6 6"]:
    """The rows that give w/2 − u, l/2 − v, w/2 + u, l/2 + v, σ²(e_u), σ²(e_v) from the features of a footprint."""
    rows = axis_rows(boxes)
    axes, variances = rows[..., :2, :], rows[..., 2:, :]
    half = torch.nn.functional.pad(boxes[..., 2:4, None] / 2, (2, 3))
    return torch.cat([half - axes, half + axes, variances], -2)


class _Edges:
    """Where figures begin and end: the runs of pixels that a figure's edge may cross, and how far it is from each.

    Convention:
        E pixels, figure after figure. Distances come as (2, 2, E): first or second edge, across or along the figure.
    """

    def __init__(self, rows: Float[Tensor, "b k 6 6"], runs: Runs) -> None:
        self.shape = rows.shape
        self.inside, crossed = runs.relation(rows)
        pattern, figure, run = crossed.nonzero(as_tuple=True)
        self.place = (pattern * rows.shape[1] + figure) * len(runs) + run
        self.counts = cast("list[int]", (crossed.sum(-1) * RUN).flatten().tolist())
        self.features = runs.picked(pattern, run)
        parts = zip(rows.flatten(0, 1), _split(self.features, self.counts), strict=True)
        values = torch.cat([row @ part for row, part in parts], 1)
        self.sharpness = values[4:].clamp_min_(MIN_VARIANCE).rsqrt_()
        self.t = values[:4].view(2, 2, -1).mul_(self.sharpness).clamp_(-1.0, 1.0)
        share = torch.addcmul(self.t, self.t, self.t.abs(), value=-0.5)
        self.share = share[0].add_(share[1])

    def masks(self) -> Float[Tensor, "b k p"]:
        """Coverage of each pixel by each figure."""
        masks = self.inside.to(self.t.dtype).flatten()[:, None].expand(-1, RUN).contiguous()
        masks.index_copy_(0, self.place, (self.share[0] * self.share[1]).view(-1, RUN))
        return masks.view(*self.shape[:2], -1)

    def adjoint(self, grad_masks: Float[Tensor, "b k p"]) -> Float[Tensor, "b k 6 6"]:
        """From ∂L/∂M to the gradient of `_edge_rows`."""
        grad = grad_masks.view(-1, RUN).index_select(0, self.place).flatten()
        scaled = self.share.flip(0).mul_(self.sharpness).mul_(grad)
        values = self.t.new_empty(6, len(grad))
        distance, variance = values[:4].view(2, 2, -1), values[4:]
        torch.mul(1 - self.t.abs(), scaled, out=distance)
        torch.mul(distance[0], self.t[0], out=variance).addcmul_(distance[1], self.t[1])
        variance.mul_(self.sharpness).mul_(-0.5)
        parts = zip(_split(values, self.counts), _split(self.features, self.counts), strict=True)
        return torch.stack([part @ features.T for part, features in parts]).view(self.shape)


def _split(values: Tensor, counts: list[int]) -> tuple[Tensor, ...]:
    return cast("tuple[Tensor, ...]", values.split(counts, 1))


def _shown_through(masks: Tensor) -> Tensor:
    """T_{−1}, T_0 … T_{K−1}: the bare road, then what each figure shows through, (B, K + 1, p)."""
    batch, figures, pixels = masks.shape
    through = masks.new_empty(batch, figures + 1, pixels)
    through[:, figures] = 1.0
    for k in range(figures - 1, -1, -1):
        torch.addcmul(through[:, k + 1], through[:, k + 1], masks[:, k], value=-1.0, out=through[:, k])
    return through


def _masks_adjoint(grad_visibility: Tensor, masks: Tensor, through: Tensor) -> Tensor:
    """From ∂L/∂V to ∂L/∂M, in place."""
    beneath = torch.zeros_like(masks[:, 0])
    for k in range(masks.shape[1]):
        gain = grad_visibility[:, k].sub_(beneath)
        beneath.addcmul_(gain, masks[:, k])
    return grad_visibility.mul_(through[:, 1:])
