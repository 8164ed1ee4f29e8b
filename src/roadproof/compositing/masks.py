"""How much of each pixel ellipses and polygons cover, and the way back, on a CPU: what `coverage` gives.

`compositing.compiled` lays them over each other; the masks of rectangles it works out itself. With S̃ and its slope as
in `compositing.tents`:

An *ellipse* has the radius ρ = √((u/h_u)² + (v/h_v)²), with h half its width and length, and across its edge the
footprint's σ along n = ∇ρ,

    M = S̃((1 − ρ)/σ_n) + S̃((1 + ρ)/σ_n),   σ_n² = n·Σn

A *polygon* covers of a footprint, in whose units that is the square [−½, ½]², the area below its edges, −∮ y dx with y
clamped to the square. When its corners move, an edge from a to b sweeps what of it lies in the square, t₀ ≤ t ≤ t₁:

    ∂M/∂a = (b_y − a_y, a_x − b_x) ∫ (1 − t) dt,   ∂M/∂b = (b_y − a_y, a_x − b_x) ∫ t dt

Figures and pixels come as in `compositing.compiled`; masks are (B, K, P), and hold their own gradient on the way back.
"""

# ruff: noqa: ANN001, ANN202
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from typing import no_type_check

import numpy as np

from roadproof.compiling import Kernel, inline
from roadproof.compositing.tents import interval_share, slope
from roadproof.coverage import MIN_VARIANCE, Shape

BLOCK = 1 << 14
"""Pixels that are taken at once."""

_CORNERS = 4

_ZERO, _HALF, _ONE, _LEAST = np.float32(0), np.float32(0.5), np.float32(1), np.float32(MIN_VARIANCE)
_TINY, _UPRIGHT, _LEVEL = np.float32(1e-12), np.float32(1e-6), np.float32(1e-4)


@inline
@no_type_check
def _radius(figures, b, k, x, y):
    """A pixel in an ellipse's half axes, the radius there, and the radius' slope along the axes."""
    c, s, half_u, half_v = figures[b, k, 0], figures[b, k, 1], figures[b, k, 7], figures[b, k, 8]
    u, v = (c * x + s * y + figures[b, k, 2]) / half_u, (c * y - s * x + figures[b, k, 3]) / half_v
    radius = np.sqrt(u * u + v * v + _TINY)
    return u, v, radius, u / radius / half_u, v / radius / half_v


@inline
@no_type_check
def _across(figures, b, k, slope_u, slope_v, xx, xy, yy):
    """The radius' slope on the canvas, and the footprint's variance along it."""
    c, s = figures[b, k, 0], figures[b, k, 1]
    nx, ny = c * slope_u - s * slope_v, s * slope_u + c * slope_v
    return nx, ny, nx * nx * xx + nx * ny * xy + ny * ny * yy


@Kernel
@no_type_check
def _cover_by_ellipses(figures, features, jacobian, counted, side, masks, block):  # noqa: ARG001  # as of polygons
    for b in range(figures.shape[0]):
        w = b if features.shape[0] > 1 else 0
        for k in range(figures.shape[1]):
            for p in range(block * BLOCK, min(counted[w], (block + 1) * BLOCK)):
                x, y = features[w, 0, p], features[w, 1, p]
                xx, xy, yy = features[w, 3, p], features[w, 4, p], features[w, 5, p]
                _, _, radius, slope_u, slope_v = _radius(figures, b, k, x, y)
                _, _, variance = _across(figures, b, k, slope_u, slope_v, xx, xy, yy)
                masks[b, k, p] = interval_share(radius, _ONE, np.sqrt(max(variance, _LEAST)))


@Kernel
@no_type_check
def _uncover_ellipses(figures, features, jacobian, counted, side, masks, shares, block):  # noqa: ARG001
    """Add a block's share of the gradient of every number of the ellipses."""
    for b in range(figures.shape[0]):
        w = b if features.shape[0] > 1 else 0
        for k in range(figures.shape[1]):
            c, s, half_u, half_v = figures[b, k, 0], figures[b, k, 1], figures[b, k, 7], figures[b, k, 8]
            on_c, on_s, on_off_u, on_off_v, on_half_u, on_half_v = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for p in range(block * BLOCK, min(counted[w], (block + 1) * BLOCK)):
                on_mask = masks[b, k, p]
                if on_mask == _ZERO:
                    continue
                x, y = features[w, 0, p], features[w, 1, p]
                xx, xy, yy = features[w, 3, p], features[w, 4, p], features[w, 5, p]
                u, v, radius, slope_u, slope_v = _radius(figures, b, k, x, y)
                nx, ny, variance = _across(figures, b, k, slope_u, slope_v, xx, xy, yy)
                sharp = _ONE / np.sqrt(max(variance, _LEAST))
                low, high = (_ONE - radius) * sharp, (_ONE + radius) * sharp
                on_low, on_high = on_mask * slope(low), on_mask * slope(high)
                spread = _ZERO
                if variance >= _LEAST:
                    spread = -_HALF * (on_low * low + on_high * high) * sharp * sharp
                on_nx, on_ny = spread * (nx * xx + nx * xx + ny * xy), spread * (nx * xy + ny * yy + ny * yy)
                on_slope_u, on_slope_v = c * on_nx + s * on_ny, c * on_ny - s * on_nx
                on_radius = (on_high - on_low) * sharp - (on_slope_u * slope_u + on_slope_v * slope_v) / radius
                on_u = (on_slope_u / half_u + on_radius * u) / radius
                on_v = (on_slope_v / half_v + on_radius * v) / radius
                on_half_u -= (on_slope_u * slope_u + on_u * u) / half_u
                on_half_v -= (on_slope_v * slope_v + on_v * v) / half_v
                on_u, on_v = on_u / half_u, on_v / half_v
                on_c += on_nx * slope_u + on_ny * slope_v + on_u * x + on_v * y
                on_s += on_ny * slope_u - on_nx * slope_v + on_u * y - on_v * x
                on_off_u += on_u
                on_off_v += on_v
            shares[block, b, k, 0] += on_c
            shares[block, b, k, 1] += on_s
            shares[block, b, k, 2] += on_off_u
            shares[block, b, k, 3] += on_off_v
            shares[block, b, k, 7] += on_half_u
            shares[block, b, k, 8] += on_half_v


@inline
@no_type_check
def _to_footprint(jacobian, w, p, side):
    """The matrix from the canvas into the units of a pixel's footprint, row by row."""
    a, b, c, d = jacobian[w, p, 0], jacobian[w, p, 1], jacobian[w, p, 2], jacobian[w, p, 3]
    by = _ONE / ((a * d - b * c) * side)
    return d * by, -b * by, -c * by, a * by


@inline
@no_type_check
def _in_square(t):
    return min(_HALF, max(-_HALF, t))


@inline
@no_type_check
def _clamped_integral(y):
    """Integral of y, clamped to the square, from 0."""
    inside = _in_square(y)
    return _HALF * inside * inside + _HALF * abs(y - inside)


@inline
@no_type_check
def _below(x0, y0, x1, y1):
    """The area between an edge, clamped to the square, and the middle of the square."""
    run, begin, end = x1 - x0, _in_square(x0), _in_square(x1)
    if begin == end or abs(run) < _UPRIGHT:
        return _ZERO
    steep = (y1 - y0) / run
    low, high = y0 + steep * (begin - x0), y0 + steep * (end - x0)
    if abs(high - low) < _LEVEL:
        return (end - begin) * _in_square(_HALF * (low + high))
    return (end - begin) * (_clamped_integral(high) - _clamped_integral(low)) / (high - low)


@Kernel
@no_type_check
def _cover_by_polygons(figures, features, jacobian, counted, side, masks, block):
    for b in range(figures.shape[0]):
        w = b if features.shape[0] > 1 else 0
        for k in range(figures.shape[1]):
            left, top = figures[b, k, 0], figures[b, k, 1]
            right, bottom = left, top
            for corner in range(1, _CORNERS):
                x, y = figures[b, k, 2 * corner], figures[b, k, 2 * corner + 1]
                left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
            for p in range(block * BLOCK, min(counted[w], (block + 1) * BLOCK)):
                x, y = features[w, 0, p], features[w, 1, p]
                # So far the parallelogram reaches at most.
                wide, high = np.sqrt(features[w, 3, p]), np.sqrt(features[w, 5, p])
                masks[b, k, p] = _ZERO
                if x + wide <= left or x - wide >= right or y + high <= top or y - high >= bottom:
                    continue
                ux, uy, vx, vy = _to_footprint(jacobian, w, p, side)
                area = _ZERO
                dx, dy = figures[b, k, 2 * _CORNERS - 2] - x, figures[b, k, 2 * _CORNERS - 1] - y
                x0, y0 = ux * dx + uy * dy, vx * dx + vy * dy
                for corner in range(_CORNERS):
                    dx, dy = figures[b, k, 2 * corner] - x, figures[b, k, 2 * corner + 1] - y
                    x1, y1 = ux * dx + uy * dy, vx * dx + vy * dy
                    area -= _below(x0, y0, x1, y1)
                    x0, y0 = x1, y1
                masks[b, k, p] = min(_ONE, max(_ZERO, area))


@inline
@no_type_check
def _within(at, by, first, last):
    """What of an edge's stretch from `first` to `last` lies in the square along one axis."""
    if by == _ZERO:
        return first, last if abs(at) < _HALF else first
    one, other = (-_HALF - at) / by, (_HALF - at) / by
    first = max(first, min(one, other))
    return first, max(first, min(last, max(one, other)))


@Kernel
@no_type_check
def _uncover_polygons(figures, features, jacobian, counted, side, masks, shares, block):
    """Add a block's share of the gradient of every corner of the polygons."""
    added = np.empty(2 * _CORNERS, np.float64)
    for b in range(figures.shape[0]):
        w = b if features.shape[0] > 1 else 0
        for k in range(figures.shape[1]):
            added[:] = 0.0
            for p in range(block * BLOCK, min(counted[w], (block + 1) * BLOCK)):
                on_mask = masks[b, k, p]
                if on_mask == _ZERO:
                    continue
                x, y = features[w, 0, p], features[w, 1, p]
                ux, uy, vx, vy = _to_footprint(jacobian, w, p, side)
                before = _CORNERS - 1
                dx, dy = figures[b, k, 2 * before] - x, figures[b, k, 2 * before + 1] - y
                x0, y0 = ux * dx + uy * dy, vx * dx + vy * dy
                for corner in range(_CORNERS):
                    dx, dy = figures[b, k, 2 * corner] - x, figures[b, k, 2 * corner + 1] - y
                    x1, y1 = ux * dx + uy * dy, vx * dx + vy * dy
                    run, rise = x1 - x0, y1 - y0
                    first, last = _within(x0, run, _ZERO, _ONE)
                    first, last = _within(y0, rise, first, last)
                    if last > first:
                        with_end = _HALF * (last * last - first * first)
                        with_begin = last - first - with_end
                        # Outwards: across the edge in the footprint's units, and then on the canvas.
                        out_x, out_y = on_mask * (ux * rise - vx * run), on_mask * (uy * rise - vy * run)
                        added[2 * before] += with_begin * out_x
                        added[2 * before + 1] += with_begin * out_y
                        added[2 * corner] += with_end * out_x
                        added[2 * corner + 1] += with_end * out_y
                    x0, y0, before = x1, y1, corner
            for number in range(2 * _CORNERS):
                shares[block, b, k, number] += added[number]


COVERS = {
    Shape.ELLIPSE: (_cover_by_ellipses, _uncover_ellipses),
    Shape.TRIANGLE: (_cover_by_polygons, _uncover_polygons),
    Shape.DIAMOND: (_cover_by_polygons, _uncover_polygons),
}
"""For each shape the kernel that writes its masks, and the one that adds the gradient of its numbers from theirs."""
