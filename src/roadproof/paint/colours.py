"""Which colours paint may have, and the map that brings every colour to an allowed one.

The colours between the bounds of the albedo, and those that print can mix, are a convex set C of RGB given by planes.
A colour outside is moved towards the middle of C until it is in it. With asphalt a and contrast ‖c − a‖ / √3, a colour
of too much contrast is moved towards the point of C nearest to a, one of too little towards the one farthest from it:
both stay in C, since it is convex, and stop exactly where the contrast is allowed.

    symbol   meaning                                              shape
    A, b     planes: c is in C where A c ≤ b                      (p, 3), (p,)
    V        corners of C                                         (v, 3)
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.errors import PatternError
from roadproof.paint.site import Rgb, hex_of, rgb_of

PRINT = ("#ffffff", "#009fe3", "#e6007e", "#ffed00", "#e30613", "#009640", "#312783", "#1d1d1b")
"""What offset print (FOGRA39) makes of no ink, of one, of two over each other, and of all, as sRGB: every other
colour of print is a mix of them (Neugebauer)."""

_BLACK_AND_WHITE = 3**0.5
_TINY = 1e-5
_ROUNDING = 1e-6

Planes = tuple[Float[np.ndarray, "p 3"], Float[np.ndarray, " p"]]


@dataclass(frozen=True, slots=True, eq=False)
class AllowedColours:
    """The map that brings colours to allowed ones.

    Args:
        palette: the only colours allowed, RGB in [0, 1], (c, 3); None if all colours of C are allowed.
        planes: the planes A and b of C; None if no colour lies outside.
        middle: a point well inside C, (3,).
        asphalt: the asphalt's colour a, (3,); None if contrast is not limited.
        nearest: the point of C nearest to the asphalt, (3,).
        farthest: the corner of C farthest from the asphalt, (3,).
        contrast: least and largest contrast to the asphalt, each in [0, 1].
    """

    palette: Float[Tensor, "c 3"] | None
    planes: tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]] | None
    middle: Float[Tensor, " 3"]
    asphalt: Float[Tensor, " 3"] | None
    nearest: Float[Tensor, " 3"]
    farthest: Float[Tensor, " 3"]
    contrast: tuple[float, float]

    def __call__(self, colours: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """The allowed colour of each colour; gradients pass a palette as if it were not there."""
        if self.palette is not None:
            known = self.palette.to(colours)
            chosen = known[(colours.detach()[..., None, :] - known).square().sum(-1).argmin(-1)]
            return chosen + (colours - colours.detach())
        if self.planes is not None:
            colours = _inside(colours, *(part.to(colours) for part in (*self.planes, self.middle)))
        if self.asphalt is None:
            return colours
        asphalt = self.asphalt.to(colours)
        least, most = (share * _BLACK_AND_WHITE for share in self.contrast)
        far = (colours - asphalt).square().sum(-1, keepdim=True).clamp_min(1e-20).sqrt()
        nearer = _until(colours, self.nearest.to(colours), asphalt, most - _ROUNDING)
        further = _until(colours, self.farthest.to(colours), asphalt, least + _ROUNDING)
        outside = torch.where(far < least + _ROUNDING, further, colours)
        return torch.where(far > most - _ROUNDING, nearer, outside)


def contrast(colours: Float[np.ndarray, "*b 3"], asphalt: Rgb) -> Float[np.ndarray, "*b"]:
    """Distance of colours from the asphalt in RGB: 0 is none, 1 is black on white."""
    return np.asarray(np.linalg.norm(colours - np.array(asphalt), axis=-1) / _BLACK_AND_WHITE)


def allowed_colours(
    *,
    albedo: tuple[float, float],
    palette: tuple[str, ...],
    printable: bool,
    limit: tuple[float, float] | None,
    asphalt: Rgb | None,
) -> AllowedColours:
    """The map to the colours that all limits together allow.

    Args:
        albedo: lowest and highest value of a channel, each in [0, 1].
        palette: the only colours allowed, as "#d6a83d"; empty if all are allowed.
        printable: whether offset print must be able to mix the colours.
        limit: least and largest contrast to the asphalt, each in [0, 1]; None for no limit.
        asphalt: colour of the paint that looks like the bare road, RGB in [0, 1]; None where it is not known.

    Raises:
        PatternError: the limits allow no colour; the message says which limit is at fault.
    """
    rows, bounds = _box(*albedo)
    if printable:
        more, ends = _hull(np.array([rgb_of(each) for each in PRINT]))
        rows, bounds = np.concatenate([rows, more]), np.concatenate([bounds, ends])
    corners = _corners(rows, bounds)
    if printable and (not len(corners) or np.ptp(corners, axis=0).max() < 1e-3):
        raise PatternError(f"no colour with an albedo of {albedo[0]:g} to {albedo[1]:g} can be printed; widen it")
    middle = corners.mean(0)
    near = far = middle
    if limit is not None and asphalt is not None:
        near, far = _nearest(np.array(asphalt), rows, bounds, middle), corners[contrast(corners, asphalt).argmax()]
    listed = _listed(palette, (rows, bounds), limit, asphalt)
    if not palette and limit is not None and asphalt is not None:
        least, most = float(contrast(near, asphalt)), float(contrast(far, asphalt))
        if least > limit[1] or most < limit[0]:
            raise PatternError(
                f"no paint has a contrast of {limit[0]:g} to {limit[1]:g} to the asphalt ({hex_of(asphalt)}); allowed "
                f"colours have {least:.2f} to {most:.2f}"
            )
    near, far, middle_ = (torch.tensor(each) for each in (near, far, middle))
    return AllowedColours(
        palette=listed,
        planes=(torch.tensor(rows), torch.tensor(bounds)) if printable else None,
        middle=middle_,
        asphalt=None if limit is None or asphalt is None else torch.tensor(asphalt, dtype=torch.float64),
        nearest=near,
        farthest=far,
        contrast=limit or (0.0, 1.0),
    )


def _listed(
    palette: tuple[str, ...], planes: Planes, limit: tuple[float, float] | None, asphalt: Rgb | None
) -> Float[Tensor, "c 3"] | None:
    if not palette:
        return None
    colours = np.array([rgb_of(each) for each in palette])
    left = (colours @ planes[0].T <= planes[1] + 1e-3).all(1)
    if not left.any():
        raise PatternError(f"none of the colours {', '.join(palette)} is left by albedo and print; list others")
    if limit is not None and asphalt is not None:
        known = contrast(colours, asphalt)
        left &= (known >= limit[0]) & (known <= limit[1])
        if not left.any():
            told = ", ".join(f"{name} ({value:.2f})" for name, value in zip(palette, known, strict=True))
            raise PatternError(
                f"no colour listed has a contrast of {limit[0]:g} to {limit[1]:g} to the asphalt ({hex_of(asphalt)}): "
                f"{told}"
            )
    return torch.tensor(colours[left])


def _box(low: float, high: float) -> Planes:
    one = np.eye(3)
    return np.concatenate([one, -one]), np.array([high] * 3 + [-low] * 3)


def _hull(points: Float[np.ndarray, "n 3"]) -> Planes:
    """The planes of the convex hull of some points."""
    # Most patterns have no limits, and this takes a third of a second to import.
    from scipy.spatial import ConvexHull

    equations = np.asarray(ConvexHull(points).equations)
    return equations[:, :3], -equations[:, 3]


def _corners(rows: Float[np.ndarray, "p 3"], bounds: Float[np.ndarray, " p"]) -> Float[np.ndarray, "v 3"]:
    """The corners of C: points where three planes meet and that no other plane cuts off."""
    met: list[np.ndarray] = []
    for three in combinations(range(len(rows)), 3):
        some = rows[list(three)]
        if abs(np.linalg.det(some)) > 1e-9:
            met.append(np.linalg.solve(some, bounds[list(three)]))
    points = np.array(met)
    return points[(points @ rows.T <= bounds + 1e-7).all(1)]


def _nearest(point: np.ndarray, rows: np.ndarray, bounds: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """The point of C nearest to another, by Dykstra's projections, drawn towards the middle by what they leave."""
    if (rows @ point <= bounds).all():
        return point
    at, left = point.copy(), np.zeros_like(rows)
    for _, k in product(range(200), range(len(rows))):
        moved = at + left[k]
        at = moved - rows[k] * max(float(rows[k] @ moved - bounds[k]), 0.0)
        left[k] = moved - at
    slope = rows @ (at - middle)
    over = slope > 1e-12
    return middle + (at - middle) * min(1.0, float(((bounds - rows @ middle)[over] / slope[over]).min(initial=1.0)))


def _inside(colours: Tensor, rows: Tensor, bounds: Tensor, middle: Tensor) -> Tensor:
    """Colours outside C, moved towards its middle as far as needed."""
    slope = (colours - middle) @ rows.mT
    share = torch.where(slope > 1e-9, (bounds - rows @ middle) / slope.clamp_min(1e-9), 1.0)
    share = share.amin(-1, keepdim=True)
    return torch.where(share < 1, middle + (colours - middle) * (share * (1 - _TINY)), colours)


def _until(colours: Tensor, target: Tensor, asphalt: Tensor, radius: float) -> Tensor:
    """Colours moved towards a target until their contrast to the asphalt is a given one, at the last such point."""
    way, gap = target - colours, colours - asphalt
    a = way.square().sum(-1, keepdim=True).clamp_min(1e-12)
    b = (way * gap).sum(-1, keepdim=True)
    c = gap.square().sum(-1, keepdim=True) - radius**2
    root = (b.square() - a * c).clamp_min(1e-14).sqrt()
    # Inwards the smaller root comes first; outwards the one ahead is the larger.
    share = torch.where(c > 0, (-b - root) / a, (-b + root) / a).clamp(0.0, 1.0)
    return colours + way * share
