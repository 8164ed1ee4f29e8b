"""How much of a pixel's footprint lies inside a figure: antialiased, and differentiable in every shape parameter.

Every figure lives in a box on the canvas: centre (x, y), width, length, rotation. Its own axes are `e_u` across the
width and `e_v` along the length; rotation turns them clockwise on the picture, since y points down.

    symbol   meaning                                                            shape
    c        canvas coordinates of a pixel's centre, px                         (P, 2)
    J        canvas px per picture px there, ∂c/∂(column, row)                  (P, 2, 2)
    σ²(e)    e·(J Jᵀ)e · footprint², squared half-width of the footprint on e   (…, P)
    u, v     c − centre in the figure's axes                                    (…, P)
    S(t)     share of a tent of half-width 1 that lies below t                  in [0, 1]

The antialiased bilinear filter that makes a controller's input is a tent two pixels wide in x and y. Projected on any
direction e it is, to a good approximation, again a tent, of half-width σ(e) (same variance exactly; the same tent
exactly along the pixel axes). So the coverage of a box is a product of two differences of S: closed form, C¹ smooth,
and one small matrix product for all pixels. An area filter (a box one pixel wide) has half that variance; so have the
camera's own pixels, which an input has that is as large as its crop (`footprint_variance`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.constants import constant, placed
from roadproof.geometry import CANVAS_SIZE_PX, CropResize, Resampling

FOOTPRINT_VARIANCE: dict[Resampling, float] = {"antialiased-bilinear": 1.0, "area": 0.5}
"""Squared half-width, in picture px, of the tent that stands for each filter where it makes pictures smaller."""


def footprint_variance(view: CropResize) -> float:
    """Squared half-width, in input px, of the tent that stands for the footprint of a controller's input.

    Where the input is as large as its crop nothing is filtered, and where it is larger the filter is as wide as pixels
    of the camera: to each comes the box of the camera's own pixel.
    """
    crop = (view.right_px - view.left_px) * (view.bottom_px - view.top_px)
    camera_px = (crop / (view.width_px * view.height_px)) ** 0.5  # of its side, for each of the input
    if camera_px > 1.0:
        return FOOTPRINT_VARIANCE[view.resampling]
    enlarged = 1.0 if camera_px < 1.0 and view.resampling != "area" else 0.0
    return (0.5 + enlarged) / camera_px**2


def footprint_px(variance: float) -> int:
    """How far beside a pixel on the canvas footprints still touch it, in whole px of the input (`footprint_variance`).

    At a sharp corner the nearest pixel on the canvas is further off, which counts where pixels are small.
    """
    return 1 if variance <= 1.0 else math.ceil(math.sqrt(variance)) + 1


MIN_VARIANCE = 1e-4
"""Least σ², canvas px²: far footprints are so long that rounding could make it negative across them."""


class Shape(StrEnum):
    """What fills the box of a figure."""

    RECTANGLE = "rectangle"
    ELLIPSE = "ellipse"
    TRIANGLE = "triangle"
    DIAMOND = "diamond"


# Corners of the convex polygons in their box, as shares of (width, length), clockwise on the picture.
_CORNERS = {
    Shape.RECTANGLE: ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)),
    Shape.TRIANGLE: ((0.0, -0.5), (0.5, 0.5), (-0.5, 0.5)),
    Shape.DIAMOND: ((0.0, -0.5), (0.5, 0.0), (0.0, 0.5), (-0.5, 0.0)),
}


@dataclass(frozen=True, slots=True, eq=False)
class Footprints:
    """The footprints of P picture pixels on the canvas; leading dimensions count patterns with pixels of their own.

    Args:
        centre: canvas coordinates of the pixel centres, px, (*v, P, 2).
        jacobian: canvas px per picture px, (*v, P, 2, 2).
        features: (6, P): x, y, 1 and the entries xx, 2·xy, yy of footprint² · J Jᵀ; a figure's u, v, σ²(e_u), σ²(e_v)
            are linear in them.
        variance: footprint² of the picture (`footprint_variance`).
    """

    centre: Float[Tensor, "*v p 2"]
    jacobian: Float[Tensor, "*v p 2 2"]
    features: Float[Tensor, "*v 6 p"]
    variance: float

    @staticmethod
    def of(
        centre: Float[np.ndarray, "p 2"],
        jacobian: Float[np.ndarray, "p 2 2"],
        variance: float,
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> Footprints:
        """Footprints from canvas coordinates and Jacobians, computed in float64 and stored as `dtype`."""
        return placed(Footprints.made(torch.tensor(centre), torch.tensor(jacobian), variance), device, dtype)

    @staticmethod
    def made(centre: Float[Tensor, "*v p 2"], jacobian: Float[Tensor, "*v p 2 2"], variance: float) -> Footprints:
        """Footprints from canvas coordinates and Jacobians, on their device and in their precision."""
        x, y = centre.unbind(-1)
        (a, b), (c, d) = (row.unbind(-1) for row in jacobian.unbind(-2))
        moments = (variance * (a * a + b * b), 2 * variance * (a * c + b * d), variance * (c * c + d * d))
        features = torch.stack([x, y, torch.ones_like(x), *moments], -2)
        return Footprints(centre, jacobian, features, variance)

    def __len__(self) -> int:
        return self.centre.shape[-2]

    @property
    def side(self) -> float:
        """Side, in picture px, of the square of equal variance."""
        return (2 * self.variance) ** 0.5


def in_figure_axes(
    box: Float[Tensor, "*b 5"], footprints: Footprints
) -> tuple[Float[Tensor, "*b p"], Float[Tensor, "*b p"], Float[Tensor, "*b p"], Float[Tensor, "*b p"]]:
    """Each footprint in each figure's own axes: u, v, σ²(e_u), σ²(e_v)."""
    rows = axis_rows(box) @ footprints.features
    u, v, variance_u, variance_v = rows.unbind(-2)
    return u, v, variance_u, variance_v


def axis_rows(box: Float[Tensor, "*b 5"]) -> Float[Tensor, "*b 4 6"]:
    """The rows that give u, v, σ²(e_u), σ²(e_v) from the features of a footprint."""
    x, y, _, _, rotation_deg = box.unbind(-1)
    angle = torch.deg2rad(rotation_deg)
    c, s = torch.cos(angle), torch.sin(angle)
    o = torch.zeros_like(c)
    return torch.stack(
        [
            torch.stack([c, s, -(c * x + s * y), o, o, o], -1),
            torch.stack([-s, c, s * x - c * y, o, o, o], -1),
            torch.stack([o, o, o, c * c, c * s, s * s], -1),
            torch.stack([o, o, o, s * s, -c * s, c * c], -1),
        ],
        -2,
    )


def tent_share(t: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """S(t) − ½: the share of a tent of half-width 1 that lies between its middle and t (odd in t)."""
    t = t.clamp(-1.0, 1.0)
    return t * (1.0 - 0.5 * t.abs())


def coverage(shape: Shape, box: Float[Tensor, "*b 5"], footprints: Footprints) -> Float[Tensor, "*b p"]:
    """Share of every footprint that lies inside every figure.

    Args:
        shape: shape that fills the boxes.
        box: centre x, centre y, width, length in canvas px, and rotation in degrees clockwise, (*b, 5).
        footprints: footprints of the pixels.

    Returns:
        Shares in [0, 1], (*b, P): the mask M of the paper, antialiased.
    """
    match shape:
        case Shape.RECTANGLE:
            return _rectangle_coverage(box, footprints)
        case Shape.ELLIPSE:
            return _ellipse_coverage(box, footprints)
        case _:
            return _polygon_coverage(polygon_vertices(shape, box), footprints)


def canvas_share(footprints: Footprints) -> Float[Tensor, "*v p"]:
    """Share of every footprint that lies on the canvas."""
    middle, size = (CANVAS_SIZE_PX - 1) / 2, float(CANVAS_SIZE_PX)
    whole = constant((middle, middle, size, size, 0.0), footprints.centre)
    return _rectangle_coverage(whole.expand(*footprints.centre.shape[:-2], 5), footprints)


def _rectangle_coverage(box: Tensor, footprints: Footprints) -> Tensor:
    u, v, variance_u, variance_v = in_figure_axes(box, footprints)
    half_width, half_length = box[..., 2:3] / 2, box[..., 3:4] / 2
    return _interval_share(u, half_width, variance_u) * _interval_share(v, half_length, variance_v)


def _interval_share(u: Tensor, half: Tensor, variance: Tensor) -> Tensor:
    """Share of a tent at u that lies inside [−half, half]."""
    sharpness = torch.rsqrt(variance.clamp_min(MIN_VARIANCE))
    return tent_share((half - u) * sharpness) + tent_share((half + u) * sharpness)


def _ellipse_coverage(box: Tensor, footprints: Footprints) -> Tensor:
    # The ellipse is the unit disc after dividing u and v by the half axes; across its edge, along the gradient of the
    # radius there, the footprint is again taken for a tent. An ellipse thinner than a footprint counts too much by up
    # to a third (its tips are cut square); all other shapes keep their area however thin they are.
    at_u, at_v, _, _ = in_figure_axes(box, footprints)
    half_width, half_length = box[..., 2:3] / 2, box[..., 3:4] / 2
    angle = torch.deg2rad(box[..., 4:5])
    c, s = torch.cos(angle), torch.sin(angle)
    u, v = at_u / half_width, at_v / half_length
    radius = torch.sqrt(u * u + v * v + 1e-12)
    nu, nv = u / radius / half_width, v / radius / half_length
    nx, ny = c * nu - s * nv, s * nu + c * nv
    xx, xy2, yy = footprints.features[..., 3:, :].unbind(-2)
    sharpness = torch.rsqrt((nx * nx * xx + nx * ny * xy2 + ny * ny * yy).clamp_min(MIN_VARIANCE))
    return tent_share((1 - radius) * sharpness) + tent_share((1 + radius) * sharpness)


def polygon_vertices(shape: Shape, box: Float[Tensor, "*b 5"]) -> Float[Tensor, "*b n 2"]:
    """Corners on the canvas, px, clockwise on the picture (the ellipse as a fine polygon)."""
    if shape is Shape.ELLIPSE:
        turn = torch.arange(128, device=box.device, dtype=box.dtype) * (2 * torch.pi / 128)
        unit = torch.stack([torch.cos(turn), torch.sin(turn)], -1) / 2
    else:
        unit = constant(_CORNERS[shape], box)
    angle = torch.deg2rad(box[..., 4:5])
    c, s = torch.cos(angle), torch.sin(angle)
    du, dv = unit[:, 0] * box[..., 2:3], unit[:, 1] * box[..., 3:4]
    return torch.stack([box[..., 0:1] + c * du - s * dv, box[..., 1:2] + s * du + c * dv], -1)


def _polygon_coverage(vertices: Float[Tensor, "*b n 2"], footprints: Footprints) -> Float[Tensor, "*b p"]:
    """Exact area of a polygon inside each footprint, taken as the parallelogram of equal variance.

    In units of the footprint it is the square [−½, ½]²; the area is, by Green's theorem, the sum over the edges of
    the integral of the edge's height clamped to the square. Exact for thin slivers and corners alike.
    """
    picture_from_canvas = cast("Tensor", torch.linalg.inv(footprints.jacobian)) / footprints.side
    offset = vertices[..., None, :, :] - footprints.centre[..., None, :]
    points = torch.einsum("...pij,...pnj->...pni", picture_from_canvas, offset)
    following = points.roll(-1, dims=-2)
    x0, y0, x1, y1 = points[..., 0], points[..., 1], following[..., 0], following[..., 1]
    run = x1 - x0
    upright = run.abs() < 1e-6
    slope = (y1 - y0) / torch.where(upright, torch.ones_like(run), run)
    xa, xb = x0.clamp(-0.5, 0.5), x1.clamp(-0.5, 0.5)
    ya, yb = y0 + slope * (xa - x0), y0 + slope * (xb - x0)
    below = (xb - xa) * _mean_clamped(ya, yb)
    area = torch.where(upright, torch.zeros_like(below), below).sum(-1)
    # Clockwise with y down means the integral of y dx runs backwards along the lower (larger y) edges.
    return (-area).clamp(0.0, 1.0)


def _mean_clamped(a: Tensor, b: Tensor) -> Tensor:
    """Mean of clamp(y, −½, ½) while y goes evenly from a to b."""
    rise = b - a
    level = rise.abs() < 1e-4
    steep = (_clamp_integral(b) - _clamp_integral(a)) / torch.where(level, torch.ones_like(rise), rise)
    return torch.where(level, ((a + b) / 2).clamp(-0.5, 0.5), steep)


def _clamp_integral(y: Tensor) -> Tensor:
    """Integral of clamp(·, −½, ½) from 0 to y."""
    inside = y.clamp(-0.5, 0.5)
    return inside * inside / 2 + 0.5 * (y - inside).abs()
