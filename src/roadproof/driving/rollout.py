"""Driving a scenario closed loop, and the episode that comes of it.

For example:

    with TownSimulator() as town:
        episode = rollout(town, controller, scenario, weather=Weather.RAINY_NOON, pattern=pattern)
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from contextlib import suppress
from functools import partial
from inspect import signature
from itertools import chain, count
from typing import TypeAlias, TypeVar

import numpy as np

from roadproof import foreign
from roadproof.controllers import Controller
from roadproof.controllers.asking import next_act_of, require_size
from roadproof.datatypes import Control, Ending, Observation, Weather
from roadproof.driving.episode import GIVEN, SEEN, Episode
from roadproof.errors import ControllerError, SimulatorError
from roadproof.machine import threads
from roadproof.patterns import Pattern, raster
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage, Pictures, Simulator

SimulatorT = TypeVar("SimulatorT", bound=Simulator)
Seen = TypeVar("Seen")
Policy: TypeAlias = Callable[[Observation], Control]
"""What one drive is driven by: what is seen in, what is done out."""

Driver: TypeAlias = Callable[[SimulatorT], Policy]
"""Is given the simulator after its reset, and returns the policy of this one drive."""

OnStep: TypeAlias = Callable[[Observation, Control | None], object]
"""Told of each observation and the control that answers it, before it is carried out; the last has none."""


def rollout(
    simulator: SimulatorT,
    driver: Controller | Driver[SimulatorT],
    scenario: Scenario,
    *,
    weather: Weather = Weather.CLEAR_NOON,
    pattern: Pattern | PatternImage | None = None,
    cars: int = 0,
    pedestrians: int = 0,
    seed: int = 0,
    frames: Pictures = True,
    full_pictures: Pictures = False,
    on_step: OnStep | None = None,
    until: Callable[[Observation], bool] | None = None,
) -> Episode:
    """Drive a scenario until it ends.

    Args:
        simulator: an open simulator.
        driver: a controller, or a function that is given the simulator after each reset, such as
            `training.expert.expert` or `replay`.
        scenario: scenario with start, goal, canvas, time limit and map.
        weather: weather of the drive, clear noon by default.
        pattern: pattern painted on the canvas, or a picture of the canvas; None leaves the road bare.
        cars: number of other cars on the road.
        pedestrians: number of pedestrians.
        seed: seed of cars and pedestrians.
        frames: which observations show the controller's frame to driver and `on_step`, all by default; for a controller
            all of them.
        full_pictures: which observations show the full camera picture to driver and `on_step`.
        on_step: called after each step; the simulator is then still at the state of the observation.
        until: condition that ends the drive at the first observation for which it is true; None for none.

    Raises:
        SimulatorError: the simulator is not open, an argument does not fit, or a driver's control is not finite.
        ScenarioError: the scenario does not fit its map.
        PatternError: the pattern is a batch.
        ControllerError: the controller takes frames of another size, raises, or answers with something that is no
            control; the message names the line of its author's code.
    """
    if isinstance(driver, Controller):
        # Before the town is built, also for controllers that would not complain.
        size = simulator.input.height_px, simulator.input.width_px
        require_size(driver, size, "the simulator gives", "give the simulator another `input`")
        if frames is not True:
            raise SimulatorError(
                "a controller drives by every frame, but `frames` is not True; leave it to drivers that look at none, "
                "such as `replay`"
            )
    _require_frames(simulator)
    seen = simulator.reset(
        scenario,
        weather=weather,
        pattern=raster(pattern) if isinstance(pattern, Pattern) else pattern,
        cars=cars,
        pedestrians=pedestrians,
        seed=seed,
        frames=frames,
        full_pictures=full_pictures,
    )
    rows, controls, events = [_row(seen)], list[Control](), list(seen.events)
    # A drive is the same in a process that shares the cores with others.
    with threads(1):
        policy = policy_of(driver, simulator)
        while not (stopped := until is not None and until(seen)) and not seen.done:
            control = policy(seen.copied())
            if not isinstance(control, Control):  # pyright: ignore[reportUnnecessaryIsInstance]  # drivers are the user's
                raise ControllerError(f"the driver answered {control!r}, expected a roadproof.datatypes.Control")
            controls.append(control.clipped())
            if on_step is not None:
                on_step(seen, controls[-1])
            seen = simulator.step(controls[-1])
            rows.append(_row(seen))
            events += seen.events
    if on_step is not None:
        on_step(seen, None)
    *observed, command = np.array(rows, np.float64).T
    given = [np.array([getattr(control, name) for control in controls], np.float64) for name in GIVEN]
    return Episode(
        scenario=scenario.name,
        weather=Weather(weather),
        painted=pattern is not None,
        paint=simulator.paint,
        cars=cars,
        pedestrians=pedestrians,
        seed=seed,
        dt_s=simulator.dt_s,
        ending=Ending.STOPPED if stopped else _ending(seen, scenario, simulator.dt_s),
        events=tuple(events),
        command=command.astype(np.int64),
        **dict(zip((*SEEN[:-1], *GIVEN), chain(observed, given), strict=True)),
    )


def _require_frames(simulator: Simulator) -> None:
    """See that a simulator is told which frames are wanted, before its first drive and not at its first replay."""
    # Compiled code need not say what it takes.
    with suppress(ValueError):
        try:
            signature(simulator.reset).bind_partial(frames=True)
        except TypeError:
            raise SimulatorError(
                f"reset of {type(simulator).__name__} takes no keyword `frames`, which says what frames are looked at; "
                "add it, `frames=True`, and show every frame all the same, or only those"
            ) from None


def _ending(seen: Observation, scenario: Scenario, dt_s: float) -> Ending:
    """Why a drive ended that nobody stopped, where a simulator does not say: too late, or at the goal."""
    late = seen.time_s >= scenario.time_limit_s - 0.5 * dt_s
    return seen.ending or (Ending.TIME_LIMIT if late else Ending.GOAL_REACHED)


def replay(episode: Episode) -> Driver[Simulator]:
    """A driver that gives an episode's controls again: same scenario and seed, same states, whatever is painted.

    After the last control it brakes.
    """

    def begin(_: Simulator) -> Policy:
        given = zip(episode.steer.tolist(), episode.throttle.tolist(), episode.brake.tolist(), strict=True)
        stop = Control(0.0, brake=1.0)

        def policy(_: Observation) -> Control:
            values = next(given, None)
            return stop if values is None else Control(*values)

        return policy

    return begin


def drive_again(
    simulator: Simulator,
    episode: Episode,
    scenario: Scenario,
    *,
    pattern: Pattern | PatternImage | None = None,
    looked_at: frozenset[int],
    full_pictures: bool = False,
    on_step: OnStep | None = None,
) -> Episode:
    """Drive an episode again from its controls, in its weather and traffic, over other paint: the states are the same.

    It is driven as far as it is looked at. There is the controller's frame or the full picture; nothing else is drawn.

    Args:
        simulator: an open simulator of the kind that the episode was driven in.
        episode: episode whose controls are given again.
        scenario: scenario of the episode, from the start that it had.
        pattern: pattern painted on the canvas, or a picture of the canvas; None leaves the road bare.
        looked_at: the steps that are looked at, counted from 0; one at the least.
        full_pictures: whether full camera pictures are looked at, and not the controller's frames.
        on_step: called after each step, as by `rollout`.

    Raises:
        SimulatorError: a full picture that is looked at did not come; else as `rollout` does.
        ScenarioError, PatternError: as `rollout` does.
    """
    numbers, last, unseen = count(), max(looked_at), frozenset[int]()

    def is_last(seen: Observation) -> bool:
        number = next(numbers)
        if full_pictures and number in looked_at and seen.picture is None:
            raise SimulatorError(
                f"the simulator gave no full picture at step {number}, though it was asked for; see what "
                "`roadproof.simulators.checks.check_simulator` says of it"
            )
        return number >= last

    return rollout(
        simulator,
        replay(episode),
        scenario,
        weather=episode.weather,
        pattern=pattern,
        cars=episode.cars,
        pedestrians=episode.pedestrians,
        seed=episode.seed,
        frames=unseen if full_pictures else looked_at,
        full_pictures=looked_at if full_pictures else unseen,
        on_step=on_step,
        until=is_last,
    )


def look_again(
    simulator: Simulator,
    episode: Episode,
    scenario: Scenario,
    steps: Collection[int],
    look: Callable[[Observation], Seen],
    *,
    pattern: Pattern | PatternImage | None = None,
    full_pictures: bool = False,
) -> dict[int, Seen]:
    """Drive an episode again as far as it is looked at, and keep what `look` makes of its observations at some steps.

    All else is as in `drive_again`.

    Returns:
        What was kept, by the step; only of steps that came before the drive ended.
    """
    wanted, numbers = frozenset(steps), count()
    kept: dict[int, Seen] = {}

    def keep(seen: Observation, _: Control | None) -> None:
        if (number := next(numbers)) in wanted:
            kept[number] = look(seen)

    drive_again(
        simulator, episode, scenario, pattern=pattern, looked_at=wanted, full_pictures=full_pictures, on_step=keep
    )
    return kept


def policy_of(driver: Controller | Driver[SimulatorT], simulator: SimulatorT) -> Policy:
    """The policy of a driver for a drive that has just begun.

    Raises:
        ControllerError: the driver raises, now or later.
    """
    if isinstance(driver, Controller):
        return _acting(driver)
    return partial(foreign.call, "the driver", foreign.call("the driver", driver, simulator))


def _acting(controller: Controller) -> Policy:
    """The policy of one drive, which carries on what the controller remembers of it."""
    memory: object = None
    before_s: float | None = None

    def policy(seen: Observation) -> Control:
        nonlocal memory, before_s
        elapsed_s = 0.0 if before_s is None else seen.time_s - before_s
        asked = (seen.frame, seen.state.speed_mps, int(seen.command), elapsed_s)
        control, memory = next_act_of(controller, memory, *asked)
        before_s = seen.time_s
        return control

    return policy


def _row(seen: Observation) -> tuple[float, ...]:
    return seen.time_s, *(float(getattr(seen.state, name)) for name in SEEN[1:-1]), float(seen.command)
