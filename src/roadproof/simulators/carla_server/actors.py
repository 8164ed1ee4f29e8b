"""Actors as CARLA's clients know them, and poses in CARLA's left-handed world.

Convention:
    x as in the town, y to the other side (right), z up; pitch up, yaw to the right, roll to the right, in degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from roadproof.datatypes import VehicleState
from roadproof.simulators.carla_server import blueprints
from roadproof.simulators.carla_server.labels import OF_ACTORS
from roadproof.simulators.carla_server.wire import Pose6, Value, token
from roadproof.traffic.agents import CAR_LENGTH_M, CAR_WIDTH_M

CAR_BOX = ((0.0, 0.0, 0.75), (CAR_LENGTH_M / 2, CAR_WIDTH_M / 2, 0.75))
WALKER_BOX = ((0.0, 0.0, 0.0), (0.25, 0.25, 0.93))
WALKER_UP_M = 0.93
AT_REST = (0.0, 0.0, 0.0, False, False, False, 0)


@dataclass(slots=True)
class Actor:
    """A vehicle, a walker or a sensor.

    Attributes:
        id: number of the actor; never used twice.
        uid: number of its blueprint in the library.
        name: name of its blueprint.
        attributes: its attributes as (name, type, value), as they came.
        pose: its pose in the world, or relative to its parent where it is a sensor with one.
        parent: id of the vehicle it is fixed to, 0 for none.
        stream: the stream that a sensor's data is sent to, 0 for none.
        velocity: velocity in the town's right-handed world, m/s.
        control: a vehicle's throttle, steer, brake, hand brake, reverse, manual, gear.
        walk: a walker's direction in CARLA's world, and its speed in m/s.
        physics: whether it moves by itself.
        walked_m: how far the actor has come, metres.
    """

    id: int
    uid: int
    name: str
    attributes: list[Value]
    pose: Pose6
    parent: int = 0
    stream: int = 0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    control: tuple[Value, ...] = AT_REST
    walk: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    physics: bool = True
    walked_m: float = 0.0
    values: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        self.values = {str(name): str(value) for name, _, value in self.attributes}

    @property
    def kind(self) -> str:
        """The first part of its name: vehicle, walker or sensor."""
        return self.name.split(".", 1)[0]

    @property
    def look(self) -> int:
        """The town's number for its shape and colour."""
        return blueprints.look_of(self.name, self.values)

    @property
    def state(self) -> VehicleState:
        """Where it is in the town's world, and how fast it goes ahead."""
        x, y, z, _, yaw, _ = self.pose
        heading = -math.radians(yaw)
        up = WALKER_UP_M if self.kind == "walker" else 0.0
        speed = self.velocity[0] * math.cos(heading) + self.velocity[1] * math.sin(heading)
        return VehicleState(x, -y, z - up, heading, speed)

    def stand(self, state: VehicleState) -> None:
        """Take a pose and speed of the town's world."""
        up = WALKER_UP_M if self.kind == "walker" else 0.0
        c, s = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
        self.pose = (state.x_m, -state.y_m, state.z_m + up, 0.0, -math.degrees(state.yaw_rad), 0.0)
        self.velocity = (state.speed_mps * c, state.speed_mps * s, 0.0)

    def wire(self, port: int) -> Value:
        """The actor as the client takes it; `port` is where its stream is served."""
        label = OF_ACTORS.get(self.kind)
        return [
            self.id,
            self.parent,
            [self.uid, self.name, self.attributes],
            [*self.box, [0.0, 0.0, 0.0]],
            b"" if label is None else bytes([label]),
            token(self.stream, port) if self.stream else b"",
        ]

    @property
    def box(self) -> Value:
        """Middle and half extents of the actor's box, metres."""
        middle, half = {"vehicle": CAR_BOX, "walker": WALKER_BOX}.get(self.kind, ((0.0,) * 3, (0.0,) * 3))
        return [list(middle), list(half)]

    @property
    def world_box(self) -> Value:
        """The box of an upright actor in the world: middle, half extents, rotation, metres and degrees, and its id."""
        (x, y, z, _, yaw, _), (middle, half) = self.pose, self.box
        return [[x, y, z + middle[2]], half, [0.0, yaw, 0.0], self.id]


def turned(pose: Pose6) -> Float[np.ndarray, "3 3"]:
    """CARLA's world axes (x, y, z) from an actor's own (ahead, right, up)."""
    pitch, yaw, roll = (math.radians(angle) for angle in pose[3:])
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (math.cos, math.sin))
    return np.array(
        [
            [cp * cy, cy * sp * sr - sy * cr, -cy * sp * cr - sy * sr],
            [cp * sy, sy * sp * sr + cy * cr, -sy * sp * cr + cy * sr],
            [sp, -cp * sr, cp * cr],
        ]
    )


def attached(parent: Pose6, relative: Pose6) -> Pose6:
    """Where something is that is fixed to a parent."""
    axes = turned(parent) @ turned(relative)
    x, y, z = np.array(parent[:3]) + turned(parent) @ np.array(relative[:3])
    pitch = math.asin(float(np.clip(axes[2, 0], -1.0, 1.0)))
    yaw = math.atan2(float(axes[1, 0]), float(axes[0, 0]))
    roll = math.atan2(-float(axes[2, 1]), float(axes[2, 2]))
    return float(x), float(y), float(z), math.degrees(pitch), math.degrees(yaw), math.degrees(roll)
