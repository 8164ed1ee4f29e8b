"""Two drives from above: road, canvas with its pattern, both paths, and where things went wrong.

Drawn in metres around the canvas, ahead of it upwards, so the paint lies straight.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from roadproof.driving.deviation import passage, path_of
from roadproof.driving.episode import Episode
from roadproof.driving.infractions import counted
from roadproof.report.charts import CLEAN, INK, NO_MOMENTS, PAINTED, VARIABLES, WIDTH_IN, Chart, Mark, svg_of
from roadproof.report.road_view import Ground, Points, around_canvas, draw_canvas, draw_road, plan_of, road_of
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage

MARGIN_M = 6.0
BEFORE_M, AFTER_S = 10.0, 3.0
SCALE_M = 5.0
GROUND = Ground(VARIABLES["kerb"], VARIABLES["asphalt"], VARIABLES["marking"])


def top_view(
    scenario: Scenario,
    paint: PatternImage,
    clean: Episode,
    painted: Episode,
    name: str = "above",
    steps: Int[np.ndarray, " n"] = NO_MOMENTS,
) -> Chart:
    """Both drives past the canvas, from above.

    Args:
        scenario: the scenario, with its canvas and its map; the road is drawn where the map can be read.
        paint: the pattern on the canvas.
        clean: the drive without paint.
        painted: the drive over the pattern.
        name: a word that tells this chart from the page's others.
        steps: the steps of both drives at which there are pictures of the passage.
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
    box = (left, low, right, high)
    figure, axes = plan_of(box, (WIDTH_IN, WIDTH_IN * (high - low) / (right - left)), "none")
    road = road_of(scenario.map_name)
    beside = VARIABLES["asphalt" if road is None else "grass"]
    axes.add_patch(Rectangle((left, low), right - left, high - low, color=beside))
    if road is not None:
        draw_road(axes, road, around, box, GROUND)
    draw_canvas(axes, scenario.canvas, paint, INK, upright=True)
    axes.plot(*bare.T, color=CLEAN, linewidth=2.2, solid_capstyle="round")
    axes.plot(*driven.T, color=PAINTED, linewidth=2.2, solid_capstyle="round")
    for colour, path in ((CLEAN, bare), (PAINTED, driven)):
        axes.plot(*path[min(shown.stop, len(path)) - 1], "o", color=colour, markersize=5)
    count = _draw_events(axes, painted, driven)
    axes.plot([left + 1.5, left + 1.5 + SCALE_M], [low + 1.5] * 2, color=INK, linewidth=1.6, solid_capstyle="butt")
    middle = left + 1.5 + SCALE_M / 2
    axes.text(middle, low + 2.1, f"{SCALE_M:.0f} m", color=INK, fontsize=9, ha="center", va="bottom")
    words = (
        "From above: the bare-road drive (blue) and the drive over the paint (red) past the canvas"
        f"{f', with {count} numbered event' + ('s' if count != 1 else '') if count else ''}"
    )
    marks = (
        Mark(kind, path[np.minimum(steps, len(path) - 1)]) for kind, path in (("clean", bare), ("painted", driven))
    )
    return Chart(svg_of(figure, name, words, marks), words + ". Up is the direction of travel at the canvas.")


def _draw_events(axes: Axes, painted: Episode, driven: Points) -> int:
    events = counted(painted.events)
    for number, event in enumerate(events, 1):
        x, y = driven[int(np.abs(painted.time_s - event.time_s).argmin())]
        axes.plot(x, y, "o", markersize=13, color=VARIABLES["paper"], markeredgecolor=PAINTED, clip_on=True)
        axes.text(x, y, str(number), color=PAINTED, fontsize=9, ha="center", va="center_baseline", clip_on=True)
    return len(events)


def _widened(low: float, high: float, least: float) -> tuple[float, float]:
    grow = max(least - (high - low), 0.0) / 2
    return low - grow, high + grow
