"""What stands beside the road on a CARLA server, from the boxes that the server gives of the things on its map.

A box holds a whole thing, of which only a part may stop a car: a tree's box is as wide as its crown, a lamp's reaches
to the end of its arm, and that of a bent rail covers the road inside the bend.

Convention:
    CARLA's world is left-handed: y and yaw change their sign. A footprint is x, y, yaw, half length and half width of
    the box on the ground, then the heights of its bottom and top: metres and radians in the town's world.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from roadproof.datatypes import Obstacle
from roadproof.geometry import CanvasPlacement
from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.carla.session import Session, carla
from roadproof.simulators.protocol import BESIDE_M

Footprints = Float[np.ndarray, "_ 7"]
Points = Float[np.ndarray, "_ 2"]

TREES, VEHICLES, POSTS = ("Vegetation",), ("Car", "Truck", "Bus", "Motorcycle", "Bicycle"), ("Poles", "TrafficLight")
LABELS = ("Buildings", "Walls", "Fences", "GuardRail", "Static", "TrafficSigns", *POSTS, *TREES, *VEHICLES)
"""Names of CARLA's labels for what stops a car. Not Dynamic, which are bins and bags that give way, nor Bridge, whose
boxes hold the deck that cars drive on. Servers before 0.9.14 lack some of them."""

ROOF_M, WHEEL_M = 1.5, 0.2
"""Heights above the road: what hangs higher passes over a car, what is lower passes under it or is rolled over."""

TREE_M, TRUNK_M = 2.5, 0.2
"""Vegetation taller than the one is a tree, whose trunk reaches the other to each side of its middle. Lower plants give
way, and so does the crown, which most of a tree's box holds."""

MOST_M = 1000.0
"""Half the length of the longest obstacle there can be."""


def stand_beside(session: Session, roads: RoadMap, canvas: CanvasPlacement) -> tuple[Obstacle, ...]:
    """What a car could run into within `BESIDE_M` of a canvas on the map that is loaded.

    Raises:
        SimulatorError: the server refuses or does not answer.
    """
    actors = session.ask("its actors", session.world.get_actors)
    places = [actor.get_transform().location for actor in actors if actor.type_id.startswith("vehicle.")]
    spawned = np.array([(place.x, -place.y) for place in places]).reshape(-1, 2)
    road = _on_the_road(roads, canvas)
    known = carla.CityObjectLabel.names
    found: list[Footprints] = []
    for name in LABELS:
        if name in known:
            # The server goes through all that is on its map.
            boxes = session.patiently("boxes of its map", lambda name=name: session.world.get_level_bbs(known[name]))
            found.append(standing(name, footprints(boxes), canvas, spawned if name in VEHICLES else road))
    return tuple(
        Obstacle(x_m=x, y_m=y, yaw_rad=yaw, half_length_m=a, half_width_m=b)
        for x, y, yaw, a, b in np.concatenate(found)[:, :5].tolist()
    )


def footprints(boxes: Sequence[carla.BoundingBox]) -> Footprints:
    """Boxes of CARLA's world, turned in any way, as they stand on the ground of the town's."""
    corners = [[(at.x, -at.y, at.z) for at in box.get_world_vertices(carla.Transform())] for box in boxes]
    reach = np.array(corners).reshape(-1, 8, 3)
    x, y, _ = middle = reach.mean(axis=1).T
    yaw = np.array([-math.radians(box.rotation.yaw) for box in boxes])
    dx, dy, _ = np.moveaxis(reach, -1, 0) - middle[..., None]
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    half_length, half_width = (np.abs(side).max(axis=1) for side in (c * dx + s * dy, c * dy - s * dx))
    return np.stack([x, y, yaw, half_length, half_width, reach[..., 2].min(axis=1), reach[..., 2].max(axis=1)], axis=1)


def standing(name: str, boxes: Footprints, canvas: CanvasPlacement, free: Points) -> Footprints:
    """The footprints, of boxes with one label, that can stop a car near a canvas.

    Args:
        name: the name of the label.
        boxes: the footprints of all boxes with it.
        canvas: the canvas; the ground is as high as it is.
        free: places where no such thing stands, world x, y in metres: a box that holds one is left out.
    """
    low, high = boxes[:, 5] - canvas.z_m, boxes[:, 6] - canvas.z_m
    boxes = boxes[(low < ROOF_M) & (high > WHEEL_M) & (boxes[:, 3:5] < MOST_M).all(axis=1)]
    if name in TREES:
        boxes = boxes[boxes[:, 6] - boxes[:, 5] > TREE_M]
        boxes[:, 3:5] = TRUNK_M
    elif name in POSTS:
        boxes = _posts(boxes, canvas)
    away = np.linalg.norm(_beyond(np.array([[canvas.x_m, canvas.y_m]]), boxes).clip(0.0), axis=-1)[0]
    boxes = boxes[away < BESIDE_M]
    return boxes[~(_beyond(free, boxes) < 0.0).all(axis=-1).any(axis=0)]


def _posts(boxes: Footprints, canvas: CanvasPlacement) -> Footprints:
    """Posts without their arms, which reach towards the road: a post is at the end that is further from the canvas."""
    x, y, yaw, a, b, *heights = boxes.T
    thin, arm, along = np.minimum(a, b), np.abs(a - b), yaw + math.pi / 2 * (a < b)
    dx, dy = arm * np.cos(along), arm * np.sin(along)
    side = np.where(dx * (x - canvas.x_m) + dy * (y - canvas.y_m) < 0.0, -1.0, 1.0)
    return np.stack([x + side * dx, y + side * dy, yaw, thin, thin, *heights], axis=1)


def _on_the_road(roads: RoadMap, canvas: CanvasPlacement) -> Points:
    """Places on the driving lanes near a canvas, in three rows on each lane."""
    driving = [lane for lane in roads.lanes if lane.kind == "driving"]
    rows = [row for lane in driving for row in (lane.centre, *((lane.centre + e) / 2 for e in (lane.left, lane.right)))]
    places = np.concatenate(rows)[:, :2]
    return places[np.linalg.norm(places - (canvas.x_m, canvas.y_m), axis=1) < BESIDE_M]


def _beyond(points: Points, boxes: Footprints) -> Float[np.ndarray, "_ _ 2"]:
    """How far points lie beyond the ends and the sides of boxes, negative within."""
    x, y, yaw, half_length, half_width = boxes.T[:5]
    dx, dy, c, s = points[:, :1] - x, points[:, 1:] - y, np.cos(yaw), np.sin(yaw)
    return np.stack([np.abs(c * dx + s * dy) - half_length, np.abs(c * dy - s * dx) - half_width], axis=-1)
