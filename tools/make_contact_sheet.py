"""Draws the town's contact sheet: places down, weathers across.

python tools/make_contact_sheet.py docs/images/town-contact-sheet.jpg
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from roadproof.datatypes import Weather
from roadproof.scenarios import Scenario, find_scenario
from roadproof.simulators.town.simulator import TownSimulator

# Scenario, and how far before the canvas the picture is taken.
PLACES = (
    ("straight-03", 10.0), ("left-05", 10.5), ("right-02", 10.0),
    ("straight-08", 11.0), ("left-02", 12.0), ("right-07", 11.0),
)  # fmt: skip
TILE = (320, 180)
CROP = (0, 40, 800, 490)
SEED = 4


def pattern() -> np.ndarray:
    """Three bars, one half transparent."""
    image = np.zeros((400, 400, 4), np.uint8)
    image[40:130, 60:340] = (198, 44, 40, 255)
    image[200:360, 250:310] = (236, 236, 232, 255)
    image[220:330, 90:180] = (36, 84, 180, 150)
    return image


def main() -> None:
    """Take the pictures and put them side by side."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("path", type=Path)
    path = parser.parse_args().path
    weathers, header = list(Weather), 26
    sheet = Image.new("RGB", (len(weathers) * TILE[0], header + len(PLACES) * TILE[1]), (250, 250, 248))
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(17)
    with TownSimulator() as simulator:
        for column, weather in enumerate(weathers):
            pen.text((column * TILE[0] + 8, 3), weather.value, (30, 30, 30), font)
            for row, (name, distance) in enumerate(PLACES):
                scenario = find_scenario(name)
                near = started_before_canvas(simulator, scenario, distance)
                seen = simulator.reset(
                    near, weather=weather, pattern=pattern(), cars=30, pedestrians=40, seed=SEED, full_pictures=True
                )
                assert seen.picture is not None
                tile = Image.fromarray(seen.picture).crop(CROP).resize(TILE, Image.Resampling.LANCZOS)
                sheet.paste(tile, (column * TILE[0], header + row * TILE[1]))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path, quality=84, optimize=True)


def started_before_canvas(simulator: TownSimulator, scenario: Scenario, distance_m: float) -> Scenario:
    """The scenario, started on its route `distance_m` before its canvas."""
    simulator.reset(scenario)
    route, canvas = simulator.route, scenario.canvas
    at = max(route.locate(canvas.x_m, canvas.y_m).arclength_m - distance_m, 0.0)
    x, y, z, yaw = route.at(at)
    start = dataclasses.replace(scenario.start, x_m=x, y_m=y, z_m=z, yaw_rad=math.remainder(yaw, math.tau))
    return dataclasses.replace(scenario, start=start)


if __name__ == "__main__":
    main()
