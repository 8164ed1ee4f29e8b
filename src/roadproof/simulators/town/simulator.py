"""The embedded town as a simulator: map, renderer, physics and judge behind `roadproof.simulators.protocol`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import TracebackType

import numpy as np

from roadproof.datatypes import Control, Observation, VehicleState, Weather
from roadproof.errors import SimulatorError
from roadproof.geometry import (
    CIL_CAMERA,
    CIL_INPUT,
    CameraModel,
    CropResize,
    Homography,
    homography_from_pose,
)
from roadproof.roads.maps import load_map, scenario_route
from roadproof.roads.roadmap import RoadMap
from roadproof.roads.routes import Route
from roadproof.scenarios import Scenario
from roadproof.simulators.arguments import check_crop, check_pattern
from roadproof.simulators.protocol import PaintKind, PatternImage, Pictures
from roadproof.simulators.town.engine import make_pipe
from roadproof.simulators.town.meshes import Pose
from roadproof.simulators.town.physics import SUBSTEP_S, Physics
from roadproof.simulators.town.renderer import Renderer
from roadproof.simulators.town.scenery import Scenery, build_scenery
from roadproof.simulators.tracker.endings import Endings
from roadproof.simulators.tracker.judge import Judge
from roadproof.traffic.agents import NOBODY, Agents
from roadproof.traffic.traffic import Traffic


@dataclass(slots=True)
class _Town:
    """What is kept from drive to drive: one map with all that stands on it."""

    name: str
    roads: RoadMap
    scenery: Scenery
    renderer: Renderer


@dataclass(slots=True)
class _Drive:
    """One drive under way."""

    scenario: Scenario
    route: Route
    physics: Physics
    judge: Judge
    endings: Endings
    traffic: Traffic | None
    full_pictures: Pictures
    state: VehicleState
    steps: int = 0
    arclength_m: float = 0.0

    @property
    def cars(self) -> Agents:
        return NOBODY if self.traffic is None else self.traffic.cars

    @property
    def pedestrians(self) -> Agents:
        return NOBODY if self.traffic is None else self.traffic.pedestrians


class TownSimulator:
    """A small town on one CPU core, without a screen, a GPU or a server.

    Args:
        camera: the camera on the car.
        input: how the controller's frame is cut from its picture; it is rendered at twice its resolution and reduced
            by a box, so the simulator's own `input` says "area", whatever this one said.
        dt_s: seconds per step, a multiple of 0.01.

    Raises:
        SimulatorError: `dt_s` is not a positive multiple of 0.01, or the crop leaves the camera picture.
    """

    def __init__(
        self,
        *,
        camera: CameraModel = CIL_CAMERA,
        input: CropResize = CIL_INPUT,  # noqa: A002
        dt_s: float = 0.05,
    ) -> None:
        substeps = dt_s / SUBSTEP_S
        if not (math.isfinite(dt_s) and round(substeps) >= 1 and abs(substeps - round(substeps)) < 1e-6):
            raise SimulatorError(f"dt_s is {dt_s}, expected a positive multiple of {SUBSTEP_S}")
        check_crop(camera, input)
        self._camera, self._input, self._dt_s = camera, replace(input, resampling="area"), dt_s
        self._open = False
        self._town: _Town | None = None
        self._drive: _Drive | None = None

    @property
    def camera(self) -> CameraModel:
        """The camera on the car; full pictures have its size."""
        return self._camera

    @property
    def input(self) -> CropResize:
        """How the controller's frame is cut from the camera picture."""
        return self._input

    @property
    def dt_s(self) -> float:
        """Simulated seconds per step."""
        return self._dt_s

    @property
    def paint(self) -> PaintKind:
        """How patterns are put on the road: rendered with it."""
        return PaintKind.RENDERED

    @property
    def roads(self) -> RoadMap:
        """The map of the current drive.

        Raises:
            SimulatorError: there was no reset.
        """
        self._running()
        assert self._town is not None
        return self._town.roads

    def road_map(self, name: str) -> RoadMap:
        """The map a scenario names; it needs no drive.

        Raises:
            ScenarioError: there is no such map, or it cannot be read.
        """
        return load_map(name)

    @property
    def route(self) -> Route:
        """The route of the current drive.

        Raises:
            SimulatorError: there was no reset.
        """
        return self._running().route

    @property
    def state(self) -> VehicleState:
        """Where the car is now.

        Raises:
            SimulatorError: there was no reset.
        """
        return self._running().state

    @property
    def cars(self) -> Agents:
        """The other cars as they are now.

        Raises:
            SimulatorError: there was no reset.
        """
        return self._running().cars

    @property
    def pedestrians(self) -> Agents:
        """The people as they are now.

        Raises:
            SimulatorError: there was no reset.
        """
        return self._running().pedestrians

    def __enter__(self) -> TownSimulator:
        make_pipe()
        self._open = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end_drive()
        if self._town is not None:
            self._town.renderer.close()
            self._town = None
        self._open = False

    def reset(
        self,
        scenario: Scenario,
        *,
        weather: Weather = Weather.CLEAR_NOON,
        pattern: PatternImage | None = None,
        cars: int = 0,
        pedestrians: int = 0,
        seed: int = 0,
        full_pictures: Pictures = False,
    ) -> Observation:
        """Begin a drive; see `roadproof.simulators.protocol.Simulator.reset`.

        Raises:
            SimulatorError: the simulator is not open, or an argument does not fit.
            ScenarioError: the scenario does not fit its map.
        """
        if not self._open:
            raise SimulatorError("the simulator is closed; use it in a with-block")
        weather = Weather(weather)
        check_pattern(pattern)
        town = self._town_of(scenario)
        route = scenario_route(scenario, town.roads)
        self._end_drive()
        traffic = None
        if cars != 0 or pedestrians != 0:
            traffic = Traffic(town.roads, cars=cars, pedestrians=pedestrians, seed=seed, ego=scenario.start)
        self._drive = _Drive(
            scenario=scenario,
            route=route,
            physics=Physics(town.scenery.solids, scenario.start, [] if traffic is None else _poses(traffic.cars)),
            judge=Judge(town.roads),
            endings=Endings(route, scenario.time_limit_s),
            traffic=traffic,
            full_pictures=full_pictures,
            state=scenario.start,
        )
        town.renderer.set_weather(weather)
        town.renderer.set_canvas(scenario.canvas, pattern)
        town.renderer.set_agents(self._drive.cars, self._drive.pedestrians)
        return self._observe(self._drive)

    def step(self, control: Control) -> Observation:
        """Drive on for `dt_s`; values of the control outside their range are clipped.

        Raises:
            SimulatorError: there was no reset.
        """
        drive = self._running()
        assert self._town is not None
        if drive.traffic is not None:
            drive.traffic.step(self._dt_s, drive.state)
            drive.physics.move_cars(np.stack([drive.cars.x_m, drive.cars.y_m, drive.cars.yaw_rad], axis=1))
            self._town.renderer.move_agents(drive.cars, drive.pedestrians)
        drive.physics.step(control.clipped(), self._dt_s)
        drive.state = drive.physics.state()
        drive.steps += 1
        return self._observe(drive)

    def image_from_canvas(self) -> Homography:
        """The exact homography of the current state: canvas px to camera px.

        Raises:
            SimulatorError: there was no reset.
        """
        drive = self._running()
        return homography_from_pose(self._camera, drive.state, drive.scenario.canvas)

    def _running(self) -> _Drive:
        if self._drive is None:
            raise SimulatorError("there is no drive; call reset first")
        return self._drive

    def _end_drive(self) -> None:
        if self._drive is not None:
            self._drive.physics.close()
            self._drive = None

    def _town_of(self, scenario: Scenario) -> _Town:
        """The map of a scenario with everything on it; built when the map changes."""
        if self._town is None or self._town.name != scenario.map_name:
            roads = load_map(scenario.map_name)
            self._end_drive()
            if self._town is not None:
                self._town.renderer.close()
                self._town = None
            scenery = build_scenery(roads)
            renderer = Renderer(roads, scenery, self._camera, self._input)
            self._town = _Town(scenario.map_name, roads, scenery, renderer)
        return self._town

    def _observe(self, drive: _Drive) -> Observation:
        assert self._town is not None
        state, time_s = drive.state, drive.steps * self._dt_s
        place = drive.route.locate(state.x_m, state.y_m, drive.arclength_m if drive.steps else None)
        drive.arclength_m = place.arclength_m
        people = np.column_stack([drive.pedestrians.x_m, drive.pedestrians.y_m])
        events = drive.judge.watch(state, time_s, drive.physics.contacts(), people)
        frame = self._town.renderer.frame(state, drive.steps)
        wanted = drive.full_pictures
        # It takes several times as long as the frame.
        shown = wanted if isinstance(wanted, bool) else drive.steps in wanted
        picture = self._town.renderer.picture(state, drive.steps) if shown else None
        ending = drive.endings.watch(state, place, time_s, events)
        return Observation(
            frame=frame,
            state=state,
            command=place.command,
            time_s=time_s,
            events=events,
            done=ending is not None,
            picture=picture,
            ending=ending,
        )


def _poses(cars: Agents) -> list[Pose]:
    return [Pose(float(x), float(y), float(yaw)) for x, y, yaw in zip(cars.x_m, cars.y_m, cars.yaw_rad, strict=True)]
