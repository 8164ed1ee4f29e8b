"""Writes the built-in towns as OpenDRIVE: `python tools/make_town.py`.

A town is a list of junctions and of streets between them. A street is a polyline whose corners are rounded by arcs or
by spirals with an arc between them; in a junction every pair of arms is joined by an arc of its own.

Needs scenariogeneration (`pip install --group dev`).
"""

from __future__ import annotations

import argparse
import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scenariogeneration import xodr

from roadproof.roads.records import Clothoid

ASSETS = Path(__file__).parents[1] / "src" / "roadproof" / "roads" / "assets"
SHOULDER_M, SIDEWALK_M, MARK_M = 0.4, 2.6, 0.15


@dataclass(frozen=True)
class Bend:
    """A corner of a street, rounded by an arc of this radius, with spirals of this length before and after it."""

    x_m: float
    y_m: float
    radius_m: float
    spiral_m: float = 0.0


@dataclass(frozen=True)
class Street:
    """A road from a junction to a junction: its bends, its centre line and whether its edges are painted."""

    start: str
    end: str
    bends: tuple[Bend, ...] = ()
    centre: str = "broken yellow"
    edges: bool = True


@dataclass(frozen=True)
class Town:
    """Junctions by name, (x, y) in metres, and streets; `arm_m` from a junction's middle to where its streets end."""

    name: str
    lane_m: float
    arm_m: float
    junctions: dict[str, tuple[float, float]]
    streets: tuple[Street, ...]


TOWN = Town(
    name="town",
    lane_m=3.5,
    arm_m=12.0,
    junctions={
        "south-west": (95.0, 0.0),
        "south-east": (205.0, 0.0),
        "east-low": (290.0, 110.0),
        "east-high": (290.0, 175.0),
        "north-east": (205.0, 250.0),
        "north-west": (70.0, 250.0),
        "west-high": (0.0, 170.0),
        "west-low": (0.0, 85.0),
        "cross-low": (95.0, 85.0),
        "cross-high": (95.0, 170.0),
        "middle": (150.0, 85.0),
        "centre-east": (205.0, 85.0),
    },
    streets=(
        # The ring, counter-clockwise from the south-west corner, each corner with a radius of its own.
        Street("west-low", "south-west", (Bend(0.0, 0.0, 30.0),), "solid yellow"),
        Street("south-west", "south-east", centre="broken white"),
        Street("south-east", "east-low", (Bend(290.0, 0.0, 32.0, 16.0),), "solid yellow"),
        Street("east-low", "east-high", centre="broken yellow"),
        Street("east-high", "north-east", (Bend(290.0, 250.0, 16.0),), "solid white"),
        Street("north-east", "north-west", centre="broken white"),
        Street("north-west", "west-high", (Bend(0.0, 250.0, 22.0),), "solid yellow"),
        Street("west-high", "west-low", centre="broken yellow"),
        # Inside.
        Street("west-low", "cross-low", centre="broken yellow", edges=False),
        Street("west-high", "cross-high", centre="broken white", edges=False),
        Street("south-west", "cross-low", centre="broken yellow"),
        Street("cross-low", "cross-high", centre="solid solid yellow"),
        Street(
            "cross-high", "north-west", (Bend(95.0, 203.0, 22.0), Bend(70.0, 225.0, 16.0)), "solid white", edges=False
        ),
        Street("cross-low", "middle", centre="broken white", edges=False),
        Street("middle", "centre-east", centre="broken white", edges=False),
        Street("south-east", "centre-east", centre="broken yellow"),
        Street("centre-east", "east-low", (Bend(235.0, 85.0, 26.0), Bend(262.0, 110.0, 26.0)), "solid yellow"),
        Street("cross-high", "middle", (Bend(150.0, 170.0, 18.0, 6.0),), "solid yellow"),
        Street("north-east", "east-high", (Bend(205.0, 175.0, 26.0),), "broken white"),
    ),
)

SECOND = Town(
    name="second",
    lane_m=3.3,
    arm_m=14.0,
    junctions={
        "south": (130.0, -10.0),
        "east": (280.0, 60.0),
        "north": (100.0, 240.0),
        "west": (10.0, 110.0),
        "centre": (150.0, 110.0),
        "fork": (75.0, 110.0),
        "lane-end": (139.0, 44.0),
    },
    streets=(
        Street("west", "south", (Bend(0.0, 0.0, 25.0),), "broken white"),
        Street("south", "east", (Bend(260.0, -20.0, 20.0, 8.0),), "broken white"),
        Street("east", "north", (Bend(300.0, 140.0, 38.0), Bend(180.0, 260.0, 24.0)), "solid yellow"),
        Street("north", "west", (Bend(20.0, 220.0, 28.0),), "broken white"),
        Street("west", "fork", centre="solid white", edges=False),
        Street("fork", "centre", centre="solid white", edges=False),
        Street("south", "lane-end", centre="broken yellow"),
        Street("lane-end", "centre", centre="broken yellow"),
        Street("east", "centre", (Bend(215.0, 70.0, 30.0),), "solid solid yellow"),
        Street("centre", "north", (Bend(140.0, 170.0, 34.0),), "broken yellow", edges=False),
        Street("fork", "lane-end", (Bend(75.0, 44.0, 17.0),), "broken white", edges=False),
    ),
)

Piece = tuple[float, float, float]
"""Length and the curvature at both ends."""


class Pen:
    """Draws consecutive pieces of a reference line from a pose."""

    def __init__(self, x_m: float, y_m: float, heading_rad: float) -> None:
        self.x_m, self.y_m, self.heading_rad, self.s_m = x_m, y_m, heading_rad, 0.0
        self.plan = xodr.PlanView()

    def draw(self, piece: Piece) -> None:
        """Add a line, arc or spiral."""
        length, start, end = piece
        if length < 1e-6:
            return
        shape = xodr.Line(_r(length)) if start == end == 0 else xodr.Spiral(_r(start), _r(end), _r(length))
        if start == end != 0:
            shape = xodr.Arc(_r(start), length=_r(length))
        self.plan.add_fixed_geometry(shape, _r(self.x_m), _r(self.y_m), _r(self.heading_rad), _r(self.s_m))
        dx, dy, turn = advance(piece)
        c, s = math.cos(self.heading_rad), math.sin(self.heading_rad)
        self.x_m, self.y_m = self.x_m + c * dx - s * dy, self.y_m + s * dx + c * dy
        self.heading_rad += turn
        self.s_m += length


def _r(value: float) -> float:
    return round(value, 9) + 0.0


def advance(piece: Piece) -> tuple[float, float, float]:
    """Where a piece leads in the frame of its start: (x, y, heading)."""
    length, start, end = piece
    x, y, heading = Clothoid(start, end).local(np.array([length]), length)
    return float(x[0]), float(y[0]), float(heading[0])


def bend_pieces(turn_rad: float, radius_m: float, spiral_m: float) -> tuple[list[Piece], float]:
    """Pieces of a bend and the distance from its start to the corner it rounds."""
    curvature = math.copysign(1.0 / radius_m, turn_rad)
    arc_m = radius_m * abs(turn_rad) - spiral_m
    pieces = [(spiral_m, 0.0, curvature), (arc_m, curvature, curvature), (spiral_m, curvature, 0.0)]
    pieces = [piece for piece in pieces if piece[0] > 0]
    if arc_m <= 0:
        raise ValueError(f"spirals of {spiral_m} m leave no arc in a bend of {radius_m} m")
    x = y = heading = 0.0
    for piece in pieces:
        dx, dy, turn = advance(piece)
        x, y = x + math.cos(heading) * dx - math.sin(heading) * dy, y + math.sin(heading) * dx + math.cos(heading) * dy
        heading += turn
    return pieces, x - y / math.tan(turn_rad)


def _heading(a: tuple[float, float], b: tuple[float, float]) -> float:
    return math.atan2(b[1] - a[1], b[0] - a[0])


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % (2 * math.pi) - math.pi


def _colour(name: str) -> xodr.RoadMarkColor:
    return xodr.RoadMarkColor.yellow if name == "yellow" else xodr.RoadMarkColor.white


def street_lanes(town: Town, street: Street) -> xodr.Lanes:
    """Two driving lanes with shoulder and sidewalk on both sides."""
    kind, colour = street.centre.rsplit(" ", 1)
    middle = xodr.Lane(a=0.0)
    middle.add_roadmark(xodr.RoadMark(xodr.RoadMarkType[kind.replace(" ", "_")], MARK_M, color=_colour(colour)))
    section = xodr.LaneSection(0, middle)
    for add in (section.add_left_lane, section.add_right_lane):
        lane = xodr.Lane(xodr.LaneType.driving, a=town.lane_m)
        edge = xodr.RoadMarkType.solid if street.edges else xodr.RoadMarkType.none
        lane.add_roadmark(xodr.RoadMark(edge, MARK_M, color=xodr.RoadMarkColor.white))
        shoulder = xodr.Lane(xodr.LaneType.shoulder, a=SHOULDER_M)
        shoulder.add_roadmark(xodr.RoadMark(xodr.RoadMarkType.curb, MARK_M))
        for strip in (lane, shoulder, xodr.Lane(xodr.LaneType.sidewalk, a=SIDEWALK_M)):
            add(strip)
    return xodr.Lanes().add_lanesection(section)


def street_plan(town: Town, street: Street) -> xodr.PlanView:
    """The reference line from arm to arm."""
    corners = [town.junctions[street.start], *((b.x_m, b.y_m) for b in street.bends), town.junctions[street.end]]
    headings = [_heading(a, b) for a, b in pairwise(corners)]
    rounded = [
        bend_pieces(_wrapped(after - before), bend.radius_m, bend.spiral_m)
        for bend, before, after in zip(street.bends, headings[:-1], headings[1:], strict=True)
    ]
    taken = [town.arm_m, *(tangent for _, tangent in rounded), town.arm_m]
    start = corners[0]
    pen = Pen(start[0] + town.arm_m * math.cos(headings[0]), start[1] + town.arm_m * math.sin(headings[0]), headings[0])
    for k, (a, b) in enumerate(pairwise(corners)):
        straight = math.dist(a, b) - taken[k] - taken[k + 1]
        if straight < 0:
            raise ValueError(f"street {street.start} to {street.end}: its bends overlap by {-straight:.1f} m")
        pen.draw((straight, 0.0, 0.0))
        for piece in rounded[k][0] if k < len(rounded) else []:
            pen.draw(piece)
    return pen.plan


@dataclass(frozen=True)
class Arm:
    """An end of a street at a junction: the street's id, which end, and the heading away from the junction."""

    road: int
    contact: xodr.ContactPoint
    heading_rad: float


def build(town: Town) -> xodr.OpenDrive:
    """The town as roads and junctions."""
    drive = xodr.OpenDrive(town.name)
    arms: dict[str, list[Arm]] = {name: [] for name in town.junctions}
    numbers = {name: 1000 + k for k, name in enumerate(town.junctions)}
    for number, street in enumerate(town.streets):
        road = xodr.Road(number, street_plan(town, street), street_lanes(town, street), name=f"street {number}")
        road.add_predecessor(xodr.ElementType.junction, numbers[street.start])
        road.add_successor(xodr.ElementType.junction, numbers[street.end])
        drive.add_road(road)
        corners = [town.junctions[street.start], *((b.x_m, b.y_m) for b in street.bends), town.junctions[street.end]]
        arms[street.start].append(Arm(number, xodr.ContactPoint.start, _heading(corners[0], corners[1])))
        arms[street.end].append(Arm(number, xodr.ContactPoint.end, _heading(corners[-1], corners[-2])))
    next_road = 100
    for name, here in arms.items():
        junction = xodr.Junction(name, numbers[name])
        for entry in here:
            for leave in here:
                if entry is not leave:
                    drive.add_road(connecting_road(town, name, next_road, entry, leave, numbers[name]))
                    connection = xodr.Connection(entry.road, next_road, xodr.ContactPoint.start)
                    connection.add_lanelink(-1 if entry.contact == xodr.ContactPoint.end else 1, -1)
                    junction.add_connection(connection)
                    next_road += 1
        drive.add_junction(junction)
    return drive


def connecting_road(town: Town, name: str, number: int, entry: Arm, leave: Arm, junction: int) -> xodr.Road:
    """One lane from an arm to another."""
    x, y = town.junctions[name]
    inwards = entry.heading_rad + math.pi
    turn = _wrapped(leave.heading_rad - inwards)
    start_x, start_y = (x + town.arm_m * math.cos(entry.heading_rad), y + town.arm_m * math.sin(entry.heading_rad))
    pen = Pen(start_x, start_y, _wrapped(inwards))
    if abs(turn) < 1e-9:
        pen.draw((2 * town.arm_m, 0.0, 0.0))
    else:
        radius = town.arm_m / math.tan(abs(turn) / 2)
        pen.draw((radius * abs(turn), math.copysign(1 / radius, turn), math.copysign(1 / radius, turn)))
    section = xodr.LaneSection(0, xodr.Lane(a=0.0))
    lane = xodr.Lane(xodr.LaneType.driving, a=town.lane_m)
    lane.add_link("predecessor", -1 if entry.contact == xodr.ContactPoint.end else 1)
    lane.add_link("successor", -1 if leave.contact == xodr.ContactPoint.start else 1)
    section.add_right_lane(lane)
    road = xodr.Road(number, pen.plan, xodr.Lanes().add_lanesection(section), road_type=junction)
    road.add_predecessor(xodr.ElementType.road, entry.road, entry.contact)
    road.add_successor(xodr.ElementType.road, leave.road, leave.contact)
    return road


def written(town: Town) -> str:
    """The town as text; the same every time."""
    root = build(town).get_element()
    header = root.find("header")
    assert header is not None
    del header.attrib["date"]
    for side in ("north", "south", "east", "west"):
        del header.attrib[side]
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def main() -> None:
    """Write both towns."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ASSETS, help="folder to write to")
    folder: Path = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    for town in (TOWN, SECOND):
        (folder / f"{town.name}.xodr").write_text(written(town), encoding="utf-8")


if __name__ == "__main__":
    main()
