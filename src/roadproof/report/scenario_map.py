"""A map with scenarios on it: where each starts, which way it goes, where its canvas lies."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes

from roadproof.errors import OutputError, ScenarioError
from roadproof.geometry import CANVAS_CORNERS_PX
from roadproof.io.files import write_atomically
from roadproof.report.plots import show_as_it_is
from roadproof.report.road_view import DAYLIGHT, Points, draw_road, in_world, plan_of
from roadproof.roads.maps import scenario_route
from roadproof.roads.roadmap import RoadMap
from roadproof.scenarios import Scenario

COLOURS = {"straight": "#2166ac", "left": "#b2182b", "right": "#1b7837"}
WIDTH_IN, DPI = 13.0, 110
MARGIN_M = 15.0
FORMATS = (".png", ".jpg", ".svg", ".pdf")

SHORT = 4
"""A name of more characters reaches back to its start, or out of the map, from where a short one stands beside it."""


def draw_scenarios(scenarios: Sequence[Scenario], road_map: RoadMap, path: Path) -> None:
    """Draw scenarios of one map to a PNG, or whatever the name's ending says, whole or not at all.

    Raises:
        ScenarioError: the list is empty, or a scenario does not fit the map.
        OutputError: the picture cannot be written.
    """
    if not scenarios:
        raise ScenarioError("there is no scenario to draw, expected at least one")
    if path.suffix.lower() not in FORMATS:
        raise OutputError(
            f"the map cannot be drawn to {path}, expected a name that ends in one of {', '.join(FORMATS)}"
        )
    routes = [scenario_route(scenario, road_map) for scenario in scenarios]
    x0, y0, x1, y1 = road_map.bounds_m
    box = (x0 - MARGIN_M, y0 - MARGIN_M, x1 + MARGIN_M, y1 + MARGIN_M)
    size_in = (WIDTH_IN, WIDTH_IN * (box[3] - box[1]) / (box[2] - box[0]))
    figure, axes = plan_of(box, size_in, DAYLIGHT.grass)
    draw_road(axes, road_map, in_world, box, DAYLIGHT)
    taken: list[tuple[float, float]] = []
    for scenario, route in zip(scenarios, routes, strict=True):
        _draw_scenario(axes, scenario, route.points[:, :2], taken)
    _draw_legend(axes, scenarios)
    show_as_it_is(figure)
    try:
        write_atomically(path, lambda part: figure.savefig(part, dpi=DPI))
    except ValueError as error:
        raise OutputError(f"the map cannot be drawn to {path} ({error}); choose another place or a .png") from error


def _draw_scenario(axes: Axes, scenario: Scenario, way: Points, taken: list[tuple[float, float]]) -> None:
    colour, canvas = COLOURS[scenario.kind], scenario.canvas
    axes.plot(way[:, 0], way[:, 1], color=colour, linewidth=1.6, alpha=0.85, zorder=5)
    axes.plot(way[0, 0], way[0, 1], "o", color=colour, markersize=5.5, markeredgecolor="white", zorder=7)
    arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.6}
    axes.annotate("", xy=tuple(way[-1]), xytext=tuple(way[-5:][0]), arrowprops=arrow, zorder=7)
    outline = (CANVAS_CORNERS_PX @ canvas.world_from_canvas.T)[:, :2]
    axes.fill(*outline.T, facecolor=colour, alpha=0.35, edgecolor=colour, linewidth=1.0, zorder=4)
    x, y = _label_place(scenario, taken)
    taken.append((x, y))
    name = re.sub(r"^(straight|left|right)-(?=\d+$)", lambda kind: kind[1][0].upper(), scenario.name)
    ha = "center"
    if len(name) > SHORT and abs(x - scenario.start.x_m) > 1.0:
        # Beside the start, a long name goes from there to the middle of the map.
        inwards = 1.0 if scenario.start.x_m < sum(axes.get_xlim()) / 2 else -1.0
        x, ha = scenario.start.x_m + 6.0 * inwards, "left" if inwards > 0 else "right"
    axes.text(x, y, name, color=colour, fontsize=8.5, fontweight="bold", ha=ha, va="center", zorder=8)


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
