"""The spawn points of a map."""

from __future__ import annotations

import math

from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.carla_server.wire import Pose6

EVERY_M = 15.0
UP_M = 0.3


def spawn_points(roads: RoadMap) -> list[Pose6]:
    """Places along the driving lanes, outside of junctions."""
    places: list[Pose6] = []
    for lane in roads.lanes:
        if lane.kind != "driving" or lane.junction is not None:
            continue
        for k in range(int(lane.length_m // EVERY_M)):
            x, y, z, heading = lane.at((k + 0.5) * EVERY_M)
            places.append((x, -y, z + UP_M, 0.0, -math.degrees(heading), 0.0))
    return places
