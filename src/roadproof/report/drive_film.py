"""A drive as a film: what the camera sees, the way from above with the canvas, the controls, and what happens."""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from roadproof.datatypes import Control, Event, Observation
from roadproof.driving.rollout import OnStep
from roadproof.geometry import CanvasPlacement
from roadproof.io.video import film_file
from roadproof.recorded import RecordedSimulator
from roadproof.report.road_view import DAYLIGHT, DPI, Points, draw_canvas, draw_road, in_world, pixels_of, plan_of
from roadproof.roads.maps import scenario_route
from roadproof.roads.polylines import polyline_stations
from roadproof.roads.roadmap import RoadMap
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage
from roadproof.traffic.agents import CAR_LENGTH_M, CAR_WIDTH_M

if TYPE_CHECKING:
    from roadproof.simulators.loading import MappedSimulator

SIZE = (1280, 720)
VIEW = (800, 600)
ABOVE_PX = 480
PIXELS_PER_M = 6.0
AROUND_M = 60.0
"""So far beside the way the map is drawn; a car further aside is shown beyond its edge."""
EVENT_SHOWN_S = 3.0

INK, PAPER, FAINT = "#202226", "#f6f6f3", "#d0d0cb"
WAY, CAR, OTHERS, PEOPLE, ALARM = "#286ebe", "#d23c28", "#46484e", "#288c5a", "#be281e"
NOBODY: Points = np.zeros((0, 2))


@contextmanager
def film_drive(
    path: Path, world: MappedSimulator | RecordedSimulator, scenario: Scenario, pattern: PatternImage | None = None
) -> Generator[OnStep]:
    """Film a drive: the with-block gets what `rollout` is to call at each step, as its `on_step`.

    Args:
        path: the film to write; it ends in .mp4, and appears when the block ends without an error.
        world: the open simulator that is driven in.
        scenario: the scenario that is driven.
        pattern: the pattern that is painted on the canvas; None for the bare road.

    Raises:
        OutputError: PyAV is not installed, or the file cannot be written.
    """
    roads, way = _map_of(world, scenario)
    view = DriveView(roads=roads, way=way, canvas=scenario.canvas, pattern=pattern)
    with film_file(path, SIZE, world.dt_s) as add:

        def on_step(seen: Observation, control: Control | None) -> None:
            around = () if isinstance(world, RecordedSimulator) else (world.cars, world.pedestrians)
            others = [np.column_stack([agents.x_m, agents.y_m]) for agents in around]
            add(view.compose(seen, control or Control(0.0), *others))

        yield on_step


def length_m(world: MappedSimulator | RecordedSimulator, scenario: Scenario) -> float:
    """How long the way from a scenario's start to its goal is, in metres."""
    return float(polyline_stations(_map_of(world, scenario)[1])[-1])


def _map_of(world: MappedSimulator | RecordedSimulator, scenario: Scenario) -> tuple[RoadMap | None, Points]:
    """The roads, where they are known, and world x, y of the way from start to goal."""
    if isinstance(world, RecordedSimulator):
        return None, world.way
    roads = world.road_map(scenario.map_name)
    return roads, scenario_route(scenario, roads).points[:, :2]


class DriveView:
    """Draws the images of a film, one observation after another.

    Args:
        roads: the map driven on; None where it is not known.
        way: world x, y of the way from start to goal.
        canvas: where the canvas lies in the world.
        pattern: the pattern that is painted on the canvas; None for a bare canvas.
    """

    def __init__(
        self, *, roads: RoadMap | None, way: Points, canvas: CanvasPlacement, pattern: PatternImage | None = None
    ) -> None:
        ground = DAYLIGHT if roads is not None else replace(DAYLIGHT, grass=DAYLIGHT.asphalt)
        self._ground = ground.grass
        (left, low), (right, high) = way.min(0) - AROUND_M, way.max(0) + AROUND_M
        box = (float(left), float(low), float(right), float(high))
        per_in = PIXELS_PER_M / DPI
        figure, axes = plan_of(box, ((box[2] - box[0]) * per_in, (box[3] - box[1]) * per_in), ground.grass)
        if roads is not None:
            draw_road(axes, roads, in_world, box, ground)
        axes.plot(*way.T, color=WAY, linewidth=1.5, zorder=1.3)
        draw_canvas(axes, canvas, pattern, INK, upright=False)
        self._plan, self._corner = Image.fromarray(pixels_of(figure)), (box[0], box[3])
        self._driven: list[tuple[float, float]] = []
        self._events: list[Event] = []
        self._font = ImageFont.load_default(18)

    def compose(
        self, seen: Observation, control: Control, cars: Points = NOBODY, people: Points = NOBODY
    ) -> UInt8[np.ndarray, "720 1280 3"]:
        """The image of one observation.

        Args:
            seen: the observation; its full picture is shown where there is one, else the controller's frame.
            control: the control that the driver answered with.
            cars: world x, y of the other cars.
            people: world x, y of the people.
        """
        self._driven.append((seen.state.x_m, seen.state.y_m))
        self._events += seen.events
        page = Image.new("RGB", SIZE, PAPER)
        page.paste(_fitted(seen.shown, VIEW))
        page.paste(self._above(seen, cars, people), (VIEW[0], 0))
        page.paste(_fitted(seen.frame, (200, 88)), (VIEW[0] + 140, ABOVE_PX + 26))
        pen = ImageDraw.Draw(page)
        pen.text((VIEW[0] + 140, ABOVE_PX + 4), "what the controller sees", INK, self._font)
        self._draw_instruments(pen, seen, control)
        for i, event in enumerate(self._events[-4:]):
            fresh = seen.time_s - event.time_s < EVENT_SHOWN_S
            text = f"{event.time_s:5.1f} s  {event.kind.value}  {event.detail}"[:52]
            pen.text((VIEW[0] + 20, ABOVE_PX + 130 + 24 * i), text, ALARM if fresh else INK, self._font)
        return np.asarray(page)

    def _above(self, seen: Observation, cars: Points, people: Points) -> Image.Image:
        """The map around the car, north up."""
        state = seen.state
        ((x, y),) = self._pixels([(state.x_m, state.y_m)])
        left, top = round(x - ABOVE_PX / 2), round(y - ABOVE_PX / 2)
        view = Image.new("RGB", (ABOVE_PX, ABOVE_PX), self._ground)
        view.paste(self._plan, (-left, -top))
        pen = ImageDraw.Draw(view)

        def at(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
            return [(x - left, y - top) for x, y in self._pixels(points)]

        if len(self._driven) > 1:
            pen.line(at(self._driven), CAR, 3)
        for points, colour, size in ((cars, OTHERS, 6), (people, PEOPLE, 3)):
            for x, y in at(points.tolist()):
                pen.ellipse((x - size, y - size, x + size, y + size), fill=colour)
        c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
        corners = [(CAR_LENGTH_M / 2 * a, CAR_WIDTH_M / 2 * b) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
        outline = at([(state.x_m + a * c - b * s, state.y_m + a * s + b * c) for a, b in corners])
        pen.polygon(outline, fill=CAR, outline=INK)
        return view

    def _pixels(self, points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        left, high = self._corner
        return [((x - left) * PIXELS_PER_M, (high - y) * PIXELS_PER_M) for x, y in points]

    def _draw_instruments(self, pen: ImageDraw.ImageDraw, seen: Observation, control: Control) -> None:
        """Steering, throttle, brake, speed, command and time, below the camera picture."""
        top, clipped = VIEW[1] + 16, control.clipped()
        state, command = seen.state, seen.command.name.lower()
        values = (f"{state.speed_mps * 3.6:5.1f} km/h", f"command: {command}", f"{seen.time_s:6.2f} s")
        for row, (name, value) in enumerate(zip(("steer", "throttle", "brake"), values, strict=True)):
            pen.text((20, top + 34 * row), name, INK, self._font)
            pen.text((430, top + 34 * row), value, INK, self._font)
        _bar(pen, (90, top + 2, 390, top + 20), -min(clipped.steer, 0.0), max(clipped.steer, 0.0), WAY)
        _bar(pen, (110, top + 36, 390, top + 54), None, clipped.throttle, PEOPLE)
        _bar(pen, (110, top + 70, 390, top + 88), None, clipped.brake, ALARM)


def _fitted(picture: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> Image.Image:
    image = Image.fromarray(picture)
    return image if image.size == size else image.resize(size, Image.Resampling.BICUBIC)


def _bar(
    pen: ImageDraw.ImageDraw,
    box: tuple[int, int, int, int],
    left: float | None,
    right: float,
    colour: str,
) -> None:
    """A bar from its left end, or from its middle to both sides where `left` is given; shares are in [0, 1]."""
    x0, y0, x1, y1 = box
    pen.rectangle(box, fill=FAINT)
    middle = x0 if left is None else (x0 + x1) / 2
    pen.rectangle((middle - (left or 0.0) * (middle - x0), y0, middle + right * (x1 - middle), y1), fill=colour)
    if left is not None:
        pen.line((middle, y0 - 3, middle, y1 + 3), INK, 1)
