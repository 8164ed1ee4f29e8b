"""Plots of an attack, drawn without a screen and without global state."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from roadproof.io.files import write_atomically

_SIDES = ("#0b6fa4", "#c8501e", "#3a7d44", "#7a4fa3")
_INK = "#222222"


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
    steps = np.arange(1, len(history) + 1)
    for index, (name, colour) in enumerate(zip(groups, _SIDES, strict=False)):
        axes.plot(steps, history[:, index], color=colour, alpha=0.3, linewidth=0.8)
        best = np.maximum.accumulate(history[:, index].max(axis=1))
        axes.plot(steps, best, color=colour, linewidth=2.2, label=f"{name}: {best[-1]:.2f}")
    axes.axhline(0.0, color=_INK, linewidth=0.6)
    axes.set_xlabel("iteration")
    axes.set_ylabel("mean steering shift a frame\n(surrogate, steer units)")
    axes.legend(frameon=False, title="best of each group")
    _finish(axes)
    save(figure, path)


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
