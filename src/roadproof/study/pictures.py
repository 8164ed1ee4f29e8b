"""Pictures of what a study found, for some of its scenarios: paths past the canvas, the patterns, what the car sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from textwrap import fill
from typing import Any

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from roadproof.patterns import raster
from roadproof.pipeline.film import FILMED_M
from roadproof.recordings import evenly
from roadproof.report.formatting import in_words, plain
from roadproof.report.road_view import Ground, around_canvas, draw_canvas, draw_road, on_asphalt, road_of
from roadproof.scenarios import KINDS
from roadproof.study.charts import INK, LETTER_IN, MUTED, Picture, legend, style
from roadproof.study.kept_jobs import KeptJob
from roadproof.study.results import Results
from roadproof.study.rows import JobId

PANELS = 6
ROWS, COLUMNS = 8, 12
BEFORE_M, AFTER_M, BESIDE_M = 12.0, 26.0, 10.5
GROUND = Ground(sidewalk="#d8d4c9", asphalt="#b9bcc0", marking="#f6f4ee", grass="#e4e9d9")
PICTURE_PX = 160

Jobs = Mapping[JobId, KeptJob]


def examples(results: Results, count: int) -> tuple[str, ...]:
    """Scenarios to be shown: of every kind some, evenly spread from the most to the least that GradOpt deviates there.

    Args:
        results: the study's numbers; deviations at the largest K decide.
        count: how many scenarios there are at most.
    """
    values = results.values(results.overall[0], results.reference.name, results.figures[-1])
    reached: dict[str, float] = dict.fromkeys(results.kinds, 0.0) | values.groupby(level=0).max().to_dict()
    kinds = [kind for kind in KINDS if kind in results.kinds.values()]
    chosen: list[str] = []
    for number, kind in enumerate(kinds):
        ranked = sorted((name for name, own in results.kinds.items() if own == kind), key=lambda name: -reached[name])
        share = count // len(kinds) + (number < count % len(kinds))
        at = evenly(len(ranked), share)
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
            axes.plot(*around(clean).T, color=INK, linewidth=1.4, label="bare road")
        # The first lies on top: it is what the others are compared with.
        look: dict[str, Any] = style(results, job.id.method) | {"marker": "", "zorder": 4.0 - 0.1 * number}
        axes.plot(*around(painted).T, linewidth=2.0, label=plain(job.id.method), **look)


def _draw_place(axes: Axes, job: KeptJob) -> None:
    """The road, where its map can be read, and the canvas."""
    canvas = job.scenario.canvas
    low, high = -canvas.length_m / 2 - BEFORE_M, canvas.length_m / 2 + AFTER_M
    axes.set(xticks=[], yticks=[], facecolor=GROUND.grass, xlim=(-BESIDE_M, BESIDE_M), ylim=(low, high))
    axes.spines[:].set_visible(False)
    if (road := road_of(job.scenario.map_name)) is not None:
        draw_road(axes, road, around_canvas(canvas), (-BESIDE_M, low, BESIDE_M, high), GROUND)
    draw_canvas(axes, canvas, None, INK, upright=True)


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
    rows = [[_pattern(results, jobs, JobId(scenario, *column, seed)) for column in columns] for scenario in scenarios]
    figure = _grid(scenarios, titles, rows, (1.25 * len(columns) + 0.9, 1.95 * len(rows) + 0.6))
    return figure and Picture(
        "patterns",
        f"The patterns found, as they lie on the road, seed {seed}; the far edge is above. Under each the mean "
        "deviation it caused, driven alone in the first weather.",
        figure,
    )


def passages(results: Results, jobs: Jobs) -> list[Picture]:
    """What the car's camera sees while it passes a pattern, a row a condition and a column a method.

    One scenario of each kind is shown, the one where the reference method's patterns deviate most, at the largest K; a
    straight one at K = 4 where the study has that, as the paper's supplement shows it.
    """
    conditions = [(weather, traffic) for traffic in (False, True) for weather in results.weathers]
    shown = examples(results, PANELS)
    pictures: list[Picture] = []
    for kind in KINDS:
        scenario = next((name for name in shown if results.kinds[name] == kind), None)
        if scenario is None:
            continue
        figures = "4" if kind == "straight" and "4" in results.figures else results.figures[-1]
        ids = [JobId(scenario, figures, method, results.seeds[0]) for method in results.compared]
        rows = {where: [_strip(results, jobs, job, *where) for job in ids] for where in conditions}
        kept = {where: row for where, row in rows.items() if any(cell.picture is not None for cell in row)}
        labels = [f"{in_words(weather)}{', traffic' * traffic}" for weather, traffic in kept]
        titles = list(map(plain, results.compared))
        figure = _grid(labels, titles, list(kept.values()), (6.4 * len(ids) + 0.5, 1.15 * len(kept) + 0.4))
        if figure is not None:
            words = (
                f"What the car’s camera sees on {plain(scenario)} as it passes each method’s pattern, K = {figures}, "
                f"seed {results.seeds[0]}: one drive in each condition, from {FILMED_M:.0f} m before the canvas to "
                "its end. Under each the mean deviation of all drives in that condition."
            )
            pictures.append(Picture(f"passage-{kind}", words, figure))
    return pictures


@dataclass(frozen=True, slots=True, eq=False)
class _Cell:
    """A picture of a grid and what stands under it."""

    picture: UInt8[np.ndarray, "h w 3"] | None
    note: str


def _pattern(results: Results, jobs: Jobs, job: JobId) -> _Cell:
    kept = jobs.get(job)
    pattern = None if kept is None else kept.pattern()
    if kept is None or pattern is None:
        return _Cell(None, "")
    picture = np.asarray(on_asphalt(raster(pattern, PICTURE_PX), PICTURE_PX, kept.scenario.canvas))
    return _Cell(picture, _driven(results, job, results.home, traffic=results.overall[0].traffic))


def _strip(results: Results, jobs: Jobs, job: JobId, weather: str, traffic: bool) -> _Cell:
    kept = jobs.get(job)
    picture = None if kept is None else kept.passage(weather, traffic=traffic)
    return _Cell(picture, _driven(results, job, weather, traffic=traffic))


def _driven(results: Results, job: JobId, weather: str, *, traffic: bool) -> str:
    block = replace(results.overall[0], weather=weather, traffic=traffic)
    reached = results.values(block, job.method, job.figures).get((job.scenario, job.seed))
    return "not driven" if reached is None else f"{reached:.2f} m"


def _grid(
    labels: Sequence[str], titles: Sequence[str], rows: Sequence[Sequence[_Cell]], size_in: tuple[float, float]
) -> Figure | None:
    """Pictures side by side, with a label to each row and a title over each column; None where there is none."""
    if not any(cell.picture is not None for row in rows for cell in row):
        return None
    figure = Figure(figsize=size_in, layout="constrained")
    grid: Any = figure.subplots(len(rows), len(titles), squeeze=False)
    letters = max(8, int(size_in[0] / len(titles) / LETTER_IN))
    over = ["\n".join(fill(line, letters, break_on_hyphens=False) for line in title.splitlines()) for title in titles]
    for row, column in product(range(len(rows)), range(len(titles))):
        axes, cell = grid[row, column], rows[row][column]
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_visible(False)
        if row == 0:
            axes.set_title(over[column], fontsize=9.5, color=INK)
        if column == 0:
            axes.set_ylabel(labels[row], fontsize=9.5, color=INK)
        if cell.picture is None:
            axes.text(0.5, 0.5, "none", ha="center", va="center", color=MUTED, fontsize=9)
            continue
        axes.imshow(cell.picture)
        axes.set_xlabel(cell.note, fontsize=9, color=INK, labelpad=2)
    return figure
