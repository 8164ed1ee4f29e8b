"""Charts of a study: deviation and penalty by K, and how searches come forward.

Every method keeps its colour, line and marker in all charts (Okabe and Ito's colours, and two of Tol's).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from roadproof.report.formatting import in_words, plain
from roadproof.study.history import Progress
from roadproof.study.kept_jobs import KeptJob
from roadproof.study.results import DEVIATION, Block, Results
from roadproof.study.statistics import mean_over_scenarios
from roadproof.study.table_notes import averaged, cases_of

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b07a00", "#56b4e9", "#000000", "#882255", "#7a7f85")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", "*")
LINES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.4)), (0, (6, 2, 1, 2)))
_ENTRY_IN, LETTER_IN = 0.7, 0.085
"""Room that an entry of a legend takes, and each of its letters, inches."""
INK, MUTED, RULE = "#1c2126", "#575e66", "#dcd9d1"


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A figure and its words.

    Args:
        name: the name of the picture's file, without the ending.
        caption: what the picture shows.
        figure: the figure, drawn.
    """

    name: str
    caption: str
    figure: Figure


def style(results: Results, method: str) -> dict[str, Any]:
    """Colour, line and marker of a method."""
    index = [each.name for each in results.methods].index(method)
    return {
        "color": COLOURS[index % len(COLOURS)],
        "linestyle": LINES[index % len(LINES)],
        "marker": MARKERS[index % len(MARKERS)],
    }


def by_figures(results: Results) -> Picture:
    """Deviation and penalty of every method for each K, with their intervals."""
    figure = Figure(figsize=(10.0, 3.9), layout="constrained")
    for column, block in enumerate(results.overall):
        axes = figure.add_subplot(1, 2, column + 1)
        for number, method in enumerate(results.methods):
            _draw_means(axes, results, block, method.name, number - (len(results.methods) - 1) / 2)
        axes.set_xticks(range(len(results.figures)), results.figures)
        axes.set_xlim(-0.5, len(results.figures) - 0.5)
        axes.set_ylim(bottom=0.0)
        named = f"{block.metric.title.lower()}, {block.metric.unit}"
        _label(axes, "K, figures of the pattern", named)
    legend(figure)
    names = [method.name for method in results.methods]
    how = f"penalty {'in traffic' if results.overall[1].traffic else 'alone on the road'}"
    return Picture(
        "by-figures",
        f"Deviation and infraction penalty for each K at {in_words(results.home)}, driven, {how}. "
        f"{averaged([cases_of(results, block, names, compared=False) for block in results.overall], compared=False)}",
        figure,
    )


def _draw_means(axes: Axes, results: Results, block: Block, method: str, place: float) -> None:
    """A method's means with their intervals, beside those of others."""
    means = [mean_over_scenarios(results.values(block, method, each)) for each in results.figures]
    apart = place * min(0.12, 0.6 / len(results.methods))
    kept = [(x + apart, mean) for x, mean in enumerate(means) if mean is not None]
    ends = [
        [mean.value - (mean.value if mean.low is None else mean.low) for _, mean in kept],
        [(mean.value if mean.high is None else mean.high) - mean.value for _, mean in kept],
    ]
    axes.errorbar(
        [x for x, _ in kept],
        [mean.value for _, mean in kept],
        yerr=ends,
        label=plain(method),
        linewidth=1.5,
        elinewidth=1.1,
        capsize=2.5,
        markersize=5.5,
        **style(results, method),
    )


def progress(results: Results, jobs: Sequence[KeptJob]) -> Picture | None:
    """Deviation of the best pattern so far against simulator calls and against seconds, driven."""
    courses: dict[str, dict[str, list[Progress]]] = {}
    for job in jobs:
        course = job.deviation() if job.id.method in results.compared else None
        if course is not None:
            courses.setdefault(job.id.figures, {}).setdefault(job.id.method, []).append(course)
    shown = [figures for figures in results.figures if figures in courses]
    if not shown:
        return None
    figure = Figure(figsize=(max(3.0 * len(shown), 6.0), 5.6), layout="constrained")
    grid: Any = figure.subplots(2, len(shown), squeeze=False, sharey="col")
    for column, figures in enumerate(shown):
        for row, (field, name) in enumerate((("calls", "simulator calls"), ("seconds", "seconds of search"))):
            axes: Axes = grid[row, column]
            for method in results.compared:
                chosen = courses[figures].get(method)
                own = chosen or _judged(results, method, figures)
                if not own:
                    continue
                at = [np.asarray(getattr(course, field), np.float64) for course in own]
                best = [np.asarray(course.best, np.float64) for course in own]
                hollow = {} if chosen else {"markerfacecolor": "white"}
                _draw_course(axes, at, best, plain(method), {**style(results, method), **hollow})
            axes.set_xscale("log")
            # 1, 2, 5, 10 … in words, however few decades there are.
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.set_ylim(bottom=0.0)
            reached = "deviation of the best so far, m" if column == 0 else ""
            _label(axes, name, reached)
            if row == 0:
                axes.set_title(f"K = {figures}", fontsize=10, color=INK)
    legend(figure)
    return Picture(
        "progress",
        "What the best pattern so far does when driven, against simulator calls and seconds: median over scenarios and "
        "seeds, and their range, from where all of a method's searches have begun. Black-box searches choose the best "
        "by their own measure, so a line may fall; a search on recordings is a point, at the drive that chose its "
        "answer, which flatters it as the lines are flattered; a hollow point, where no drive chose the pattern, is "
        "the mean of those that judge it.",
        figure,
    )


def _judged(results: Results, method: str, figures: str) -> list[Progress]:
    """What each pattern of a method did in the drives that judge it, at the whole cost of its search."""
    drives = results.drives_of(results.overall[0], [method], figures).groupby(["scenario", "seed"], sort=False)
    means = drives[["search_calls", "search_seconds", DEVIATION.column]].mean()
    rows = means.itertuples(index=False)
    return [Progress(calls=(int(calls),), seconds=(took_s,), best=(far_m,)) for calls, took_s, far_m in rows]


def _draw_course(
    axes: Axes, places: Sequence[np.ndarray], reached: Sequence[np.ndarray], name: str, look: Mapping[str, Any]
) -> None:
    """A line with its band, or a point with its range where each search was driven but once."""
    if all(len(each) == 1 for each in reached):
        middle = float(np.median(reached))
        ends = [[middle - float(np.min(reached))], [float(np.max(reached)) - middle]]
        at = float(np.median(np.concatenate(places)))
        point: dict[str, Any] = {**look, "linestyle": "none", "zorder": 5}
        axes.errorbar([at], [middle], yerr=ends, label=name, capsize=3, markersize=7, **point)
        return
    line: dict[str, Any] = {**look, "marker": ""}
    x, values = _aligned(places, reached)
    axes.plot(x, np.median(values, 0), label=name, linewidth=1.9, **line)
    axes.fill_between(x, values.min(0), values.max(0), color=look["color"], alpha=0.14, linewidth=0)


def _aligned(
    axes: Sequence[np.ndarray], values: Sequence[np.ndarray]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "s n"]]:
    """Steps of several searches at common places, from where all have begun; the best stays when a search has ended."""
    first, last = max(float(own[0]) for own in axes), max(float(own[-1]) for own in axes)
    x = np.unique(np.geomspace(max(first, 1e-3), max(last, 1e-3), 400))
    steps = [own[(np.searchsorted(at, x, side="right") - 1).clip(0)] for at, own in zip(axes, values, strict=True)]
    return x, np.stack(steps)


def _label(axes: Axes, x: str, y: str) -> None:
    axes.set_xlabel(x, color=MUTED, fontsize=9)
    axes.set_ylabel(y, color=MUTED, fontsize=9)
    axes.tick_params(colors=MUTED, labelsize=9, length=3, width=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.grid(axis="y", color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)


def legend(figure: Figure) -> None:
    """One legend for all axes, above them, in as many columns as the figure has room for."""
    entries: dict[str, Any] = {}
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        for handle, name in zip(handles, labels, strict=True):
            entries.setdefault(name, handle)
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="outside upper left",
        ncols=max(1, min(len(entries), int(figure.get_figwidth() / (_ENTRY_IN + LETTER_IN * max(map(len, entries)))))),
        frameon=False,
        fontsize=9.5,
        labelcolor=INK,
        handlelength=3.0,
    )
