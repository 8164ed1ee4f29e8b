"""Which calibration is worth its simulator calls?

    python studies/calibration.py --json OUT --keep FOLDER [--controller pilotnet:FILE] [--scenarios left-03,right-05]

In each scenario and weather the expert is recorded (clean, right, left), the drives are calibrated in
three ways, and composites made with each are compared with replays over the same random patterns, really painted:
  reprojection  distance of the homographies from those the town states, over a 9×9 grid of canvas points in view,
                corners included; px of the 800×600 camera picture
  paint         mean absolute error over channels and over pixels of which the pattern covers half, 8-bit levels
  steer         mean absolute difference of a controller's answers to composited and to painted frames, and, beside it,
                of its answers to painted and clean frames: what there is to predict
All but the reprojection error of a method are over the frames that every method keeps. The town's poses are exact,
which other simulators' need not be: two more rows take poses that are off by 0.5° and 10 cm, as they are and mended by
what is seen.

Replays are kept in FOLDER; an interrupted study goes on there, and writes what it has after every scenario.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from roadproof.calibration import METHODS, Calibrated, CalibrationMethod, calibrate
from roadproof.calibration.outline import moved
from roadproof.calibration.replays import Replays, Target
from roadproof.calibration.report import Spread, stated_errors_px
from roadproof.calibration.two_paint import look_at_paints
from roadproof.compositing import composite, covered_share, view_canvas
from roadproof.controllers import Controller, load_controller
from roadproof.datatypes import Weather
from roadproof.drives import Drive, Drives, Trajectories, Window, record
from roadproof.geometry import homography_from_pose
from roadproof.io.files import write_json
from roadproof.machine import made_with
from roadproof.patterns import Pattern, raster
from roadproof.recordings import Recording
from roadproof.scenarios import find_scenario
from roadproof.search_space import SearchSpace
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.expert import expert

OFF = np.array([0.004, 0.008, 0.002, 0.08, -0.02, 0.1])
"""A camera turned by 0.2°, 0.5° and 0.1° about its axes and shifted by 8, 2 and 10 cm along them."""


def steer(controller: Controller, recording: Recording, frames: torch.Tensor) -> np.ndarray:
    """A controller's answers to frames (F, 3, H, W) seen on a recorded drive."""
    with torch.no_grad():
        speed = torch.tensor(recording.speed_mps, dtype=torch.float32)
        return controller.steer(frames, speed, torch.tensor(recording.command)).numpy()


def at(recording: Recording, steps: set[int]) -> Recording:
    """A recording with some of its frames only."""
    kept = [k for k, number in enumerate(recording.frame_number.tolist()) if number in steps]
    maps = recording.maps
    if maps is not None:
        maps = replace(maps, gain=maps.gain[kept], offset=maps.offset[kept], visible=maps.visible[kept])
    names = ("frames", "frame_number", "image_from_canvas", "speed_mps", "command", "steer")
    return replace(recording, maps=maps, **{name: getattr(recording, name)[kept] for name in names})


def compare(
    results: dict[CalibrationMethod, Calibrated],
    painted: dict[str, list[np.ndarray]],
    drives: Drives,
    patterns: list[Pattern],
    controller: Controller | None,
) -> dict[CalibrationMethod, dict[str, float]]:
    """Errors of each method's composites."""
    sums: dict[CalibrationMethod, list[list[float]]] = {method: [] for method in results}
    for n, drive in enumerate(drives.drives):
        kept = [set(result.recordings.recordings[n].frame_number.tolist()) for result in results.values()]
        common = set.intersection(*kept)
        rows = [k for k, number in enumerate(drive.frame_number.tolist()) if number in common]
        # Poses are exact in the town: where the paint is, is taken from them for all methods.
        exact = at(results[CalibrationMethod.POSE].recordings.recordings[n], common)
        for k, pattern in enumerate(patterns):
            truth = painted[drive.name][k][rows]
            paint = (
                covered_share(pattern, exact.image_from_canvas, results[CalibrationMethod.POSE].recordings.view) >= 0.5
            )
            for method, result in results.items():
                one = at(result.recordings.recordings[n], common)
                colour, view = result.recordings.colour, result.recordings.view
                canvas = view_canvas(one.frames, one.image_from_canvas, view, colour, maps=one.maps)
                made = composite(pattern, canvas)
                levels = 255 * made.permute(0, 2, 3, 1).numpy()
                row = [float(np.abs(np.round(levels) - truth)[paint].mean())]
                if controller is not None:
                    real, bare = (torch.tensor(f).permute(0, 3, 1, 2).float() / 255 for f in (truth, one.frames))
                    answers = [steer(controller, one, frames) for frames in (made, real, bare)]
                    row += [
                        float(np.abs(answers[0] - answers[1]).mean()),
                        float(np.abs(answers[1] - answers[2]).mean()),
                    ]
                sums[method].append(row)
    names = ("paint_levels", "steer_error", "steer_effect")
    return {method: dict(zip(names, np.mean(rows, 0).tolist(), strict=False)) for method, rows in sums.items()}


def from_poses_that_are_off(replays: Replays, drives: Drives) -> dict[str, Spread | None]:
    """Reprojection errors of disturbed poses, and of the same mended by what is seen."""
    settings = drives.settings
    before: list[np.ndarray] = []
    after: list[np.ndarray] = []
    for drive in drives.drives:
        exact = np.stack([homography_from_pose(settings.camera, s, settings.scenario.canvas) for s in drive.states])
        prior = moved(exact, np.tile(OFF, (len(exact), 1)), settings.camera)
        seen, _ = look_at_paints(replays, drive, prior, settings.camera, settings.view, refine=True)
        before.append(stated_errors_px(prior, exact, settings.camera))
        mended = np.stack(list(seen.found.values()))
        after.append(stated_errors_px(mended, exact[list(seen.found)], settings.camera))
    parts = {"pose, off": before, "two-paint, from poses that are off": after}
    return {name: Spread.of(np.concatenate(errors)) for name, errors in parts.items()}


def reprojection(result: Calibrated, replays: Replays, drives: Drives) -> Spread | None:
    """Over all drives and points in view."""
    errors: list[np.ndarray] = []
    for recording, drive in zip(result.recordings.recordings, drives.drives, strict=True):
        stated = stated_of(replays, drive)
        kept = np.isin(drive.frame_number, recording.frame_number)
        errors.append(stated_errors_px(recording.image_from_canvas, stated[kept], drives.settings.camera))
    return Spread.of(np.concatenate(errors))


def stated_of(replays: Replays, drive: Drive) -> np.ndarray:
    """What the town states; there is a replay of every drive by now."""
    stated = replays.stated(drive)
    assert stated is not None
    return stated


def judge(
    town: TownSimulator,
    drives: Drives,
    methods: list[CalibrationMethod],
    patterns: list[Pattern],
    controller: Controller | None,
    keep: Path,
) -> list[dict[str, object]]:
    """One record a method for one scenario and weather."""
    results: dict[CalibrationMethod, Calibrated] = {}
    for method in methods:
        began = time.process_time()
        # Each in a folder of its own: one would read the replays of another.
        results[method] = calibrate(town, drives, method, folder=keep / str(method))
        print(f"  {method}: {time.process_time() - began:.0f} s of one core", flush=True)
    replays = Replays(town, drives, keep)
    painted = {
        drive.name: [replays.look(drive, Target(f"pattern-{k}", raster(pattern))) for k, pattern in enumerate(patterns)]
        for drive in drives.drives
    }
    errors = compare(results, painted, drives, patterns, controller)
    place = {"scenario": drives.settings.scenario.name, "weather": str(drives.settings.weather)}
    records: list[dict[str, object]] = [
        place
        | {"method": str(method), **spread(reprojection(result, replays, drives)), **errors[method]}
        | {"frames": sum(drive.frames for drive in result.report.drives), "calls": result.report.calls}
        | {"replay_seconds": result.report.seconds, "colour_residual": result.report.colour_residual}
        for method, result in results.items()
    ]
    off = from_poses_that_are_off(replays, drives)
    return records + [place | {"method": name, **spread(each)} for name, each in off.items()]


def spread(errors: Spread | None) -> dict[str, object]:
    """As columns."""
    return {"reprojection_px": errors and errors.mean, "reprojection_p95_px": errors and errors.p95}


def main() -> None:
    """Record, calibrate, composite, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--keep", type=Path, required=True)
    parser.add_argument("--controller", help="whose steering is compared, as `roadproof attack` takes it")
    parser.add_argument("--scenarios", default="left-03,right-05,straight-04")
    parser.add_argument("--weathers", default="clear-noon,rainy-noon")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--trajectories", type=int, default=3)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--patterns", type=int, default=3)
    parser.add_argument("--figures", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    controller = load_controller(arguments.controller) if arguments.controller else None
    space = SearchSpace(figures=arguments.figures)
    drawn = space.drawn(arguments.patterns, arguments.seed)
    patterns = [drawn[k] for k in range(arguments.patterns)]
    methods = [CalibrationMethod(name) for name in arguments.methods.split(",")]
    if CalibrationMethod.POSE not in methods:
        parser.error(f"--methods is {arguments.methods}, expected pose among them: it says where the paint is")
    records: list[dict[str, object]] = []
    with TownSimulator() as town:
        for weather in map(Weather, arguments.weathers.split(",")):
            for name in arguments.scenarios.split(","):
                print(f"{name}, {weather}", flush=True)
                keep = arguments.keep / f"{name}-{weather}"
                drives = record(
                    town,
                    expert,
                    find_scenario(name),
                    weather=weather,
                    trajectories=Trajectories(count=arguments.trajectories),
                    window=Window(frames=arguments.frames),
                    seed=arguments.seed,
                    folder=keep / "record",
                    driver_name="expert",
                )
                records += judge(town, drives, methods, patterns, controller, keep / "calibration")
                write(arguments, records)
                for each in records[-len(methods) - 2 :]:
                    numbers = {k: round(v, 4) for k, v in each.items() if isinstance(v, float)}
                    print(f"  {each['method']:36} {numbers}", flush=True)


def write(arguments: argparse.Namespace, records: list[dict[str, object]]) -> None:
    """All that is known so far."""
    result = {
        "study": "calibration",
        "version": 1,
        "settings": {k: str(v) for k, v in vars(arguments).items() if k not in ("json", "keep", "controller")},
        "controller": arguments.controller and Path(str(arguments.controller)).name,
        "records": records,
        "made_with": made_with(),
    }
    write_json(arguments.json, result)


if __name__ == "__main__":
    main()
