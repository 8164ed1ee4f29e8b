"""Pictures of what a study found, for some of its scenarios: paths past the canvas, the patterns, what the car sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from roadproof.driving.deviation import Path2D
from roadproof.errors import ScenarioError
from roadproof.patterns import raster
from roadproof.report.formatting import in_words
from roadproof.report.road_view import Ground, around_canvas, draw_road, on_asphalt
from roadproof.report.study.blocks import compared, reference
from roadproof.report.study.charts import INK, MUTED, Picture, legend, plain, style
from roadproof.report.study.folder import Found
from roadproof.report.study.results import JobId, Results
from roadproof.roads.maps import load_map
from roadproof.roads.roadmap import RoadMap
from roadproof.scenarios import KINDS

PANELS = 6
ROWS, COLUMNS = 8, 12
VIEWS = 4
BEFORE_M, AFTER_M, BESIDE_M = 12.0, 26.0, 10.5
GROUND = Ground(sidewalk="#d8d4c9", asphalt="#b9bcc0", marking="#f6f4ee")
GRASS = "#e4e9d9"
CLEAN = "#1c2126"
PICTURE_PX = 160


def examples(results: Results, count: int) -> tuple[str, ...]:
    """Scenarios to be shown: of every kind some, evenly spread from the most to the least that GradOpt deviates there.

    Args:
        results: of the study; deviations at the largest K decide.
        count: how many at most.
    """
    ours, alone = reference(results.methods).name, not results.has(traffic=False)
    reached: dict[str, float] = dict.fromkeys(results.kinds, 0.0)
    values = results.values("deviation_m", ours, results.figures[-1], weather=results.home, traffic=alone)
    for (scenario, _), value in values.items():
        reached[scenario] = max(reached[scenario], value)
    kinds = [kind for kind in KINDS if kind in results.kinds.values()]
    chosen: list[str] = []
    for number, kind in enumerate(kinds):
        ranked = sorted((name for name, own in results.kinds.items() if own == kind), key=lambda name: -reached[name])
        share = count // len(kinds) + (number < count % len(kinds))
        at = np.unique(np.linspace(0, len(ranked) - 1, min(share, len(ranked))).round().astype(int))
        chosen += [ranked[k] for k in at]
    return tuple(chosen)


def trajectories(results: Results, found: Mapping[JobId, Found]) -> Picture | None:
    """Paths of the car past the canvas, without paint and over each method's pattern, in example scenarios."""
    figures, seed = results.figures[-1], results.seeds[0]
    names = compared(results.methods)
    shown = [(name, own) for name in examples(results, PANELS) if (own := _paths(found, name, figures, names, seed))]
    if not shown:
        return None
    figure = Figure(figsize=(1.9 * len(shown) + 0.4, 4.3), layout="constrained")
    for column, (scenario, own) in enumerate(shown):
        axes = figure.add_subplot(1, len(shown), column + 1)
        axes.set_title(plain(scenario), fontsize=10, color=INK)
        one = found[JobId(scenario, figures, next(iter(own)), seed)]
        _draw_place(axes, one)
        around = around_canvas(one.canvas)
        for number, (method, (clean, painted)) in enumerate(own.items()):
            if number == 0:
                axes.plot(*around(clean).T, color=CLEAN, linewidth=1.4, label="bare road")
            # The first lies on top: it is what the others are compared with.
            look: dict[str, Any] = _line(results, method) | {"zorder": 4.0 - 0.1 * number}
            axes.plot(*around(painted).T, linewidth=2.0, label=plain(method), **look)
        axes.set(xlim=(-BESIDE_M, BESIDE_M), ylim=_reach(one), aspect="equal")
    legend(figure)
    return Picture(
        "trajectories",
        f"The car’s paths past the canvas (dashed) at K = {figures}, seed {seed}, alone, from above; up is the "
        f"direction of travel at the canvas, and the window is {2 * BESIDE_M:.0f} m wide. Of each kind of scenario, "
        f"from the one where {reference(results.methods).name} deviates most to where least.",
        figure,
    )


def gallery(results: Results, found: Mapping[JobId, Found]) -> Picture | None:
    """Patterns on asphalt, a row a scenario and a column each K and method, with the deviation under each."""
    seed = results.seeds[0]
    scenarios = [
        name for name in examples(results, ROWS) if any(job.scenario == name and job.seed == seed for job in found)
    ]
    names = compared(results.methods)
    spread = np.linspace(len(results.figures) - 1, 0, max(1, min(len(results.figures), COLUMNS // len(names))))
    at: list[int] = np.unique(spread.round().astype(int)).tolist()
    shown_figures = [results.figures[k] for k in at]
    columns = [(figures, name) for figures in shown_figures for name in names]
    if not scenarios:
        return None
    figure = Figure(figsize=(1.25 * len(columns) + 0.9, 1.95 * len(scenarios) + 0.6), layout="constrained")
    grid: Any = figure.subplots(len(scenarios), len(columns), squeeze=False)
    drawn = 0
    for row, scenario in enumerate(scenarios):
        for column, (figures, method) in enumerate(columns):
            axes: Axes = grid[row, column]
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            if row == 0:
                axes.set_title(f"K = {figures}\n{plain(method)}", fontsize=9, color=INK)
            if column == 0:
                axes.set_ylabel(plain(scenario), fontsize=9.5, color=INK)
            job = found.get(JobId(scenario, figures, method, seed))
            pattern = None if job is None else job.pattern()
            if job is None or pattern is None:
                axes.text(0.5, 0.5, "none", ha="center", va="center", color=MUTED, fontsize=9)
                continue
            size = (job.canvas.width_m, job.canvas.length_m)
            axes.imshow(np.asarray(on_asphalt(raster(pattern, PICTURE_PX), PICTURE_PX, size)))
            reached = _deviation(results, job.job, results.home)
            axes.set_xlabel("not driven" if reached is None else f"{reached:.2f} m", fontsize=9, color=INK, labelpad=2)
            drawn += 1
    if not drawn:
        return None
    return Picture(
        "patterns",
        f"The patterns found, as they lie on the road, seed {seed}; the far edge is above. Under each the deviation it "
        "caused, driven alone in the weather in which it was found.",
        figure,
    )


def in_weathers(results: Results, found: Mapping[JobId, Found]) -> Picture | None:
    """What the car's camera sees of the reference method's patterns, a row a scenario and a column each weather."""
    figures, seed, method = results.figures[-1], results.seeds[0], reference(results.methods).name
    jobs = [job for name in examples(results, VIEWS) if (job := found.get(JobId(name, figures, method, seed)))]
    seen = {job.job: {weather: job.view(weather) for weather in results.weathers} for job in jobs}
    shown = [job for job, views in seen.items() if any(view is not None for view in views.values())]
    if not shown:
        return None
    size = (2.6 * len(results.weathers) + 0.4, 2.25 * len(shown) + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    grid: Any = figure.subplots(len(shown), len(results.weathers), squeeze=False)
    for row, job in enumerate(shown):
        for column, weather in enumerate(results.weathers):
            axes: Axes = grid[row, column]
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
            if row == 0:
                axes.set_title(plain(in_words(weather)), fontsize=10, color=INK)
            if column == 0:
                axes.set_ylabel(plain(job.scenario), fontsize=9.5, color=INK)
            view = seen[job][weather]
            if view is not None:
                axes.imshow(view)
            reached = _deviation(results, job, weather)
            axes.set_xlabel("not driven" if reached is None else f"{reached:.2f} m", fontsize=9, color=INK, labelpad=2)
    return Picture(
        "weathers",
        f"What the car’s camera sees of {method}’s patterns, K = {figures}, seed {seed}, a few metres before them. "
        "Under each the deviation in that weather, driven alone.",
        figure,
    )


def _paths(
    found: Mapping[JobId, Found], scenario: str, figures: str, methods: Sequence[str], seed: int
) -> dict[str, tuple[Path2D, Path2D]]:
    """Both paths of every method that has some."""
    jobs = {method: found.get(JobId(scenario, figures, method, seed)) for method in methods}
    return {method: paths for method, job in jobs.items() if job is not None and (paths := job.paths()) is not None}


def _line(results: Results, method: str) -> dict[str, Any]:
    look = style(results, method)
    return {"color": look["color"], "linestyle": look["linestyle"]}


def _reach(job: Found) -> tuple[float, float]:
    half = job.canvas.length_m / 2
    return -half - BEFORE_M, half + AFTER_M


def _draw_place(axes: Axes, job: Found) -> None:
    """The road, where its map can be read, and the canvas."""
    low, high = _reach(job)
    axes.set(xticks=[], yticks=[], facecolor=GRASS)
    axes.spines[:].set_visible(False)
    road = _road(job.map_name)
    if road is not None:
        draw_road(axes, road, around_canvas(job.canvas), (-BESIDE_M, low, BESIDE_M, high), GROUND)
    width, length = job.canvas.width_m, job.canvas.length_m
    axes.add_patch(
        Rectangle(
            (-width / 2, -length / 2), width, length, fill=False, edgecolor=INK, linewidth=0.9, linestyle=(0, (3, 2))
        )
    )


def _road(map_name: str) -> RoadMap | None:
    try:
        return load_map(map_name)
    except ScenarioError:
        # Another simulator's map: paths and canvas are shown without it.
        return None


def _deviation(results: Results, job: JobId, weather: str) -> float | None:
    alone = not results.has(traffic=False)
    values = results.values("deviation_m", job.method, job.figures, weather=weather, traffic=alone)
    return values.get((job.scenario, str(job.seed)))
