"""Charts as SVG that takes its colours from the page, so that it is readable by day, at night and on paper.

Charts are drawn in stand-in colours, each of which becomes a CSS variable of the page.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from markupsafe import Markup, escape
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from roadproof.datatypes import Event
from roadproof.driving.deviation import HORIZON_M, lateral_m
from roadproof.driving.episode import Episode
from roadproof.driving.evaluation import path_of
from roadproof.geometry import CanvasPlacement
from roadproof.pipeline.fidelity import Fidelity
from roadproof.pipeline.prediction import Prediction
from roadproof.report.words import in_words

VARIABLES = {
    "ink": "#010101",
    "muted": "#010102",
    "rule": "#010103",
    "clean": "#010104",
    "painted": "#010105",
    "predicted": "#010106",
    "canvas": "#010107",
    "third": "#010108",
    "fourth": "#010109",
    "asphalt": "#01010a",
    "kerb": "#01010b",
    "grass": "#01010c",
    "marking": "#01010d",
    "paper": "#01010e",
}
INK, MUTED, RULE, CLEAN, PAINTED, PREDICTED, CANVAS = list(VARIABLES.values())[:7]
SERIES = (PAINTED, PREDICTED, VARIABLES["third"], VARIABLES["fourth"])

WIDTH_IN, HEIGHT_IN = 5.2, 3.0
_STYLES = ("solid", (0, (5, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2)))
BEHIND_M = 20.0
_UNITS = {"steering shift": "steer a frame", "path deviation": "predicted m"}


@dataclass(frozen=True, slots=True)
class Chart:
    """One picture and its words.

    Args:
        svg: to be put into the page as it is.
        caption: what it shows.
    """

    svg: Markup
    caption: str


def svg_of(figure: Figure, name: str, description: str) -> Markup:
    """A figure as an SVG element for a page.

    Args:
        figure: drawn in stand-in colours (`VARIABLES`).
        name: makes its inner names differ from those of the page's other charts.
        description: read out instead of the picture.
    """
    out = io.StringIO()
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name, "text.parse_math": False}):
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
    return Markup(text.replace("<svg ", f'<svg role="img" aria-label="{escape(description)}" ', 1))  # noqa: S704


def metres_past(episode: Episode, canvas: CanvasPlacement) -> Float[np.ndarray, " n"]:
    """How far the car had driven at each observation, from the canvas' near edge; before it negative."""
    path = path_of(episode)
    driven = np.concatenate([np.zeros(1), np.cumsum(np.hypot(*np.diff(path, axis=0).T))])
    at = int(np.hypot(path[:, 0] - canvas.x_m, path[:, 1] - canvas.y_m).argmin())
    return driven - driven[at] + canvas.length_m / 2


def steering(clean: Episode, painted: Episode, fidelity: Fidelity | None, canvas: CanvasPlacement) -> Chart:
    """Steering of the clean drive, what the surrogate predicts, and what the car did over the paint."""
    figure, axes = _axes("metres past the canvas’ near edge", "steering (right > 0)")
    _mark_canvas(axes, canvas)
    at, predicted = metres_past(clean, canvas), painted.paint.predicted
    for episode, colour, style, label in (
        (clean, CLEAN, _STYLES[0], "bare road"),
        (painted, PAINTED, _STYLES[0], "over the paint, predicted" if predicted else "driven over the paint"),
    ):
        where = metres_past(episode, canvas)[:-1]
        axes.plot(where, episode.steer, color=colour, linewidth=1.8, linestyle=style, label=label)
    words = "Steering without paint and over it"
    if fidelity is not None:
        steps = fidelity.frame_number
        kept = steps < len(at)
        for values, style, label in (
            (fidelity.composited_steer, "o", "predicted on composites"),
            (fidelity.rendered_steer, "x", "same places, rendered"),
        ):
            axes.plot(at[steps[kept]], values[kept], style, color=PREDICTED, markersize=3.6, label=label)
        words += ", and what the surrogate predicts along the clean path"
    axes.set_xlim(-HORIZON_M - 2, canvas.length_m + BEHIND_M)
    _legend(axes, columns=2)
    return Chart(svg_of(figure, "steering", words), words + ". The shaded stretch is the canvas.")


def offsets(drives: Sequence[tuple[str, Episode, Episode]], canvas: CanvasPlacement) -> Chart:
    """How far beside the clean path the car was over the paint: a colour a weather, a line a start."""
    figure, axes = _axes("metres past the canvas’ near edge", "metres right of the clean path")
    _mark_canvas(axes, canvas)
    axes.axhline(0.0, color=CLEAN, linewidth=1.4)
    names = list(dict.fromkeys(name for name, _, _ in drives))
    width = 1.8 if len(drives) == len(names) else 1.1
    labels = {name: in_words(name) for name in names}
    for name, clean, painted in drives:
        beside = -lateral_m(path_of(clean), path_of(painted))
        k, label = names.index(name), labels.pop(name, None)
        where, colour = metres_past(painted, canvas), SERIES[k % len(SERIES)]
        axes.plot(where, beside, color=colour, linestyle=_STYLES[k % 4], linewidth=width, label=label)
    axes.set_xlim(-HORIZON_M - 2, None)
    _legend(axes, columns=2)
    predicted = any(painted.paint.predicted for _, _, painted in drives)
    words = f"Distance from the clean path along the drive, alone on the road{', predicted' if predicted else ''}"
    return Chart(svg_of(figure, "offsets", words), words + ". The shaded stretch is the canvas.")


def foretold(prediction: Prediction, canvas: CanvasPlacement) -> Chart:
    """The chosen pattern's predicted path beside the one that was driven."""
    figure, axes = _axes("metres past the canvas’ near edge", "metres right of the clean path")
    _mark_canvas(axes, canvas)
    axes.axhline(0.0, color=CLEAN, linewidth=1.4)
    ahead = np.array([math.cos(canvas.yaw_rad), math.sin(canvas.yaw_rad)])
    for path, label, colour, style in (
        (prediction.predicted_xy, "predicted in the recorded world", PREDICTED, _STYLES[1]),
        (prediction.driven_xy, "driven", PAINTED, _STYLES[0]),
    ):
        where = (path - (canvas.x_m, canvas.y_m)) @ ahead + canvas.length_m / 2
        beside = -lateral_m(prediction.clean_xy, path)
        axes.plot(where, beside, color=colour, linestyle=style, linewidth=1.8, label=label)
    axes.set_xlim(-HORIZON_M - 2, None)
    _legend(axes, columns=1)
    words = (
        f"Where the recorded world said the pattern takes the car, and where it went: deviation "
        f"{prediction.predicted_m:.2f} m predicted, {prediction.driven_m:.2f} m driven"
    )
    return Chart(svg_of(figure, "foretold", words), words + ". The shaded stretch is the canvas.")


def search(history: Float[np.ndarray, "i g r"], groups: Sequence[str], objective: str) -> Chart:
    """The search: every start thin, the best so far of each group bold."""
    figure, axes = _axes("iteration", f"{objective}, {_UNITS.get(objective, 'its own unit')}")
    steps = np.arange(1, len(history) + 1)
    for k, name in enumerate(groups):
        colour = SERIES[k % len(SERIES)]
        axes.plot(steps, history[:, k], color=colour, alpha=0.35, linewidth=0.8)
        best = np.maximum.accumulate(history[:, k].max(axis=1))
        axes.plot(steps, best, color=colour, linestyle=_STYLES[k % 4], linewidth=2.0, label=f"best of {name}")
    axes.axhline(0.0, color=MUTED, linewidth=0.6)
    _legend(axes, columns=1)
    words = "What the search gained on composited frames, every start and the best of each group"
    return Chart(svg_of(figure, "search", words), words + ".")


def told(events: Sequence[Event]) -> list[tuple[str, str, str]]:
    """Events as time, kind and detail in words."""
    return [(f"{event.time_s:.1f} s", in_words(event.kind), event.detail) for event in events]


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


def _mark_canvas(axes: Axes, canvas: CanvasPlacement) -> None:
    axes.axvspan(0.0, canvas.length_m, color=CANVAS, alpha=0.16, linewidth=0)


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
