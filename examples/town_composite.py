"""Draw frames of one drive in the town: the bare road, a pattern composited onto it, and the same pattern really there.

    python examples/town_composite.py [docs/images/town-composite.png]

The expert drives one scenario four times with the same controls: over the bare road, over a white and a black canvas
(which calibrate the drive), and over the pattern. The composite never sees the last drive.
"""

import math
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from roadproof import SearchSpace, TownSimulator, calibrate, composite, find_scenario, record
from roadproof.compositing import view_canvas
from roadproof.drives import Drive, Trajectories, Window
from roadproof.pipeline import rendered_frames
from roadproof.training import expert

SCENARIO = find_scenario("right-04")
AHEAD_M = (12.0, 9.0, 6.5)
GAP_PX, LINE_PX = 6, 28


def approach(drive: Drive) -> list[int]:
    """The frames at which the canvas' middle is so many metres away."""
    away_m = np.array([math.hypot(s.x_m - SCENARIO.canvas.x_m, s.y_m - SCENARIO.canvas.y_m) for s in drive.states])
    before = away_m[: int(away_m.argmin()) + 1]
    return [int(np.abs(before - ahead_m).argmin()) for ahead_m in AHEAD_M]


def draw(rows: list[np.ndarray], captions: list[str], out: Path) -> None:
    """One row a way of painting, one column a place; every pixel shown as 2×2."""
    height, width = (2 * side for side in rows[0].shape[1:3])
    page = Image.new("RGB", (len(AHEAD_M) * (width + GAP_PX) - GAP_PX, len(rows) * (height + LINE_PX)), "white")
    pen, font = ImageDraw.Draw(page), ImageFont.load_default(18)
    for row, (frames, caption) in enumerate(zip(rows, captions, strict=True)):
        top = row * (height + LINE_PX)
        pen.text((2, top + 2), caption, "black", font)
        for column, frame in enumerate(frames):
            shown = Image.fromarray(frame).resize((width, height), Image.Resampling.NEAREST)
            page.paste(shown, (column * (width + GAP_PX), top + LINE_PX))
    out.parent.mkdir(parents=True, exist_ok=True)
    page.save(out, optimize=True)


def main() -> None:
    """Record, calibrate, composite, draw."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images/town-composite.png")
    space = SearchSpace(figures=5, albedo=(0.05, 0.9))
    pattern = space.pattern(space.random((), torch.Generator().manual_seed(3)))
    with TownSimulator() as town:
        drives = record(town, expert, SCENARIO, trajectories=Trajectories(count=1), window=Window(frames=60))
        recordings = calibrate(town, drives).recordings
        clean, drive = recordings.recordings[0], drives.drives[0]
        painted = rendered_frames(town, SCENARIO, drive.episode, pattern, drive.frame_number)
    seen = view_canvas(clean.frames, clean.image_from_canvas, recordings.view, recordings.colour, maps=clean.maps)
    composited = (255 * composite(pattern, seen)).round().byte().permute(0, 2, 3, 1).numpy()
    steps = approach(drive)
    rows = [frames[steps] for frames in (clean.frames, composited, painted)]
    error = np.abs(rows[1].astype(float) - rows[2])
    paint = np.abs(rows[1].astype(float) - rows[0]).max(-1) > 8
    captions = [
        "the road as it is, as the controller sees it (200 by 88 pixels)",
        "with a pattern composited onto it",
        f"with the same pattern really painted in the town: {error[paint].mean():.1f} of 255 levels apart on average",
    ]
    draw(rows, captions, out)
    print(f"{out}: {error[paint].mean():.2f} levels apart in the paint, {error[~paint].mean():.2f} elsewhere")


if __name__ == "__main__":
    main()
