"""Reads the part of ASAM OpenDRIVE that towns use into the records of `roads.records`.

Lines, arcs, spirals and parametric cubics; elevation; lane offsets, sections, widths and road marks; links, junctions
and their lane links. What would change the shape of a road and is not read (superelevation, lane borders, `poly3`,
left-hand traffic, virtual junctions) is refused by name; what would not (signals, objects, user data) is skipped.

References:
    ASAM OpenDRIVE 1.7, chapters 7 to 10.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import numpy as np

from roadproof.errors import ScenarioError
from roadproof.io.files import open_file
from roadproof.io.tables import first_twice
from roadproof.roads.records import (
    Clothoid,
    Connection,
    Cubics,
    Geometry,
    LaneRecord,
    MarkRecord,
    OpenDrive,
    ParamCubic,
    Road,
    RoadLink,
    Section,
)

MAX_LENGTH_M = 50_000.0
MAX_CURVATURE = 5.0
MAX_WIDTH_M = 100.0
GAP_M = 0.05
LEAP_M = 0.5


def read_opendrive(path: Path) -> OpenDrive:
    """Read an OpenDRIVE file.

    Raises:
        ScenarioError: the file is missing, is not OpenDRIVE, or holds an element that is damaged or not supported; the
            message names the road and the element.
    """
    try:
        with open_file(path) as file:
            text = file.read()
        if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
            raise ScenarioError(f"map {path} declares XML entities, expected plain OpenDRIVE")
        if b"\0" in text:
            raise ScenarioError(f"map {path} has two or more bytes a letter, expected UTF-8; save it so")
        root = ET.fromstring(text)  # noqa: S314  entities are refused above
    except OSError as error:
        raise ScenarioError(f"map {path} cannot be read ({error.strerror or error}); check the path") from error
    except (ET.ParseError, LookupError, ValueError) as error:  # the last two for encodings that are not known here
        raise ScenarioError(f"map {path} is not well-formed XML ({error})") from error
    if root.tag != "OpenDRIVE":
        raise ScenarioError(f"map {path} starts with <{root.tag}>, expected <OpenDRIVE>")
    try:
        roads = [_road(element) for element in root.iterfind("road")]
        junctions = [_junction(element) for element in root.iterfind("junction")]
        if not roads:
            raise ScenarioError("no <road>, expected at least one")
        _check_ids("road", (road.name for road in roads))
        _check_ids("junction", (name for name, _ in junctions))
    except ScenarioError as error:
        raise ScenarioError(f"map {path}: {error}") from error
    return OpenDrive({road.name: road for road in roads}, dict(junctions))


def _check_ids(tag: str, ids: Iterable[str | int], where: str = "") -> None:
    if (twice := first_twice(ids)) is not None:
        raise ScenarioError(f"{where}two <{tag}> elements have the id {twice}, expected each once; rename one")


def _check_order(tag: str, by: str, values: list[float], where: str) -> None:
    if values != sorted(values):
        raise ScenarioError(f"{where}: <{tag}> elements are not ordered by {by}")


def _road(element: ET.Element) -> Road:
    name = _text(element, "id", "road")
    where = f"road {name}"
    if element.get("rule", "RHT") != "RHT":
        raise ScenarioError(
            f"{where}: rule {element.get('rule')!r} is not supported, expected right-hand traffic (RHT)"
        )
    for lateral in ("superelevation", "shape"):
        for record in element.iterfind(f"lateralProfile/{lateral}"):
            if any(_number(record, key, where) != 0.0 for key in "abcd"):
                raise ScenarioError(f"{where}: <{lateral}> that is not zero is not supported")
    length = _number(element, "length", where)
    plan = tuple(_geometry(piece, where) for piece in element.iterfind("planView/geometry"))
    plan = tuple(piece for piece in plan if piece.length_m > 1e-9)
    if not plan:
        raise ScenarioError(f"{where}: <planView> has no <geometry> of some length")
    starts = [piece.s_m for piece in plan]
    _check_order("geometry", "s", starts, where)
    reach = plan[-1].s_m + plan[-1].length_m
    if abs(reach - length) > GAP_M or starts[0] > GAP_M:
        raise ScenarioError(
            f"{where}: <geometry> goes from {starts[0]:.3f} to {reach:.3f} m, expected 0 to {length:.3f}"
        )
    junction = element.get("junction", "-1")
    road = Road(
        name=name,
        length_m=length,
        junction=None if junction == "-1" else junction,
        predecessor=_road_link(element.find("link/predecessor"), where),
        successor=_road_link(element.find("link/successor"), where),
        plan=plan,
        elevation=_cubics(element.findall("elevationProfile/elevation"), "s", where),
        lane_offset=_cubics(element.findall("lanes/laneOffset"), "s", where),
        sections=_sections(element, length, where),
    )
    _check_joints(road)
    return road


def _check_joints(road: Road) -> None:
    """See that each piece of a reference line begins where the one before ends."""
    onward = road.plan[1:]
    ends, _ = road.reference(np.array([piece.s_m - 1e-6 for piece in onward]))
    for piece, (x, y) in zip(onward, ends.tolist(), strict=True):
        if (leap_m := math.dist((x, y), (piece.x_m, piece.y_m))) > LEAP_M:
            raise ScenarioError(
                f"road {road.name}: the <geometry> before {piece.s_m:.3f} m ends {leap_m:.2f} m from where the next "
                f"one begins, expected at most {LEAP_M} m; check s, x, y, length, and hdg in radians"
            )


def _geometry(element: ET.Element, where: str) -> Geometry:
    length = _number(element, "length", where)
    shape: Clothoid | ParamCubic | None = None
    names = [child.tag for child in element if child.tag != "userData"]
    for child in element:
        if child.tag == "line":
            shape = Clothoid(0.0, 0.0)
        elif child.tag == "arc":
            curvature = _number(child, "curvature", where)
            shape = Clothoid(curvature, curvature)
        elif child.tag == "spiral":
            shape = Clothoid(_number(child, "curvStart", where), _number(child, "curvEnd", where))
        elif child.tag == "paramPoly3":
            u, v = (tuple(_number(child, f"{key}{axis}", where) for key in "abcd") for axis in "UV")
            shape = ParamCubic((u[0], u[1], u[2], u[3]), (v[0], v[1], v[2], v[3]), child.get("pRange") != "arcLength")
    if shape is None:
        found = ", ".join(f"<{tag}>" for tag in names) or "nothing"
        raise ScenarioError(
            f"{where}: <geometry> holds {found}, which is not supported; expected line, arc, spiral or paramPoly3"
        )
    if not 0.0 <= length <= MAX_LENGTH_M:
        raise ScenarioError(f"{where}: <geometry> has length {length} m, expected 0 to {MAX_LENGTH_M:.0f}")
    if length > 1e-9 and (most := shape.max_curvature(length)) > MAX_CURVATURE:
        raise ScenarioError(f"{where}: <geometry> has a curvature of {most:.3g} 1/m, expected at most {MAX_CURVATURE}")
    heading = _number(element, "hdg", where)
    return Geometry(
        _number(element, "s", where), _number(element, "x", where), _number(element, "y", where), heading, length, shape
    )


def _sections(road: ET.Element, length_m: float, where: str) -> tuple[Section, ...]:
    elements = road.findall("lanes/laneSection")
    if not elements:
        raise ScenarioError(f"{where}: no <laneSection>, expected at least one")
    starts = [_number(element, "s", where) for element in elements]
    _check_order("laneSection", "s", starts, where)
    if starts[0] < 0.0 or starts[-1] > length_m:
        raise ScenarioError(f"{where}: <laneSection> starts outside the road's 0 to {length_m:.3f} m")
    if starts[0] > GAP_M:
        raise ScenarioError(f"{where}: the first <laneSection> starts at {starts[0]:.3f} m, expected at 0")
    if any(element.get("singleSide") in ("true", "1") for element in elements):
        raise ScenarioError(
            f"{where}: <laneSection> with singleSide is not supported; expected the lanes of both sides in each"
        )
    sections: list[Section] = []
    for element, start, end in zip(elements, starts, [*starts[1:], length_m], strict=True):
        lanes = [
            _lane(lane, where) for side in ("left", "center", "right") for lane in element.iterfind(f"{side}/lane")
        ]
        _check_ids("lane", (lane.number for lane in lanes), f"{where}: <laneSection> at {start:g} m: ")
        sections.append(Section(start, end, {lane.number: lane for lane in lanes}))
    return tuple(sections)


def _lane(element: ET.Element, where: str) -> LaneRecord:
    number = _integer(element, "id", where)
    where = f"{where}: lane {number}"
    if element.get("type") == "driving" and (direction := element.get("direction", "standard")) != "standard":
        raise ScenarioError(f"{where}: direction {direction!r} is not supported, expected 'standard' where cars drive")
    widths = element.findall("width")
    if number != 0 and not widths:
        hint = "<border> is not supported, " if element.find("border") is not None else ""
        raise ScenarioError(f"{where}: {hint}expected at least one <width>")
    if number != 0 and (first_m := _number(widths[0], "sOffset", where)) > GAP_M:
        raise ScenarioError(f"{where}: the first <width> has sOffset {first_m:.3f} m, expected 0")
    width = _cubics(widths, "sOffset", where) if number != 0 else None
    marks = tuple(_mark(mark, where) for mark in element.iterfind("roadMark"))
    _check_order("roadMark", "sOffset", [mark.offset_m for mark in marks], where)
    return LaneRecord(
        number=number,
        kind=element.get("type", "none"),
        width=width,
        marks=marks,
        predecessor=_lane_link(element.find("link/predecessor"), where),
        successor=_lane_link(element.find("link/successor"), where),
    )


def _mark(element: ET.Element, where: str) -> MarkRecord:
    colour = element.get("color", "standard")
    return MarkRecord(
        offset_m=_number(element, "sOffset", where),
        # Two words, but one line.
        kind=element.get("type", "none").replace("botts dots", "botts-dots"),
        colour="white" if colour == "standard" else colour,
        width_m=_number(element, "width", where) if "width" in element.attrib else 0.12,
    )


def _lane_link(element: ET.Element | None, where: str) -> int | None:
    return None if element is None else _integer(element, "id", where)


def _road_link(element: ET.Element | None, where: str) -> RoadLink | None:
    if element is None:
        return None
    target = _text(element, "elementId", where)
    if element.get("elementType") == "junction":
        return RoadLink("junction", target, None)
    return RoadLink("road", target, _contact(element, where))


def _junction(element: ET.Element) -> tuple[str, tuple[Connection, ...]]:
    name = _text(element, "id", "junction")
    where = f"junction {name}"
    if element.get("type", "default") != "default":
        raise ScenarioError(f"{where}: type {element.get('type')!r} is not supported, expected 'default'")
    connections = tuple(
        Connection(
            incoming=_text(connection, "incomingRoad", where),
            connecting=_text(connection, "connectingRoad", where),
            contact=_contact(connection, where),
            lane_links=tuple(
                (_integer(link, "from", where), _integer(link, "to", where)) for link in connection.iterfind("laneLink")
            ),
        )
        for connection in element.iterfind("connection")
    )
    return name, connections


def _contact(element: ET.Element, where: str) -> Literal["start", "end"]:
    contact = element.get("contactPoint")
    if contact == "start" or contact == "end":
        return contact
    raise ScenarioError(f"{where}: <{element.tag}> has contactPoint {contact!r}, expected 'start' or 'end'")


def _cubics(elements: list[ET.Element], start: str, where: str) -> Cubics:
    """The pieces of a value along the road; 0 before the first, as the standard has it."""
    starts = [_number(element, start, where) for element in elements]
    pieces = [[_number(element, key, where) for key in "abcd"] for element in elements]
    if elements:
        _check_order(elements[0].tag, start, starts, where)
    if not elements or starts[0] > GAP_M:
        starts, pieces = [0.0, *starts], [[0.0] * 4, *pieces]
    return Cubics(np.array(starts), np.array(pieces))


def _text(element: ET.Element, name: str, where: str) -> str:
    value = element.get(name)
    if value is None:
        raise ScenarioError(f"{where}: <{element.tag}> has no {name}")
    return value


def _integer(element: ET.Element, name: str, where: str) -> int:
    text = _text(element, name, where)
    try:
        return int(text)
    except ValueError:
        raise ScenarioError(f"{where}: <{element.tag}> has {name}={text!r}, expected a whole number") from None


def _number(element: ET.Element, name: str, where: str) -> float:
    text = _text(element, name, where)
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ScenarioError(f"{where}: <{element.tag}> has {name}={text!r}, expected a finite number")
    return value
