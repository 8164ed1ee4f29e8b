"""What lies between the arms of a junction: its area, and the kerbs and sidewalks round its corners.

OpenDRIVE gives the lanes that cross a junction, not its outline. Going round the arms counter-clockwise, the way from
one arm to the next bears furthest right of all, so the right borders of those ways are the outline, and the strips that
accompany the roads (shoulder, sidewalk) go on along it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from roadproof.roads.lanes import Lane, Line, lane_from_borders
from roadproof.roads.polylines import polyline_stations


@dataclass(frozen=True, slots=True, eq=False)
class JunctionArea:
    """The paved area of a junction: a counter-clockwise outline, not closed, (N, 3) in metres."""

    junction: str
    outline: Line


@dataclass(frozen=True, slots=True, eq=False)
class Corner:
    """A strip round a corner of a junction, and which strips it joins (indices of lanes)."""

    lane: Lane
    before: int
    after: int


def junction_areas(lanes: list[Lane]) -> tuple[list[JunctionArea], list[Corner]]:
    """Areas of all junctions, and corner strips where the file gives none."""
    areas: list[JunctionArea] = []
    corners: list[Corner] = []
    before = {after: lane for lane in lanes if lane.kind == "driving" for after in lane.successors}
    # In the file's order: a set of names would make results depend on Python's hash seed.
    for junction in dict.fromkeys(lane.junction for lane in lanes if lane.junction is not None):
        crossing = [lane for lane in lanes if lane.junction == junction]
        ways = _ways(crossing, lanes, before)
        if not ways:
            continue
        ring = _outer_ways(ways)
        outline = np.concatenate([_joined([lane.right for lane in way]) for way in ring])
        keep = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1) > 1e-3
        areas.append(JunctionArea(junction, outline[keep]))
        if all(lane.kind == "driving" for lane in crossing):
            for way in ring:
                corners += _corners(way, lanes, before)
    return areas, corners


def _ways(crossing: list[Lane], lanes: list[Lane], before: dict[int, Lane]) -> list[list[Lane]]:
    """Chains of driving lanes from an arm of the junction to an arm."""
    ways: list[list[Lane]] = []
    for lane in crossing:
        entry = before.get(lane.index)
        if lane.kind != "driving" or (entry is not None and entry.junction == lane.junction):
            continue
        open_ways = [[lane]]
        while open_ways:
            way = open_ways.pop()
            inside = [lanes[i] for i in way[-1].successors if lanes[i].junction == lane.junction]
            inside = [after for after in inside if after not in way]
            if inside:
                open_ways += [[*way, after] for after in inside]
            else:
                ways.append(way)
    return ways


def _outer_ways(ways: list[list[Lane]]) -> list[list[Lane]]:
    """For every arm the way that bears furthest right, in counter-clockwise order of the arms they start from."""
    ends = np.array([[way[0].left[0, :2], way[-1].left[-1, :2]] for way in ways])
    middle = ends.reshape(-1, 2).mean(axis=0)
    starts, goals = (np.arctan2(*(ends[:, k] - middle).T[::-1]) for k in (0, 1))
    # Ways that start at the same arm start from borders within a lane or two of each other.
    turn = (goals - starts) % (2 * math.pi)
    ring: list[list[Lane]] = []
    angles: list[float] = []
    order: list[int] = np.argsort(starts).tolist()
    for k in order:
        way = ways[k]
        heading = float(way[0].headings_rad[0])
        same = [
            j
            for j, other in enumerate(ring)
            if math.cos(float(other[0].headings_rad[0]) - heading) > 0.5
            and np.linalg.norm(other[0].centre[0] - way[0].centre[0]) < 12.0
        ]
        if not same:
            ring.append(way)
            angles.append(float(turn[k]))
        elif turn[k] < angles[same[0]]:
            ring[same[0]], angles[same[0]] = way, float(turn[k])
    return ring


def _joined(lines: list[Float[np.ndarray, "_ 3"]]) -> Line:
    return np.concatenate([lines[0], *(line[1:] for line in lines[1:])])


def _corners(way: list[Lane], lanes: list[Lane], before: dict[int, Lane]) -> list[Corner]:
    """Shoulder and sidewalk along the right of a way, from the strips before it to those after it, where they match."""
    entry = before.get(way[0].index)
    leaves = [lanes[i] for i in way[-1].successors]
    if entry is None or not leaves:
        return []
    strips = list(zip(_strips(entry, lanes), _strips(leaves[0], lanes), strict=False))
    border = _joined([lane.right for lane in way])
    across = border - _joined([lane.left for lane in way])
    outward = across / np.maximum(np.linalg.norm(across, axis=1), 1e-9)[:, None]
    stations = polyline_stations(border)
    share = (stations / max(float(stations[-1]), 1e-9))[:, None]
    corners: list[Corner] = []
    for place, (first, last) in enumerate(strips):
        if first.kind != last.kind:
            break
        width = (1.0 - share) * _width_at(first, -1) + share * _width_at(last, 0)
        further = border + outward * width
        strip = lane_from_borders(
            border,
            further,
            road=way[0].road,
            section=way[0].section,
            number=(way[0].number - 1 - place) if way[0].number < 0 else (way[0].number + 1 + place),
            kind=first.kind,
            junction=way[0].junction,
        )
        corners.append(Corner(strip, first.index, last.index))
        border = further
    return corners


def _width_at(lane: Lane, end: int) -> float:
    return float(np.linalg.norm(lane.left[end] - lane.right[end]))


def _strips(lane: Lane, lanes: list[Lane]) -> list[Lane]:
    """The lanes outside a driving lane, outwards."""
    beside = [
        other
        for other in lanes
        if other.road == lane.road and other.section == lane.section and other.number * lane.number > 0
    ]
    outside = [other for other in beside if abs(other.number) > abs(lane.number) and other.kind != "driving"]
    return sorted(outside, key=lambda other: abs(other.number))


def triangulated(outline: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3 3"]:
    """Triangles of a simple counter-clockwise polygon, by ear clipping.

    A polygon that crosses itself is covered as far as ears are found; the rest is left out.
    """
    left = list(range(len(outline)))
    flat = outline[:, :2]
    triangles: list[tuple[int, int, int]] = []
    while len(left) >= 3:
        a, b, c = (flat[np.roll(left, shift)] for shift in (1, 0, -1))
        area = _cross(b - a, c - a)
        order: list[int] = np.argsort(-area / (1e-9 + np.linalg.norm(c - a, axis=1))).tolist()
        for k in order:
            if area[k] <= 0:
                continue
            others = np.delete(b, [k, k - 1, (k + 1) % len(left)], axis=0)
            inside = np.ones(len(others), dtype=bool)
            for p, q in ((a[k], b[k]), (b[k], c[k]), (c[k], a[k])):
                inside &= _cross(q - p, others - p) > 1e-12
            if not inside.any():
                break
        else:
            break
        triangles.append((left[k - 1], left[k], left[(k + 1) % len(left)]))
        del left[k]
    return outline[np.array(triangles, dtype=np.intp).reshape(-1, 3)]


def _cross(u: Float[np.ndarray, "*_ 2"], v: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n"]:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
