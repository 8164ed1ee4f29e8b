"""The other cars and the people of a drive, stepped together."""

from __future__ import annotations

from roadproof.datatypes import VehicleState
from roadproof.errors import SimulatorError
from roadproof.limits import is_whole
from roadproof.roads.roadmap import RoadMap
from roadproof.traffic.agents import Agents
from roadproof.traffic.cars import Cars
from roadproof.traffic.pedestrians import Pedestrians


class Traffic:
    """Cars and people who go their ways and mind each other and the driven car.

    The same map, numbers, seed and movements of the driven car give the same traffic, bit by bit.

    Attributes:
        cars: the other cars as they are now.
        pedestrians: the people as they are now.
    """

    def __init__(self, road_map: RoadMap, *, cars: int, pedestrians: int, seed: int, ego: VehicleState) -> None:
        """Place everybody, the cars away from the driven one.

        Raises:
            SimulatorError: a number or the seed is negative, or they do not fit on the map.
        """
        for what, count in (("cars", cars), ("pedestrians", pedestrians)):
            if not is_whole(count) or count < 0:
                raise SimulatorError(f"{count} {what} were asked for, expected a whole number, 0 or more")
        if not is_whole(seed) or seed < 0:
            raise SimulatorError(f"the seed of the traffic is {seed}, expected a whole number, 0 or more")
        self._cars = Cars(road_map, cars, seed, ego)
        self._pedestrians = Pedestrians(road_map, pedestrians, seed)
        self.cars: Agents = self._cars.agents
        self.pedestrians: Agents = self._pedestrians.agents

    def step(self, dt_s: float, ego: VehicleState) -> None:
        """Go on for dt_s seconds; everybody sees the others as they were before the step."""
        self._cars.step(dt_s, self.cars, self.pedestrians, ego)
        self._pedestrians.step(dt_s, self.pedestrians, self.cars, ego)
        self.cars, self.pedestrians = self._cars.agents, self._pedestrians.agents
