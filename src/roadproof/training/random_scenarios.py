"""Random scenarios to learn from, and the disturbances that make the expert's recovery worth recording.

Convention:
    Offsets and headings are positive to the left, `steer` to the right, as everywhere.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace

import numpy as np

from roadproof.datatypes import Command, Control, VehicleState
from roadproof.errors import ScenarioError
from roadproof.geometry import CanvasPlacement
from roadproof.roads.lanes import Lane
from roadproof.roads.maps import fitting_canvas, scenario_route
from roadproof.roads.roadmap import RoadMap
from roadproof.roads.routes import Route
from roadproof.scenarios import Kind, Scenario

TRIES = 400
LENGTHS_M = (60.0, 150.0)
WIDTHS_M = (7.6, 6.8, 6.0, 3.0)
LONGEST_S = 60.0
ASIDE_M, ASIDE_LIMIT_M = 0.7, 1.5
"""Standard deviation and limit of how far off the middle of its lane a displaced car starts."""
TURN_RAD, TURN_LIMIT_RAD = math.radians(6.0), math.radians(15.0)
"""The same of its heading relative to the lane."""
FASTEST_MPS = 8.5
"""Largest speed of a displaced start; half of them are at rest."""
_KINDS: dict[Command, Kind] = {Command.LEFT: "left", Command.RIGHT: "right"}


def random_scenario(
    roads: RoadMap,
    map_name: str,
    generator: np.random.Generator,
    *,
    name: str,
    command: Command = Command.FOLLOW,
    displaced: bool = False,
) -> Scenario:
    """A random route through a map, 60 to 150 m long, with a canvas at a random place on it.

    Args:
        roads: the map that the route leads through.
        map_name: the name of the map.
        generator: the random generator that is drawn from.
        name: the name of the scenario.
        command: the command that one of the route's junctions asks for; `Command.FOLLOW` asks for none.
        displaced: whether the car starts off the middle of its lane, turned and moving, rather than at rest in it.

    Raises:
        ScenarioError: the map has no such route.
    """
    driving = [lane for lane in roads.lanes if lane.kind == "driving"]
    lengths = np.array([lane.length_m for lane in driving])
    for _ in range(TRIES):
        lane = driving[int(generator.choice(len(driving), p=lengths / lengths.sum()))]
        at_m, reach_m = generator.uniform(0.0, lane.length_m), generator.uniform(*LENGTHS_M)
        goal = _walk(roads, lane.index, at_m, reach_m, generator)
        start = _start(lane, at_m, generator, displaced=displaced)
        if goal is None or math.dist(goal, (start.x_m, start.y_m)) < 20.0:
            continue
        try:
            route = roads.route(start, goal)
            if not 0.7 * reach_m < route.length_m < 1.3 * reach_m:
                continue
            commands = [crossing.command for crossing in route.crossings]
            if command is not Command.FOLLOW and command not in commands:
                continue
            scenario = Scenario(
                name=name,
                kind=_KINDS.get(command, "straight"),
                map_name=map_name,
                start=start,
                goal_m=goal,
                canvas=_lay_canvas(route, roads, generator),
                time_limit_s=min(15.0 + route.length_m / 2.5, LONGEST_S),
            )
            scenario_route(scenario, roads)
        except ScenarioError:
            continue
        return scenario
    raise ScenarioError(f"no route of {LENGTHS_M[0]:.0f} m with the command {command.name} was found on map {map_name}")


class Disturbance:
    """Disturbs the controls of one drive: triangles on the steering, steps on the pedals, with pauses between them.

    Args:
        steps: how many steps the drive has at most.
        dt_s: seconds per step.
        generator: the random generator that is drawn from.

    References:
        Codevilla et al., "End-to-end driving via conditional imitation learning", ICRA 2018, section IV.B.
    """

    PAUSE_S = 2.0
    LASTS_S = (0.5, 1.8)
    STEER = (0.15, 0.6)
    PUSH = (-0.9, 0.7)

    def __init__(self, steps: int, dt_s: float, generator: np.random.Generator) -> None:
        self._steer, self._push = np.zeros(steps), np.zeros(steps)
        for noise, share, shaped in ((self._steer, 1.0, True), (self._push, 2.5, False)):
            at = generator.exponential(self.PAUSE_S * share)
            while at < steps * dt_s:
                lasts = generator.uniform(*self.LASTS_S)
                first, last = int(at / dt_s), min(int((at + lasts) / dt_s) + 1, steps)
                phase = np.linspace(0.0, 1.0, last - first) if last - first > 1 else np.array([0.5])
                if shaped:
                    peak = generator.uniform(*self.STEER) * generator.choice([-1.0, 1.0])
                    noise[first:last] += peak * (1.0 - np.abs(2.0 * phase - 1.0))
                else:
                    noise[first:last] += generator.uniform(*self.PUSH)
                at += lasts + generator.exponential(self.PAUSE_S * share)

    def on(self, control: Control, step: int) -> Control:
        """The control as the car gets it."""
        push = control.throttle - control.brake + float(self._push[step])
        return Control(control.steer + float(self._steer[step]), max(push, 0.0), max(-push, 0.0)).clipped()


def _walk(
    roads: RoadMap, lane: int, at_m: float, reach_m: float, generator: np.random.Generator
) -> tuple[float, float] | None:
    """Where one is after so many metres of turning at random; None in a junction or at a dead end."""
    left_m = reach_m + at_m
    while left_m > roads.lanes[lane].length_m:
        left_m -= roads.lanes[lane].length_m
        after = roads.lanes[lane].successors
        if not after:
            return None
        lane = int(generator.choice(after))
    end = roads.lanes[lane]
    if end.junction is not None:
        return None
    x, y, *_ = end.at(left_m)
    return x, y


def _start(lane: Lane, at_m: float, generator: np.random.Generator, *, displaced: bool) -> VehicleState:
    x, y, _, yaw = lane.at(at_m)
    aside = turn = speed = 0.0
    if displaced:
        aside = float(np.clip(generator.normal(0.0, ASIDE_M), -ASIDE_LIMIT_M, ASIDE_LIMIT_M))
        turn = float(np.clip(generator.normal(0.0, TURN_RAD), -TURN_LIMIT_RAD, TURN_LIMIT_RAD))
        speed = float(max(generator.uniform(-FASTEST_MPS, FASTEST_MPS), 0.0))
    return VehicleState(
        x - aside * math.sin(yaw), y + aside * math.cos(yaw), 0.0, math.remainder(yaw + turn, 2 * math.pi), speed
    )


def _lay_canvas(route: Route, roads: RoadMap, generator: np.random.Generator) -> CanvasPlacement:
    """A canvas across the road at a random place of the route: the widest that fits there."""
    for _ in range(20):
        at_m = float(generator.uniform(0.15, 0.9)) * route.length_m
        x, y, _, yaw = route.at(at_m)
        lane_m = roads.lanes[roads.nearest_lane(x, y, yaw).lane].width_m
        tries = [(0.0 if width_m < lane_m else lane_m / 2, width_m) for width_m in WIDTHS_M]
        with contextlib.suppress(ScenarioError):
            canvas = fitting_canvas(CanvasPlacement(x_m=x, y_m=y, yaw_rad=yaw), tries, roads)
            return replace(canvas, yaw_rad=math.remainder(yaw, 2 * math.pi))
    raise ScenarioError("no canvas fits along the route")
