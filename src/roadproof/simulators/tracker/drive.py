"""One drive under way: what has been driven of it, which command holds, what happened, whether and why it is over."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from roadproof.datatypes import Command, Ending, Event, Observation, Weather
from roadproof.roads.maps import scenario_route
from roadproof.roads.roadmap import RoadMap
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage, Pictures
from roadproof.simulators.tracker.judge import Contact, Endings, Judge, time_is_up
from roadproof.traffic.agents import NOBODY, Agents
from roadproof.traffic.traffic import Traffic

Picture = UInt8[np.ndarray, "_ _ 3"]


class Request(NamedTuple):
    """What a reset asks for; see `roadproof.simulators.protocol.Simulator.reset`."""

    scenario: Scenario
    weather: Weather
    pattern: PatternImage | None
    cars: int
    pedestrians: int
    seed: int
    frames: Pictures
    full_pictures: Pictures


class DriveTracker:
    """Counts the steps of one drive.

    Args:
        request: what the reset asked for.
        dt_s: seconds per step.

    Attributes:
        scenario: the scenario that is driven.
        state: where the car is now; the simulator keeps it up to date.
        steps: how many steps were taken.
    """

    def __init__(self, request: Request, dt_s: float) -> None:
        self.scenario, self.state, self.dt_s, self.steps = request.scenario, request.scenario.start, dt_s, 0
        self._frames, self._full_pictures = request.frames, request.full_pictures

    @property
    def time_s(self) -> float:
        """Seconds since the start."""
        return self.steps * self.dt_s

    @property
    def time_is_up(self) -> bool:
        """Whether the scenario's time limit is reached."""
        return time_is_up(self.time_s, self.scenario.time_limit_s)

    @property
    def shows_frame(self) -> bool:
        """Whether the controller's frame is asked for at this step."""
        return self._among(self._frames)

    @property
    def shows_picture(self) -> bool:
        """Whether the full camera picture is asked for at this step."""
        return self._among(self._full_pictures)

    def _among(self, wanted: Pictures) -> bool:
        return wanted if isinstance(wanted, bool) else self.steps in wanted

    def observation(
        self,
        frame: Picture,
        picture: Picture | None,
        command: Command,
        ending: Ending | None,
        events: tuple[Event, ...] = (),
    ) -> Observation:
        """What the simulator answers after this step.

        Args:
            frame: the controller's input.
            picture: the full camera picture; None where it is not asked for.
            command: the command that holds now.
            ending: why the drive is over; None where it goes on.
            events: the events that began in this step.
        """
        return Observation(
            frame=frame,
            state=self.state,
            command=command,
            time_s=self.time_s,
            events=events,
            done=ending is not None,
            picture=picture,
            ending=ending,
        )


class RouteTracker(DriveTracker):
    """Follows one drive along its route, among traffic, and judges it.

    Args:
        request: what the reset asked for.
        roads: the scenario's map.
        dt_s: seconds per step.

    Attributes:
        route: the way to the goal.
        place: where the car is along the route.
        traffic: the other cars and the people; None where nobody was asked for.

    Raises:
        ScenarioError: the scenario does not fit its map.
        SimulatorError: so many cars or people do not fit on the map.
    """

    def __init__(self, request: Request, roads: RoadMap, dt_s: float) -> None:
        super().__init__(request, dt_s)
        scenario, cars, people = request.scenario, request.cars, request.pedestrians
        self.route = scenario_route(scenario, roads)
        self.traffic: Traffic | None = None
        if cars != 0 or people != 0:
            self.traffic = Traffic(roads, cars=cars, pedestrians=people, seed=request.seed, ego=scenario.start)
        self._judge, self._endings = Judge(roads), Endings(self.route, scenario.time_limit_s)
        self.place = self.route.locate(scenario.start.x_m, scenario.start.y_m)

    @property
    def cars(self) -> Agents:
        """The other cars as they are now."""
        return NOBODY if self.traffic is None else self.traffic.cars

    @property
    def pedestrians(self) -> Agents:
        """The people as they are now."""
        return NOBODY if self.traffic is None else self.traffic.pedestrians

    def step_traffic(self) -> None:
        """Let the others go on for one step, seeing the car where it is now."""
        if self.traffic is not None:
            self.traffic.step(self.dt_s, self.state)

    def judged(
        self, frame: Picture, picture: Picture | None, contacts: Sequence[Contact], signals: tuple[Event, ...] = ()
    ) -> Observation:
        """The observation of this step, with the command, the events and the ending that the state makes.

        Args:
            frame: the controller's input.
            picture: the full camera picture; None where it is not asked for.
            contacts: what the car touches, people aside.
            signals: the red lights and stop signs that the car runs in this step.
        """
        near_m = self.place.arclength_m if self.steps else None
        self.place = self.route.locate(self.state.x_m, self.state.y_m, near_m)
        people = np.column_stack([self.pedestrians.x_m, self.pedestrians.y_m])
        events = self._judge.watch(self.state, self.time_s, contacts, people) + signals
        ending = self._endings.watch(self.state, self.place, self.time_s, contacts)
        return self.observation(frame, picture, self.place.command, ending, events)
