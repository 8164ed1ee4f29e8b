"""Pictures of what a study found, for some of its scenarios: paths past the canvas, the patterns, what the car sees."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from roadproof.errors import ScenarioError
from roadproof.patterns import raster
from roadproof.report.formatting import in_words
from roadproof.report.road_view import Ground, around_canvas, draw_road, on_asphalt
from roadproof.roads.maps import load_map
from roadproof.scenarios import KINDS
from roadproof.study.charts import INK, MUTED, Picture, legend, plain, style
from roadproof.study.kept_jobs import KeptJob
from roadproof.study.results import Results
from roadproof.study.rows import JobId

PANELS = 6
ROWS, COLUMNS = 8, 12
VIEWS = 4
BEFORE_M, AFTER_M, BESIDE_M = 12.0, 26.0, 10.5
GROUND = Ground(sidewalk="#d8d4c9", asphalt="#b9bcc0", marking="#f6f4ee")
GRASS = "#e4e9d9"
CLEAN = "#1c2126"
PICTURE_PX = 160

Jobs = Mapping[JobId, KeptJob]


def examples(results: Results, count: int) -> tuple[str, ...]:
    """Scenarios to be shown: of every kind some, evenly spread from the most to the least that GradOpt deviates there.

    Args:
        results: of the study; deviations at the largest K decide.
        count: how many at most.
    """
    values = results.values(results.overall[0], results.reference.name, results.figures[-1])
    reached: dict[str, float] = dict.fromkeys(results.kinds, 0.0) | values.groupby(level=0).max().to_dict()
    kinds = [kind for kind in KINDS if kind in results.kinds.values()]
    chosen: list[str] = []
    for number, kind in enumerate(kinds):
        ranked = sorted((name for name, own in results.kinds.items() if own == kind), key=lambda name: -reached[name])
        share = count // len(kinds) + (number < count % len(kinds))
        at = np.unique(np.linspace(0, len(ranked) - 1, min(share, len(ranked))).round().astype(int))
        chosen += [ranked[k] for k in at]
    return tuple(chosen)


def trajectories(results: Results, jobs: Jobs) -> Picture | None:
    """Paths of the car past the canvas, without paint and over each method's pattern, in example scenarios."""
    figures, seed = results.figures[-1], results.seeds[0]
    shown: list[tuple[str, list[KeptJob]]] = []
    for scenario in examples(results, PANELS):
        own = [jobs.get(JobId(scenario, figures, method, seed)) for method in results.compared]
        driven = [job for job in own if job is not None and job.paths() is not None]
        shown += [(scenario, driven)] if driven else []
    if not shown:
        return None
    figure = Figure(figsize=(1.9 * len(shown) + 0.4, 4.3), layout="constrained")
    for column, (scenario, driven) in enumerate(shown):
        axes = figure.add_subplot(1, len(shown), column + 1)
        axes.set_title(plain(scenario), fontsize=10, color=INK)
        _draw_place(axes, driven[0])
        _draw_paths(axes, results, driven)
    legend(figure)
    return Picture(
        "trajectories",
        f"The car’s paths past the canvas (dashed) at K = {figures}, seed {seed}, alone, from above; up is the "
        f"direction of travel at the canvas, and the window is {2 * BESIDE_M:.0f} m wide. Of each kind of scenario, "
        f"from the one where {results.reference.name} deviates most to where least.",
        figure,
    )


def _draw_paths(axes: Axes, results: Results, driven: Sequence[KeptJob]) -> None:
    """The bare road's path, and those over each method's pattern."""
    around = around_canvas(driven[0].scenario.canvas)
    for number, job in enumerate(driven):
        paths = job.paths()
        assert paths is not None
        clean, painted = paths
        if number == 0:
            axes.plot(*around(clean).T, color=CLEAN, linewidth=1.4, label="bare road")
        # The first lies on top: it is what the others are compared with.
        look: dict[str, Any] = style(results, job.id.method) | {"marker": "", "zorder": 4.0 - 0.1 * number}
        axes.plot(*around(painted).T, linewidth=2.0, label=plain(job.id.method), **look)


def _draw_place(axes: Axes, job: KeptJob) -> None:
    """The road, where its map can be read, and the canvas."""
    canvas = job.scenario.canvas
    width, length = canvas.width_m, canvas.length_m
    low, high = -length / 2 - BEFORE_M, length / 2 + AFTER_M
    axes.set(xticks=[], yticks=[], facecolor=GRASS)
    axes.spines[:].set_visible(False)
    try:
        box = (-BESIDE_M, low, BESIDE_M, high)
        draw_road(axes, load_map(job.scenario.map_name), around_canvas(canvas), box, GROUND)
    except ScenarioError:
        pass  # Another simulator's map: paths and canvas are shown without it.
    look: dict[str, Any] = {"fill": False, "edgecolor": INK, "linewidth": 0.9, "linestyle": (0, (3, 2))}
    axes.add_patch(Rectangle((-width / 2, -length / 2), width, length, **look))
    axes.set(xlim=(-BESIDE_M, BESIDE_M), ylim=(low, high), aspect="equal")


def gallery(results: Results, jobs: Jobs) -> Picture | None:
    """Patterns on asphalt, a row a scenario and a column each K and method, with the deviation under each."""
    names, seed = results.compared, results.seeds[0]
    scenarios = [
        name for name in examples(results, ROWS) if any(job.scenario == name and job.seed == seed for job in jobs)
    ]
    spread = np.linspace(len(results.figures) - 1, 0, max(1, min(len(results.figures), COLUMNS // len(names))))
    kept: list[int] = np.unique(spread.round().astype(int)).tolist()
    shown = [results.figures[k] for k in kept]
    columns = [(figures, name) for figures in shown for name in names]
    titles = [f"K = {figures}\n{plain(name)}" for figures, name in columns]
    rows = [[JobId(scenario, *column, seed) for column in columns] for scenario in scenarios]

    def picture(job: JobId, _column: int) -> UInt8[np.ndarray, "h w 3"] | None:
        kept = jobs.get(job)
        pattern = None if kept is None else kept.pattern()
        if kept is None or pattern is None:
            return None
        canvas = kept.scenario.canvas
        return np.asarray(on_asphalt(raster(pattern, PICTURE_PX), PICTURE_PX, (canvas.width_m, canvas.length_m)))

    size_in = (1.25 * len(columns) + 0.9, 1.95 * len(rows) + 0.6)
    figure = _grid(results, rows, titles, [results.home] * len(columns), picture, size_in)
    return figure and Picture(
        "patterns",
        f"The patterns found, as they lie on the road, seed {seed}; the far edge is above. Under each the deviation it "
        "caused, driven alone in the weather in which it was found.",
        figure,
    )


def in_weathers(results: Results, jobs: Jobs) -> Picture | None:
    """What the car's camera sees of the reference method's patterns, a row a scenario and a column each weather."""
    figures, seed, method = results.figures[-1], results.seeds[0], results.reference.name
    wanted = [JobId(name, figures, method, seed) for name in examples(results, VIEWS)]
    seen = {job: [jobs[job].view(weather) for weather in results.weathers] for job in wanted if job in jobs}
    rows = [[job] * len(views) for job, views in seen.items() if any(view is not None for view in views)]
    titles = [plain(in_words(weather)) for weather in results.weathers]
    size_in = (2.6 * len(titles) + 0.4, 2.25 * len(rows) + 0.4)
    figure = _grid(results, rows, titles, results.weathers, lambda job, column: seen[job][column], size_in)
    return figure and Picture(
        "weathers",
        f"What the car’s camera sees of {method}’s patterns, K = {figures}, seed {seed}, a few metres before them. "
        "Under each the deviation in that weather, driven alone.",
        figure,
    )


def _grid(
    results: Results,
    rows: Sequence[Sequence[JobId]],
    titles: Sequence[str],
    weathers: Sequence[str],
    picture: Callable[[JobId, int], UInt8[np.ndarray, "h w 3"] | None],
    size_in: tuple[float, float],
) -> Figure | None:
    """Pictures of jobs side by side, with the deviation under each; None where there is none.

    Args:
        results: of the study.
        rows: jobs, each row of one scenario.
        titles: over the columns.
        weathers: of each column's deviations.
        picture: gives that of a job in a column.
        size_in: width and height of the whole, inches.
    """
    pictures = [[picture(job, column) for column, job in enumerate(row)] for row in rows]
    if not any(one is not None for row in pictures for one in row):
        return None
    figure = Figure(figsize=size_in, layout="constrained")
    grid: Any = figure.subplots(len(rows), len(titles), squeeze=False)
    for row, column in product(range(len(rows)), range(len(titles))):
        axes, job, shown = grid[row, column], rows[row][column], pictures[row][column]
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        if row == 0:
            axes.set_title(titles[column], fontsize=9.5, color=INK)
        if column == 0:
            axes.set_ylabel(plain(job.scenario), fontsize=9.5, color=INK)
        if shown is None:
            axes.text(0.5, 0.5, "none", ha="center", va="center", color=MUTED, fontsize=9)
            continue
        axes.imshow(shown)
        reached = _deviation_m(results, job, weathers[column])
        axes.set_xlabel("not driven" if reached is None else f"{reached:.2f} m", fontsize=9, color=INK, labelpad=2)
    return figure


def _deviation_m(results: Results, job: JobId, weather: str) -> float | None:
    values = results.values(replace(results.overall[0], weather=weather), job.method, job.figures)
    return values.get((job.scenario, job.seed))
