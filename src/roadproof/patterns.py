"""Painted patterns: ordered figures on the canvas, the published parameters, rasters, files.

Convention:
    Canvas px, x right, y down, y = 0 the far edge. A figure is a shape in a box: centre x, centre y, width, length,
    rotation in degrees, clockwise on the picture. The last figure is painted on top. Colours are RGB in [0, 1], the
    paint's own, before any camera has seen it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from roadproof.constants import constant
from roadproof.coverage import FOOTPRINT_VARIANCE, Footprints, Shape, coverage
from roadproof.errors import PatternError
from roadproof.geometry import CANVAS_SIZE_PX
from roadproof.io.files import AnyPath, as_path, write_atomically
from roadproof.io.html import content_of
from roadproof.io.pictures import read_picture
from roadproof.io.records import RecordFile
from roadproof.limits import MAX_FIGURES

_MIDDLE = CANVAS_SIZE_PX / 2
_MOST_PX = 1e5


@dataclass(frozen=True, slots=True, eq=False)
class Pattern:
    """K figures, painted in order; leading dimensions, where there are any, count patterns of the same shapes.

    Args:
        shapes: shape of each figure, K in all.
        boxes: centre x, centre y, width, length in canvas px, rotation in degrees clockwise, (*b, K, 5).
        colours: RGB of the paint in [0, 1], (*b, K, 3).

    Raises:
        PatternError: no figure, or unequal numbers of shapes, boxes and colours. That values are finite is seen where a
            pattern is painted or saved.
    """

    shapes: tuple[Shape, ...]
    boxes: Float[Tensor, "*b k 5"]
    colours: Float[Tensor, "*b k 3"]

    def __post_init__(self) -> None:
        counts = (len(self.shapes), self.boxes.shape[-2], self.colours.shape[-2])
        if len(set(counts)) != 1 or counts[0] < 1:
            raise PatternError(f"{counts[0]} shapes, {counts[1]} boxes, {counts[2]} colours; expected K ≥ 1 of each")

    def __getitem__(self, index: int | tuple[int, ...] | slice | None) -> Pattern:
        """One pattern of a batch, some of them, or a batch of one."""
        return self.mapped(lambda part: part[index])

    def mapped(self, change: Callable[[Tensor], Tensor]) -> Pattern:
        """The pattern with its boxes and its colours changed by one function, such as moved to a device."""
        return Pattern(self.shapes, change(self.boxes), change(self.colours))

    @property
    def painted_share(self) -> Float[Tensor, "*b"]:
        """Sum of the figures' areas over the canvas' area: an upper bound of what is painted."""
        fill = constant(tuple(_FILL[shape] for shape in self.shapes), self.boxes)
        return (fill * self.boxes[..., 2] * self.boxes[..., 3]).sum(-1) / CANVAS_SIZE_PX**2

    def _repr_png_(self) -> bytes | None:
        """How a notebook shows one pattern; a batch is shown in words."""
        return content_of(Image.fromarray(raster(self)), "PNG") if self.boxes.ndim == 2 else None


_FILL = {Shape.RECTANGLE: 1.0, Shape.ELLIPSE: torch.pi / 4, Shape.TRIANGLE: 0.5, Shape.DIAMOND: 0.5}


def boxes_from_published(
    values: Float[Tensor, "*b k 4"], *, rotate_about: Literal["figure", "canvas"] = "figure"
) -> Float[Tensor, "*b k 5"]:
    """Boxes from the published rectangle parameters.

    Args:
        values: rotation (degrees, 0…180), position (px, 0…380), width (px, 0…100) and length (px, 0…70) as the
            released code names them: the rectangle is 5 + width wide, its left edge is at position + 10, and it ends
            5 + length short of both ends of the canvas.
        rotate_about: "figure", its own centre, as the released code does; "canvas", the canvas' centre, as the
            paper's text says.

    References:
        The paper's supplement, "Canvas"; shape_fly_simulator.py of the released code.
    """
    rotation_deg, position, inner_width, inset = values.unbind(-1)
    width = 5 + inner_width
    length = CANVAS_SIZE_PX - 2 * (5 + inset)
    x = position + 10 + width / 2
    y = torch.full_like(x, _MIDDLE)
    if rotate_about == "canvas":
        angle = torch.deg2rad(rotation_deg)
        arm = x - _MIDDLE
        x, y = _MIDDLE + arm * torch.cos(angle), _MIDDLE + arm * torch.sin(angle)
    return torch.stack([x, y, width, length, rotation_deg], -1)


def published_from_boxes(
    boxes: Float[Tensor, "*b k 5"], *, rotate_about: Literal["figure", "canvas"] = "figure"
) -> Float[Tensor, "*b k 4"]:
    """The published parameters of boxes that `boxes_from_published` made, (*b, K, 4)."""
    x, y, width, length, rotation_deg = boxes.unbind(-1)
    arm = x - _MIDDLE
    if rotate_about == "canvas":
        angle = torch.deg2rad(rotation_deg)
        arm = arm * torch.cos(angle) + (y - _MIDDLE) * torch.sin(angle)
    return torch.stack([rotation_deg, _MIDDLE + arm - 10 - width / 2, width - 5, (CANVAS_SIZE_PX - length) / 2 - 5], -1)


def coverages(pattern: Pattern, footprints: Footprints) -> Float[Tensor, "*b k p"]:
    """The mask M of every figure at every footprint, in [0, 1]."""
    if len(set(pattern.shapes)) == 1:
        return coverage(pattern.shapes[0], pattern.boxes, footprints)
    parts = [coverage(shape, pattern.boxes[..., k : k + 1, :], footprints) for k, shape in enumerate(pattern.shapes)]
    return torch.cat(parts, -2)


def visibilities(masks: Float[Tensor, "*b k p"]) -> Float[Tensor, "*b k p"]:
    """What of each figure is seen under those painted later: V_k = M_k ∏_{j>k} (1 − M_j).

    A partition: together with the bare road, 1 − ∑ V = ∏ (1 − M), the shares sum to one also for fractional masks,
    which the paper's recursion with V inside the product does not ensure. For binary masks both agree.
    """
    uncovered = torch.ones_like(masks[..., :1, :])
    bare_above = torch.cumprod(torch.cat([uncovered, (1 - masks[..., 1:, :]).flip(-2)], -2), -2).flip(-2)
    return masks * bare_above


def require_visible(paint: UInt8[np.ndarray, "s s 4"], name: str) -> None:
    """See that a raster shows anything of its pattern.

    Raises:
        PatternError: it does not; the message says so by the pattern's name.
    """
    if not paint[..., 3].any():
        raise PatternError(f"{name} paints nothing, so there is nothing to drive over; give another")


def raster(pattern: Pattern, size_px: int = CANVAS_SIZE_PX) -> UInt8[np.ndarray, "s s 4"]:
    """The pattern as an antialiased RGBA picture of the canvas (straight alpha).

    Args:
        pattern: one pattern, without batch dimensions.
        size_px: rows and columns of the picture; the canvas has 400.

    Raises:
        PatternError: the pattern is a batch or has values that are not finite, or size_px is below 1.
    """
    if pattern.boxes.ndim != 2:
        raise PatternError(f"expected one pattern, got a batch of shape {tuple(pattern.boxes.shape[:-2])}; take one")
    for name, values in (("boxes", pattern.boxes), ("colours", pattern.colours)):
        if not bool(values.isfinite().all()):
            raise PatternError(f"{name} of the pattern are not finite (NaN or infinity); check what made them")
    if size_px < 1:
        raise PatternError(f"raster size is {size_px} px, expected at least 1")
    scale = CANVAS_SIZE_PX / size_px
    rows, columns = np.mgrid[0:size_px, 0:size_px]
    centre = (np.stack([columns.ravel(), rows.ravel()], -1) + 0.5) * scale - 0.5
    jacobian = np.broadcast_to(np.eye(2) * scale, (size_px**2, 2, 2))
    footprints = Footprints.of(centre, jacobian, FOOTPRINT_VARIANCE["area"])
    single = pattern.mapped(lambda part: part.detach().cpu().float())
    seen = visibilities(coverages(single, footprints))
    alpha = seen.sum(0)
    colour = (single.colours.mT @ seen) / alpha.clamp_min(1e-6)
    rgba = torch.cat([colour, alpha[None]]).clamp(0, 1).mul(255).round().to(torch.uint8)
    return rgba.T.reshape(size_px, size_px, 4).numpy()


@dataclass(frozen=True, slots=True)
class _Figure:
    """A figure as the pattern file stores it."""

    shape: Shape
    x_px: float
    y_px: float
    width_px: float
    length_px: float
    rotation_deg: float
    rgb: tuple[float, float, float]

    @property
    def box(self) -> tuple[float, ...]:
        return self.x_px, self.y_px, self.width_px, self.length_px, self.rotation_deg

    def __post_init__(self) -> None:
        # Far beyond the canvas a float32 could not tell where a figure is.
        if max(map(abs, self.box)) > _MOST_PX:
            raise PatternError(f"figure has {max(self.box, key=abs):g}, expected at most {_MOST_PX:g} px or degrees")
        if min(self.rgb) < 0 or max(self.rgb) > 1 or self.width_px <= 0 or self.length_px <= 0:
            raise PatternError("figure needs rgb in [0, 1] and a width and length above 0")


@dataclass(frozen=True, slots=True)
class _Figures:
    """A pattern as its file stores it."""

    figures: tuple[_Figure, ...]
    canvas_px: int = CANVAS_SIZE_PX

    def __post_init__(self) -> None:
        if self.canvas_px != CANVAS_SIZE_PX:
            raise PatternError(f"canvas_px is {self.canvas_px}, expected {CANVAS_SIZE_PX}: figures are in these pixels")
        if not 1 <= len(self.figures) <= MAX_FIGURES:
            raise PatternError(f"it has {len(self.figures)} figures, expected at least one and {MAX_FIGURES} at most")


_FILE = RecordFile(
    kind=_Figures, name="roadproof-pattern", error=PatternError, remedy="make it again", most_bytes=2**18
)


def save_pattern(pattern: Pattern, path: AnyPath) -> None:
    """Write `path` (JSON: every figure by name and unit) and, beside it, its raster as PNG.

    Raises:
        PatternError: the pattern is a batch, has values that are not finite, or a figure of it is not valid; or the
            path does not end in .json.
        OutputError: the folder cannot be written.
    """
    if as_path(path).suffix != ".json":
        raise PatternError(f"{path} does not end in .json; give such a path, beside which its picture goes as .png")
    path, picture = as_path(path), Image.fromarray(raster(pattern))
    boxes = cast("list[list[float]]", pattern.boxes.tolist())
    colours = cast("list[list[float]]", pattern.colours.tolist())
    figures = [
        _Figure(shape, x, y, width, length, rotation, (red, green, blue))
        for shape, (x, y, width, length, rotation), (red, green, blue) in zip(
            pattern.shapes, boxes, colours, strict=True
        )
    ]
    _FILE.write(path, _Figures(tuple(figures)))
    write_atomically(path.with_suffix(".png"), lambda part: picture.save(part, format="PNG"))


def load_pattern(path: AnyPath) -> Pattern:
    """Read a pattern written by `save_pattern`.

    Raises:
        PatternError: the file is missing, is not a pattern of this format, or a figure of it is not valid.
    """
    path = as_path(path)
    figures = _FILE.read(path).figures
    boxes, colours = [figure.box for figure in figures], [figure.rgb for figure in figures]
    return Pattern(tuple(figure.shape for figure in figures), torch.tensor(boxes), torch.tensor(colours))


def read_paint(path: AnyPath) -> UInt8[np.ndarray, "s s 4"]:
    """Read what a file says to paint, as RGBA of the canvas: the raster of a pattern (.json), or a picture as it is.

    Raises:
        PatternError: the file is neither a pattern nor a picture of the canvas' size.
    """
    path = as_path(path)
    if path.suffix == ".json":
        return raster(load_pattern(path))
    remedy = "give a pattern (.json), or a picture (.png, .jpg)"
    paint = read_picture(path, PatternError, remedy, mode="RGBA")
    if paint.shape[:2] != (CANVAS_SIZE_PX, CANVAS_SIZE_PX):
        raise PatternError(
            f"{path} has {paint.shape[1]}×{paint.shape[0]} pixels, expected the canvas' "
            f"{CANVAS_SIZE_PX}×{CANVAS_SIZE_PX}; resize it"
        )
    return paint
