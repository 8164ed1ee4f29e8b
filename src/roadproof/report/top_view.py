"""Two drives from above: road, canvas with its pattern, both paths, and where things went wrong.

Drawn in metres around the canvas, ahead of it upwards, so the paint lies straight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from roadproof.driving.deviation import passage
from roadproof.driving.episode import Episode
from roadproof.driving.evaluation import path_of
from roadproof.driving.infractions import counted
from roadproof.errors import ScenarioError
from roadproof.geometry import CanvasPlacement
from roadproof.report.charts import CLEAN, INK, PAINTED, VARIABLES, Chart, svg_of
from roadproof.roads.maps import load_map
from roadproof.roads.roadmap import RoadMap
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage

MARGIN_M = 6.0
BEFORE_M, AFTER_S = 10.0, 3.0
SCALE_M = 5.0

Plan = Float[np.ndarray, "n 2"]


@dataclass(frozen=True, slots=True)
class Ground:
    """The colours of a road."""

    sidewalk: str
    asphalt: str
    marking: str


GROUND = Ground(VARIABLES["kerb"], VARIABLES["asphalt"], VARIABLES["marking"])


def top_view(scenario: Scenario, paint: PatternImage, clean: Episode, painted: Episode) -> Chart:
    """Both drives past the canvas, from above.

    Args:
        scenario: its canvas and its map; the road is drawn where the map can be read.
        paint: on the canvas.
        clean: the drive without paint.
        painted: the drive with it.
    """
    around = around_canvas(scenario.canvas)
    bare, driven = around(path_of(clean)), around(path_of(painted))
    seen = passage(path_of(clean), scenario.canvas, horizon_m=BEFORE_M)
    shown = slice(seen.start, seen.stop + round(AFTER_S / clean.dt_s))
    near = np.concatenate([bare[shown], driven[shown], [[0.0, 0.0]]])
    (left, low), (right, high) = near.min(0) - MARGIN_M, near.max(0) + MARGIN_M
    # Neither a slit nor a strip: people should see the lanes.
    left, right = _widened(left, right, 0.5 * (high - low))
    low, high = _widened(low, high, 0.5 * (right - left))
    width = 5.2
    figure = Figure(figsize=(width, width * (high - low) / (right - left)))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(left, right), ylim=(low, high), aspect="equal")
    axes.set_axis_off()
    road = _road(scenario)
    around_it = VARIABLES["asphalt" if road is None else "grass"]
    axes.add_patch(Rectangle((left, low), right - left, high - low, color=around_it))
    if road is not None:
        draw_road(axes, road, around, (left, low, right, high), GROUND)
    _draw_canvas(axes, scenario.canvas, paint)
    axes.plot(*bare.T, color=CLEAN, linewidth=2.2, solid_capstyle="round")
    axes.plot(*driven.T, color=PAINTED, linewidth=2.2, solid_capstyle="round")
    for colour, path in ((CLEAN, bare), (PAINTED, driven)):
        axes.plot(*path[min(shown.stop, len(path)) - 1], "o", color=colour, markersize=5)
    count = _draw_events(axes, painted, driven)
    _draw_scale(axes, left, low)
    words = (
        "From above: the bare-road drive (blue) and the drive over the paint (red) past the canvas"
        f"{f', with {count} numbered event' + ('s' if count != 1 else '') if count else ''}"
    )
    return Chart(svg_of(figure, "above", words), words + ". Up is the direction of travel at the canvas.")


def around_canvas(canvas: CanvasPlacement) -> Callable[[Plan], Plan]:
    """From world x, y to metres right of and ahead of the canvas' middle."""
    c, s = math.cos(canvas.yaw_rad), math.sin(canvas.yaw_rad)

    def around(points: Plan) -> Plan:
        dx, dy = points[:, 0] - canvas.x_m, points[:, 1] - canvas.y_m
        return np.column_stack([s * dx - c * dy, c * dx + s * dy])

    return around


def _road(scenario: Scenario) -> RoadMap | None:
    try:
        return load_map(scenario.map_name)
    except ScenarioError:
        # Another simulator's map: paths and canvas are shown without it.
        return None


def draw_road(
    axes: Axes, road: RoadMap, around: Callable[[Plan], Plan], box: tuple[float, float, float, float], ground: Ground
) -> None:
    """Draw what of a map lies in a box.

    Args:
        axes: to draw on.
        road: the map.
        around: from world x, y to the axes' plane.
        box: left, low, right, high in that plane.
        ground: its colours.
    """
    left, low, right, high = box
    colours = {"sidewalk": ground.sidewalk, "shoulder": ground.asphalt, "driving": ground.asphalt}

    def inside(plan: Plan) -> bool:
        outside = (plan.max(0) < (left, low)) | (plan.min(0) > (right, high))
        return not bool(outside.any())

    for kind in ("sidewalk", "shoulder", "driving"):
        outlines = [np.concatenate([lane.left, lane.right[::-1]])[:, :2] for lane in road.lanes if lane.kind == kind]
        if kind == "driving":
            outlines += [area.outline[:, :2] for area in road.junctions]
        shapes = [plan for plan in map(around, outlines) if inside(plan)]
        axes.add_collection(PolyCollection(shapes, facecolors=colours[kind], edgecolors=colours[kind], linewidths=0.4))
    lines = [(around(line.points[:, :2]), line.mark.kind) for line in road.mark_lines if line.junction is None]
    kept = [(plan, "--" if kind == "broken" else "-") for plan, kind in lines if inside(plan)]
    axes.add_collection(
        LineCollection(
            [plan for plan, _ in kept],
            colors=ground.marking,
            linewidths=0.8,
            linestyles=[style for _, style in kept],
        )
    )


def _draw_canvas(axes: Axes, canvas: CanvasPlacement, paint: PatternImage) -> None:
    half_x, half_y = canvas.width_m / 2, canvas.length_m / 2
    limits = axes.get_xlim(), axes.get_ylim()
    axes.imshow(paint, extent=(-half_x, half_x, -half_y, half_y), interpolation="antialiased", zorder=1.5)
    outline = Rectangle((-half_x, -half_y), canvas.width_m, canvas.length_m, fill=False, edgecolor=INK, linewidth=0.8)
    outline.set_linestyle((0, (3, 2)))
    axes.add_patch(outline)
    axes.set(xlim=limits[0], ylim=limits[1], aspect="equal")


def _draw_events(axes: Axes, painted: Episode, driven: Plan) -> int:
    events = counted(painted.events)
    for number, event in enumerate(events, 1):
        x, y = driven[int(np.abs(painted.time_s - event.time_s).argmin())]
        axes.plot(x, y, "o", markersize=13, color=VARIABLES["paper"], markeredgecolor=PAINTED, clip_on=True)
        axes.text(x, y, str(number), color=PAINTED, fontsize=9, ha="center", va="center_baseline", clip_on=True)
    return len(events)


def _draw_scale(axes: Axes, left: float, low: float) -> None:
    x, y = left + 1.5, low + 1.5
    axes.plot([x, x + SCALE_M], [y, y], color=INK, linewidth=1.6, solid_capstyle="butt")
    axes.text(x + SCALE_M / 2, y + 0.6, f"{SCALE_M:.0f} m", color=INK, fontsize=9, ha="center", va="bottom")


def _widened(low: float, high: float, least: float) -> tuple[float, float]:
    grow = max(least - (high - low), 0.0) / 2
    return low - grow, high + grow
