"""Run folders for tests, made by the real stages on drives whose paths are known."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from roadproof.attacks import AttackResult, Candidate, GradOpt
from roadproof.attacks.result import Cost
from roadproof.calibration.report import CalibrationReport, DriveReport, Spread
from roadproof.checks import Check
from roadproof.coverage import Shape
from roadproof.datatypes import Ending, Event, EventKind, Weather
from roadproof.drives import Drive, Trajectories, Window
from roadproof.drives.folder import Settings, write_drive, write_settings
from roadproof.driving.episode import Episode
from roadproof.driving.evaluation import Evaluation
from roadproof.driving.starts import StartOffset
from roadproof.driving.trial import judge
from roadproof.geometry import CIL_CAMERA, CIL_INPUT
from roadproof.hardening.judgement import BareDrives, JudgedAttack, Judgement
from roadproof.hardening.result import Hardened, Round
from roadproof.patterns import Pattern, raster
from roadproof.pipeline.film import Strip
from roadproof.pipeline.selection import Driven, Selection
from roadproof.pipeline.stage_costs import StageCost
from roadproof.recordings import Side, save_recordings
from roadproof.roads.maps import load_map, scenario_route
from roadproof.scenarios import find_scenario
from roadproof.search_space import SearchSpace
from scenes import recording_set

PATTERN = Pattern(
    (Shape.RECTANGLE, Shape.RECTANGLE),
    torch.tensor([[150.0, 200.0, 60.0, 340.0, 20.0], [260.0, 200.0, 40.0, 300.0, 160.0]]),
    torch.tensor([[0.9, 0.8, 0.1], [0.1, 0.2, 0.9]]),
)
WEATHERS = (Weather.CLEAR_NOON, Weather.RAINY_NOON)
DT_S = 0.05


def driven(scenario, aside_m=0.0, *, weather=WEATHERS[0], traffic=False, seed=0, events=(), painted=False):
    """An episode along a scenario's route, up to so many metres left of it from the canvas on."""
    route = scenario_route(scenario, load_map(scenario.map_name))
    canvas_m = route.locate(scenario.canvas.x_m, scenario.canvas.y_m).arclength_m
    at = np.arange(0.0, route.length_m - 2.0, 0.35)
    x, y = np.array([route.at(s)[:2] for s in at]).T
    heading = np.arctan2(np.gradient(y), np.gradient(x))
    aside = aside_m / (1 + np.exp(-(at - canvas_m) / 2))
    steps = len(at) - 1
    steer = 0.1 * np.sin(at / 5)[:-1] - 0.05 * aside[:-1]
    return Episode(
        scenario=scenario.name,
        weather=weather,
        painted=painted,
        cars=20 if traffic else 0,
        pedestrians=20 if traffic else 0,
        seed=seed,
        dt_s=DT_S,
        ending=Ending.GOAL_REACHED,
        events=tuple(events),
        time_s=DT_S * np.arange(steps + 1),
        x_m=x - aside * np.sin(heading),
        y_m=y + aside * np.cos(heading),
        z_m=np.zeros(steps + 1),
        yaw_rad=heading,
        speed_mps=np.full(steps + 1, 7.0),
        command=np.full(steps + 1, 2),
        steer=np.clip(steer, -1, 1),
        throttle=np.full(steps, 0.4),
        brake=np.zeros(steps),
    )


def write_evaluation(folder, *, aside_m=1.5, clean_events=(), events=(), scenario=None, controller="cil", runs=2):
    """An evaluation of drives that go so far aside, in two weathers."""
    scenario = scenario or find_scenario("left-03")
    trials = []
    for weather in WEATHERS:
        for run, traffic in [(0, False), *((run, True) for run in range(runs))]:
            one = driven(scenario, weather=weather, traffic=traffic, seed=run, events=clean_events)
            two = driven(
                scenario, aside_m + 0.2 * run, weather=weather, traffic=traffic, seed=run, events=events, painted=True
            )
            names = [f"{weather}-{traffic}-{run}-{which}.npz" for which in ("clean", "attack")]
            for name, episode in zip(names, (one, two), strict=True):
                episode.save(folder / "episodes" / name)
            trials.append(
                judge(one, two, scenario.canvas, pattern="attack", clean_file=names[0], painted_file=names[1])
            )
    evaluation = Evaluation(
        scenario=scenario,
        controller=controller,
        weathers=WEATHERS,
        runs=runs,
        cars=20,
        pedestrians=20,
        seed=0,
        trials=tuple(trials),
        simulator_calls=2 * len(trials),
        seconds=12.5,
    )
    evaluation.save(folder, raster(PATTERN))
    return evaluation


def write_attack(folder):
    """A search that gained."""
    steps = np.linspace(0.0, 0.3, 20)
    AttackResult(
        pattern=PATTERN,
        group="clean+left",
        surrogate_shift=0.31,
        by_group={"clean+right": 0.21, "clean+left": 0.31},
        candidates=(Candidate(PATTERN, "clean+left", 0.31),),
        history=np.stack([np.stack([steps, 0.8 * steps], -1), np.stack([1.1 * steps, steps], -1)], 1),
        cost=Cost(controller_frames=4800, seconds=31.0),
        checks=(Check("non-zero gradients", True, "0% of the parameters have no gradient"),
                Check("better than random search", False, "random found more", "use more restarts")),
        space=SearchSpace(figures=2),
        method=GradOpt(iterations=20, restarts=2),
        seed=0,
    ).save(folder)  # fmt: skip


def write_selection(folder, *aside_m, chosen):
    """Candidates that go so far aside when driven."""
    scenario = find_scenario("left-03")
    clean = driven(scenario)
    trials = [
        judge(
            clean,
            driven(scenario, metres, painted=True),
            scenario.canvas,
            pattern=f"candidate-{rank}",
            clean_file="clean.npz",
            painted_file=f"candidate-{rank}.npz",
        )
        for rank, metres in enumerate(aside_m, 1)
    ]
    candidates = tuple(Driven(group="clean+left", rank=rank, trial=trial) for rank, trial in enumerate(trials, 1))
    Selection(pattern=PATTERN, driven=candidates, chosen=chosen, simulator_calls=1 + len(trials)).save(folder)
    return trials


def write_strip(folder):
    """Six pairs of pictures."""
    pictures = np.random.default_rng(0).integers(0, 255, (2, 6, 60, 80, 3), np.uint8)
    beside = np.linspace(0.0, 1.5, 6)
    Strip(time_s=np.arange(6.0), lateral_m=beside, clean=pictures[0], painted=pictures[1]).save(folder / "strip.npz")
    Image.fromarray(pictures[0, 0]).resize((320, 144)).save(folder / "film.jpg")


def write_film(folder):
    """A film of one second and a bit."""
    av = pytest.importorskip("av", reason="films need the extra roadproof[video]")
    pages = np.random.default_rng(0).integers(0, 255, (3, 9, 20, 3), np.uint8).repeat(8, 0).repeat(64, 1).repeat(64, 2)
    with av.open(str(folder / "film.mp4"), "w", options={"movflags": "+faststart"}) as container:
        stream = container.add_stream("libx264", rate=20)
        stream.width, stream.height, stream.pix_fmt = 1280, 576, "yuv420p"
        for page in pages:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(page, "rgb24")))
        container.mux(stream.encode())


CRASH = (
    Event(EventKind.WRONG_LANE, 5.0, "1.2 m beside its lane"),
    Event(EventKind.COLLISION_STATIC, 6.0, "tree 7"),
)


def write_run(folder, **options):
    """A whole run but for the film."""
    write_attack(folder / "attack")
    evaluation = write_evaluation(folder / "evaluation", **options)
    write_strip(folder / "evaluation")
    write_record(folder / "record", evaluation.scenario)
    save_recordings(recording_set(frames=3), folder / "recordings")
    write_calibration(folder / "calibration")
    return evaluation


def write_calibration(folder):
    """One good calibration."""
    drives = tuple(
        DriveReport(
            name=name, frames=4, dropped=((45, "too few points"),), residual_px=Spread(0.2, 0.4), stated_px=None
        )
        for name in ("clean", "right", "left")
    )
    CalibrationReport(method="two-paint", drives=drives, colour_residual=None, calls=10, seconds=4.0).save(
        folder / "report.json"
    )


def settings_of(scenario):
    """How a scenario is recorded where nothing is asked for."""
    return Settings(
        scenario=scenario,
        weather=WEATHERS[0],
        trajectories=Trajectories(),
        window=Window(),
        seed=0,
        driver="cil",
        camera=CIL_CAMERA,
        view=CIL_INPUT,
        dt_s=DT_S,
    )


def write_record(folder, scenario):
    """Three recorded drives, of which one had to be tried twice."""
    write_settings(settings_of(scenario), folder)
    steps = np.arange(40, 60, 5)
    for name, right_m, calls in (("clean", 0.0, 1), ("right", 1.5, 2), ("left", -1.4, 1)):
        write_drive(
            Drive(
                name=name,
                side=Side(name),
                episode=driven(scenario, -right_m),
                frame_number=steps,
                frames=np.zeros((4, 88, 200, 3), np.uint8),
                steer=np.zeros(4),
                right_m=np.full(4, right_m),
                calls=calls,
                note="perturbed less than asked" if calls > 1 else "",
            ),
            folder,
        )


def hardened():
    """A hardening that helped."""
    judged = [
        JudgedAttack(
            scenario="left-03",
            kind=kind,
            after=after,
            deviation_m=(metres, metres),
            left_lane=(metres > 1, False),
            starts=(StartOffset(right_m=0.1), StartOffset(right_m=-0.2)),
            simulator_calls=4,
        )
        for kind in ("by gradient", "random")
        for after, metres in ((False, 1.2), (True, 0.3))
    ]
    rounds = tuple(
        Round(number=number, deviation_m={"right-02": metres}, left_lane=metres / 2)
        for number, metres in ((0, 1.1), (1, 0.4))
    )
    clean = (BareDrives(4, 4, ()), BareDrives(4, 3, ("left-03, rainy-noon",)))
    return Hardened(
        controller="pilotnet",
        hardened="hardened.safetensors",
        rounds=rounds,
        best=1,
        judgement=Judgement(tuple(judged), clean),
        cost={"learn": StageCost(90.0), "judge": StageCost(60.0, 16)},
    )


def read_result(folder):
    return json.loads((folder / "result.json").read_text())
