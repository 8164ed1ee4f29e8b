"""Lanes as polylines, and what follows what: made from an OpenDRIVE file, once, when a map is loaded."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float

from roadproof.errors import ScenarioError
from roadproof.roads.opendrive import MAX_WIDTH_M
from roadproof.roads.polylines import interpolated, polyline_stations
from roadproof.roads.records import LaneRecord, MarkRecord, OpenDrive, Road, Section

Line = Float[np.ndarray, "n 3"]

STEP_M = 1.0
CHORD_ERROR_M = 0.002
JOINT_GAP_M = 0.5
UNPAINTED = ("none", "curb")


@dataclass(frozen=True, slots=True, eq=False)
class MarkLine:
    """A stretch of painted line, once for both lanes it divides; `start_m` is its station, for the phase of dashes."""

    mark: MarkRecord
    points: Line
    start_m: float
    junction: str | None


@dataclass(frozen=True, slots=True, eq=False)
class Lane:
    """One lane of one section of a road.

    Args:
        index: its place in the map's list of lanes.
        road: id of the road that the lane belongs to.
        section: index of its section along the road.
        number: OpenDRIVE's number of the lane; negative runs along the road, positive against it.
        kind: "driving", "sidewalk", "shoulder" …
        centre: points in the direction of travel, at most a metre apart, closer in bends, (N, 3), metres.
        left: points of its left border, one for each point of the centre, (N, 3), metres.
        right: points of its right border, one for each point of the centre, (N, 3), metres.
        headings_rad: direction of travel at each point of the centre.
        stations_m: arc length of the centre up to each of its points.
        successors: indices of the lanes that go on from its end.
        junction: id of the junction it lies in; None outside junctions.
    """

    index: int
    road: str
    section: int
    number: int
    kind: str
    centre: Line
    left: Line
    right: Line
    headings_rad: Float[np.ndarray, " n"]
    stations_m: Float[np.ndarray, " n"]
    successors: tuple[int, ...]
    junction: str | None

    @property
    def length_m(self) -> float:
        """Arc length of its centre."""
        return float(self.stations_m[-1])

    @property
    def width_m(self) -> float:
        """Its largest width."""
        return float(np.linalg.norm(self.left - self.right, axis=1).max())

    def width_at(self, station_m: float) -> float:
        """Width at a station, metres."""
        across = interpolated(station_m, self.stations_m, self.left - self.right)
        return float(np.linalg.norm(across[:2]))

    def at(self, station_m: float) -> tuple[float, float, float, float]:
        """(x, y, z, heading) of its centre at an arc length, held at both ends."""
        x, y, z = interpolated(station_m, self.stations_m, self.centre).tolist()
        return x, y, z, float(np.interp(station_m, self.stations_m, self.headings_rad))


def lane_from_borders(
    left: Line, right: Line, *, road: str, section: int, number: int, kind: str, junction: str | None
) -> Lane:
    """A lane between two borders given in the direction of travel; its index and successors are still to be set."""
    centre = 0.5 * (left + right)
    stations = polyline_stations(centre)
    across = left - right
    if stations[-1] > 1e-3:
        along = np.gradient(centre[:, :2], axis=0)
    else:
        along = np.stack([across[:, 1], -across[:, 0]], axis=1)
    return Lane(
        index=-1,
        road=road,
        section=section,
        number=number,
        kind=kind,
        centre=centre,
        left=left,
        right=right,
        headings_rad=np.unwrap(np.arctan2(along[:, 1], along[:, 0])),
        stations_m=stations,
        successors=(),
        junction=junction,
    )


def build_lanes(drive: OpenDrive) -> tuple[list[Lane], list[MarkLine]]:
    """All lanes, with successors, and all painted lines of a file."""
    lanes: list[Lane] = []
    marks: list[MarkLine] = []
    for road in drive.roads.values():
        for k, section in enumerate(road.sections):
            borders = _borders(road, section)
            lanes += [
                _lane(road, k, record, borders) for record in section.lanes.values() if record.number in borders.inner
            ]
            for record in section.lanes.values():
                marks += _mark_lines(road, section, record, borders)
    lanes = [replace(lane, index=i) for i, lane in enumerate(lanes)]
    by_place = {(lane.road, lane.section, lane.number): lane for lane in lanes}
    return [replace(lane, successors=_successors(drive, lane, by_place)) for lane in lanes], marks


@dataclass(frozen=True, slots=True, eq=False)
class _Borders:
    """Lane borders of one section at common stations: `inner` and `outer` lateral offsets by lane number."""

    s_m: Float[np.ndarray, " n"]
    points: Line
    normals: Line
    centre_m: Float[np.ndarray, " n"]
    inner: dict[int, Float[np.ndarray, " n"]]
    outer: dict[int, Float[np.ndarray, " n"]]

    def line(self, offset_m: Float[np.ndarray, " n"]) -> Line:
        return self.points + self.normals * offset_m[:, None]


def _stations(road: Road, section: Section) -> Float[np.ndarray, " n"]:
    """Stations of a section, close enough for the chord error, with every change of geometry among them."""
    cuts = [section.start_m, section.end_m]
    cuts += [piece.s_m for piece in road.plan if section.start_m < piece.s_m < section.end_m]
    cuts.sort()
    parts: list[Float[np.ndarray, " n"]] = []
    for start, end in pairwise(cuts):
        here = [p for p in road.plan if p.s_m <= 0.5 * (start + end)] or [road.plan[0]]
        curvature = here[-1].shape.max_curvature(here[-1].length_m)
        step = min(STEP_M, math.sqrt(8.0 * CHORD_ERROR_M / curvature)) if curvature > 0 else STEP_M
        parts.append(np.linspace(start, end, max(1, math.ceil((end - start) / step)) + 1)[:-1])
    return np.concatenate([*parts, [section.end_m]])


def _borders(road: Road, section: Section) -> _Borders:
    s = _stations(road, section)
    inside = np.minimum(s, max(section.end_m - 1e-9, section.start_m))
    ground, headings = road.reference(s)
    points = np.column_stack([ground, road.elevation(s)])
    normals = np.column_stack([-np.sin(headings), np.cos(headings), np.zeros_like(s)])
    centre = road.lane_offset(inside)
    inner: dict[int, Float[np.ndarray, " n"]] = {}
    outer: dict[int, Float[np.ndarray, " n"]] = {}
    for side in (1, -1):
        edge = centre
        number = side
        while (record := section.lanes.get(number)) is not None:
            assert record.width is not None
            width = np.maximum(record.width(inside - section.start_m), 0.0)
            if width.max() > MAX_WIDTH_M:
                raise ScenarioError(
                    f"road {road.name}: lane {number} is {width.max():.0f} m wide, expected at most {MAX_WIDTH_M:.0f}"
                )
            inner[number], edge = edge, edge + side * width
            outer[number] = edge
            number += side
    missing = [n for n in section.lanes if n != 0 and n not in inner]
    if missing:
        raise ScenarioError(f"road {road.name}: lane {missing[0]} has no neighbour towards the centre line")
    return _Borders(s, points, normals, centre, inner, outer)


def _lane(road: Road, k: int, record: LaneRecord, borders: _Borders) -> Lane:
    number = record.number
    left, right = borders.line(borders.inner[number]), borders.line(borders.outer[number])
    if number > 0:
        left, right = left[::-1].copy(), right[::-1].copy()
    return lane_from_borders(
        left, right, road=road.name, section=k, number=number, kind=record.kind, junction=road.junction
    )


def _mark_lines(road: Road, section: Section, record: LaneRecord, borders: _Borders) -> Iterable[MarkLine]:
    line = borders.line(borders.centre_m if record.number == 0 else borders.outer[record.number])
    starts = [*(section.start_m + mark.offset_m for mark in record.marks), section.end_m]
    for mark, (start, end) in zip(record.marks, pairwise(starts), strict=True):
        end = min(end, section.end_m)
        if mark.kind in UNPAINTED or end - start <= 1e-6:
            continue
        start = max(start, section.start_m)
        s = np.concatenate([[start], borders.s_m[(borders.s_m > start + 1e-6) & (borders.s_m < end - 1e-6)], [end]])
        yield MarkLine(mark, interpolated(s, borders.s_m, line), start, road.junction)


def _successors(drive: OpenDrive, lane: Lane, by_place: dict[tuple[str, int, int], Lane]) -> tuple[int, ...]:
    road = drive.roads[lane.road]
    along = lane.number < 0
    record = road.sections[lane.section].lanes[lane.number]
    next_number = record.successor if along else record.predecessor
    next_section = lane.section + (1 if along else -1)
    if 0 <= next_section < len(road.sections):
        after = by_place.get((lane.road, next_section, next_number)) if next_number is not None else None
        return () if after is None else (after.index,)
    link = road.successor if along else road.predecessor
    if link is None:
        return ()
    found: list[Lane] = []
    if link.kind == "road":
        if next_number is not None and link.contact is not None:
            found += _at_contact(drive, link.target, link.contact, next_number, by_place, f"road {road.name}")
    else:
        if link.target not in drive.junctions:
            raise ScenarioError(
                f"road {road.name}: <{'successor' if along else 'predecessor'}> names junction "
                f"{link.target}, which is not in the file"
            )
        for way in drive.junctions[link.target]:
            for start, end in way.lane_links:
                if way.incoming == road.name and start == lane.number:
                    found += _at_contact(drive, way.connecting, way.contact, end, by_place, f"junction {link.target}")
    both_ends = road.successor == road.predecessor
    gaps = [float(np.linalg.norm(other.centre[0] - lane.centre[-1])) for other in found]
    for other, gap in zip(found, gaps, strict=True):
        if gap > JOINT_GAP_M and not both_ends and lane.kind == "driving" == other.kind:
            raise ScenarioError(
                f"road {road.name}: lane {lane.number} ends {gap:.2f} m from lane {other.number} of road {other.road} "
                f"that it is linked to, expected at most {JOINT_GAP_M} m; check <link> and <junction>"
            )
    return tuple(other.index for other, gap in zip(found, gaps, strict=True) if gap <= JOINT_GAP_M)


def _at_contact(
    drive: OpenDrive, road: str, contact: str, number: int, by_place: dict[tuple[str, int, int], Lane], where: str
) -> list[Lane]:
    """The lane one drives onto at an end of a road; none where it leads towards that end, not away from it."""
    if road not in drive.roads:
        raise ScenarioError(f"{where}: links to road {road}, which is not in the file")
    section = 0 if contact == "start" else len(drive.roads[road].sections) - 1
    lane = by_place.get((road, section, number))
    leads_away = (number < 0) == (contact == "start")
    return [] if lane is None or not leads_away else [lane]
