"""CARLA 0.9.16 on the wire: answers to remote calls, stream tokens and the messages of sensors, as bytes.

Calls travel as msgpack-rpc on one port, sensor data as length-prefixed messages on the next. A message with a wrong
length ends the client's process, so every layout stands here once.

    message        layout, little-endian
    stream token   u32 stream, u16 port, u8 protocol (1: TCP), u8 address family (0: the host the client called), 16 B
    header, 48 B   u64 kind of sensor, u64 frame, f64 seconds, f32 x, y, z, pitch, yaw, roll
    episode state  header, u64 episode, f64 clock, f32 step, 3 × i32 map origin, i32 flags, then 119 B an actor
    actor, 119 B   u32 id, u8 state (1: active), f32 pose × 6, f32 velocity × 3, angular × 3, acceleration × 3, 54 B
    those 54 B     of a vehicle: f32 throttle, steer, brake, u8 hand brake, reverse, manual, i32 gear, f32 speed limit,
                   u8 light, u8 has light, u32 light id, u8 failure
    image          header, u32 width, u32 height, f32 field of view, BGRA
    collision      header, msgpack [actor, other actor, [impulse]]

References:
    LibCarla of CARLA 0.9.16 (carla/streaming, carla/sensor, carla/rpc), and traffic observed with its client.
"""

from __future__ import annotations

import importlib
import struct
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import UInt8

from roadproof.errors import SimulatorError

try:
    msgpack: Any = importlib.import_module("msgpack")
except ImportError as error:  # pragma: no cover - the extra is installed where this is tested
    raise SimulatorError("serving CARLA's protocol needs msgpack: pip install 'roadproof[carla]'") from error

VERSION = "0.9.16"
WORLD_STREAM = 1

# Places in the client's registry of sensors.
COLLISION, IMAGE, WORLD_OBSERVER = 0, 13, 17

Value: TypeAlias = Any
"""Anything msgpack can hold."""

Pose6: TypeAlias = tuple[float, float, float, float, float, float]
"""x, y, z in metres and pitch, yaw, roll in degrees, in CARLA's left-handed world."""

ORIGIN: Pose6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def granted(value: Value) -> Value:
    """The answer to a call that gives something."""
    return [[1, value]]


def refused(text: str) -> Value:
    """The answer to a call that cannot be met."""
    return [[0, [text]]]


DONE: Value = [[False]]
"""The answer to a call that gives nothing."""


def request_answer(call_id: int, result: Value) -> bytes:
    """One answer on the wire."""
    return msgpack.packb([1, call_id, None, result])


def request_error(call_id: int, text: str) -> bytes:
    """The answer to what cannot be taken as a call: msgpack-rpc's own error, of which the client shows no text."""
    return msgpack.packb([1, call_id, text, None])


def token(stream: int, port: int) -> bytes:
    """Where a client finds a stream."""
    return struct.pack("<IHBB16x", stream, port, 1, 0)


def framed(message: bytes) -> bytes:
    """A message with its length before it."""
    return struct.pack("<I", len(message)) + message


def transform(pose: Pose6) -> Value:
    """A pose as an argument or a result of a call."""
    return [list(pose[:3]), list(pose[3:])]


def pose_of(value: Value) -> Pose6:
    """The pose in a call's argument."""
    (x, y, z), (pitch, yaw, roll) = value
    return x, y, z, pitch, yaw, roll


def header(kind: int, frame: int, time_s: float, pose: Pose6) -> bytes:
    """What every sensor's message begins with."""
    return struct.pack("<QQd6f", kind, frame, time_s, *pose)


def image(start: bytes, bgra: UInt8[np.ndarray, "h w 4"], fov_deg: float) -> bytes:
    """A camera's message after its header `start`."""
    height, width = bgra.shape[:2]
    return start + struct.pack("<IIf", width, height, fov_deg) + bgra.tobytes()


def collision(start: bytes, actor: Value, other: Value, impulse: Sequence[float]) -> bytes:
    """A collision sensor's message after its header `start`."""
    return start + msgpack.packb([actor, other, list(impulse)])


def episode_state(
    start: bytes, *, episode: int, clock_s: float, dt_s: float, changed: bool, actors: Sequence[bytes]
) -> bytes:
    """The state of a world after its header `start`; `changed` tells clients that this is another map."""
    return start + struct.pack("<Qdf3ii", episode, clock_s, dt_s, 0, 0, 0, int(changed)) + b"".join(actors)


def actor_state(actor: int, pose: Pose6, velocity: tuple[float, float, float], vehicle: bytes = b"") -> bytes:
    """One actor of an episode's state; `vehicle` is from `vehicle_state`."""
    return struct.pack("<IB15f54s", actor, 1, *pose, *velocity, *([0.0] * 6), vehicle)


def vehicle_state(control: Sequence[float]) -> bytes:
    """What an episode's state says of a vehicle: its control as (throttle, steer, brake, hand brake, reverse, …)."""
    throttle, steer, brake = (float(value) for value in control[:3])
    hand, reverse, manual = (bool(value) for value in control[3:6])
    gear = int(control[6])
    return struct.pack("<fff???ifB?IB", throttle, steer, brake, hand, reverse, manual, gear, 30.0, 2, False, 0, 0)
