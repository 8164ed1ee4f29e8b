"""The lane marks of a road map on a canvas."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from roadproof.geometry import CANVAS_SIZE_PX, CanvasPlacement
from roadproof.paint.site import WHITE_MARK, YELLOW_MARK, LaneMark, Site
from roadproof.roads.maps import Mapped
from roadproof.roads.roadmap import RoadMap
from roadproof.scenarios import Scenario

BESIDE_M = 5.0
"""Marks within this distance of the canvas still count: figures may reach beyond it."""


def marks_on(canvas: CanvasPlacement, roads: RoadMap) -> tuple[LaneMark, ...]:
    """The painted lines of a map on a canvas and beside it, in canvas metres.

    Lines within junctions are left out, since maps draw every way through one. A double line is one as wide as both
    with the gap between them; a broken one has no gaps. Stop lines and crossings are not in a map's lane marks.
    """
    found: list[LaneMark] = []
    for line in roads.mark_lines:
        if line.junction is None:
            strands = len(line.mark.kind.split())
            points = _on_canvas(canvas, line.points[:, :2])
            colour = YELLOW_MARK if line.mark.colour == "yellow" else WHITE_MARK
            found += [
                LaneMark(points_m=part, width_m=(2 * strands - 1) * line.mark.painted_width_m, colour=colour)
                for part in _near(points, canvas)
                if len(set(part)) > 1
            ]
    return tuple(found)


def _on_canvas(canvas: CanvasPlacement, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    px = np.linalg.solve(
        canvas.world_from_canvas[[0, 1, 3]], np.stack([points[:, 0], points[:, 1], np.ones(len(points))])
    )
    scale = np.array([canvas.width_m, canvas.length_m]) / CANVAS_SIZE_PX
    return (px[:2].T + 0.5) * scale


def _near(points: Float[np.ndarray, "n 2"], canvas: CanvasPlacement) -> list[tuple[tuple[float, float], ...]]:
    """The stretches of a line whose pieces come near the canvas, with as few points as follow it to a centimetre."""
    low, high = np.minimum(points[:-1], points[1:]), np.maximum(points[:-1], points[1:])
    size = np.array([canvas.width_m, canvas.length_m])
    near = np.flatnonzero(((high >= -BESIDE_M) & (low <= size + BESIDE_M)).all(1))
    if not len(near):
        return []
    runs = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)
    return [tuple((float(x), float(y)) for x, y in _simpler(points[run[0] : run[-1] + 2]).round(4)) for run in runs]


def _simpler(points: Float[np.ndarray, "n 2"], tolerance_m: float = 0.01) -> Float[np.ndarray, "m 2"]:
    """A line without the points that lie on the way between others (Douglas and Peucker)."""
    if len(points) <= 2:
        return points
    way = points[-1] - points[0]
    length = float(np.linalg.norm(way))
    gap = points - points[0]
    beside = np.abs(way[0] * gap[:, 1] - way[1] * gap[:, 0]) / length if length else np.linalg.norm(gap, axis=1)
    k = int(beside.argmax())
    if beside[k] <= tolerance_m:
        return points[[0, -1]]
    return np.concatenate([_simpler(points[: k + 1], tolerance_m)[:-1], _simpler(points[k:], tolerance_m)])


def site_at(simulator: object, scenario: Scenario) -> Site:
    """What is known of a scenario's canvas before anything is recorded there: all but the colour of the asphalt.

    Raises:
        SimulatorError, ScenarioError: as `marks_of`.
    """
    canvas = scenario.canvas
    return Site(size_m=(canvas.width_m, canvas.length_m), marks=marks_of(simulator, scenario))


def marks_of(simulator: object, scenario: Scenario) -> tuple[LaneMark, ...] | None:
    """The lane marks on a scenario's canvas, from the simulator's map; None where it has none.

    Raises:
        SimulatorError: the simulator does not answer.
        ScenarioError: the simulator has no such map.
    """
    return marks_on(scenario.canvas, simulator.road_map(scenario.map_name)) if isinstance(simulator, Mapped) else None
