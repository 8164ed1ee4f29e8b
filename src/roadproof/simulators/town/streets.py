"""What is built on the ground of a map: kerbs, pavements, painted lines, stop lines and zebra crossings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from roadproof.roads.lanes import Lane, MarkLine
from roadproof.roads.polylines import interpolated, polyline_stations
from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.town.meshes import Mesh, MeshBuilder

SEED = 30
KERB_M = 0.13
KERB_STONE_M = 0.22
PAVEMENT_STEP_M, KERB_STEP_M, PAINT_STEP_M = 2.0, 5.0, 2.5
DASH_M, GAP_M = 3.0, 4.5
CROSSING_M = (1.6, 4.2)
STOP_LINE_M = 5.2
SLAB_TILE_M = 2.0

PAINT = {"white": (0.87, 0.87, 0.85), "yellow": (0.84, 0.66, 0.24)}
STONE = (0.70, 0.69, 0.67)

Line = Float[np.ndarray, "n 3"]


@dataclass(frozen=True, slots=True, eq=False)
class Streets:
    """Meshes of the streets.

    Args:
        pavement: tops of the sidewalks, at kerb height; their albedo is in the ground's picture.
        kerbs: the kerb stones.
        paint: everything painted, flat on the road.
    """

    pavement: Mesh
    kerbs: Mesh
    paint: Mesh


def build_streets(roads: RoadMap) -> Streets:
    """Meshes of a map's streets; chance picks which arms of junctions have a zebra crossing."""
    pavement, kerbs, paint = MeshBuilder(), MeshBuilder(), MeshBuilder()
    for lane in roads.lanes:
        if lane.kind == "sidewalk":
            _sidewalk(pavement, kerbs, lane)
    for line in roads.mark_lines:
        # Files paint every way through a junction; real junctions are bare.
        if line.junction is None:
            _mark(paint, line)
    rng = np.random.default_rng(SEED)
    for lane in roads.lanes:
        ahead = [roads.lanes[i] for i in lane.successors]
        if lane.kind == "driving" and lane.junction is None and any(after.junction is not None for after in ahead):
            _arm(paint, roads, lane, crossing=bool(rng.random() < 0.6))
    return Streets(pavement.build(), kerbs.build(), paint.build())


def _sidewalk(pavement: MeshBuilder, kerbs: MeshBuilder, lane: Lane) -> None:
    lift = np.array([0.0, 0.0, KERB_M])
    width = np.linalg.norm(lane.right - lane.left, axis=1, keepdims=True)
    if width.max() < 2 * KERB_STONE_M:
        return
    inner = lane.left + (lane.right - lane.left) * np.minimum(KERB_STONE_M / np.maximum(width, 1e-6), 1.0)
    keep = _thinned(lane.left, PAVEMENT_STEP_M)
    top, back = inner[keep] + lift, lane.right[keep] + lift
    pavement.ribbon(top, back, uv=np.concatenate([top[:, :2], back[:, :2]]) / SLAB_TILE_M)
    keep = _thinned(lane.left, KERB_STEP_M)
    foot, edge = lane.left[keep], lane.left[keep] + lift
    kerbs.ribbon(foot, edge, (0.86 * STONE[0], 0.86 * STONE[1], 0.86 * STONE[2]))
    kerbs.ribbon(edge, inner[keep] + lift, STONE)


def _thinned(line: Line, spacing_m: float) -> np.ndarray:
    """Indices that keep the ends, every bend, and a point every `spacing_m`."""
    chosen = [0]
    heading = np.arctan2(*np.diff(line[:, :2], axis=0).T[::-1])
    for i in range(1, len(line) - 1):
        last = chosen[-1]
        far = np.linalg.norm(line[i + 1] - line[last]) > spacing_m
        turned = abs((heading[i] - heading[last] + np.pi) % (2 * np.pi) - np.pi) > 0.05
        if far or turned:
            chosen.append(i)
    chosen.append(len(line) - 1)
    return np.array(chosen)


def _mark(paint: MeshBuilder, line: MarkLine) -> None:
    colour = PAINT.get(line.mark.colour, PAINT["white"])
    width = line.mark.painted_width_m
    kinds = line.mark.kind.split()
    for i, kind in enumerate(kinds):
        shift = (len(kinds) - 1) * width - 2 * width * i
        stations = polyline_stations(line.points)
        if stations[-1] < 0.3:
            continue
        pieces = [(0.0, float(stations[-1]))] if kind == "solid" else _dashes(line.start_m, float(stations[-1]))
        for start, end in pieces:
            _stripe(paint, line.points, stations, (start, end), shift, width, colour)


def _dashes(start_m: float, length_m: float) -> list[tuple[float, float]]:
    period = DASH_M + GAP_M
    first = -(start_m % period)
    begins = np.arange(first, length_m, period)
    clipped = [(max(float(b), 0.0), min(float(b) + DASH_M, length_m)) for b in begins]
    return [(b, e) for b, e in clipped if e - b > 0.3]


def _stripe(
    paint: MeshBuilder,
    points: Line,
    stations: Float[np.ndarray, " n"],
    span: tuple[float, float],
    shift_m: float,
    width_m: float,
    colour: tuple[float, float, float],
) -> None:
    """A painted strip along part of a line, worn here and there."""
    inside = points[(stations > span[0]) & (stations < span[1])]
    bends = len(inside) > 2 and float(np.linalg.norm(inside[0] - 2 * inside[len(inside) // 2] + inside[-1])) > 0.05
    count = max(2, int(np.ceil((span[1] - span[0]) / (1.0 if bends else PAINT_STEP_M))) + 1)
    s = np.linspace(*span, count)
    centre = interpolated(s, stations, points)
    along = np.gradient(centre[:, :2], axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    left = np.column_stack([-along[:, 1], along[:, 0], np.zeros(count)])
    worn = 0.90 + 0.07 * np.sin(centre[:, :1] * 0.37 + centre[:, 1:2] * 0.23)
    albedo = np.tile(worn * np.array(colour), (2, 1))
    paint.ribbon(centre + left * (shift_m + width_m / 2), centre + left * (shift_m - width_m / 2), albedo)


def _arm(paint: MeshBuilder, roads: RoadMap, lane: Lane, *, crossing: bool) -> None:
    """A stop line before a junction and, maybe, a zebra crossing over the whole road."""
    if lane.length_m < 12.0:
        return
    stop = STOP_LINE_M if crossing else 0.9
    _across(paint, lane, lane.length_m - stop, 0.4)
    if not crossing:
        return
    for other in roads.lanes:
        if other.road != lane.road or other.kind != "driving" or other.section != lane.section:
            continue
        at_end = np.sign(other.number) == np.sign(lane.number)
        near, far = CROSSING_M
        span = (other.length_m - far, other.length_m - near) if at_end else (near, far)
        _zebra(paint, other, span)


def _at(lane: Lane, station_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Left and right border of a lane at a station."""
    left, right = (interpolated(station_m, lane.stations_m, border) for border in (lane.left, lane.right))
    return left, right


def _across(paint: MeshBuilder, lane: Lane, station_m: float, length_m: float) -> None:
    (l0, r0), (l1, r1) = _at(lane, station_m), _at(lane, station_m + length_m)
    inset = 0.06
    corners = [l0 + inset * (r0 - l0), r0 - inset * (r0 - l0), r1 - inset * (r1 - l1), l1 + inset * (r1 - l1)]
    paint.quad(np.array(corners), albedo=PAINT["white"])


def _zebra(paint: MeshBuilder, lane: Lane, span: tuple[float, float]) -> None:
    (l0, r0), (l1, r1) = _at(lane, span[0]), _at(lane, span[1])
    bars = max(2, round(float(np.linalg.norm(r0 - l0))))
    for i in range(bars):
        a, b = (i + 0.25) / bars, (i + 0.75) / bars
        corners = [l0 + a * (r0 - l0), l0 + b * (r0 - l0), l1 + b * (r1 - l1), l1 + a * (r1 - l1)]
        paint.quad(np.array(corners), albedo=PAINT["white"])
