"""What can be spawned: a small part of CARLA's library, under CARLA's own names."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from roadproof.errors import SimulatorError
from roadproof.simulators.carla_server.wire import Value
from roadproof.simulators.town.models import PAINTS, Body


class Kind(IntEnum):
    """Types of attributes on the wire."""

    BOOL = 1
    INT = 2
    FLOAT = 3
    TEXT = 4
    COLOUR = 5


@dataclass(frozen=True, slots=True)
class Attribute:
    """One attribute of a blueprint: its default, what is recommended, and whether it can be set."""

    name: str
    kind: Kind
    default: str
    recommended: tuple[str, ...] = ()
    settable: bool = True

    @property
    def wire(self) -> Value:
        """The attribute as the client takes it."""
        return [self.name, int(self.kind), self.default, list(self.recommended), self.settable, False]

    def takes(self, value: str) -> bool:
        """Whether a value is of its kind."""
        try:
            match self.kind:
                case Kind.BOOL:
                    return value.lower() in ("true", "false", "1", "0")
                case Kind.INT:
                    return abs(int(value)) < 2**31
                case Kind.FLOAT:
                    return math.isfinite(float(value))
                case Kind.COLOUR:
                    levels = [int(level) for level in value.split(",")]
                    return len(levels) == 3 and all(0 <= level <= 255 for level in levels)
                case Kind.TEXT:
                    return True
        except ValueError:
            return False


@dataclass(frozen=True, slots=True)
class Blueprint:
    """One kind of actor."""

    name: str
    attributes: tuple[Attribute, ...]

    def wire(self, uid: int) -> Value:
        """The blueprint as the client takes it."""
        tags = ",".join(reversed(self.name.split(".")))
        return [uid, self.name, tags, [attribute.wire for attribute in self.attributes]]

    def filled(self, given: Sequence[tuple[str, int, str]]) -> list[Value]:
        """All attributes of an actor as (name, kind, value), from what a client gave; the others have their defaults.

        Raises:
            SimulatorError: the blueprint has no such attribute, or the value is of another kind.
        """
        values = {name: value for name, _, value in given}
        own = {attribute.name: attribute for attribute in self.attributes}
        for name, value in values.items():
            if name not in own:
                raise SimulatorError(f"{self.name} has no attribute {name!r:.80}, expected one of {', '.join(own)}")
            if not own[name].takes(value):
                kind = own[name].kind.name.lower()
                raise SimulatorError(
                    f"attribute {name} of {self.name} is {value!r:.80}, expected a value of type {kind}"
                )
        return [[name, int(each.kind), values.get(name, each.default)] for name, each in own.items()]


VEHICLES = {
    "vehicle.ford.mustang": Body.SEDAN,
    "vehicle.lincoln.mkz_2017": Body.SEDAN,
    "vehicle.tesla.model3": Body.SEDAN,
    "vehicle.audi.a2": Body.HATCHBACK,
    "vehicle.mini.cooper_s": Body.HATCHBACK,
    "vehicle.mercedes.sprinter": Body.VAN,
}
COLOURS = tuple(",".join(str(round(255 * level)) for level in paint) for paint in PAINTS)
WALKERS = 12
CAMERAS = {
    "sensor.camera.rgb": "rgb",
    "sensor.camera.depth": "depth",
    "sensor.camera.semantic_segmentation": "semantic_segmentation",
}
COLLISION_SENSOR, LANE_SENSOR = "sensor.other.collision", "sensor.other.lane_invasion"


_FRONT = Attribute("role_name", Kind.TEXT, "front")
_VEHICLE = (
    Attribute("role_name", Kind.TEXT, "autopilot"),
    Attribute("color", Kind.COLOUR, COLOURS[0], COLOURS),
    Attribute("number_of_wheels", Kind.INT, "4", settable=False),
    Attribute("base_type", Kind.TEXT, "car", settable=False),
    Attribute("generation", Kind.INT, "1", settable=False),
)
_WALKER = (
    Attribute("role_name", Kind.TEXT, "pedestrian"),
    Attribute("is_invincible", Kind.BOOL, "false"),
    Attribute("speed", Kind.FLOAT, "1.4", ("0.0", "1.4", "2.8")),
)
_CAMERA = (
    _FRONT,
    Attribute("image_size_x", Kind.INT, "800"),
    Attribute("image_size_y", Kind.INT, "600"),
    Attribute("fov", Kind.FLOAT, "90.0"),
    Attribute("sensor_tick", Kind.FLOAT, "0.0"),
)
LIBRARY = (
    *(Blueprint(name, _VEHICLE) for name in VEHICLES),
    *(Blueprint(f"walker.pedestrian.{number:04}", _WALKER) for number in range(1, WALKERS + 1)),
    *(Blueprint(name, _CAMERA) for name in CAMERAS),
    *(Blueprint(name, (_FRONT,)) for name in (COLLISION_SENSOR, LANE_SENSOR)),
)

NUMBERS = {blueprint.name: number for number, blueprint in enumerate(LIBRARY, 1)}
"""The number of each blueprint by its name."""


def look_of(name: str, attributes: dict[str, str]) -> int:
    """The number by which the town chooses shape and colour of a vehicle or a walker."""
    if name in VEHICLES:
        wanted = [int(level) for level in attributes.get("color", COLOURS[0]).split(",")]
        away = [
            sum((a - 255 * b) ** 2 for a, b in zip(wanted, paint, strict=True)) for paint in PAINTS
        ]  # the nearest of the town's paints
        return int(VEHICLES[name]) + len(Body) * away.index(min(away))
    return int(name.rsplit(".", 1)[1]) - 1
