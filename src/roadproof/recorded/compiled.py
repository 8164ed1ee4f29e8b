"""What a car sees at any pose, on a CPU and without a lens: two passes over its pixels that Numba compiles.

The same values as the tensor operations of `pictures`, to their last digits. One pass moves a recorded frame; the other
finds the canvas' pixels of a picture and works out all that painting needs there. Each thread takes whole pictures.
"""

# ruff: noqa: ANN001, ANN202
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from roadproof.compiling import Kernel, inline, run
from roadproof.compositing.tents import interval_share
from roadproof.compositing.view import OwnViews
from roadproof.coverage import MIN_VARIANCE, Footprints, footprint_px
from roadproof.geometry import CANVAS_SIZE_PX
from roadproof.photometry import Response
from roadproof.recorded.light import Light

WORTH = 16
"""Pictures that are worth a thread."""

_ZERO, _HALF, _ONE, _TWO, _FAR = (np.float32(number) for number in (0, 0.5, 1, 2, 3))
_IN_FRONT, _FURTHEST, _LEAST = np.float32(1e-6), np.float32(1e30), np.float32(MIN_VARIANCE)
_Index = np.uintp
"""A number that is never negative, so that nobody asks whether it counts from the end."""

_MIDDLE, _REACH = np.float32((CANVAS_SIZE_PX - 1) / 2), np.float32(CANVAS_SIZE_PX / 2)


def draw(
    levels: Float[Tensor, "n 3 h w"],
    frame: Int[Tensor, " p"],
    source: Float[Tensor, "p 2 3 3"],
    horizon_row: int,
    row: Int[Tensor, " p"],
    drawn: Float[Tensor, "r 3 h w"],
    beyond: Float[Tensor, "r h w"],
) -> None:
    """Draw some of R pictures from recorded frames, where these show more of them than what is there already.

    Args:
        levels: the recorded frames, 0 to 255.
        frame: index of the recorded frame for each of the pictures to be drawn.
        source: place in the recorded frame, in halves of its size from its middle, from px of the picture, above the
            horizon and below it.
        horizon_row: the first row below the horizon.
        row: which pictures are drawn.
        drawn: all pictures, in whole levels; written to.
        beyond: how far each pixel lies beyond the frame that it was drawn from, in halves of its size, infinite where
            nothing is drawn yet; written to.
    """
    run(_draw, (levels, frame, source.float().contiguous(), horizon_row, row, drawn, beyond), len(row), worth=WORTH)


def lit_canvas(
    frames: Float[Tensor, "r 3 h w"],
    rows: slice,
    canvas_from_input: Float[Tensor, "r 3 3"],
    frame: Int[Tensor, " r"],
    source: Float[Tensor, "r 2 3 3"],
    light: Light,
    variance: float,
    response: Response,
) -> OwnViews | None:
    """The canvas' pixels of R pictures with the light on them; None if no picture shows the canvas.

    Args:
        frames: the pictures, in [0, 1].
        rows: the rows in which they have the canvas.
        canvas_from_input: canvas px from px of each picture.
        frame: index of the recorded frame that each picture was drawn from.
        source: place in that frame, as for `draw`.
        light: the light on the canvas in recorded frames.
        variance: of the footprint of the controller's input (`coverage.footprint_variance`).
        response: response from painted to seen colour.
    """
    many, width = len(frames), frames.shape[-1]
    touches = torch.zeros(many, rows.stop - rows.start, width, dtype=torch.uint8)
    canvas, source = canvas_from_input.float().contiguous(), source.float().contiguous()
    run(_find, (canvas, rows.start, footprint_px(variance), touches), many, worth=WORTH)
    most = int(touches.sum((1, 2)).max())
    if most == 0:
        return None
    pixel, valid = torch.empty(many, most, dtype=torch.int64), torch.empty(many, most, dtype=torch.bool)
    centre, jacobian = frames.new_empty(many, 1, most, 2), frames.new_empty(many, 1, most, 2, 2)
    features = frames.new_empty(many, 1, 6, most)
    clean, gain, bias = frames.new_empty(3, many, most, 3)
    lit = (light.values, light.of_frames, variance)
    found = (pixel, valid, centre, jacobian, features, clean, gain, bias)
    run(_light, (frames, canvas, rows.start, touches, frame, source, *lit, *found), many, worth=WORTH)
    footprints = Footprints(centre, jacobian, features, variance)
    return OwnViews(
        pixel=pixel, valid=valid, footprints=footprints, clean=clean, gain=gain, bias=bias, response=response
    )


# Numbers are asked for one by one, as in `compositing.compiled`.


@inline
@no_type_check
def _mapped(matrix, i, j, x, y):
    """A pixel through one of the matrices of a picture, homogeneous."""
    at_x = matrix[i, j, 0, 0] * x + matrix[i, j, 0, 1] * y + matrix[i, j, 0, 2]
    at_y = matrix[i, j, 1, 0] * x + matrix[i, j, 1, 1] * y + matrix[i, j, 1, 2]
    return at_x, at_y, matrix[i, j, 2, 0] * x + matrix[i, j, 2, 1] * y + matrix[i, j, 2, 2]


@inline
@no_type_check
def _on_canvas(canvas, r, x, y):
    """A pixel on the canvas, canvas px, and its depth."""
    at_x = canvas[r, 0, 0] * x + canvas[r, 0, 1] * y + canvas[r, 0, 2]
    at_y = canvas[r, 1, 0] * x + canvas[r, 1, 1] * y + canvas[r, 1, 2]
    depth = canvas[r, 2, 0] * x + canvas[r, 2, 1] * y + canvas[r, 2, 2]
    return at_x / depth, at_y / depth, depth


@inline
@no_type_check
def _clipped(value, least, most):
    """A number held between two others; one that is none becomes the least."""
    value = value if value > least else least
    return value if value < most else most


@Kernel
@no_type_check
def _draw(levels, frame, source, horizon_row, row, drawn, beyond, part):
    n, r = _Index(frame[part]), _Index(row[part])
    height, width = levels.shape[2], levels.shape[3]
    wide, high = np.float32(width), np.float32(height)
    along, down, further = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(_Index(height)):
        wanted = False
        for x in range(_Index(width)):
            wanted |= beyond[r, y, x] > _ZERO
        if not wanted:
            continue
        # The places are worked out for a whole row first, which a processor does for many pixels at once.
        w, level = (1 if y >= horizon_row else 0), np.float32(y)
        x0 = source[part, w, 0, 1] * level + source[part, w, 0, 2]
        y0 = source[part, w, 1, 1] * level + source[part, w, 1, 2]
        depth0 = source[part, w, 2, 1] * level + source[part, w, 2, 2]
        dx, dy, ddepth = source[part, w, 0, 0], source[part, w, 1, 0], source[part, w, 2, 0]
        for x in range(width):
            # What is behind the camera would come out mirrored, in the sky; it is far outside the frame.
            nearness = _ONE / _clipped(ddepth * np.float32(x) + depth0, _IN_FRONT, _FURTHEST)
            at_x = _clipped((dx * np.float32(x) + x0) * nearness, -_FAR, _FAR)
            at_y = _clipped((dy * np.float32(x) + y0) * nearness, -_FAR, _FAR)
            further[x] = max(abs(at_x), abs(at_y)) - _ONE
            along[x] = _clipped(((at_x + _ONE) * wide - _ONE) * _HALF, _ZERO, wide - _ONE)
            down[x] = _clipped(((at_y + _ONE) * high - _ONE) * _HALF, _ZERO, high - _ONE)
        for x in range(_Index(width)):
            short = beyond[r, y, x]
            if short <= _ZERO or further[x] >= short:
                continue
            beyond[r, y, x] = further[x]
            left, upper = _Index(along[x]), _Index(down[x])
            right, lower = min(left + _Index(1), _Index(width - 1)), min(upper + _Index(1), _Index(height - 1))
            to_right, to_lower = along[x] - np.float32(left), down[x] - np.float32(upper)
            b, d = (_ONE - to_lower) * to_right, to_lower * to_right
            a, c = _ONE - to_lower - b, to_lower - d
            for channel in range(_Index(3)):
                drawn[r, channel, y, x] = np.rint(
                    a * levels[n, channel, upper, left]
                    + b * levels[n, channel, upper, right]
                    + c * levels[n, channel, lower, left]
                    + d * levels[n, channel, lower, right]
                )


@Kernel
@no_type_check
def _find(canvas, top, reach, touches, r):
    """Mark the pixels whose footprint may touch the canvas: those on it, and those beside them."""
    rows, width = touches.shape[1], touches.shape[2]
    for y in range(rows):
        for x in range(width):
            at_x, at_y, depth = _on_canvas(canvas, r, np.float32(x), np.float32(y + top))
            if depth > _ZERO and max(abs(at_x - _MIDDLE), abs(at_y - _MIDDLE)) < _REACH:
                for beside_y in range(max(y - reach, 0), min(y + reach + 1, rows)):
                    for beside_x in range(max(x - reach, 0), min(x + reach + 1, width)):
                        touches[r, beside_y, beside_x] = 1
    for y in range(rows):
        for x in range(width):
            if touches[r, y, x] and not _on_canvas(canvas, r, np.float32(x), np.float32(y + top))[2] > _ZERO:
                touches[r, y, x] = 0


@inline
@no_type_check
def _share(off, variance):
    """Share of a tent that lies on the canvas, so far off its middle."""
    return interval_share(off, _REACH, np.sqrt(max(variance, _LEAST)))


@Kernel
@no_type_check
def _light(
    frames, canvas, top, touches, frame, source, values, of_frames, variance,
    pixel, valid, centre, jacobian, features, clean, gain, bias, r,
):  # fmt: skip
    r = _Index(r)
    height, width = _Index(frames.shape[2]), _Index(frames.shape[3])
    wide, high, spread = np.float32(width), np.float32(height), np.float32(variance)
    first = _Index(frame[r]) * height * width
    seen = _Index(0)
    for y in range(_Index(touches.shape[1])):
        for x in range(width):
            if touches[r, y, x]:
                pixel[r, seen] = (y + _Index(top)) * width + x
                seen += _Index(1)
    # Rows are filled up with copies of their last pixel, which are painted as it is. A picture without any canvas has
    # none to copy: what stands for it must only be finite, and unseen.
    for p in range(_Index(pixel.shape[1])):
        valid[r, p] = p < seen
        if p >= seen:
            pixel[r, p] = pixel[r, seen - _Index(1)] if seen else top * width
        index = _Index(pixel[r, p])
        row, column = _Index(np.uint32(index) // np.uint32(width)), _Index(np.uint32(index) % np.uint32(width))
        at_x, at_y, depth = _on_canvas(canvas, r, np.float32(column), np.float32(row))
        if seen == 0:
            at_x, at_y, depth = _ONE, _ONE, _ONE
        nearness = _ONE / depth
        a = (canvas[r, 0, 0] - at_x * canvas[r, 2, 0]) * nearness
        b = (canvas[r, 0, 1] - at_x * canvas[r, 2, 1]) * nearness
        c = (canvas[r, 1, 0] - at_y * canvas[r, 2, 0]) * nearness
        d = (canvas[r, 1, 1] - at_y * canvas[r, 2, 1]) * nearness
        xx, xy, yy = spread * (a * a + b * b), _TWO * spread * (a * c + b * d), spread * (c * c + d * d)
        share = _share(at_x - _MIDDLE, xx) * _share(at_y - _MIDDLE, yy) if seen else _ZERO
        at = index
        if of_frames:
            # Light changes slowly across a frame: the nearest pixel's will do.
            from_x, from_y, from_depth = _mapped(source, r, _Index(1), np.float32(column), np.float32(row))
            from_depth = max(from_depth, _IN_FRONT)
            from_x = np.rint((from_x / from_depth + _ONE) * (wide * _HALF) - _HALF)
            from_y = np.rint((from_y / from_depth + _ONE) * (high * _HALF) - _HALF)
            from_x, from_y = _clipped(from_x, _ZERO, wide - _ONE), _clipped(from_y, _ZERO, high - _ONE)
            at = first + _Index(from_y) * width + _Index(from_x)
            share *= values[at, 6]
        centre[r, 0, p, 0], centre[r, 0, p, 1] = at_x, at_y
        jacobian[r, 0, p, 0, 0], jacobian[r, 0, p, 0, 1] = a, b
        jacobian[r, 0, p, 1, 0], jacobian[r, 0, p, 1, 1] = c, d
        features[r, 0, 0, p], features[r, 0, 1, p], features[r, 0, 2, p] = at_x, at_y, _ONE
        features[r, 0, 3, p], features[r, 0, 4, p], features[r, 0, 5, p] = xx, xy, yy
        for channel in range(_Index(3)):
            bare = frames[r, channel, row, column]
            clean[r, p, channel] = bare
            gain[r, p, channel] = share * values[at, channel]
            bias[r, p, channel] = share * (values[at, channel + _Index(3)] - bare)
