"""What footprints share with the canvas and its squares, in one pass that Numba compiles.

Along either axis the share is that of a tent, as in painting, and a checkerboard is a square wave: squares are where
the product of both waves is positive.
"""

# ruff: noqa: ANN001, ANN202
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int

from roadproof.compiling import Kernel
from roadproof.compositing.tents import interval_share
from roadproof.geometry import CANVAS_SIZE_PX
from roadproof.homographies import Homographies

SQUARES = 4
"""Along each side of the canvas in the dark frames."""
GREY = 128 / 255
"""Of the squares."""

_SQUARE_PX = CANVAS_SIZE_PX / SQUARES
_LEAST_DEPTH = 1e-9


def canvas_shares(
    canvas_from_input: Homographies,
    frame: Int[np.ndarray, " p"],
    pixel: Float[np.ndarray, "p 3"],
    bend: Float[np.ndarray, "p 3 2"],
    variance: float,
) -> Float[np.ndarray, "2 p"]:
    """Share of each footprint on the canvas, and the contrast that it then has: 1 for white minus black.

    Args:
        canvas_from_input: homographies of F frames, (F, 3, 3).
        frame: the frame of each pixel.
        pixel: where each pixel looks through the lens, homogeneous.
        bend: how that changes with a step to the right and down, as `geometry.sight` gives both.
        variance: variance of the filter that makes a pixel, along either axis, px².
    """
    found = np.zeros((2, len(frame)))
    given = (np.ascontiguousarray(each) for each in (canvas_from_input, frame, pixel, bend))
    _share(*given, float(variance), found)
    return found


@Kernel
@no_type_check
def _share(canvas_from_input, frame, pixel, bend, variance, found):
    """Share and contrast of every pixel; 0 where it looks behind the camera's horizon."""
    for p in range(len(frame)):
        sees = canvas_from_input[frame[p]]
        depth = sees[2, 0] * pixel[p, 0] + sees[2, 1] * pixel[p, 1] + sees[2, 2] * pixel[p, 2]
        if depth <= _LEAST_DEPTH:
            continue
        share, both_waves = 1.0, 1.0
        for axis in range(2):
            at = 0.0
            for k in range(3):
                at += sees[axis, k] * pixel[p, k] / depth
            across = 1e-9
            for side in range(2):
                slope = 0.0
                for k in range(3):
                    slope += (sees[axis, k] - at * sees[2, k]) * bend[p, k, side] / depth
                across += variance * slope * slope
            reach = math.sqrt(across)
            along, wave, sign = 0.0, 0.0, 1.0
            for square in range(SQUARES):
                part = interval_share(at + 0.5 - (square + 0.5) * _SQUARE_PX, 0.5 * _SQUARE_PX, reach)
                along += part
                wave += sign * part
                sign = -sign
            share *= along
            both_waves *= wave
        found[0, p] = share
        found[1, p] = share - GREY * 0.5 * (share + both_waves)
