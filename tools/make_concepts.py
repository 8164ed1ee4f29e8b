"""Draws the pictures of docs/concepts.md, from drives in the town.

python tools/make_concepts.py docs/images
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image, ImageDraw, ImageFont

from roadproof import SearchSpace, TownSimulator, calibrate, composite, find_scenario, record
from roadproof.calibration import CalibrationMethod
from roadproof.compositing import view_canvas
from roadproof.datatypes import VehicleState
from roadproof.drives import Swerve, Trajectories, Window
from roadproof.geometry import CANVAS_CORNERS_PX
from roadproof.patterns import raster
from roadproof.recorded import RecordedWorld
from roadproof.recorded.pictures import Poses
from roadproof.training.expert import expert

SCENARIO = find_scenario("straight-10")
AHEAD_M = 9.0
ASIDE_M, TURNED_RAD = 0.7, 0.08
SIZE = (500, 220)
GAP_PX, LINE_PX = 8, 30
ASPHALT = (112, 112, 112)


def shown(frame: np.ndarray, size: tuple[int, int] = SIZE) -> Image.Image:
    """A frame, enlarged."""
    return Image.fromarray(frame).resize(size, Image.Resampling.BICUBIC)


def page(tiles: list[tuple[str, Image.Image]], columns: int) -> Image.Image:
    """Pictures in rows, each under its caption."""
    font = ImageFont.load_default(17)
    width, height = tiles[0][1].size
    rows = -(-len(tiles) // columns)
    whole = Image.new("RGB", (columns * (width + GAP_PX) - GAP_PX, rows * (height + LINE_PX)), "white")
    pen = ImageDraw.Draw(whole)
    for number, (caption, picture) in enumerate(tiles):
        left, top = number % columns * (width + GAP_PX), number // columns * (height + LINE_PX)
        pen.text((left + 2, top + 4), caption, "black", font)
        whole.paste(picture, (left, top + LINE_PX))
    return whole


def three_drives() -> Figure:
    """What moves in surrogate, predicted and driven numbers: a sketch."""
    along = np.linspace(0, 30, 120)
    aside = 1.6 / (1 + np.exp(-(along - 17) / 2.2))
    figure = Figure(figsize=(10.1, 3.4), dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3)
    told = (
        ("surrogate", "recorded pictures, paint added:\nhow much more does it steer?", None),
        ("predicted", "pictures made for wherever the car\nhas got to: where does it go?", "--"),
        ("driven", "the simulator, paint on its road:\nwhere did it go?", "-"),
    )
    for axis, (name, words, line) in zip(axes, told, strict=True):
        axis.add_patch(Rectangle((-3.5, 0), 7, 32, color="0.82", zorder=0))
        axis.plot([0, 0], [0, 32], color="#d6a83d", linewidth=2, zorder=1)
        axis.add_patch(Rectangle((-3.4, 15), 6.8, 8, color="#7a4ea3", alpha=0.45, zorder=1))
        axis.plot([1.75, 1.75], [0, 31], color="0.25", linewidth=1.6)
        if line is None:
            for at in range(3, 26, 4):
                axis.plot(1.75, at, "o", color="0.25", markersize=4)
                turn = 0.12 * at / 3
                axis.annotate(
                    "", (1.75 + turn, at + 2.4), (1.75, at), arrowprops={"arrowstyle": "->", "color": "#b3202c"}
                )
        else:
            axis.plot(1.75 + aside, along, line, color="#b3202c", linewidth=2.2)
        axis.set_title(name, fontsize=13, fontweight="bold")
        axis.set_xlabel(words, fontsize=10.5)
        axis.set(xlim=(-6, 6), ylim=(0, 31), xticks=[], yticks=[])
        axis.spines[:].set_visible(False)
    figure.tight_layout()
    return figure


def main() -> None:
    """Record, calibrate, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    three_drives().savefig(folder / "concepts-numbers.png")

    space = SearchSpace(figures=5, albedo=(0.05, 0.9))
    pattern = space.pattern(space.random((), torch.Generator().manual_seed(3)))
    around = Trajectories(count=3, perturbation=Swerve((1.5,)))
    with TownSimulator() as town:
        drives = record(town, expert, SCENARIO, trajectories=around, window=Window(frames=40, least_px=8))
        recordings = calibrate(town, drives, method=CalibrationMethod.POSE).recordings
        clean, states = recordings.recordings[0], drives.drives[0].states
        away_m = [math.hypot(s.x_m - SCENARIO.canvas.x_m, s.y_m - SCENARIO.canvas.y_m) for s in states]
        at = int(np.abs(np.array(away_m) - AHEAD_M).argmin())
        here = states[at]
        # To the right of the recorded place, and turned to the left.
        moved = VehicleState(
            here.x_m + ASIDE_M * math.sin(here.yaw_rad),
            here.y_m - ASIDE_M * math.cos(here.yaw_rad),
            here.z_m,
            here.yaw_rad + TURNED_RAD,
            here.speed_mps,
        )
        real = town.reset(replace(SCENARIO, start=moved)).frame
    seen = view_canvas(clean.frames, clean.image_from_canvas, recordings.view, recordings.colour, maps=clean.maps)
    composited = (255 * composite(pattern, seen)[at]).round().byte().permute(1, 2, 0).numpy()

    frame, view = shown(clean.frames[at]), recordings.view
    x, y, w = clean.image_from_canvas[at] @ CANVAS_CORNERS_PX.T
    right = (x / w - view.left_px) / (view.right_px - view.left_px) * SIZE[0]
    down = (y / w - view.top_px) / (view.bottom_px - view.top_px) * SIZE[1]
    outline = list(zip(right.tolist(), down.tolist(), strict=True))
    ImageDraw.Draw(frame).line([*outline, outline[0]], (255, 40, 200), 3)
    paint = Image.fromarray(raster(pattern, SIZE[1]))
    canvas = Image.new("RGB", SIZE, "white")
    canvas.paste(Image.new("RGB", paint.size, ASPHALT), ((SIZE[0] - SIZE[1]) // 2, 0))
    canvas.paste(paint, ((SIZE[0] - SIZE[1]) // 2, 0), paint)
    tiles = [
        ("1  a recorded frame, the canvas outlined", frame),
        ("2  a pattern on the canvas, from above", canvas),
        ("3  the composite: the frame with the pattern", shown(composited)),
    ]
    page(tiles, 3).save(folder / "concepts-composite.jpg", quality=88, optimize=True)

    bank, canvas_at = RecordedWorld(recordings).bank, SCENARIO.canvas
    wanted = (moved.x_m - canvas_at.x_m, moved.y_m - canvas_at.y_m, moved.yaw_rad)
    poses = Poses(*(torch.tensor([value], dtype=torch.float64) for value in wanted))
    nearest = bank.nearest(poses)
    made = (255 * bank.show(poses, nearest).frames[0]).round().byte().permute(1, 2, 0).numpy()
    recorded = np.concatenate([each.frames for each in recordings.recordings])[int(nearest.frame)]
    tiles = [
        ("the nearest recorded frame", shown(recorded)),
        (f"moved to where the car is: {ASIDE_M} m to the right, turned", shown(made)),
        ("the simulator there, for comparison", shown(real)),
    ]
    page(tiles, 3).save(folder / "concepts-recorded-world.jpg", quality=88, optimize=True)


if __name__ == "__main__":
    main()
