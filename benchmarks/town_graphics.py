"""How far are the town's pictures by OpenGL from those by software, and does a controller drive alike in both?

    python benchmarks/town_graphics.py --json OUT

Each controller drives each scenario over the bare road, by software and by OpenGL, and over the same random pattern.
Pictures are compared from the same places, by giving the controls of the software's drive again: mean absolute
differences over channels, in 8-bit levels, whole pictures. Paths are compared where the canvas is in view: the paper's
deviation between the drive by software and that by OpenGL, and beside it how far paint takes the car in either.
"""

from __future__ import annotations

import argparse
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from roadproof.controllers import Controller, load_controller
from roadproof.datatypes import Weather
from roadproof.driving.deviation import passage_deviation_m
from roadproof.driving.episode import Ending, Episode
from roadproof.driving.rollout import replay, rollout
from roadproof.io.files import write_json
from roadproof.machine import made_with
from roadproof.patterns import Pattern
from roadproof.scenarios import Scenario, find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.town.simulator import TownSimulator


def driven(
    town: TownSimulator, controller: Controller, scenario: Scenario, weather: Weather, pattern: Pattern | None
) -> tuple[Episode, np.ndarray]:
    """A drive and its frames, (T, H, W, 3)."""
    frames: list[np.ndarray] = []
    episode = rollout(
        town,
        controller,
        scenario,
        weather=weather,
        pattern=pattern,
        on_step=lambda seen, _: frames.append(seen.frame),
    )
    return episode, np.stack(frames)


def compared(
    towns: tuple[TownSimulator, TownSimulator], controller: Controller, scenario: Scenario, weather: Weather
) -> dict[str, Any]:
    """The four drives of a controller in one scenario and weather."""
    pattern = SearchSpace(figures=5).drawn(1, seed=0)[0]
    drives = [[driven(town, controller, scenario, weather, each) for each in (None, pattern)] for town in towns]
    (bare, paint), (bare_gl, paint_gl) = drives
    again = driven(towns[1], replay(paint[0]), scenario, weather, pattern)  # type: ignore[arg-type]
    off = np.abs(paint[1].astype(np.int16) - again[1][: len(paint[1])])
    canvas = scenario.canvas
    return {
        "mean_levels": float(off.mean()),
        "median_levels": float(np.median(off)),
        "bare_apart_m": passage_deviation_m(bare[0], bare_gl[0], canvas),
        "painted_apart_m": passage_deviation_m(paint[0], paint_gl[0], canvas),
        "deviation_m": [passage_deviation_m(one[0], other[0], canvas) for one, other in drives],
        "reached": [each[0].ending is Ending.GOAL_REACHED for each in (bare, bare_gl)],
    }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--controllers", default="pilotnet,cil")
    parser.add_argument("--scenarios", default="straight-02,left-03,right-02,straight-09,left-07,right-05")
    parser.add_argument("--weathers", default="clear-noon,rainy-noon")
    arguments = parser.parse_args()
    names = [value.split(",") for value in (arguments.controllers, arguments.scenarios, arguments.weathers)]
    rows: list[dict[str, Any]] = []
    with TownSimulator() as software, TownSimulator(graphics="egl") as opengl:
        for controller, scenario, weather in product(*names):
            asked = load_controller(controller), find_scenario(scenario), Weather(weather)
            row = compared((software, opengl), *asked)
            rows.append({"controller": controller, "scenario": scenario, "weather": weather, **row})
            print(rows[-1], flush=True)
    write_json(arguments.json, {"rows": rows, "made_with": made_with() | {"panda3d": version("panda3d")}})


if __name__ == "__main__":
    main()
