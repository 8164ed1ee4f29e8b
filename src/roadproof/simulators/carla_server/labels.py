"""CARLA's labels, in its numbers since 0.9.14, of what the town holds."""

from __future__ import annotations

from enum import IntEnum

from roadproof.simulators.town.labels import Label


class CarlaLabel(IntEnum):
    """The members of CARLA's CityObjectLabel that the town has something for, by their numbers on the wire."""

    ROADS = 1
    SIDEWALKS = 2
    BUILDINGS = 3
    FENCES = 5
    POLES = 6
    VEGETATION = 9
    TERRAIN = 10
    SKY = 11
    PEDESTRIANS = 12
    CAR = 14
    STATIC = 20
    ROAD_LINES = 24
    GUARD_RAIL = 28
    ANY = 255


OF_PIXELS = {
    Label.SKY: CarlaLabel.SKY,
    Label.ROAD: CarlaLabel.ROADS,
    Label.ROAD_LINE: CarlaLabel.ROAD_LINES,
    Label.SIDEWALK: CarlaLabel.SIDEWALKS,
    Label.TERRAIN: CarlaLabel.TERRAIN,
    Label.BUILDING: CarlaLabel.BUILDINGS,
    Label.FURNITURE: CarlaLabel.STATIC,
    Label.VEGETATION: CarlaLabel.VEGETATION,
    Label.VEHICLE: CarlaLabel.CAR,
    Label.PEDESTRIAN: CarlaLabel.PEDESTRIANS,
}

OF_ACTORS = {"vehicle": CarlaLabel.CAR, "walker": CarlaLabel.PEDESTRIANS}

OF_SOLIDS = {
    "building": CarlaLabel.BUILDINGS,
    "hedge": CarlaLabel.FENCES,
    "lamp post": CarlaLabel.POLES,
    "parked car": CarlaLabel.CAR,
    "guard rail": CarlaLabel.GUARD_RAIL,
}
"""A hedge stops cars, so it is a fence here; its trees have boxes of their own."""
