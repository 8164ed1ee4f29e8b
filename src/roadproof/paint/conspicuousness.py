"""How conspicuous a pattern is: its area, its contrast, how near it comes to lane marks, how much it looks like one.

The likeness of a figure to a mark is the product of three shares, each 1 where they agree: the narrower of both
widths over the wider; 1 − turn / 45° between their directions; and 1 − distance / 0.25 between their colours, in the
unit of contrast. A pattern is as like a mark as its most similar figure.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import numpy as np
from jaxtyping import Float

from roadproof.coverage import polygon_vertices
from roadproof.paint.colours import contrast
from roadproof.paint.limits import area_m2
from roadproof.paint.site import Rgb, Site, half_edges_m, metres_per_px, rgb_of
from roadproof.patterns import Pattern

_OTHER_DIRECTION_RAD, _OTHER_COLOUR = np.pi / 4, 0.25


@dataclass(frozen=True, kw_only=True, slots=True)
class Conspicuousness:
    """How much a pattern catches the eye; a field is None if the road is not known well enough to say.

    Args:
        figures: number of figures.
        area_m2: sum of the figures' areas, m².
        contrast: mean contrast of the figures to the asphalt, weighted by area; 0 is none, 1 is black on white.
        mark_distance_m: least distance from a figure's edge to the edge of a lane mark, metres; 0 if they touch.
        mark_likeness: likeness of the most similar figure to a lane mark, from 0 to 1.
    """

    figures: int
    area_m2: float | None = None
    contrast: float | None = None
    mark_distance_m: float | None = None
    mark_likeness: float | None = None

    @property
    def sentence(self) -> str:
        """The measures as one sentence for people."""
        told = [f"{self.figures} figure{'' if self.figures == 1 else 's'}"]
        told += [] if self.area_m2 is None else [f"{self.area_m2:.2f} m² of paint"]
        told += [] if self.contrast is None else [f"contrast {self.contrast:.2f} to the asphalt"]
        told += [] if self.mark_distance_m is None else [f"{self.mark_distance_m:.2f} m from the nearest lane mark"]
        told += [] if self.mark_likeness is None else [f"likeness to a mark {self.mark_likeness:.2f}"]
        return ", ".join(told)


def conspicuousness(pattern: Pattern, site: Site) -> Conspicuousness:
    """How conspicuous one pattern is on a stretch of road."""
    one = pattern.mapped(lambda part: part.detach().double().cpu())
    colours = one.colours.numpy()
    shares = np.array(
        [
            float(Pattern((shape,), one.boxes[k : k + 1], one.colours[k : k + 1]).painted_share)
            for k, shape in enumerate(one.shapes)
        ]
    )
    distance = likeness = None
    if site.size_m is not None and site.marks:
        distance, likeness = _beside_marks(one, colours, site, site.size_m)
    return Conspicuousness(
        figures=len(one.shapes),
        area_m2=None if site.size_m is None else float(area_m2(one, site.size_m)),
        contrast=None
        if site.asphalt is None
        else float(np.average(contrast(colours, site.asphalt), weights=shares + 1e-12)),
        mark_distance_m=distance,
        mark_likeness=likeness,
    )


def _beside_marks(
    pattern: Pattern, colours: np.ndarray, site: Site, size_m: tuple[float, float]
) -> tuple[float, float]:
    ends, widths, paints = site.segments
    _, across, along = (part.numpy() for part in half_edges_m(pattern.boxes, size_m))
    distance, likeness = np.inf, 0.0
    for k, shape in enumerate(pattern.shapes):
        corners = (polygon_vertices(shape, pattern.boxes[k]).numpy() + 0.5) * metres_per_px(size_m)
        clear = _apart_m(corners, ends) - widths / 2
        distance = min(distance, float(clear.min()))
        likeness = max(likeness, _likeness(across[k], along[k], colours[k], ends, widths, paints))
    return max(distance, 0.0), likeness


def _likeness(
    across: np.ndarray,
    along: np.ndarray,
    colour: np.ndarray,
    ends: np.ndarray,
    widths: np.ndarray,
    paints: tuple[str, ...],
) -> float:
    """Likeness of one figure, whose longer edge is its direction, to the most similar piece of a mark, in [0, 1]."""
    short, long = sorted((across, along), key=lambda edge: float(np.linalg.norm(edge)))
    width = 2 * float(np.linalg.norm(short))
    unit = (ends[:, 1] - ends[:, 0]) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)[:, None]
    turned = np.arccos(np.clip(np.abs(unit @ long) / np.linalg.norm(long), 0.0, 1.0))
    other = contrast(np.array([rgb_of(paint) for paint in paints]), cast("Rgb", tuple(colour.tolist())))
    alike = np.minimum(width, widths) / np.maximum(width, widths)
    alike = alike * np.clip(1 - turned / _OTHER_DIRECTION_RAD, 0, 1) * np.clip(1 - other / _OTHER_COLOUR, 0, 1)
    return float(alike.max())


def _apart_m(corners: Float[np.ndarray, "c 2"], ends: Float[np.ndarray, "s 2 2"]) -> Float[np.ndarray, " s"]:
    """Distance of a convex polygon from each of some segments; 0 where they touch."""
    edges = list(pairwise([*corners, corners[0]]))
    return np.array([0.0 if _inside(corners, p) else min(_between(p, q, a, b) for a, b in edges) for p, q in ends])


def _inside(corners: np.ndarray, point: np.ndarray) -> bool:
    way, gap = np.roll(corners, -1, axis=0) - corners, point - corners
    side = way[:, 0] * gap[:, 1] - way[:, 1] * gap[:, 0]
    return bool((side >= 0).all() or (side <= 0).all())


def _between(p: np.ndarray, q: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Distance between the segments from p to q and from a to b; 0 if they cross."""
    if _left(p, q, a) * _left(p, q, b) < 0 and _left(a, b, p) * _left(a, b, q) < 0:
        return 0.0
    return min(_to(p, a, b), _to(q, a, b), _to(a, p, q), _to(b, p, q))


def _left(p: np.ndarray, q: np.ndarray, at: np.ndarray) -> float:
    return float((q[0] - p[0]) * (at[1] - p[1]) - (q[1] - p[1]) * (at[0] - p[0]))


def _to(point: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    way = b - a
    share = np.clip(float((point - a) @ way) / max(float(way @ way), 1e-18), 0.0, 1.0)
    return float(np.linalg.norm(point - a - share * way))
