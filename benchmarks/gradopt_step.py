"""What one step of GradOpt costs, against the bare controller and against the published way.

    python benchmarks/gradopt_step.py --json OUT [--frames 88] [--recordings SET] [--controllers cil pilotnet] [--quick]

A step composites the frames, shows them to the controller and goes back to the pattern's parameters. The bare
controller's forward and backward pass to the same frames is the physical limit: ratio 1. The published way renders
1 + 8 K whole sets of frames for one gradient. All three are measured in turn, in one run, on the same frames. Beside
the clock stands processor time, which others on the machine disturb less; with one thread its ratio is the one to trust
where the machine is busy.

On a GPU the whole step of a search, as a CUDA graph that is recorded once and replayed, is measured beside the bare
controller's passes as a graph of their own: the physical limit there, where starting operations one by one takes most
of the time (goal: 1.3 with --frames 400).

A set of recordings that can be driven in has a second part, with shipped weights: one step of the search in the
recorded world (three starts a side, a picture every second step), against the bare controller's passes to as many
pictures, those of an instant at a time as a closed loop must and all of them in one batch; and how long drives over
1,000 patterns take.
"""

import argparse
import json
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

import roadproof
from roadproof.attacks import PathDeviation, Surrogate
from roadproof.attacks.captured import Replay, cuda_graph, replay_of
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP, parse_groups
from roadproof.attacks.published import PublishedMeasure
from roadproof.attacks.step import state_at
from roadproof.controllers import CIL, pilotnet_controller
from roadproof.controllers.asking import controls_of
from roadproof.datatypes import VehicleState
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CanvasPlacement, homography_from_pose
from roadproof.io.files import write_json
from roadproof.machine import keep_freed_memory, made_with
from roadproof.photometry import AffineResponse, ColourTransform
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


def measure(
    recordings: RecordingSet, name: str, figures: int, dtype: torch.dtype, device: str, repeats: int, published: bool
) -> dict[str, object]:
    """One case: medians of alternating repeats after a warm-up."""
    controller = placed(CIL(seed=0).folded() if name == "cil" else pilotnet_controller(seed=0), device, dtype)
    groups = parse_groups("all", recordings)
    surrogate = Surrogate(recordings, controller, groups, device=device)
    space = SearchSpace(figures=figures)
    unit = space.random((1, 1), torch.Generator().manual_seed(0)).to(device)
    frames = surrogate.views[0].clean_frames.detach().clone(memory_format=torch.channels_last)
    speed = torch.cat([torch.tensor(r.speed_mps, device=device).float() for r in recordings.recordings])
    command = torch.cat([torch.tensor(r.command, device=device) for r in recordings.recordings])

    def step() -> None:
        surrogate.values_and_gradients(space, unit)

    def bare() -> None:
        leaf = frames.requires_grad_()
        torch.autograd.grad(controller.steer(leaf, speed, command).float().sum(), leaf)

    runs = {"step": step, "bare": bare}
    if published:
        authors = PublishedMeasure(recordings, controller, groups, device=device).on_grid(10.0)
        runs["published"] = lambda: authors.values_and_gradients(space, unit)
    reason = None
    if device != "cpu":
        replay = replay_of(
            surrogate, space, learning_rate=0.1, momentum=0.9, iterations=repeats + 2, state=state_at(unit)
        )
        bare()
        runs["bare_graph"] = cuda_graph(bare, lambda: None, surrogate.device)
        if isinstance(replay, Replay):
            runs["step_graph"] = replay.again
        else:
            reason = replay
        torch.cuda.reset_peak_memory_stats()
    times: dict[str, list[float]] = {key: [] for key in runs}
    cpu_times: dict[str, list[float]] = {key: [] for key in runs}
    for repeat in range(repeats + 2):
        for key, function in runs.items():
            if key == "published" and repeat >= 4:
                continue
            elapsed, processor = milliseconds(function, device)
            if repeat >= (1 if key == "published" else 2):
                times[key].append(elapsed)
                cpu_times[key].append(processor)
    median = {key: statistics.median(values) for key, values in times.items()}
    peak = torch.cuda.max_memory_allocated() / 2**20 if device != "cpu" else _peak_mb()
    return {
        "controller": name,
        "figures": figures,
        "dtype": str(dtype).removeprefix("torch."),
        "device": device,
        "frames": len(frames),
        "canvas_pixels": len(surrogate.views[0].clean),
        "step_ms": round(median["step"], 2),
        "step_ms_range": [round(min(times["step"]), 2), round(max(times["step"]), 2)],
        "bare_ms": round(median["bare"], 2),
        "bare_ms_range": [round(min(times["bare"]), 2), round(max(times["bare"]), 2)],
        "ratio": _median_ratio(times),
        "cpu_ratio": _median_ratio(cpu_times) if device == "cpu" else None,
        "graph_step_ms": round(median["step_graph"], 2) if "step_graph" in median else None,
        "graph_bare_ms": round(median["bare_graph"], 2) if "bare_graph" in median else None,
        "graph_ratio": _median_ratio({"step": times["step_graph"], "bare": times["bare_graph"]})
        if "step_graph" in times
        else None,
        "not_a_graph": reason,
        "published_step_ms": round(median["published"], 1) if published else None,
        "published_over_ours": round(median["published"] / median["step"], 2) if published else None,
        "peak_mb": round(peak),
    }


def measure_path(recordings: RecordingSet, name: str, repeats: int, patterns: int) -> dict[str, object]:
    """One step of the search in the recorded world, and drives over many patterns, on the CPU."""
    controller, space = roadproof.load_controller(name), SearchSpace(figures=5)
    path = PathDeviation()
    world = path.measure(recordings, controller, (RIGHT_GROUP, LEFT_GROUP), device="cpu")
    unit = space.random((2, 3), torch.Generator().manual_seed(0))
    rolled = world.worlds[0]
    instants = -(-rolled.course.count // path.every)
    seen = (rolled.bank.levels[:6] / 255, rolled.bank.speed_mps[:6], rolled.bank.command[:6])

    def bare(copies: int) -> None:
        frames, speed, command = (part.repeat(copies, *[1] * (part.ndim - 1)) for part in seen)
        leaf = frames.contiguous(memory_format=torch.channels_last).requires_grad_()
        torch.autograd.grad(controls_of(controller, leaf, speed, command).float().sum(), leaf)

    runs = {
        "step": lambda: world.values_and_gradients(space, unit),
        "bare": lambda: [bare(1) for _ in range(instants)],
        "batch": lambda: bare(instants),
    }
    times: dict[str, list[float]] = {key: [] for key in runs}
    cpu_times: dict[str, list[float]] = {key: [] for key in runs}
    for repeat in range(repeats + 1):
        for key, function in runs.items():
            elapsed, processor = milliseconds(function, "cpu")
            if repeat:
                times[key].append(elapsed)
                cpu_times[key].append(processor)
    many = space.drawn(patterns, 1)
    began = time.perf_counter()
    rolled.predict(controller, many)
    return {
        "controller": name,
        "figures": 5,
        "pictures": 6 * instants,
        **{f"{key}_ms": round(statistics.median(values), 1) for key, values in times.items()},
        "ratio": _median_ratio(times),
        "cpu_ratio": _median_ratio(cpu_times),
        "ratio_to_one_batch": _median_ratio({"step": times["step"], "bare": times["batch"]}),
        "patterns_driven": patterns,
        "seconds_for_1000": round((time.perf_counter() - began) * 1000 / patterns, 1),
    }


def _median_ratio(times: dict[str, list[float]]) -> float:
    return round(statistics.median(s / b for s, b in zip(times["step"], times["bare"], strict=True)), 3)


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> None:
    """Measure every case and write them with versions and device."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=88)
    parser.add_argument("--recordings", type=Path, help="a set of real recordings instead of the synthetic drive")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--controllers", nargs="+", choices=("cil", "pilotnet"), default=("cil", "pilotnet"))
    parser.add_argument("--quick", action="store_true", help="K = 5 in float32 on the CPU only")
    args = parser.parse_args()
    keep_freed_memory()  # as the command line does
    recordings = load_recordings(args.recordings) if args.recordings else synthetic_drive(args.frames)
    devices = ["cpu", "cuda"] if torch.cuda.is_available() and not args.quick else ["cpu"]
    dtypes = [torch.float32] if args.quick else [torch.float32, torch.bfloat16]
    cases = []
    for device in devices:
        for name in args.controllers:
            for figures in (5,) if args.quick else (1, 5):
                for dtype in dtypes:
                    case = measure(recordings, name, figures, dtype, device, args.repeats, dtype == torch.float32)
                    cases.append(case)
                    print(json.dumps(case), flush=True)
    paths = []
    for name in args.controllers if recordings.is_placed else ():
        paths.append(measure_path(recordings, name, args.repeats, 64 if args.quick else 1000))
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
