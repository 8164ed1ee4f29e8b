"""What an OpenDRIVE file says, as records: roads and their curves, lanes, marks, links, ways through junctions.

Convention:
    s runs along a road's reference line, t to its left, both in metres. Lane numbers are negative right of the
    reference line (travelled along s) and positive left of it (travelled against s).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

Stations = Float[np.ndarray, " n"]
_USUAL_WIDTH_M, _NO_WIDTH_M = 0.15, 0.05
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


@dataclass(frozen=True, slots=True, eq=False)
class Cubics:
    """A piecewise cubic a + b·ds + c·ds² + d·ds³, ds counted from the start of its piece."""

    starts_m: Float[np.ndarray, " k"]
    coefficients: Float[np.ndarray, "k 4"]

    def __call__(self, s_m: Stations) -> Stations:
        """Values at stations s_m."""
        piece = np.maximum(np.searchsorted(self.starts_m, s_m, side="right") - 1, 0)
        ds = s_m - self.starts_m[piece]
        a, b, c, d = self.coefficients[piece].T
        return a + ds * (b + ds * (c + ds * d))


@dataclass(frozen=True, slots=True)
class Clothoid:
    """A curve whose curvature goes linearly from one value to another: line, arc and spiral."""

    start_curvature: float
    end_curvature: float

    def local(self, ds_m: Stations, length_m: float) -> tuple[Stations, Stations, Stations]:
        """Position (u, v) and heading in the frame of its start, by Gauss-Legendre quadrature of the heading."""
        rate = (self.end_curvature - self.start_curvature) / length_m
        heading = ds_m * (self.start_curvature + 0.5 * rate * ds_m)
        if self.start_curvature == 0.0 and self.end_curvature == 0.0:
            return ds_m, np.zeros_like(ds_m), heading
        at = 0.5 * ds_m[:, None] * (_NODES + 1.0)
        phase = at * (self.start_curvature + 0.5 * rate * at)
        half = 0.5 * ds_m
        return half * (np.cos(phase) @ _WEIGHTS), half * (np.sin(phase) @ _WEIGHTS), heading

    def max_curvature(self, length_m: float) -> float:
        """Largest curvature in 1/m, without sign, of a piece of this length."""
        del length_m
        return max(abs(self.start_curvature), abs(self.end_curvature))


@dataclass(frozen=True, slots=True)
class ParamCubic:
    """u(p), v(p) as cubics; p is the arc length, or runs from 0 to 1 where `normalized`."""

    u: tuple[float, float, float, float]
    v: tuple[float, float, float, float]
    normalized: bool

    def local(self, ds_m: Stations, length_m: float) -> tuple[Stations, Stations, Stations]:
        """Position (u, v) and heading in the frame of its start."""
        p = ds_m / length_m if self.normalized else ds_m
        powers = np.stack([np.ones_like(p), p, p * p, p**3])
        slopes = np.stack([np.zeros_like(p), np.ones_like(p), 2 * p, 3 * p * p])
        u, v = np.array(self.u), np.array(self.v)
        return u @ powers, v @ powers, np.unwrap(np.arctan2(v @ slopes, u @ slopes))

    def max_curvature(self, length_m: float) -> float:
        """Largest curvature in 1/m, without sign, over 33 points of a piece of this length."""
        p = np.linspace(0.0, 1.0 if self.normalized else length_m, 33)
        u, v = np.polynomial.Polynomial(self.u), np.polynomial.Polynomial(self.v)
        du, dv, ddu, ddv = u.deriv()(p), v.deriv()(p), u.deriv(2)(p), v.deriv(2)(p)
        return float(np.max(np.abs(du * ddv - dv * ddu) / np.maximum(du * du + dv * dv, 1e-9) ** 1.5))


@dataclass(frozen=True, slots=True)
class Geometry:
    """One piece of a reference line: where it starts, how long it is and its shape."""

    s_m: float
    x_m: float
    y_m: float
    heading_rad: float
    length_m: float
    shape: Clothoid | ParamCubic


@dataclass(frozen=True, slots=True)
class MarkRecord:
    """A line painted on the outer border of a lane, from `offset_m` after the start of its section on.

    Args:
        offset_m: the beginning of the line, metres along the reference line from the start of the section.
        kind: "solid", "broken", "solid solid" …
        colour: "white", "yellow" …
        width_m: width of one strand, metres.
    """

    offset_m: float
    kind: str
    colour: str
    width_m: float

    @property
    def painted_width_m(self) -> float:
        """Width of one strand on the road; that of usual lines where a file gives hardly any."""
        return self.width_m if self.width_m > _NO_WIDTH_M else _USUAL_WIDTH_M


@dataclass(frozen=True, slots=True, eq=False)
class LaneRecord:
    """One lane of one section; lane 0 has no width and carries the centre line's marks."""

    number: int
    kind: str
    width: Cubics | None
    marks: tuple[MarkRecord, ...]
    predecessor: int | None
    successor: int | None


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """A stretch of road with a fixed set of lanes, from `start_m` to `end_m`."""

    start_m: float
    end_m: float
    lanes: dict[int, LaneRecord]


@dataclass(frozen=True, slots=True)
class RoadLink:
    """What a road's end touches: an end of another road, or a junction (no contact)."""

    kind: Literal["road", "junction"]
    target: str
    contact: Literal["start", "end"] | None


@dataclass(frozen=True, slots=True, eq=False)
class Road:
    """A reference line and the lanes along it."""

    name: str
    length_m: float
    junction: str | None
    predecessor: RoadLink | None
    successor: RoadLink | None
    plan: tuple[Geometry, ...]
    elevation: Cubics
    lane_offset: Cubics
    sections: tuple[Section, ...]

    def reference(self, s_m: Stations) -> tuple[Float[np.ndarray, "n 2"], Stations]:
        """Position (x, y) and heading of the reference line at stations s_m."""
        points, headings = np.empty((len(s_m), 2)), np.empty(len(s_m))
        starts = np.array([piece.s_m for piece in self.plan])
        owner = np.clip(np.searchsorted(starts, s_m, side="right") - 1, 0, None)
        pieces: list[int] = np.unique(owner).tolist()
        for k in pieces:
            piece, mine = self.plan[k], owner == k
            u, v, turn = piece.shape.local(s_m[mine] - piece.s_m, piece.length_m)
            c, s = math.cos(piece.heading_rad), math.sin(piece.heading_rad)
            points[mine] = np.stack([piece.x_m + c * u - s * v, piece.y_m + s * u + c * v], axis=1)
            headings[mine] = piece.heading_rad + turn
        return points, headings


@dataclass(frozen=True, slots=True)
class Connection:
    """A way through a junction: from a road onto a connecting road, lane by lane (from, to)."""

    incoming: str
    connecting: str
    contact: Literal["start", "end"]
    lane_links: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, eq=False)
class OpenDrive:
    """What a file says: roads by id, connections by junction id."""

    roads: dict[str, Road]
    junctions: dict[str, tuple[Connection, ...]]
