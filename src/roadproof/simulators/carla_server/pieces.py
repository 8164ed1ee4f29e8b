"""What a map has for clients: spawn points, boxes of what stands there, and pieces of road that can be painted.

Convention:
    Pieces are known by the names of their objects. A piece's picture covers it once. How it lies there differs from
    piece to piece, as it does in CARLA's own towns, so clients have to find out: turned by quarters, and mirrored on
    every second piece.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from roadproof.geometry import CANVAS_SIZE_PX, CanvasPlacement
from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.carla_server.labels import OF_SOLIDS, CarlaLabel
from roadproof.simulators.carla_server.wire import Pose6, Value
from roadproof.simulators.town.scenery import Scenery

SPAWN_EVERY_M, SPAWN_UP_M = 15.0, 0.3
PIECE_M = 20.0
STRAIGHT_RAD = 0.02
TURNS = 4


@dataclass(frozen=True, slots=True)
class Piece:
    """A straight piece of road, over all its driving lanes.

    Args:
        name: the name of the object.
        placement: where the piece is; its far edge is the end of the piece along the road.
        turns: quarter turns of its picture, counter-clockwise as seen from above.
        mirrored: whether the picture is mirrored before it is turned.
    """

    name: str
    placement: CanvasPlacement
    turns: int
    mirrored: bool

    def pattern(self, picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "400 400 4"]:
        """A picture as opaque paint all over the piece, its far edge on top."""
        laid = np.rot90(picture[:, ::-1] if self.mirrored else picture, self.turns)
        image = Image.fromarray(np.ascontiguousarray(laid))
        size = (CANVAS_SIZE_PX, CANVAS_SIZE_PX)
        # A box where it is made smaller; blocks, not blurs, where it is made larger.
        smaller = image.width > CANVAS_SIZE_PX
        fitted = np.asarray(image.resize(size, Image.Resampling.BOX if smaller else Image.Resampling.NEAREST))
        return np.dstack([fitted, np.full(size, 255, np.uint8)])


def road_pieces(map_name: str, roads: RoadMap) -> tuple[Piece, ...]:
    """The straight pieces of a map's roads outside of junctions, in order of their numbers."""
    pieces: list[Piece] = []
    against = {(lane.road, lane.section, lane.number): lane for lane in roads.lanes if lane.kind == "driving"}
    for lane in roads.lanes:
        if lane.kind != "driving" or lane.junction is not None or lane.number != -1:
            continue
        # The lane that comes the other way lies to its left.
        other = against.get((lane.road, lane.section, 1))
        width_m = lane.width_m + (0.0 if other is None else other.width_m)
        for begin in np.arange(0.0, lane.length_m - PIECE_M + 1e-6, PIECE_M).tolist():
            inside = (lane.stations_m > begin - 1e-6) & (lane.stations_m < begin + PIECE_M + 1e-6)
            if not inside.any() or float(np.ptp(lane.headings_rad[inside])) > STRAIGHT_RAD:
                continue
            middle = begin + PIECE_M / 2
            x, y, z, _ = lane.at(middle)
            heading = float(lane.headings_rad[inside].mean())
            left_m = (width_m - lane.width_m) / 2
            placement = CanvasPlacement(
                x_m=x - left_m * math.sin(heading),
                y_m=y + left_m * math.cos(heading),
                z_m=z,
                yaw_rad=heading,
                width_m=width_m,
                length_m=PIECE_M,
            )
            number = len(pieces)
            pieces.append(Piece(f"Road_Road_{map_name}_{number}", placement, number % TURNS, number % 2 == 1))
    return tuple(pieces)


def spawn_points(roads: RoadMap) -> list[Pose6]:
    """Places along the driving lanes, outside of junctions."""
    places: list[Pose6] = []
    for lane in roads.lanes:
        if lane.kind != "driving" or lane.junction is not None:
            continue
        for k in range(int(lane.length_m // SPAWN_EVERY_M)):
            x, y, z, heading = lane.at((k + 0.5) * SPAWN_EVERY_M)
            places.append((x, -y, z + SPAWN_UP_M, 0.0, -math.degrees(heading), 0.0))
    return places


def level_boxes(scenery: Scenery, label: int) -> list[Value]:
    """Boxes of what stands there with one of CARLA's labels: middles, half extents and rotations, metres and degrees.

    As CARLA's, those of trees hold the whole crown. Without a fourth value, the id of an actor, they are of the map.
    """
    trees = [(tree.x_m, tree.y_m, 0.0, tree.height_m / 2, tree.height_m / 2, tree.height_m) for tree in scenery.trees]
    solids = [
        (OF_SOLIDS[each.name], (each.pose.x_m, each.pose.y_m, each.pose.yaw_rad, *each.half_m, each.height_m))
        for each in scenery.solids
        if each.name in OF_SOLIDS
    ]
    return [
        [[x, -y, height / 2], [length, width, height / 2], [0.0, -math.degrees(yaw), 0.0]]
        for own, (x, y, yaw, length, width, height) in [*solids, *((CarlaLabel.VEGETATION, tree) for tree in trees)]
        if label in (own, CarlaLabel.ANY)
    ]
