"""A drive as a film: what the camera sees, the way from above with the canvas, the controls, and what happens."""

from __future__ import annotations

import importlib
import math
import os
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from roadproof.datatypes import Control, Event, Observation
from roadproof.errors import OutputError
from roadproof.geometry import CanvasPlacement
from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.protocol import PatternImage

SIZE = (1280, 720)
VIEW = (0, 0, 800, 600)
ABOVE_PX = 480
PIXELS_PER_M = 6.0
UNKNOWN_M = 60.0
EVENT_SHOWN_S = 3.0

INK, PAPER, FAINT = (32, 34, 38), (246, 246, 243), (208, 208, 203)
WAY, CAR, OTHERS, PEOPLE, ALARM = (40, 110, 190), (210, 60, 40), (70, 72, 78), (40, 140, 90), (190, 40, 30)
GROUND = {"sidewalk": (214, 208, 196), "shoulder": (150, 150, 147), "driving": (122, 123, 126)}
LAWN = (226, 232, 216)

Plan = Float[np.ndarray, "n 2"]
NOBODY: Plan = np.zeros((0, 2))


class DriveVideo:
    """Writes one drive, observation by observation, into an MP4 file.

    The film appears under its name when the with-block ends without an error.

    Args:
        path: of the film; ends in .mp4.
        roads: the map driven on; None where it is not known.
        way: world x, y of the way from start to goal.
        canvas: where the canvas lies.
        pattern: what is painted on it.
        dt_s: seconds between observations.

    Raises:
        OutputError: PyAV is not installed, or the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        *,
        roads: RoadMap | None,
        way: Plan,
        canvas: CanvasPlacement,
        pattern: PatternImage | None = None,
        dt_s: float = 0.05,
    ) -> None:
        if path.suffix != ".mp4":
            raise OutputError(f"the film is to be {path.name}, expected a name that ends in .mp4")
        self._path = path
        self._partial = path.with_name(f".{os.getpid()}.{path.name}")
        self._rate = Fraction(1 / dt_s).limit_denominator(1000)
        self._plan, self._low = _plan(roads, way, canvas, pattern)
        self._driven: list[tuple[float, float]] = []
        self._events: list[Event] = []
        self._font = ImageFont.load_default(18)
        self._container: Any = None
        self._stream: Any = None

    def __enter__(self) -> DriveVideo:
        try:
            av: Any = importlib.import_module("av")
        except ImportError as error:
            raise OutputError("films need PyAV, which is not installed: pip install 'roadproof[video]'") from error
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._container = av.open(str(self._partial), "w", format="mp4")
        except OSError as error:
            raise OutputError(f"the film cannot be written to {self._path} ({error}); choose another place") from error
        self._frame_of = av.VideoFrame.from_ndarray
        self._stream = self._container.add_stream("libx264", rate=self._rate, options={"crf": "23", "threads": "1"})
        self._stream.width, self._stream.height = SIZE
        self._stream.pix_fmt = "yuv420p"
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self._container.mux(self._stream.encode())
        self._container.close()
        if kind is None:
            self._partial.replace(self._path)
        else:
            self._partial.unlink(missing_ok=True)

    def add(self, seen: Observation, control: Control, cars: Plan = NOBODY, people: Plan = NOBODY) -> None:
        """Append one observation and the control given after it.

        Args:
            seen: the full picture is shown where there is one, else the controller's frame.
            control: what the driver did.
            cars: world x, y of the other cars.
            people: world x, y of the people.
        """
        self._container.mux(self._stream.encode(self._frame_of(self.compose(seen, control, cars, people), "rgb24")))

    def compose(
        self, seen: Observation, control: Control, cars: Plan = NOBODY, people: Plan = NOBODY
    ) -> UInt8[np.ndarray, "720 1280 3"]:
        """One image of the film."""
        self._driven.append((seen.state.x_m, seen.state.y_m))
        self._events += seen.events
        page = Image.new("RGB", SIZE, PAPER)
        page.paste(_fitted(seen.shown, (VIEW[2], VIEW[3])), VIEW[:2])
        page.paste(self._above(seen, cars, people), (VIEW[2], 0))
        page.paste(_fitted(seen.frame, (200, 88)), (VIEW[2] + 140, ABOVE_PX + 26))
        pen = ImageDraw.Draw(page)
        pen.text((VIEW[2] + 140, ABOVE_PX + 4), "what the controller sees", INK, self._font)
        self._instruments(pen, seen, control)
        self._happened(pen, seen.time_s)
        return np.asarray(page)

    def _above(self, seen: Observation, cars: Plan, people: Plan) -> Image.Image:
        """The map around the car, north up."""
        centre = self._pixels([(seen.state.x_m, seen.state.y_m)])[0]
        left, top = (round(v - ABOVE_PX / 2) for v in centre)
        view = Image.new("RGB", (ABOVE_PX, ABOVE_PX), LAWN)
        view.paste(self._plan, (-left, -top))
        pen = ImageDraw.Draw(view)
        driven = [(x - left, y - top) for x, y in self._pixels(self._driven)]
        if len(driven) > 1:
            pen.line(driven, CAR, 3)
        for points, colour, size in ((cars, OTHERS, 6), (people, PEOPLE, 3)):
            for x, y in self._pixels([(float(x), float(y)) for x, y in points]):
                pen.ellipse((x - left - size, y - top - size, x - left + size, y - top + size), fill=colour)
        c, s = math.cos(seen.state.yaw_rad), math.sin(seen.state.yaw_rad)
        outline = [
            (2.25 * a * c - 0.95 * b * s, 2.25 * a * s + 0.95 * b * c) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
        ]
        corners = self._pixels([(seen.state.x_m + x, seen.state.y_m + y) for x, y in outline])
        pen.polygon([(x - left, y - top) for x, y in corners], fill=CAR, outline=INK)
        return view

    def _pixels(self, points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        height = self._plan.height
        return [((x - self._low[0]) * PIXELS_PER_M, height - (y - self._low[1]) * PIXELS_PER_M) for x, y in points]

    def _instruments(self, pen: ImageDraw.ImageDraw, seen: Observation, control: Control) -> None:
        """Steering, throttle, brake, speed, command and time, below the camera picture."""
        top, clipped = VIEW[3] + 16, control.clipped()
        pen.text((20, top), "steer", INK, self._font)
        _bar(pen, (90, top + 2, 390, top + 20), -min(clipped.steer, 0.0), max(clipped.steer, 0.0), WAY)
        pen.text((20, top + 34), "throttle", INK, self._font)
        _bar(pen, (110, top + 36, 390, top + 54), None, clipped.throttle, PEOPLE)
        pen.text((20, top + 68), "brake", INK, self._font)
        _bar(pen, (110, top + 70, 390, top + 88), None, clipped.brake, ALARM)
        pen.text((430, top), f"{seen.state.speed_mps * 3.6:5.1f} km/h", INK, self._font)
        pen.text((430, top + 34), f"command: {seen.command.name.lower()}", INK, self._font)
        pen.text((430, top + 68), f"{seen.time_s:6.2f} s", INK, self._font)

    def _happened(self, pen: ImageDraw.ImageDraw, now_s: float) -> None:
        """The last events, fresh ones in red."""
        left, top = VIEW[2] + 20, ABOVE_PX + 130
        for i, event in enumerate(self._events[-4:]):
            fresh = now_s - event.time_s < EVENT_SHOWN_S
            text = f"{event.time_s:5.1f} s  {event.kind.value}  {event.detail}"[:52]
            pen.text((left, top + 24 * i), text, ALARM if fresh else INK, self._font)


def _fitted(picture: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> Image.Image:
    image = Image.fromarray(picture)
    return image if image.size == size else image.resize(size, Image.Resampling.BICUBIC)


def _bar(
    pen: ImageDraw.ImageDraw,
    box: tuple[int, int, int, int],
    left: float | None,
    right: float,
    colour: tuple[int, int, int],
) -> None:
    """A bar from its left end, or from its middle to both sides where `left` is given; shares are in [0, 1]."""
    x0, y0, x1, y1 = box
    pen.rectangle(box, fill=FAINT)
    middle = x0 if left is None else (x0 + x1) / 2
    pen.rectangle((middle - (left or 0.0) * (middle - x0), y0, middle + right * (x1 - middle), y1), fill=colour)
    if left is not None:
        pen.line((middle, y0 - 3, middle, y1 + 3), INK, 1)


def _plan(
    roads: RoadMap | None, way: Plan, canvas: CanvasPlacement, pattern: PatternImage | None
) -> tuple[Image.Image, tuple[float, float]]:
    """The map from above with way and canvas, and the world x, y of its lower left corner."""
    x0, y0, x1, y1 = (*way.min(0), *way.max(0)) if roads is None else roads.bounds_m
    margin = UNKNOWN_M if roads is None else 10.0
    low = (float(x0) - margin, float(y0) - margin)
    size = (round((x1 - x0 + 2 * margin) * PIXELS_PER_M), round((y1 - y0 + 2 * margin) * PIXELS_PER_M))
    plan = Image.new("RGB", size, GROUND["driving"] if roads is None else LAWN)
    pen = ImageDraw.Draw(plan)

    def at(points: np.ndarray) -> list[tuple[float, float]]:
        return [((x - low[0]) * PIXELS_PER_M, size[1] - (y - low[1]) * PIXELS_PER_M) for x, y in points[:, :2].tolist()]

    if roads is not None:
        _draw_roads(pen, roads, at)
    pen.line(at(way), fill=WAY, width=2)
    corners = np.array([(-0.5, -0.5, 1), (399.5, -0.5, 1), (399.5, 399.5, 1), (-0.5, 399.5, 1)])
    if pattern is not None:
        _paint(plan, canvas, pattern, low)
    outline = at((corners @ canvas.world_from_canvas.T)[:, :2])
    pen.line([*outline, outline[0]], fill=INK, width=1)
    return plan, low


def _draw_roads(
    pen: ImageDraw.ImageDraw, roads: RoadMap, at: Callable[[np.ndarray], list[tuple[float, float]]]
) -> None:
    for kind in ("sidewalk", "shoulder", "driving"):
        for lane in roads.lanes:
            if lane.kind == kind:
                pen.polygon(at(np.concatenate([lane.left, lane.right[::-1]])), fill=GROUND[kind])
    for area in roads.junctions:
        pen.polygon(at(area.outline), fill=GROUND["driving"])
    for line in roads.mark_lines:
        if line.junction is None:
            pen.line(at(line.points), fill=(242, 200, 80) if line.mark.colour == "yellow" else (240, 240, 238), width=1)


def _paint(plan: Image.Image, canvas: CanvasPlacement, pattern: PatternImage, low: tuple[float, float]) -> None:
    """Lay the pattern on the map."""
    canvas_from_world = np.linalg.inv(canvas.world_from_canvas[[0, 1, 3]])
    step = 1 / PIXELS_PER_M
    world_from_plan = np.array([[step, 0, low[0]], [0, -step, low[1] + plan.height * step], [0, 0, 1]])
    affine = canvas_from_world @ world_from_plan
    # Pillow maps edges to edges: canvas pixel centres are at integers, their edges half a pixel before.
    affine[:2, 2] += 0.5
    turned = Image.fromarray(pattern).transform(
        plan.size, Image.Transform.AFFINE, tuple(affine[:2].ravel().tolist()), Image.Resampling.BILINEAR
    )
    plan.paste(turned.convert("RGB"), (0, 0), turned.getchannel("A"))
