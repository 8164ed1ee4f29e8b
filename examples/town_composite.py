"""Draw frames of one drive in the town: the bare road, a pattern composited onto it, and the same pattern really there.

    python examples/town_composite.py [docs/images/town-composite.png]

The expert drives one scenario four times with the same controls: over the bare road, over a white and a black canvas
(from which gain and offset of every pixel follow), and over the pattern. The composite never sees the last drive.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from roadproof.compositing import composite, view_canvas
from roadproof.datatypes import Control, Observation, Weather
from roadproof.patterns import raster
from roadproof.photometry import ColourTransform, pixel_maps_from_two_paints
from roadproof.rollout import Driver, Episode, replay, rollout
from roadproof.scenarios import builtin_scenarios, find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import PatternImage
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.expert import expert

SCENARIO = find_scenario("right-04", builtin_scenarios())
WEATHER = Weather.CLEAR_NOON
AHEAD_M = (12.0, 9.0, 6.5)
GAP_PX, LINE_PX = 6, 28


@dataclass(frozen=True)
class Drive:
    """One drive: frames (F, H, W, 3) and homographies (F, 3, 3)."""

    episode: Episode
    frames: np.ndarray
    image_from_canvas: np.ndarray


def drive(town: TownSimulator, driver: Driver[TownSimulator], paint: PatternImage | None) -> Drive:
    """Drive the scenario and keep what is seen."""
    frames: list[np.ndarray] = []
    homographies: list[np.ndarray] = []

    def keep(seen: Observation, _: Control | None) -> None:
        frames.append(seen.frame)
        homographies.append(town.image_from_canvas())

    episode = rollout(town, driver, SCENARIO, weather=WEATHER, pattern=paint, on_step=keep)
    return Drive(episode, np.stack(frames), np.stack(homographies))


def approach(episode: Episode) -> list[int]:
    """The steps at which the canvas' middle is so many metres away."""
    away_m = np.hypot(episode.x_m - SCENARIO.canvas.x_m, episode.y_m - SCENARIO.canvas.y_m)
    before = away_m[: int(away_m.argmin())]
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
    """Drive, composite, draw."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/images/town-composite.png")
    space = SearchSpace(figures=5, albedo=(0.05, 0.9))
    pattern = space.pattern(space.random((), torch.Generator().manual_seed(3)))
    white, black = (np.full((400, 400, 4), (*[level] * 3, 255), np.uint8) for level in (255, 0))
    with TownSimulator() as town:
        bare = drive(town, expert, None)
        again = replay(bare.episode)
        light, dark, painted = (drive(town, again, paint).frames for paint in (white, black, raster(pattern)))
        view = town.input
    steps = approach(bare.episode)
    maps = pixel_maps_from_two_paints(torch.tensor(light[steps]), torch.tensor(dark[steps]))
    colour = ColourTransform(maps.response)
    seen = view_canvas(bare.frames[steps], bare.image_from_canvas[steps], view, colour, maps=maps)
    composited = (255 * composite(pattern, seen)).round().byte().permute(0, 2, 3, 1).numpy()
    error = np.abs(composited.astype(float) - painted[steps])
    paint = np.abs(composited.astype(float) - bare.frames[steps]).max(-1) > 8
    captions = [
        "the road as it is, as the controller sees it (200 by 88 pixels)",
        "with a pattern composited onto it",
        f"with the same pattern really painted in the town: {error[paint].mean():.1f} of 255 levels apart on average",
    ]
    draw([bare.frames[steps], composited, painted[steps]], captions, out)
    print(f"{out}: {error[paint].mean():.2f} levels apart in the paint, {error[~paint].mean():.2f} elsewhere")


if __name__ == "__main__":
    main()
