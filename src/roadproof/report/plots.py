"""Plots of an attack, and what all charts have in common; drawn without a screen and without global state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from roadproof.io.files import write_atomically

_SIDES = ("#0b6fa4", "#c8501e", "#3a7d44", "#7a4fa3")
_INK = "#222222"
LINES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2)))
"""Line styles that tell series apart without their colours."""


def search_curves(history: Float[np.ndarray, "i g r"], groups: Sequence[str], path: Path) -> None:
    """Divergence against iterations: every restart thin, the best so far of each group bold.

    Args:
        history: mean steering shift a frame at every iteration, group and restart.
        groups: their names.
        path: the PNG to write.

    Raises:
        OutputError: the picture cannot be written.
    """
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    axes = figure.add_subplot()
    draw_search(axes, history, [f"{name}: {best:.2f}" for name, best in zip(groups, history.max((0, 2)), strict=True)])
    axes.axhline(0.0, color=_INK, linewidth=0.6)
    axes.set_xlabel("iteration")
    axes.set_ylabel("mean steering shift a frame\n(surrogate, steer units)")
    axes.legend(frameon=False, title="best of each group")
    _finish(axes)
    save(figure, path)


def draw_search(
    axes: Axes, history: Float[np.ndarray, "i g r"], labels: Sequence[str], colours: Sequence[str] = _SIDES
) -> None:
    """Every start of a search thin, the best so far of each group bold.

    Args:
        axes: to draw on.
        history: value at every iteration, group and start.
        labels: of the groups.
        colours: of the groups, in turn.
    """
    steps = np.arange(1, len(history) + 1)
    for k, label in enumerate(labels):
        colour = colours[k % len(colours)]
        axes.plot(steps, history[:, k], color=colour, alpha=0.3, linewidth=0.8)
        best = np.maximum.accumulate(history[:, k].max(axis=1))
        axes.plot(steps, best, color=colour, linestyle=LINES[k % len(LINES)], linewidth=2.0, label=label)


def style_axes(axes: Axes, x: str, y: str, *, text: str, lines: str, grid: str) -> None:
    """Name axes in small letters, with two spines and a grid that stays behind the data.

    Args:
        axes: to style.
        x: name of the x axis.
        y: name of the y axis.
        text: colour of names and ticks.
        lines: colour of both spines.
        grid: colour of the grid.
    """
    axes.set_xlabel(x, color=text, fontsize=9)
    axes.set_ylabel(y, color=text, fontsize=9)
    axes.tick_params(colors=text, labelsize=9, length=3, width=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(lines)
    axes.grid(axis="y", color=grid, linewidth=0.5)
    axes.set_axisbelow(True)


def film_strip(
    clean: UInt8[np.ndarray, "f h w 3"],
    painted: UInt8[np.ndarray, "f h w 3"],
    clean_steer: Float[np.ndarray, " f"],
    painted_steer: Float[np.ndarray, " f"],
    path: Path,
    *,
    title: str,
    columns: int = 6,
) -> None:
    """Clean frames above, the same with the pattern below, and what the controller answers to every frame.

    Args:
        clean: recorded frames of one drive.
        painted: the same, composited.
        clean_steer: the controller's answers to them; positive = right.
        painted_steer: its answers to the composited ones.
        path: the PNG to write.
        title: a line above.
        columns: frames shown, spread evenly over the drive.

    Raises:
        OutputError: the picture cannot be written.
    """
    shown = np.unique(np.linspace(0, len(clean) - 1, min(columns, len(clean))).round().astype(int))
    figure = Figure(figsize=(2.3 * len(shown) + 0.6, 4.6), layout="constrained")
    figure.suptitle(title, fontsize=11)
    grid = figure.add_gridspec(3, len(shown), height_ratios=(1, 1, 1.5))
    for column, frame in enumerate(shown):
        for row, (pictures, steer) in enumerate(((clean, clean_steer), (painted, painted_steer))):
            axes = figure.add_subplot(grid[row, column])
            axes.imshow(pictures[frame], interpolation="nearest")
            axes.set_xticks([])
            axes.set_yticks([])
            axes.set_title(f"frame {frame}: steer {steer[frame]:+.2f}", fontsize=8)
            if column == 0:
                axes.set_ylabel(("clean", "painted")[row])
    axes = figure.add_subplot(grid[2, :])
    frames = np.arange(len(clean))
    axes.plot(frames, clean_steer, color=_INK, label="clean")
    axes.plot(frames, painted_steer, color=_SIDES[1], linewidth=2, label="painted")
    axes.fill_between(frames, clean_steer, painted_steer, color=_SIDES[1], alpha=0.15)
    axes.axhline(0.0, color=_INK, linewidth=0.6)
    axes.set_xlabel("frame with the canvas in view")
    axes.set_ylabel("steer (right > 0)")
    axes.legend(frameon=False)
    _finish(axes)
    save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all.

    Raises:
        OutputError: the folder cannot be written.
    """
    write_atomically(path, lambda part: figure.savefig(part, format="png", dpi=110))


def _finish(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)
