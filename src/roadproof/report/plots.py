"""Pictures of an attack, drawn without a screen and without global state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text

from roadproof.attacks import AttackResult, ShownDrive
from roadproof.io.files import write_atomically
from roadproof.recordings import evenly

LINE_STYLES = ("solid", (0, (5, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2)))
_COLOURS = ("#0b6fa4", "#c8501e", "#3a7d44", "#7a4fa3")
_INK = "#222222"
_COLUMNS = 6
"""Frames of a drive that a strip shows."""


def draw_attack(result: AttackResult, shown: Sequence[ShownDrive], folder: Path) -> None:
    """Draw the search as search.png, and every drive of the winner's group as film-DRIVE.png.

    Args:
        result: the result of the attack.
        shown: every drive of the winner's group, without and with the pattern (`attacks.show_pattern`).
        folder: the folder that the pictures are written to.

    Raises:
        OutputError: a picture cannot be written.
    """
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    axes = figure.add_subplot()
    draw_search(axes, result.history, tuple(result.by_group), _COLOURS)
    axes.set_xlabel("iteration")
    axes.set_ylabel(result.made_large)
    axes.legend(frameon=False)
    _finish(axes)
    save(figure, folder / "search.png")
    for drive in shown:
        save(_film_strip(drive), folder / f"film-{drive.name}.png")


def draw_search(
    axes: Axes, history: Float[np.ndarray, "i g r"], groups: Sequence[str], colours: Sequence[str], ink: str = _INK
) -> None:
    """Draw what a search gained: every start thin, the best so far of each group bold.

    Args:
        axes: the axes to draw on.
        history: the value of the objective at every iteration, of every group and start.
        groups: the names of the groups.
        colours: the colours of the groups, in turn.
        ink: the colour of the line at zero.
    """
    steps = np.arange(1, len(history) + 1)
    for k, name in enumerate(groups):
        colour = colours[k % len(colours)]
        axes.plot(steps, history[:, k], color=colour, alpha=0.35, linewidth=0.8)
        best = np.maximum.accumulate(history[:, k].max(axis=1))
        label = f"best of {name}: {best[-1]:.2f}"
        axes.plot(steps, best, color=colour, linestyle=LINE_STYLES[k % 4], linewidth=2.0, label=label)
    axes.axhline(0.0, color=ink, linewidth=0.6)


def _film_strip(drive: ShownDrive) -> Figure:
    """Clean frames above, the same with the pattern below, and what the controller answers to every frame."""
    shown = evenly(len(drive.clean), _COLUMNS)
    rows = (("clean", drive.clean, drive.clean_steer), ("painted", drive.painted, drive.painted_steer))
    figure = Figure(figsize=(2.3 * len(shown) + 0.6, 4.6), layout="constrained")
    title = f"{drive.name}: steering on composited frames, mean shift {drive.mean_shift:+.2f}"
    figure.suptitle(title, fontsize=11)
    grid = figure.add_gridspec(3, len(shown), height_ratios=(1, 1, 1.5))
    for column, frame in enumerate(shown):
        for row, (name, pictures, steer) in enumerate(rows):
            axes = figure.add_subplot(grid[row, column])
            axes.imshow(pictures[frame], interpolation="nearest")
            axes.set(xticks=[], yticks=[], ylabel="" if column else name)
            axes.set_title(f"frame {frame}: steer {steer[frame]:+.2f}", fontsize=8)
    axes = figure.add_subplot(grid[2, :])
    frames = np.arange(len(drive.clean))
    axes.plot(frames, drive.clean_steer, color=_INK, label="clean")
    axes.plot(frames, drive.painted_steer, color=_COLOURS[1], linewidth=2, label="painted")
    axes.fill_between(frames, drive.clean_steer, drive.painted_steer, color=_COLOURS[1], alpha=0.15)
    axes.axhline(0.0, color=_INK, linewidth=0.6)
    axes.set(xlabel="frame with the canvas in view", ylabel="steer (right > 0)")
    axes.legend(frameon=False)
    _finish(axes)
    return figure


def show_as_it_is(figure: Figure) -> None:
    """Have no text of a figure taken for mathematics: names are the user's, and may have dollars in them."""
    for text in figure.findobj(Text):
        text.set_parse_math(False)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all.

    Raises:
        OutputError: the folder cannot be written.
    """
    show_as_it_is(figure)
    write_atomically(path, lambda part: figure.savefig(part, format="png", dpi=110))


def _finish(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.01)
