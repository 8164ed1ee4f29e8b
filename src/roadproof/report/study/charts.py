"""Charts of a study: deviation and penalty by K, and how searches come forward.

Every method keeps its colour, line and marker in all charts (Okabe and Ito's colours).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from roadproof.report.formatting import in_words
from roadproof.report.study.blocks import compared, overall
from roadproof.report.study.folder import Found, History
from roadproof.report.study.results import Results
from roadproof.report.study.statistics import mean_over_scenarios

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#b07a00", "#56b4e9", "#000000")
MARKERS = ("o", "s", "^", "D", "v", "P", "X")
LINES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1, 1.4)), (0, (6, 2, 1, 2)))
INK, MUTED, RULE = "#1c2126", "#575e66", "#dcd9d1"


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A figure and its words.

    Args:
        name: of its file.
        caption: what it shows.
        figure: drawn.
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
    blocks = overall(results)
    figure = Figure(figsize=(10.0, 3.9), layout="constrained")
    count = len(results.methods)
    for column, block in enumerate(blocks):
        axes = figure.add_subplot(1, 2, column + 1)
        for number, method in enumerate(results.methods):
            means = [mean_over_scenarios(block.values(results, method.name, each)) for each in results.figures]
            at = np.arange(len(means)) + (number - (count - 1) / 2) * min(0.12, 0.6 / count)
            kept = [(x, mean) for x, mean in zip(at.tolist(), means, strict=True) if mean is not None]
            ends = [
                [mean.value - (mean.value if mean.low is None else mean.low) for _, mean in kept],
                [(mean.value if mean.high is None else mean.high) - mean.value for _, mean in kept],
            ]
            axes.errorbar(
                [x for x, _ in kept],
                [mean.value for _, mean in kept],
                yerr=ends,
                label=plain(method.name),
                linewidth=1.5,
                elinewidth=1.1,
                capsize=2.5,
                markersize=5.5,
                **style(results, method.name),
            )
        axes.set_xticks(range(len(results.figures)), results.figures)
        axes.set_xlim(-0.5, len(results.figures) - 0.5)
        axes.set_ylim(bottom=0.0)
        label(axes, "K, figures of the pattern", f"{block.metric.title.lower()}, {block.metric.unit}")
    legend(figure)
    how = f"penalty {'in traffic' if blocks[1].traffic else 'alone on the road'}"
    return Picture(
        "by-figures",
        f"Deviation and infraction penalty for each K at {in_words(results.home)}, driven, {how}: means over scenarios "
        "with 95 % bootstrap intervals.",
        figure,
    )


def progress(results: Results, found: Sequence[Found]) -> Picture | None:
    """Deviation of the best pattern so far against simulator calls and against seconds, driven."""
    names = compared(results.methods)
    histories: dict[str, dict[str, list[History]]] = {}
    for each in found:
        history = each.history() if each.job.method in names else None
        if history is not None:
            histories.setdefault(each.job.figures, {}).setdefault(each.job.method, []).append(history)
    shown = [figures for figures in results.figures if figures in histories]
    if not shown:
        return None
    figure = Figure(figsize=(max(3.0 * len(shown), 6.0), 5.6), layout="constrained")
    grid: Any = figure.subplots(2, len(shown), squeeze=False, sharey="col")
    axis_of: tuple[tuple[str, Callable[[History], np.ndarray]], ...] = (
        ("simulator calls", lambda history: history.calls),
        ("seconds of search", lambda history: history.seconds),
    )
    for column, figures in enumerate(shown):
        for row, (name, axis) in enumerate(axis_of):
            axes: Axes = grid[row, column]
            for method, own in histories[figures].items():
                _draw_course(axes, [axis(each) for each in own], own, plain(method), style(results, method))
            axes.set_xscale("log")
            _plain_ticks(axes)
            axes.set_ylim(bottom=0.0)
            label(axes, name, "deviation of the best so far, m" if column == 0 else "")
            if row == 0:
                axes.set_title(f"K = {figures}", fontsize=10, color=INK)
    legend(figure)
    return Picture(
        "progress",
        "What the best pattern so far does when driven, against simulator calls and seconds: median over scenarios and "
        "seeds, and their range. Black-box searches choose the best by their own measure, so a line may fall; a search "
        "on composited frames is a point, where its answer was driven.",
        figure,
    )


def _plain_ticks(axes: Axes) -> None:
    """1, 2, 5, 10 … in words, however few decades there are."""
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _draw_course(
    axes: Axes, places: Sequence[np.ndarray], own: Sequence[History], name: str, look: Mapping[str, Any]
) -> None:
    """A line with its band, or a point with its range where each search was driven but once."""
    if all(len(each.deviation_m) == 1 for each in own):
        reached = np.concatenate([each.deviation_m for each in own])
        middle = float(np.median(reached))
        ends = [[middle - float(reached.min())], [float(reached.max()) - middle]]
        at = float(np.median(np.concatenate(list(places))))
        point: dict[str, Any] = {**look, "linestyle": "none", "zorder": 5}
        axes.errorbar([at], [middle], yerr=ends, label=name, capsize=3, markersize=7, **point)
        return
    line: dict[str, Any] = {**look, "marker": ""}
    x, values = _aligned(places, [each.deviation_m for each in own])
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


def label(axes: Axes, x: str, y: str) -> None:
    """The house's axes."""
    axes.set_xlabel(x, color=MUTED, fontsize=9)
    axes.set_ylabel(y, color=MUTED, fontsize=9)
    axes.tick_params(colors=MUTED, labelsize=9, length=3, width=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(MUTED)
    axes.grid(axis="y", color=RULE, linewidth=0.6)
    axes.set_axisbelow(True)


def legend(figure: Figure, extra: Mapping[str, Any] | None = None) -> None:
    """One legend for all axes, above them."""
    entries: dict[str, Any] = dict(extra or {})
    for axes in figure.axes:
        handles, labels = axes.get_legend_handles_labels()
        for handle, name in zip(handles, labels, strict=True):
            entries.setdefault(name, handle)
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="outside upper left",
        ncols=min(len(entries), 6),
        frameon=False,
        fontsize=9.5,
        labelcolor=INK,
        handlelength=3.0,
    )


def plain(text: str) -> str:
    """A name that Matplotlib prints as it is: neither mathematics nor a hidden label."""
    return (" " if text.startswith("_") else "") + text.replace("$", r"\$")
