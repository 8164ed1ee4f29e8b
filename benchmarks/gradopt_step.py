"""What one step of GradOpt costs, against the bare controller and against the published way.

    python benchmarks/gradopt_step.py --json OUT [--frames 88 400] [--recordings SET] [--controllers cil pilotnet]
        [--shapes rectangle ellipse triangle diamond] [--devices cpu cuda] [--quick]

A step composites the frames, shows them to the controller and goes back to the pattern's parameters. The bare
controller's forward and backward pass to the same frames is the physical limit: ratio 1. The published way renders
1 + 8 K whole sets of frames for one gradient; it knows rectangles alone. Kornia's, where kornia is installed, draws the
canvas as a picture and warps it into every frame. On a CPU the step is measured with plain operations, too, in place of
compiled passes. All are measured in turn, in one run, on the same frames. Beside the clock stands processor
time, which others on the machine disturb less; with one thread its ratio is the one to trust where the machine is busy.

On a GPU the whole step of a search, as a CUDA graph that is recorded once and replayed, is measured beside the bare
controller's passes as a graph of their own: the physical limit there, where starting operations one by one takes most
of the time (goal: 1.3 with 400 frames, 2 with 88). float32 is strict there; "tf32" lets multiplications round to TF32.

How far a precision takes a step astray is told by its gradient's distance from that of a controller in float64, over
the length of the latter.

A set of recordings that can be driven in has a second part, with shipped weights: one step of the search in the
recorded world (three starts a side, a picture every second step), against the bare controller's passes to as many
pictures, those of an instant at a time as a closed loop must and all of them in one batch, on a GPU each as a graph;
and how long drives over 1,000 patterns take.
"""

import argparse
import json
import resource
import statistics
import time
from collections.abc import Callable
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import TypeVar
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

import roadproof
from roadproof.attacks import PathDeviation, Surrogate
from roadproof.attacks.captured import LEAST, Replay, cuda_graph, replay_of
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP, parse_groups
from roadproof.attacks.published import PublishedMeasure
from roadproof.attacks.step import state_at
from roadproof.controllers import CIL, Controller, pilotnet_controller
from roadproof.controllers.asking import controls_of
from roadproof.controllers.precision import multiply_in
from roadproof.coverage import FOOTPRINT_VARIANCE, Footprints, Shape
from roadproof.datatypes import VehicleState
from roadproof.geometry import CANVAS_SIZE_PX, CIL_CAMERA, CIL_INPUT, CanvasPlacement, homography_from_pose
from roadproof.io.files import write_json
from roadproof.machine import keep_freed_memory, made_with
from roadproof.patterns import coverages, visibilities
from roadproof.photometry import AffineResponse, ColourTransform
from roadproof.photometry.responses import response_on
from roadproof.recordings import Recording, RecordingSet, Side, load_recordings
from roadproof.search_space import SearchSpace


def synthetic_drive(frames: int) -> RecordingSet:
    """A drive of the geometry of CARLA's recordings: the canvas comes from 16 m ahead to under the car."""
    rng = np.random.default_rng(0)
    canvas = CanvasPlacement(x_m=0.0, y_m=0.0, width_m=7.56, length_m=9.53)
    distance_m = np.linspace(16.0, 5.0, frames)
    states = [
        VehicleState(x_m=-d, y_m=0.3 * np.sin(d), z_m=0.0, yaw_rad=0.03 * np.cos(d), speed_mps=6.0) for d in distance_m
    ]
    drive = Recording(
        name="clean",
        side=Side.CLEAN,
        frames=rng.integers(60, 160, (frames, 88, 200, 3), dtype=np.uint8),
        frame_number=np.arange(frames),
        image_from_canvas=np.stack([homography_from_pose(CIL_CAMERA, state, canvas) for state in states]),
        speed_mps=np.full(frames, 6.0),
        command=np.full(frames, 2),
        steer=np.zeros(frames),
    )
    colour = ColourTransform(AffineResponse(torch.eye(3) * 0.7, torch.full((3,), 0.02)))
    return RecordingSet(camera=CIL_CAMERA, view=CIL_INPUT, colour=colour, recordings=(drive,))


Network = TypeVar("Network", bound=torch.nn.Module)


def placed(controller: Network, device: str, dtype: torch.dtype) -> Network:
    """As `load_controller` leaves a network: evaluation mode, frozen, channels last."""
    controller.eval().requires_grad_(False)
    return controller.to(device, dtype).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]  # not in its stubs


def milliseconds(function: Callable[[], object], device: str) -> tuple[float, float]:
    """One call, the device's own queue included: by the clock, and of the processor over all threads."""
    if device != "cpu":
        torch.cuda.synchronize()
    start, processor = time.perf_counter(), time.process_time()
    function()
    if device != "cpu":
        torch.cuda.synchronize()
    return (time.perf_counter() - start) * 1e3, (time.process_time() - processor) * 1e3


DTYPES = {"float32": torch.float32, "tf32": torch.float32, "bfloat16": torch.bfloat16}


def network(name: str, device: str, dtype: torch.dtype) -> CIL | Controller:
    """The network of a name, with random weights."""
    return placed(CIL(seed=0).folded() if name == "cil" else pilotnet_controller(seed=0), device, dtype)


def kornia_step(
    recordings: RecordingSet, controller: Controller, space: SearchSpace, unit: Tensor
) -> Callable[[], Tensor]:
    """One gradient from kornia's parts: the canvas as an RGBA picture, warped into every frame."""
    from kornia.geometry.transform import warp_perspective  # pyright: ignore[reportMissingImports]  # an option

    drives, device = recordings.recordings, unit.device
    clean = torch.cat([torch.tensor(drive.frames, device=device) for drive in drives]).permute(0, 3, 1, 2) / 255
    view_from_canvas = recordings.view.input_from_camera @ np.concatenate([r.image_from_canvas for r in drives])
    warps = torch.tensor(view_from_canvas, device=device).float()
    speed = torch.cat([torch.tensor(drive.speed_mps, device=device).float() for drive in drives])
    command = torch.cat([torch.tensor(drive.command, device=device) for drive in drives])
    response = response_on(recordings.colour.response, device, torch.float32)
    rows, columns = np.mgrid[0:CANVAS_SIZE_PX, 0:CANVAS_SIZE_PX]
    centre = np.stack([columns.ravel(), rows.ravel()], -1).astype(float)
    slopes = np.broadcast_to(np.eye(2), (len(centre), 2, 2))
    squares = Footprints.of(centre, slopes, FOOTPRINT_VARIANCE["area"], device=device)
    size = clean.shape[-2:]

    def step() -> Tensor:
        leaf = unit[0, 0].detach().requires_grad_()
        pattern = space.pattern(leaf)
        seen = visibilities(coverages(pattern, squares))
        colours = response(pattern.colours)
        canvas = torch.cat([colours.mT @ seen, seen.sum(0)[None]]).view(1, 4, CANVAS_SIZE_PX, CANVAS_SIZE_PX)
        warped = warp_perspective(canvas.expand(len(clean), -1, -1, -1), warps, size)
        frames = (clean * (1 - warped[:, 3:]) + warped[:, :3]).clamp(0, 1).contiguous(memory_format=torch.channels_last)
        return torch.autograd.grad(controller.steer(frames, speed, command).float().sum(), leaf)[0]

    return step


def gradient(recordings: RecordingSet, name: str, device: str, dtype: torch.dtype, space: SearchSpace) -> Tensor:
    """The gradient at the benchmark's pattern, computed with a controller in some precision."""
    surrogate = Surrogate(recordings, network(name, device, dtype), parse_groups("all", recordings), device=device)
    unit = space.random((1, 1), torch.Generator().manual_seed(0)).to(device)
    return surrogate.values_and_gradients(space, unit)[1].double()


def measure(
    recordings: RecordingSet, name: str, shape: Shape, figures: int, precision: str, device: str, repeats: int
) -> dict[str, object]:
    """One case: medians of alternating repeats after a warm-up."""
    rectangles = shape is Shape.RECTANGLE
    dtype, published = DTYPES[precision], precision == "float32" and rectangles
    controller = network(name, device, dtype)
    groups = parse_groups("all", recordings)
    surrogate = Surrogate(recordings, controller, groups, device=device)
    space = SearchSpace(figures=figures) if rectangles else SearchSpace(figures=figures, family="free", shape=shape)
    unit = space.random((1, 1), torch.Generator().manual_seed(0)).to(device)
    exact = gradient(recordings, name, device, torch.float64, space)
    error = (surrogate.values_and_gradients(space, unit)[1].double() - exact).norm() / exact.norm()
    frames = surrogate.views[0].clean_frames.detach().clone(memory_format=torch.channels_last)
    speed = torch.cat([torch.tensor(r.speed_mps, device=device).float() for r in recordings.recordings])
    command = torch.cat([torch.tensor(r.command, device=device) for r in recordings.recordings])

    def step() -> None:
        surrogate.values_and_gradients(space, unit)

    def bare() -> None:
        leaf = frames.requires_grad_()
        torch.autograd.grad(controller.steer(leaf, speed, command).float().sum(), leaf)

    def plain() -> None:
        with patch("roadproof.compositing.composite._compiles", lambda *_: False):
            step()

    runs = {"step": step, "bare": bare}
    if device == "cpu":
        runs["plain"] = plain
    if published:
        authors = PublishedMeasure(recordings, controller, groups, device=device).on_grid(10.0)
        runs["published"] = lambda: authors.values_and_gradients(space, unit)
        if find_spec("kornia"):
            runs["kornia"] = kornia_step(recordings, controller, space, unit)
    reason, peak = None, None
    if device != "cpu":
        torch.cuda.reset_peak_memory_stats()
        replay = replay_of(
            surrogate,
            space,
            learning_rate=0.1,
            momentum=0.9,
            iterations=max(LEAST, repeats + 2),
            state=state_at(unit),
        )
        peak = torch.cuda.max_memory_allocated() / 2**20
        bare()
        runs["bare_graph"] = cuda_graph(bare, lambda: None, surrogate.device)
        if isinstance(replay, Replay):
            runs["step_graph"] = replay.again
        else:
            reason = replay
    times: dict[str, list[float]] = {key: [] for key in runs}
    cpu_times: dict[str, list[float]] = {key: [] for key in runs}
    for repeat in range(repeats + 2):
        for key, function in runs.items():
            if key in ("published", "kornia") and repeat >= 4:
                continue
            elapsed, processor = milliseconds(function, device)
            if repeat >= (1 if key in ("published", "kornia") else 2):
                times[key].append(elapsed)
                cpu_times[key].append(processor)
    median = {key: statistics.median(values) for key, values in times.items()}
    return {
        "controller": name,
        "shape": str(shape),
        "figures": figures,
        "dtype": precision,
        "device": device,
        "frames": len(frames),
        "canvas_pixels": len(surrogate.views[0].clean),
        "step_ms": round(median["step"], 2),
        "step_ms_range": [round(min(times["step"]), 2), round(max(times["step"]), 2)],
        "bare_ms": round(median["bare"], 2),
        "bare_ms_range": [round(min(times["bare"]), 2), round(max(times["bare"]), 2)],
        "ratio": _median_ratio(times),
        "cpu_ratio": _median_ratio(cpu_times) if device == "cpu" else None,
        "plain_step_ms": round(median["plain"], 2) if device == "cpu" else None,
        "plain_over_ours": round(median["plain"] / median["step"], 2) if device == "cpu" else None,
        "graph_step_ms": round(median["step_graph"], 2) if "step_graph" in median else None,
        "graph_bare_ms": round(median["bare_graph"], 2) if "bare_graph" in median else None,
        "graph_ratio": _graph_ratio(times),
        "not_a_graph": reason,
        "published_step_ms": round(median["published"], 1) if published else None,
        "published_over_ours": round(median["published"] / median["step"], 2) if published else None,
        "kornia_step_ms": round(median["kornia"], 1) if "kornia" in median else None,
        "kornia_over_ours": round(median["kornia"] / median["step"], 2) if "kornia" in median else None,
        "gradient_error": float(error),
        "peak_mb": round(_peak_mb() if peak is None else peak),
    }


def measure_path(recordings: RecordingSet, name: str, device: str, repeats: int, patterns: int) -> dict[str, object]:
    """One step of the search in the recorded world, and drives over many patterns."""
    controller, space = roadproof.load_controller(name, device=device), SearchSpace(figures=5)
    path = PathDeviation()
    world = path.measure(recordings, controller, (RIGHT_GROUP, LEFT_GROUP), device=device)
    unit = space.random((2, 3), torch.Generator().manual_seed(0)).to(device)
    rolled = world.worlds[0]
    world.values_and_gradients(space, unit)
    # Where the canvas is hardly seen yet, no pictures are made.
    instants = world.frames_evaluated // 6
    seen = (rolled.bank.levels[:6] / 255, rolled.bank.speed_mps[:6], rolled.bank.command[:6])

    def bare(copies: int) -> None:
        frames, speed, command = (part.repeat(copies, *[1] * (part.ndim - 1)) for part in seen)
        leaf = frames.contiguous(memory_format=torch.channels_last).requires_grad_()
        torch.autograd.grad(controls_of(controller, leaf, speed, command, finite=False).float().sum(), leaf)

    def one_by_one() -> None:
        for _ in range(instants):
            bare(1)

    runs: dict[str, Callable[[], object]] = {
        "step": lambda: world.values_and_gradients(space, unit),
        "bare": one_by_one,
        "batch": lambda: bare(instants),
    }
    reason = None
    if device != "cpu":
        count = max(LEAST, repeats + 1)
        replay = replay_of(world, space, learning_rate=0.1, momentum=0.9, iterations=count, state=state_at(unit))
        if isinstance(replay, Replay):
            runs["step_graph"] = replay.again
        else:
            reason = replay
        one_by_one()
        runs["bare_graph"] = cuda_graph(one_by_one, lambda: None, world.device)
    times: dict[str, list[float]] = {key: [] for key in runs}
    cpu_times: dict[str, list[float]] = {key: [] for key in runs}
    for repeat in range(repeats + 1):
        for key, function in runs.items():
            elapsed, processor = milliseconds(function, device)
            if repeat:
                times[key].append(elapsed)
                cpu_times[key].append(processor)
    many = space.drawn(patterns, 1).mapped(lambda part: part.to(device))
    spent_ms, _ = milliseconds(lambda: rolled.predict(controller, many), device)
    return {
        "controller": name,
        "device": device,
        "figures": 5,
        "pictures": 6 * instants,
        **{f"{key}_ms": round(statistics.median(values), 1) for key, values in times.items()},
        "ratio": _median_ratio(times),
        "cpu_ratio": _median_ratio(cpu_times) if device == "cpu" else None,
        "ratio_to_one_batch": _median_ratio({"step": times["step"], "bare": times["batch"]}),
        "graph_ratio": _graph_ratio(times),
        "not_a_graph": reason,
        "patterns_driven": patterns,
        "seconds_for_1000": round(spent_ms / patterns, 1),
    }


def _median_ratio(times: dict[str, list[float]]) -> float:
    return round(statistics.median(s / b for s, b in zip(times["step"], times["bare"], strict=True)), 3)


def _graph_ratio(times: dict[str, list[float]]) -> float | None:
    return _median_ratio({"step": times["step_graph"], "bare": times["bare_graph"]}) if "step_graph" in times else None


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Measure every case and write them with versions and device."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--frames", type=int, nargs="+", default=[88])
    parser.add_argument("--recordings", type=Path, help="a set of real recordings instead of the synthetic drives")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--controllers", nargs="+", choices=("cil", "pilotnet"), default=("cil", "pilotnet"))
    parser.add_argument("--shapes", nargs="+", type=Shape, choices=Shape, default=[Shape.RECTANGLE])
    there = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    parser.add_argument("--devices", nargs="+", choices=there, default=there)
    parser.add_argument("--quick", action="store_true", help="K = 5 in float32 on the CPU only")
    args = parser.parse_args()
    keep_freed_memory()  # as the command line does
    given = load_recordings(args.recordings) if args.recordings else None
    devices = ["cpu"] if args.quick else args.devices
    cases, paths = [], []
    for recordings in [given] if given else map(synthetic_drive, args.frames):
        counts = (5,) if args.quick else (1, 5)
        for device, name, shape, figures in product(devices, args.controllers, args.shapes, counts):
            for precision in DTYPES:
                if (args.quick and precision != "float32") or (device == "cpu" and precision == "tf32"):
                    continue
                multiply_in(precision)
                cases.append(measure(recordings, name, shape, figures, precision, device, args.repeats))
                print(json.dumps(cases[-1]), flush=True)
    multiply_in("float32")
    for device, name in product(devices, args.controllers if given and given.is_placed else ()):
        paths.append(measure_path(given, name, device, args.repeats, 64 if args.quick else 1000))
        print(json.dumps(paths[-1]), flush=True)
    result = {
        "benchmark": "gradopt_step",
        "made_with": made_with(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "cases": cases,
        "paths": paths,
    }
    write_json(args.json, result)


if __name__ == "__main__":
    main()
