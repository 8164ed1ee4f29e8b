"""How close are composites to what the town renders when the paint is really there?

    python benchmarks/town_fidelity.py --json OUT [--scenarios left-03,right-05] [--weathers clear-noon,rainy-noon]

The expert drives each scenario over the bare road; the same controls are then given again over uniformly painted
canvases and over random patterns, so every frame is seen bare, calibrated and painted from exactly the same place. The
frames are composited with the exact homographies and
  affine: one affine colour transform a drive, fitted to the mean looks of uniformly painted canvases,
  maps:   gain and offset of every pixel, from a white and a black canvas.
Both are tried with either resampling filter. No pattern takes part in a fit.

Errors are mean absolute ones over channels and over the paint, in 8-bit levels, of composites rounded to 8 bits at the
controller's input. The paint is every pixel of which the pattern covers at least half, as the compositor's own geometry
has it.
"""

import argparse
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from roadproof.compositing import composite, covered_share, view_canvas
from roadproof.coverage import Shape
from roadproof.datatypes import Control, Observation, Weather
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import Driver, replay, rollout
from roadproof.geometry import CANVAS_SIZE_PX, CropResize
from roadproof.io.files import write_json
from roadproof.machine import made_with
from roadproof.patterns import Pattern, raster
from roadproof.photometry import (
    AffineResponse,
    ColourTransform,
    PixelMaps,
    fit_affine,
    pixel_maps_from_two_paints,
)
from roadproof.scenarios import Scenario, find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import PatternImage, uniform
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.expert import expert

LEAST_PX = 150
CALIBRATION = ((0, 0, 0), (255, 255, 255), (190, 60, 60), (60, 190, 60), (60, 60, 190), (128, 128, 128))
BLACK, WHITE = 0, 1
FILTERS = ("area", "antialiased-bilinear")
PLAIN = ColourTransform(AffineResponse.identity())


@dataclass(frozen=True)
class Shots:
    """Frames (F, H, W, 3) and homographies (F, 3, 3) of one drive, where the canvas is well in view."""

    frames: np.ndarray
    image_from_canvas: np.ndarray


def shoot(
    town: TownSimulator, driver: Driver[TownSimulator], scenario: Scenario, weather: Weather, paint: PatternImage | None
) -> tuple[Episode, Shots]:
    """Drive, and keep what is seen."""
    frames: list[np.ndarray] = []
    homographies: list[np.ndarray] = []

    def keep(seen: Observation, _: Control | None) -> None:
        frames.append(seen.frame)
        homographies.append(town.image_from_canvas())

    episode = rollout(town, driver, scenario, weather=weather, pattern=paint, on_step=keep)
    return episode, Shots(np.stack(frames), np.stack(homographies))


def whole_canvas(shots: Shots, view: CropResize) -> np.ndarray:
    """Pixels that lie wholly on the canvas, (F, H, W)."""
    middle, size = (CANVAS_SIZE_PX - 1) / 2, float(CANVAS_SIZE_PX)
    everything = Pattern((Shape.RECTANGLE,), torch.tensor([[middle, middle, size, size, 0.0]]), torch.ones(1, 3))
    return covered_share(everything, shots.image_from_canvas, view) > 0.999


def in_view(shots: Shots, view: CropResize, every: int) -> np.ndarray:
    """Indices of the frames that show the canvas well."""
    return np.flatnonzero(whole_canvas(shots, view).sum((1, 2)) >= LEAST_PX)[::every]


def affine_from(looks: list[Shots], shots: Shots, view: CropResize) -> ColourTransform:
    """One affine colour transform for a drive, from the mean looks of uniform paints."""
    inner = whole_canvas(shots, view)
    seen = np.stack([look.frames[inner].mean(0) for look in looks]) / 255
    return ColourTransform(fit_affine(torch.tensor(CALIBRATION, dtype=torch.float64) / 255, torch.tensor(seen)))


def judge(
    town: TownSimulator, scenario: Scenario, weather: Weather, patterns: Iterable[Pattern], every: int
) -> list[dict[str, object]]:
    """One record a method and filter for one drive."""
    episode, drive = shoot(town, expert, scenario, weather, None)
    again, view = replay(episode), town.input
    chosen = in_view(drive, view, every)

    def seen(paint: PatternImage) -> Shots:
        shots = shoot(town, again, scenario, weather, paint)[1]
        assert np.array_equal(shots.image_from_canvas, drive.image_from_canvas), "a replay went another way"
        return Shots(shots.frames[chosen], shots.image_from_canvas[chosen])

    bare = Shots(drive.frames[chosen], drive.image_from_canvas[chosen])
    looks = [seen(uniform(*colour)) for colour in CALIBRATION]
    affine = affine_from(looks, bare, view)
    maps = pixel_maps_from_two_paints(torch.tensor(looks[WHITE].frames), torch.tensor(looks[BLACK].frames))
    methods: dict[str, tuple[ColourTransform, PixelMaps | None]] = {"affine": (affine, None), "maps": (PLAIN, maps)}
    errors: dict[tuple[str, str], list[float]] = {}
    paint_px = 0
    for pattern in patterns:
        truth = seen(raster(pattern)).frames.astype(float)
        paint = covered_share(pattern, bare.image_from_canvas, view) >= 0.5
        paint_px += int(paint.sum())
        for method, (colour, shading) in methods.items():
            for kind in FILTERS:
                canvas = view_canvas(
                    bare.frames, bare.image_from_canvas, replace(view, resampling=kind), colour, maps=shading
                )
                made = 255 * composite(pattern, canvas).permute(0, 2, 3, 1).numpy()
                errors.setdefault((method, kind), []).append(float(np.abs(np.round(made) - truth)[paint].mean()))
    place = {"scenario": scenario.name, "weather": str(weather), "frames": len(chosen), "paint_pixels": paint_px}
    return [
        place
        | {
            "method": method,
            "filter": kind,
            "mae_paint": round(float(np.mean(each)), 3),
            "mae_worst": round(max(each), 3),
        }
        for (method, kind), each in errors.items()
    ]


def main() -> None:
    """Drive, composite, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scenarios", default="left-03,right-05,straight-04,left-12")
    parser.add_argument("--weathers", default="clear-noon,cloudy-noon,rainy-noon,clear-sunset")
    parser.add_argument("--patterns", type=int, default=8)
    parser.add_argument("--figures", type=int, default=5)
    parser.add_argument("--every", type=int, default=2, help="use every n-th frame that shows the canvas")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    space = SearchSpace(figures=arguments.figures)
    drawn = space.drawn(arguments.patterns, arguments.seed)
    patterns = [drawn[k] for k in range(arguments.patterns)]
    records: list[dict[str, object]] = []
    with TownSimulator() as town:
        for name in arguments.scenarios.split(","):
            scenario = find_scenario(name)
            for weather in map(Weather, arguments.weathers.split(",")):
                found = judge(town, scenario, weather, patterns, arguments.every)
                records += found
                numbers = "   ".join(f"{r['method']}, {r['filter']} {r['mae_paint']:.2f}" for r in found)
                print(f"{name:12} {weather:13} {found[0]['frames']:3} frames   {numbers}", flush=True)
    result = {
        "benchmark": "town_fidelity",
        "version": 1,
        "patterns": arguments.patterns,
        "figures": arguments.figures,
        "seed": arguments.seed,
        "records": records,
        "made_with": made_with(),
    }
    write_json(arguments.json, result)


if __name__ == "__main__":
    main()
