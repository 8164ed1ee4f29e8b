"""Shares of a tent, for kernels compiled by Numba: what `coverage.tent_share` gives."""

# ruff: noqa: ANN001, ANN201
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from typing import no_type_check

import numpy as np

from roadproof.compiling import inline

_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)


@inline
@no_type_check
def tent(t):
    """S̃(t) = t (1 − |t|/2), the share of a tent of half-width 1 between its middle and t; t clamped to [−1, 1]."""
    t = min(_ONE, max(-_ONE, t))
    return t * (_ONE - _HALF * abs(t))


@inline
@no_type_check
def slope(t):
    """S̃′(t) = 1 − |t|, and 0 where t is clamped."""
    return max(_ONE - abs(t), _ZERO)


@inline
@no_type_check
def interval_share(off, half, reach):
    """Share of a tent, so far off the middle and of that half-width, that lies inside [−half, half]."""
    return tent((half - off) / reach) + tent((half + off) / reach)
