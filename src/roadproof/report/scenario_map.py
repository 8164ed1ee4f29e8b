"""Draws a map with scenarios on it: where each starts, which way it goes, where its canvas lies."""

# Matplotlib's own types are incomplete.
# pyright: reportUnknownMemberType=false

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure

from roadproof.errors import OutputError, ScenarioError
from roadproof.geometry import CANVAS_SIZE_PX, CanvasPlacement
from roadproof.io.files import write_atomically
from roadproof.roads.maps import scenario_route
from roadproof.roads.roadmap import RoadMap
from roadproof.scenarios import Scenario

COLOURS = {"straight": "#2166ac", "left": "#b2182b", "right": "#1b7837"}
PAVEMENT = {"sidewalk": "#d8d2c6", "shoulder": "#9a9a96", "driving": "#6f7175"}
PAINT = {"white": "#f4f4f4", "yellow": "#f2c230"}
GRASS = "#e9eddf"


def draw_scenarios(scenarios: Sequence[Scenario], road_map: RoadMap, path: Path) -> None:
    """Draw scenarios of one map to a PNG, or whatever the name's ending says, under a temporary name first.

    Raises:
        ScenarioError: the list is empty, or a scenario does not fit the map.
        OutputError: the picture cannot be written.
    """
    if not scenarios:
        raise ScenarioError("there is no scenario to draw, expected at least one")
    routes = [scenario_route(scenario, road_map) for scenario in scenarios]
    x0, y0, x1, y1 = road_map.bounds_m
    figure = Figure(figsize=(13.0, 13.0 * (y1 - y0 + 30.0) / (x1 - x0 + 30.0)), facecolor=GRASS)
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(x0 - 15.0, x1 + 15.0), ylim=(y0 - 15.0, y1 + 15.0), aspect="equal")
    axes.set_axis_off()
    _draw_roads(axes, road_map)
    taken: list[tuple[float, float]] = []
    for scenario, route in zip(scenarios, routes, strict=True):
        _draw_scenario(axes, scenario, route.points[:, :2], taken)
    _draw_legend(axes, scenarios)
    try:
        write_atomically(path, lambda part: figure.savefig(part, dpi=110))
    except ValueError as error:
        raise OutputError(f"the map cannot be drawn to {path} ({error}); choose another place or a .png") from error


def _draw_roads(axes: Axes, road_map: RoadMap) -> None:
    for kind, colour in PAVEMENT.items():
        strips = [lane for lane in road_map.lanes if lane.kind == kind]
        shapes = [np.concatenate([lane.left[:, :2], lane.right[::-1, :2]]) for lane in strips]
        axes.add_collection(PolyCollection(shapes, facecolors=colour, edgecolors=colour, linewidths=0.3))
    areas = [area.outline[:, :2] for area in road_map.junctions]
    axes.add_collection(PolyCollection(areas, facecolors=PAVEMENT["driving"], edgecolors="none"))
    for colour, shade in PAINT.items():
        lines = [line for line in road_map.mark_lines if line.mark.colour == colour]
        dashes = ["--" if line.mark.kind == "broken" else "-" for line in lines]
        shapes = [line.points[:, :2] for line in lines]
        axes.add_collection(LineCollection(shapes, colors=shade, linewidths=0.6, linestyles=dashes))


def _draw_scenario(
    axes: Axes, scenario: Scenario, way: Float[np.ndarray, "n 2"], taken: list[tuple[float, float]]
) -> None:
    colour = COLOURS[scenario.kind]
    axes.plot(way[:, 0], way[:, 1], color=colour, linewidth=1.6, alpha=0.85, zorder=5)
    axes.plot(way[0, 0], way[0, 1], "o", color=colour, markersize=5.5, markeredgecolor="white", zorder=7)
    tip, tail = way[-1], way[-5]
    axes.annotate(
        "", xy=tuple(tip), xytext=tuple(tail), arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.6}, zorder=7
    )
    canvas = _outline(scenario.canvas)
    axes.fill(canvas[:, 0], canvas[:, 1], facecolor=colour, alpha=0.35, edgecolor=colour, linewidth=1.0, zorder=4)
    x, y = _label_place(scenario, taken)
    taken.append((x, y))
    axes.text(
        x, y, scenario.name.replace("straight", "S").replace("left", "L").replace("right", "R").replace("-", ""),
        color=colour, fontsize=8.5, fontweight="bold", ha="center", va="center", zorder=8,
    )  # fmt: skip


def _outline(canvas: CanvasPlacement) -> Float[np.ndarray, "4 2"]:
    low, high = -0.5, CANVAS_SIZE_PX - 0.5
    corners = np.array([[low, high, high, low], [low, low, high, high], [1.0, 1.0, 1.0, 1.0]])
    return (canvas.world_from_canvas @ corners)[:2].T


def _label_place(scenario: Scenario, taken: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Beside the start: on its right where that is free, else on its left, else further out or along."""
    start = scenario.start
    c, s = math.cos(start.yaw_rad), math.sin(start.yaw_rad)
    tries = [(aside, along) for aside in (7.5, -11.0, 12.5) for along in (0.0, 9.0, -9.0)]
    places = [(start.x_m + along * c + aside * s, start.y_m + along * s - aside * c) for aside, along in tries]
    free = [p for p in places if all(abs(p[0] - q[0]) > 9.0 or abs(p[1] - q[1]) > 4.5 for q in taken)]
    return (free or places)[0]


def _draw_legend(axes: Axes, scenarios: Sequence[Scenario]) -> None:
    for kind, colour in COLOURS.items():
        count = sum(scenario.kind == kind for scenario in scenarios)
        if count:
            axes.plot([], [], "-o", color=colour, markersize=5.5, label=f"{kind} ({count})")
    axes.fill([], [], facecolor="#777777", alpha=0.5, edgecolor="#444444", label="canvas")
    axes.legend(loc="center", bbox_to_anchor=(0.6, 0.54), frameon=False, fontsize=10)
