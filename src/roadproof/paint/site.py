"""The stretch of road that may be painted: how large it is, what its asphalt looks like, which lane marks it has.

Convention:
    Canvas metres: x to the right from the canvas' left edge, y towards the car from its far edge. A canvas pixel
    (x, y) has its middle at ((x + ½) width / 400, (y + ½) length / 400). Pixels need not be square, so a rotated
    rectangle of canvas pixels is a parallelogram in metres.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.constants import constant
from roadproof.errors import PatternError
from roadproof.geometry import CANVAS_SIZE_PX

Rgb = tuple[float, float, float]

WHITE_MARK, YELLOW_MARK = "#dededa", "#d6a83d"
"""The paint of lane marks where nothing else is said."""


def rgb_of(text: str) -> Rgb:
    """The colour of a text such as "#d6a83d", in [0, 1].

    Raises:
        PatternError: the text is not such a colour.
    """
    if not re.fullmatch("#[0-9a-fA-F]{6}", text):
        raise PatternError(f"colour is {text!r:.40}, expected # and six hexadecimal digits, as #d6a83d")
    red, green, blue = (int(text[k : k + 2], 16) / 255 for k in (1, 3, 5))
    return red, green, blue


def hex_of(rgb: Rgb) -> str:
    """The text of an RGB colour in [0, 1], such as "#d6a83d"."""
    return "#" + "".join(f"{round(255 * channel):02x}" for channel in rgb)


@dataclass(frozen=True, kw_only=True, slots=True)
class LaneMark:
    """One painted line of the road, on the canvas or near it; a broken line counts as if it had no gaps.

    Args:
        points_m: middle line of the mark, two points or more in canvas metres, not all the same; parts outside the
            canvas count too.
        width_m: width of the mark, metres.
        colour: colour of the mark's paint, such as "#dededa".

    Raises:
        PatternError: there are fewer than two different points, or a value is out of its range.
    """

    points_m: tuple[tuple[float, float], ...]
    width_m: float = 0.12
    colour: str = WHITE_MARK

    def __post_init__(self) -> None:
        rgb_of(self.colour)
        same = all(point == self.points_m[0] for point in self.points_m[1:])
        if same or not all(abs(value) <= 1e4 for point in self.points_m for value in point):
            raise PatternError(
                f"a lane mark has the points {self.points_m!r:.80}, expected two different ones or more, in metres on "
                "the canvas"
            )
        if not 0.0 < self.width_m <= 5.0:
            raise PatternError(f"a lane mark has width_m {self.width_m}, expected above 0, and 5 at most")


@dataclass(frozen=True, kw_only=True, slots=True)
class Site:
    """What is known of the road under a canvas.

    Args:
        size_m: extent of the canvas across and along the road, metres; None if it is not known.
        asphalt: paint that would look like the bare road, RGB in [0, 1]; None if nothing was measured.
        marks: lane marks on the canvas and near it; None if they are not known, empty if there are none.
    """

    size_m: tuple[float, float] | None = None
    asphalt: Rgb | None = None
    marks: tuple[LaneMark, ...] | None = None

    @property
    def segments(self) -> tuple[Float[np.ndarray, "s 2 2"], Float[np.ndarray, " s"], tuple[str, ...]]:
        """Ends of the straight pieces of all marks in canvas metres, the width of each, and its colour."""
        found = [
            (pair, mark.width_m, mark.colour)
            for mark in self.marks or ()
            for pair in zip(mark.points_m[:-1], mark.points_m[1:], strict=True)
            if pair[0] != pair[1]
        ]
        ends, widths, colours = zip(*found, strict=True) if found else ((), (), ())
        return np.array(ends, float).reshape(-1, 2, 2), np.array(widths, float), tuple(colours)


def metres_per_px(size_m: tuple[float, float]) -> tuple[float, float]:
    """Metres of one canvas pixel, across and along the road."""
    return size_m[0] / CANVAS_SIZE_PX, size_m[1] / CANVAS_SIZE_PX


def half_edges_m(
    boxes: Float[Tensor, "*b k 5"], size_m: tuple[float, float]
) -> tuple[Float[Tensor, "*b k 2"], Float[Tensor, "*b k 2"], Float[Tensor, "*b k 2"]]:
    """Middle of every box, and half of its edges across and along, which span a parallelogram in canvas metres."""
    x, y, width, length, rotation_deg = boxes.unbind(-1)
    scale = constant(metres_per_px(size_m), boxes)
    angle = torch.deg2rad(rotation_deg)
    c, s = torch.cos(angle), torch.sin(angle)
    across = torch.stack([c, s], -1) * (width / 2)[..., None]
    along = torch.stack([-s, c], -1) * (length / 2)[..., None]
    return (torch.stack([x, y], -1) + 0.5) * scale, across * scale, along * scale
