"""Charts as SVG that takes its colours from the page, so that it is readable by day, at night and on paper.

Charts are drawn in stand-in colours, each of which becomes a CSS variable of the page.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from jaxtyping import Float, Int
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from roadproof.datatypes import Weather
from roadproof.driving.deviation import HORIZON_M, Path2D, beside_m, lateral_m, path_of
from roadproof.driving.episode import Episode
from roadproof.geometry import CanvasPlacement
from roadproof.pipeline.fidelity import Fidelity
from roadproof.pipeline.prediction import Prediction
from roadproof.report.formatting import in_words, plain
from roadproof.report.plots import LINE_STYLES, draw_search, show_as_it_is
from roadproof.roads.polylines import polyline_stations

_NAMES = "ink muted rule clean painted predicted canvas third fourth asphalt kerb grass marking paper"
VARIABLES = {name: f"#{0x010100 + k:06x}" for k, name in enumerate(_NAMES.split(), 1)}
"""The stand-in colour of each variable."""

INK, MUTED, RULE, CLEAN, PAINTED, PREDICTED, CANVAS = list(VARIABLES.values())[:7]
SERIES = (PAINTED, PREDICTED, VARIABLES["third"], VARIABLES["fourth"])

WIDTH_IN, HEIGHT_IN = 5.2, 3.0
BEHIND_M = 20.0

NO_MOMENTS = np.zeros(0, np.int64)
"""The steps of a passage without pictures."""


@dataclass(frozen=True, slots=True)
class Chart:
    """One picture and its words.

    Args:
        svg: the picture, to be put into the page as it is.
        caption: the sentences below it.
    """

    svg: Markup
    caption: str


@dataclass(frozen=True, slots=True, eq=False)
class Mark:
    """Where something is in a chart at each pictured moment of the passage; the page shows one moment at a time.

    Args:
        kind: "clean" or "painted", the drive, which gives the colour.
        at: x and y of each moment on the chart's axes, (n, 2).
    """

    kind: str
    at: Float[np.ndarray, "n 2"]


def svg_of(figure: Figure, name: str, description: str, marks: Iterable[Mark] = ()) -> Markup:
    """A figure as an SVG element for a page.

    Args:
        figure: the figure, drawn in stand-in colours (`VARIABLES`).
        name: a word that makes its inner names differ from those of the page's other charts.
        description: what is read out instead of the picture.
        marks: what is shown at one moment of the passage only, on the figure's one pair of axes.
    """
    out = io.StringIO()
    show_as_it_is(figure)
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<!--.*?-->|<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(
        r'(<svg\b[^>]*?) width="[^"]*"', r"\1", re.sub(r'(<svg\b[^>]*?) height="[^"]*"', r"\1", text, count=1)
    )
    text = re.sub(r"(\bid=\"|url\(#|xlink:href=\"#)", rf"\g<1>{name}-", text)
    text = re.sub(r"(font: [0-9.]+px|font-family:) '[^;\"]*", r"\1 var(--sans)", text)
    for variable, colour in VARIABLES.items():
        text = text.replace(colour, f"var(--{variable})")
    # Drawn once, the figure knows where its axes are.
    text = text.replace("</svg>", f"{''.join(_dots(figure, mark) for mark in marks)}</svg>")
    return Markup(text.replace("<svg ", f'<svg role="img" aria-label="{escape(description)}" ', 1))  # noqa: S704


def _dots(figure: Figure, mark: Mark) -> str:
    """A mark as one circle a moment; those beyond the axes are left out."""
    axes = figure.axes[0]
    places = axes.transData.transform(mark.at)
    inside = axes.bbox.padded(1.0)
    scale, height = 72 / figure.dpi, 72 * figure.get_figheight()
    return "".join(
        f'<circle class="at m{k} {mark.kind}" r="5" cx="{x * scale:.1f}" cy="{height - y * scale:.1f}"/>'
        for k, (x, y) in enumerate(places.tolist())
        if inside.contains(x, y)
    )


def metres_past(path: Path2D, canvas: CanvasPlacement) -> Float[np.ndarray, " n"]:
    """How far the car had driven at each place of its path, from the canvas' near edge; before it negative."""
    driven = polyline_stations(path)
    at = int(np.hypot(path[:, 0] - canvas.x_m, path[:, 1] - canvas.y_m).argmin())
    return driven - driven[at] + canvas.length_m / 2


def steering(
    clean: Episode,
    painted: Episode,
    canvas: CanvasPlacement,
    steps: Int[np.ndarray, " n"] = NO_MOMENTS,
    compared: tuple[Float[np.ndarray, " f"], Fidelity] | None = None,
) -> Chart:
    """Steering of the clean drive, what it answers to composites, and what the car did over the paint.

    Args:
        clean: the drive without paint.
        painted: the drive over the paint.
        canvas: where the canvas lies.
        steps: the steps of both drives at which there are pictures of the passage.
        compared: composites beside renders, and how far past the canvas' near edge each of their frames was recorded,
            metres; None where they were not compared.
    """
    figure, axes = _past_canvas("steering (right > 0)", canvas)
    marks: list[Mark] = []
    predicted = painted.paint.predicted
    for episode, colour, label in (
        (clean, CLEAN, "bare road"),
        (painted, PAINTED, "over the paint, predicted" if predicted else "driven over the paint"),
    ):
        where = metres_past(path_of(episode), canvas)[:-1]
        axes.plot(where, episode.steer, color=colour, linewidth=1.8, label=label)
        at = np.minimum(steps, len(where) - 1)
        marks.append(Mark("painted" if episode is painted else "clean", np.stack([where[at], episode.steer[at]], 1)))
    words = "Steering without paint and over it"
    if compared is not None:
        at_m, fidelity = compared
        for values, style, label in (
            (fidelity.composited_steer, "o", "composited along the recorded path"),
            (fidelity.rendered_steer, "x", "same places, rendered"),
        ):
            axes.plot(at_m, values, style, color=PREDICTED, markersize=3.6, label=label)
        words += ", and what the controller answers to composites along the recorded path"
    return _finished(figure, axes, "steering", words, until_m=canvas.length_m + BEHIND_M, marks=marks)


def offsets(
    drives: Sequence[tuple[str, Episode, Episode]],
    canvas: CanvasPlacement,
    steps: Int[np.ndarray, " n"] = NO_MOMENTS,
) -> Chart:
    """How far beside the clean path the car was over the paint: a colour a weather, a line a start.

    Args:
        drives: weather, drive without paint and drive over it.
        canvas: where the canvas lies.
        steps: the steps of the first pair of drives at which there are pictures of the passage.
    """
    figure, axes = _past_canvas("metres right of the clean path", canvas)
    axes.axhline(0.0, color=CLEAN, linewidth=1.4)
    names = list(dict.fromkeys(name for name, _, _ in drives))
    width = 1.8 if len(drives) == len(names) else 1.1
    labels = {name: in_words(name) if name in {*Weather} else plain(name) for name in names}
    marks: list[Mark] = []
    for name, clean, painted in drives:
        beside = -beside_m(clean, painted)
        k, label = names.index(name), labels.pop(name, None)
        where, colour = metres_past(path_of(painted), canvas)[: len(beside)], SERIES[k % len(SERIES)]
        axes.plot(where, beside, color=colour, linestyle=LINE_STYLES[(k + k // 4) % 4], linewidth=width, label=label)
        if not marks:
            shown = np.minimum(steps, len(beside) - 1)
            marks = [Mark("painted", np.stack([where[shown], beside[shown]], 1))]
    predicted = any(painted.paint.predicted for _, _, painted in drives)
    words = f"Distance from the clean path along the drive, alone on the road{', predicted' if predicted else ''}"
    return _finished(figure, axes, "offsets", words, marks=marks)


def predicted_path(prediction: Prediction, canvas: CanvasPlacement) -> Chart:
    """The chosen pattern's predicted path beside the one that was driven."""
    figure, axes = _past_canvas("metres right of the clean path", canvas)
    axes.axhline(0.0, color=CLEAN, linewidth=1.4)
    ahead = np.array([math.cos(canvas.yaw_rad), math.sin(canvas.yaw_rad)])
    for path, label, colour, style in (
        (prediction.predicted_xy, "predicted in the recorded world", PREDICTED, LINE_STYLES[1]),
        (prediction.driven_xy, "driven", PAINTED, LINE_STYLES[0]),
    ):
        where = (path - (canvas.x_m, canvas.y_m)) @ ahead + canvas.length_m / 2
        beside = -lateral_m(prediction.clean_xy, path)
        axes.plot(where, beside, color=colour, linestyle=style, linewidth=1.8, label=label)
    words = (
        f"Where the recorded world said the pattern takes the car, and where it went: deviation "
        f"{prediction.predicted_m:.2f} m predicted, {prediction.driven_m:.2f} m driven"
    )
    return _finished(figure, axes, "predicted-path", words, columns=1)


def search(history: Float[np.ndarray, "i g r"], groups: Sequence[str], made_large: str, *, driven: bool) -> Chart:
    """The search: every start thin, the best so far of each group bold.

    Args:
        history: the value at every iteration, of every group and start.
        groups: the names of the groups.
        made_large: the objective with its unit.
        driven: whether the values are of drives in a simulator.
    """
    figure, axes = _axes("iteration", made_large)
    draw_search(axes, history, groups, SERIES, MUTED)
    _legend(axes, columns=1)
    where = "in the drives that chose" if driven else "on composited frames"
    words = f"What the search gained {where}, every start and the best of each group"
    return Chart(svg_of(figure, "search", words), words + ".")


def by_round(deviation_m: Sequence[Mapping[str, float]]) -> Chart:
    """What an attack afresh reaches on each street after each tuning of a controller: streets thin, their mean bold.

    Args:
        deviation_m: for each number of tunings, from none on, the driven deviation by the street's name, metres.
    """
    figure, axes = _axes("tunings", "deviation, m")
    table = np.array([list(each.values()) for each in deviation_m])
    axes.plot(table, color=MUTED, linewidth=0.8)
    axes.plot(table.mean(1), color=PAINTED, linewidth=2.2, marker="o", label="mean over the streets")
    axes.set_xticks(range(len(table)))
    axes.set_ylim(bottom=0.0)
    _legend(axes, columns=1)
    words = (
        "How far the strongest paint leads the controller astray, attacked afresh after each tuning, street by street"
    )
    return Chart(svg_of(figure, "rounds", words), words + ".")


def _axes(x: str, y: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
    axes = figure.add_subplot()
    axes.set_xlabel(x, color=MUTED, fontsize=9)
    axes.set_ylabel(y, color=MUTED, fontsize=9)
    axes.tick_params(colors=MUTED, labelsize=9, length=3, width=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(RULE)
    axes.grid(axis="y", color=RULE, linewidth=0.5)
    axes.set_axisbelow(True)
    axes.margins(x=0.01)
    return figure, axes


def _past_canvas(y: str, canvas: CanvasPlacement) -> tuple[Figure, Axes]:
    """Axes over the metres driven past the canvas, which is shaded."""
    figure, axes = _axes("metres past the canvas’ near edge", y)
    axes.axvspan(0.0, canvas.length_m, color=CANVAS, alpha=0.16, linewidth=0)
    return figure, axes


def _finished(
    figure: Figure,
    axes: Axes,
    name: str,
    words: str,
    *,
    until_m: float | None = None,
    columns: int = 2,
    marks: Iterable[Mark] = (),
) -> Chart:
    axes.set_xlim(-HORIZON_M - 2, until_m)
    _legend(axes, columns=columns)
    return Chart(svg_of(figure, name, words, marks), words + ". The shaded stretch is the canvas.")


def _legend(axes: Axes, *, columns: int) -> None:
    axes.figure.legend(
        *axes.get_legend_handles_labels(),
        loc="outside upper left",
        ncols=columns,
        frameon=False,
        fontsize=9,
        labelcolor=INK,
        borderpad=0,
        handlelength=2.2,
    )
