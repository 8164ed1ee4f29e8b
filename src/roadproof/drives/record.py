"""The verb: drive a scenario clean and perturbed, and keep what shows the canvas."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from roadproof.compositing.view import canvas_pixels
from roadproof.controllers import Controller
from roadproof.controllers.asking import act_of
from roadproof.controllers.identity import parts_of
from roadproof.datatypes import Control, EventKind, Observation, VehicleState, Weather
from roadproof.drives.folder import Drive, Drives, Settings, forget_settings, read_drive, write_drive, write_settings
from roadproof.drives.perturb import CleanPath, noisy, offsets, steering_noise, steering_test, swerving
from roadproof.drives.trajectories import DrivePlan, SteeringNoise, Trajectories, Window
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import Driver, Policy, SimulatorT, policy_of, replay, rollout
from roadproof.errors import CanvasNotReachedError, GeometryError, RecordingError, RoadproofError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CanvasPlacement, CropResize, homography_from_pose
from roadproof.homographies import Homography
from roadproof.io.files import AnyPath, as_path
from roadproof.limits import check_seed
from roadproof.processes import Pool, open_or_here
from roadproof.recordings import Side, evenly
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import Simulator, world_of

TRIES = 4
SMALLER = 0.7
AFTER_M = 2.0
_ENDS_IT = (EventKind.COLLISION_STATIC, EventKind.COLLISION_VEHICLE, EventKind.COLLISION_PEDESTRIAN, EventKind.OFF_ROAD)


def record(
    simulator: SimulatorT,
    driver: Controller | Driver[SimulatorT],
    scenario: Scenario,
    *,
    weather: Weather = Weather.CLEAR_NOON,
    trajectories: Trajectories | None = None,
    window: Window | None = None,
    seed: int = 0,
    driver_name: str = "",
    folder: AnyPath | None = None,
    pool: Pool[SimulatorT] | None = None,
    on_drive: Callable[[int], object] = lambda _done: None,
) -> Drives:
    """Record a driver past a bare canvas: one clean drive, and perturbed drives.

    A perturbed drive ends behind the canvas. One that hits something or leaves the road before is driven again with a
    smaller perturbation, and says so.

    Args:
        simulator: an open simulator.
        driver: a controller, or a function that is given the simulator after each reset.
        scenario: scenario that is driven.
        weather: weather of all drives, clear noon by default.
        trajectories: number of drives and their perturbations; by default one clean and one 1.5 m to each side.
        window: which frames of each drive are kept; `Window()` by default.
        seed: seed of the perturbations.
        driver_name: name of the driver in words, for the record; empty by default.
        folder: folder that keeps every finished drive; those it holds already are not driven again. None keeps nothing.
        pool: processes that are open already and drive instead; the driver must be picklable.
        on_drive: called with the number of finished drives, at first 0.

    Raises:
        RecordingError: the canvas never comes into view, no drive passes it unharmed, or the folder holds a recording
            with other settings.
        SimulatorError, ScenarioError, ControllerError: as `rollout` does.
        OutputError: the folder cannot be written.
    """
    check_seed(seed, "seed", RecordingError)
    folder = None if folder is None else as_path(folder)
    settings = Settings(
        scenario=scenario,
        weather=Weather(weather),
        trajectories=trajectories or Trajectories(),
        window=window or Window(),
        seed=seed,
        driver=driver_name,
        **parts_of(driver, (simulator.input.height_px, simulator.input.width_px)),
        camera=simulator.camera,
        view=simulator.input,
        dt_s=simulator.dt_s,
        world=world_of(simulator),
    )
    began = folder is not None and write_settings(settings, folder)
    plans, done = settings.trajectories.plans(), dict[str, Drive]()

    def keep(drive: Drive, *, made: bool) -> None:
        if made and folder is not None:
            write_drive(drive, folder)
        done[drive.name] = drive
        on_drive(len(done))

    on_drive(0)
    for plan in plans:
        if folder is not None and (kept := read_drive(plan.name, folder)) is not None:
            keep(kept, made=False)
    with open_or_here(pool, simulator) as driving:
        try:
            for _, drive in driving.each(partial(_clean, driver, settings), plans[: plans[0].name not in done]):
                keep(drive, made=True)
        except RoadproofError:
            if began and folder is not None:
                # A scenario that the simulator refuses can be mended, and recorded here.
                forget_settings(settings, folder)
            raise
        astray = partial(_perturbed, driver, settings, done[plans[0].name])
        for _, drive in driving.each(astray, [plan for plan in plans if plan.name not in done]):
            keep(drive, made=True)
    return Drives(settings=settings, drives=tuple(done[plan.name] for plan in plans))


def record_along(
    simulator: Simulator,
    controller: Controller,
    drives: Drives,
    episode: Episode,
    *,
    name: str,
    folder: Path | None = None,
) -> Drive:
    """Record the bare road along a drive made before: its controls given again, open loop, with no paint.

    The paint's effect on the drive is in the path alone; a drive that came to harm is cut there. It belongs to
    the side on which it was furthest from the clean drive.

    Args:
        simulator: an open simulator, the one the drives were recorded in.
        controller: controller that is asked for its answers to the frames, which are not carried out.
        drives: a recording of the same scenario; it gives scenario, weather, window and clean drive.
        episode: episode whose controls are given again.
        name: name of the new drive.
        folder: folder that keeps the drive; a drive it holds already is not driven again. None keeps nothing.

    Raises:
        RecordingError: the canvas never comes into view, or the drive in the folder is damaged.
        RoadproofError: the drive in the folder is along another one.
        SimulatorError, ScenarioError, ControllerError: as `rollout` does.
        OutputError: the folder cannot be written.
    """
    kept = None if folder is None else read_drive(name, folder)
    if kept is not None:
        again, given = ([e.steer, e.throttle, e.brake] for e in (kept.episode, episode))
        steps = min(again[0].size, given[0].size)
        if not all(np.allclose(one[:steps], other[:steps], atol=1e-4) for one, other in zip(again, given, strict=True)):
            # No `RecordingError`, with which re-recording rounds would end as if the road showed too little.
            raise RoadproofError(
                f"{folder} holds a drive along another one than was chosen; remove that folder, and it is driven again"
            )
        return kept
    settings, clean = drives.settings, drives.drives[0]
    path = CleanPath.of(clean.episode)
    last_m, _ = path.locate(clean.states[-1], None)
    harm_s = min((event.time_s for event in episode.events if event.kind in _ENDS_IT), default=np.inf)
    film, at_m = _Film(settings.scenario, settings.window), None

    def over(seen: Observation) -> bool:
        nonlocal at_m
        at_m, _ = path.locate(seen.state, at_m)
        return at_m > last_m + AFTER_M or seen.time_s >= harm_s

    again = rollout(simulator, replay(episode), settings.scenario, weather=settings.weather, on_step=film, until=over)
    chosen = _chosen(film, settings, name)
    steps, frames, which = chosen
    answers = np.zeros(len(again))
    for step, frame in zip(steps.tolist(), frames, strict=True):
        answers[step] = act_of(controller, frame, float(again.speed_mps[step]), int(again.command[step])).steer
    right_m = np.array([path.locate(film.states[int(k)], None)[1] for k in which])
    side = Side.RIGHT if right_m[np.abs(right_m).argmax()] > 0 else Side.LEFT
    drive = _drive(DrivePlan(name, side, 0.0, 0), again, chosen, answers, right_m)
    if folder is not None:
        write_drive(drive, folder)
    return drive


@dataclass(slots=True)
class _Film:
    """Collects the frames of a drive near the canvas, from which those to keep are chosen."""

    scenario: Scenario
    window: Window
    steps: list[int] = field(default_factory=list[int])
    frames: list[UInt8[np.ndarray, "h w 3"]] = field(default_factory=list[UInt8[np.ndarray, "h w 3"]])
    states: list[VehicleState] = field(default_factory=list[VehicleState])
    step: int = 0

    def __call__(self, seen: Observation, control: Control | None) -> None:
        canvas, step = self.scenario.canvas, self.step
        self.step += 1
        away_m = np.hypot(seen.state.x_m - canvas.x_m, seen.state.y_m - canvas.y_m) - 0.5 * canvas.length_m
        if control is not None and away_m <= self.window.horizon_m:
            self.steps.append(step)
            self.frames.append(seen.frame)
            self.states.append(seen.state)


def _clean(
    driver: Controller | Driver[SimulatorT], settings: Settings, simulator: SimulatorT, plan: DrivePlan
) -> Drive:
    film = _Film(settings.scenario, settings.window)
    episode = rollout(simulator, driver, settings.scenario, weather=settings.weather, on_step=film)
    chosen = _chosen(film, settings, "clean")
    last_s = float(episode.time_s[chosen[0][-1]])
    harm = [event for event in episode.events if event.kind in _ENDS_IT and event.time_s <= last_s]
    notes = [f"{harm[0].kind} at {harm[0].time_s:.1f} s, before or on the canvas"] if harm else []
    canvas = settings.scenario.canvas
    passed = canvas.ahead_m(float(episode.x_m[-1]), float(episode.y_m[-1])) >= canvas.length_m / 2
    notes += [] if passed else [f"ended before the canvas was passed: {episode.ending}"]
    return _drive(plan, episode, chosen, episode.steer, note="; ".join(notes))


def _perturbed(
    driver: Controller | Driver[SimulatorT], settings: Settings, clean: Drive, simulator: SimulatorT, plan: DrivePlan
) -> Drive:
    path, harm = CleanPath.of(clean.episode), ""
    for tried in range(TRIES):
        share = SMALLER**tried
        film = _Film(settings.scenario, settings.window)
        episode, answered, behind_s = _astray(simulator, driver, settings, plan, clean, share, film)
        events = (event for event in episode.events if event.kind in _ENDS_IT and event.time_s <= behind_s)
        harm = next((str(event.kind) for event in events), "")
        if not harm:
            chosen = _chosen(film, settings, plan.name)
            right_m = np.array([path.locate(film.states[int(k)], None)[1] for k in chosen[2]])
            notes = [] if tried == 0 else [f"perturbed {share:.2f} times as much as asked, not to crash"]
            notes += [] if behind_s < math.inf else [f"ended before the canvas was passed: {episode.ending}"]
            return _drive(plan, episode, chosen, answered, right_m, calls=tried + 1, note="; ".join(notes))
    raise CanvasNotReachedError(
        f"drive {plan.name} of {settings.scenario.name} ends in {harm} before the canvas ends, {TRIES} times; "
        "ask for smaller perturbations, or choose another scenario"
    )


def _astray(
    simulator: SimulatorT,
    driver: Controller | Driver[SimulatorT],
    settings: Settings,
    plan: DrivePlan,
    clean: Drive,
    share: float,
    film: _Film,
) -> tuple[Episode, Float[np.ndarray, " n"], float]:
    """One perturbed drive past the canvas, the driver's answers on it, and the time at which the canvas was passed.

    A swerve ends with a steering test there, from which a vehicle can be identified (`recorded.vehicle`); it stops
    where it comes to harm.
    """
    path, answers = CleanPath.of(clean.episode), list[float]()
    first, last = (path.locate(clean.states[k], None)[0] for k in (0, -1))
    rng = np.random.default_rng((settings.seed, plan.stream, list(Side).index(plan.side)))
    at_m: float | None = None
    behind_s, test = math.inf, list[float]()
    how = settings.trajectories.perturbation

    def begin(world: SimulatorT) -> Policy:
        policy = policy_of(driver, world)
        if isinstance(how, SteeringNoise):
            noise = steering_noise(plan.side, how, clean.episode, int(clean.frame_number[-1]), rng)
            return noisy(policy, clean.episode, share * noise, answers.append)
        length_m = float(path.arclength_m[-1])
        wanted = offsets(plan.side, share * plan.offset_m, first, last, length_m, rng, weaves=plan.weaves)
        swerve = swerving(policy, path, wanted, answers.append)

        def act(seen: Observation) -> Control:
            control = swerve(seen)
            return replace(control, steer=test.pop(0)) if seen.time_s >= behind_s else control

        return act

    def over(seen: Observation) -> bool:
        nonlocal at_m, behind_s
        if behind_s < math.inf:
            return not test or any(event.kind in _ENDS_IT for event in seen.events)
        at_m, d = path.locate(seen.state, at_m)
        if at_m > last + AFTER_M:
            behind_s = seen.time_s
            test.extend([] if isinstance(how, SteeringNoise) else steering_test(-np.sign(d) or 1.0, settings.dt_s))
        return behind_s < math.inf and not test

    episode = rollout(simulator, begin, settings.scenario, weather=settings.weather, on_step=film, until=over)
    return episode, np.array(answers), behind_s


Chosen: TypeAlias = tuple[Int[np.ndarray, " f"], UInt8[np.ndarray, "f h w 3"], Int[np.ndarray, " f"]]


def _chosen(film: _Film, settings: Settings, name: str) -> Chosen:
    """The steps and frames to keep, and their indices among the collected frames; the canvas must be in view."""
    shows = in_view(film.states, settings.scenario.canvas, settings.camera, settings.view, settings.window.least_px)
    which = np.flatnonzero(shows)
    if which.size == 0:
        raise CanvasNotReachedError(
            f"drive {name} of {settings.scenario.name} never sees {settings.window.least_px} pixels of the canvas "
            f"within {settings.window.horizon_m:g} m; check the driver, or where the canvas lies"
        )
    which = which[evenly(which.size, settings.window.frames)]
    return np.array(film.steps)[which], np.stack([film.frames[int(k)] for k in which]), which


def in_view(
    states: list[VehicleState], canvas: CanvasPlacement, camera: CameraModel, view: CropResize, least_px: int
) -> Bool[np.ndarray, " n"]:
    """Whether the canvas fills `least_px` pixels of the controller's input, by the pose; occlusion does not count."""
    shown_px = (_shown_px(homography_from_pose(camera, state, canvas), view, camera) for state in states)
    return np.fromiter((shown >= least_px for shown in shown_px), bool, len(states))


def _shown_px(image_from_canvas: Homography, view: CropResize, camera: CameraModel) -> int:
    """How many pixels of the controller's input have their middle on the canvas."""
    try:
        _, centre, _ = canvas_pixels(image_from_canvas[None], view, camera)
    except GeometryError:
        return 0
    return int(((centre > -0.5) & (centre < CANVAS_SIZE_PX - 0.5)).all(1).sum())


def _drive(
    plan: DrivePlan,
    episode: Episode,
    chosen: Chosen,
    answered: Float[np.ndarray, " n"],
    right_m: Float[np.ndarray, " f"] | None = None,
    *,
    calls: int = 1,
    note: str = "",
) -> Drive:
    steps, frames, _ = chosen
    return Drive(
        name=plan.name,
        side=plan.side,
        episode=episode,
        frame_number=steps,
        frames=frames,
        steer=answered[steps],
        right_m=np.zeros(len(steps)) if right_m is None else right_m,
        calls=calls,
        note=note,
    )
