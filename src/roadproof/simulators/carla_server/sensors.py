"""What the sensors of a world see, as messages for their streams."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float, UInt8

from roadproof.datatypes import VehicleState
from roadproof.errors import SimulatorError
from roadproof.geometry import CameraModel
from roadproof.simulators.carla_server import limits, wire
from roadproof.simulators.carla_server.actors import Actor, attached
from roadproof.simulators.carla_server.blueprints import CAMERAS
from roadproof.simulators.carla_server.labels import OF_PIXELS
from roadproof.simulators.carla_server.world import Collision, Town, World
from roadproof.simulators.town.labels import FAR_M, Label, LabelledPicture
from roadproof.traffic.agents import Agents

MAX_SIDE_PX = 4096
MAX_ROLL_DEG = 0.1


def check_camera(world: World, sensor: Actor) -> None:
    """Refuse a camera that cannot be served.

    Raises:
        SimulatorError: its size, field of view, pitch or roll is out of range, it is to see less often than at every
            step, or all cameras together are too large.
    """
    width, height, fov = _optics(sensor)
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX and 1.0 <= fov <= 115.0):
        raise SimulatorError(
            f"a camera of {width}×{height} px and {fov}° is out of range: 1 to {MAX_SIDE_PX} px and 1° to 115°"
        )
    if abs(sensor.pose[3]) > 90.0:
        raise SimulatorError(f"a camera pitched by {sensor.pose[3]:.1f}° cannot be served, expected −90 to 90")
    if abs(sensor.pose[5]) > MAX_ROLL_DEG:
        raise SimulatorError(f"a camera rolled by {sensor.pose[5]:.1f}° cannot be served, expected 0")
    if every := float(sensor.values.get("sensor_tick", 0.0)):
        raise SimulatorError(f"a camera of sensor_tick {every:g} s cannot be served, expected 0: one picture a step")
    sizes = [_optics(actor)[:2] for actor in world.actors.values() if actor.name in CAMERAS]
    pixels = sum(width * height for width, height in sizes)
    if pixels > limits.CAMERA_PIXELS:
        raise SimulatorError(
            f"all cameras together would have {pixels} pixels, expected at most {limits.CAMERA_PIXELS}; destroy some, "
            "or make them smaller"
        )


def _optics(sensor: Actor) -> tuple[int, int, float]:
    values = sensor.values
    return int(values["image_size_x"]), int(values["image_size_y"]), float(values["fov"])


def pose_in_world(world: World, sensor: Actor) -> wire.Pose6:
    """The pose of a sensor in the world."""
    return attached(world.actors[sensor.parent].pose, sensor.pose) if sensor.parent else sensor.pose


def picture_message(world: World, sensor: Actor) -> bytes:
    """The message with what a camera sees now."""
    assert world.town is not None
    pose = pose_in_world(world, sensor)
    x, y, z, pitch, yaw, _ = pose
    width, height, fov = _optics(sensor)
    camera = CameraModel(width_px=width, height_px=height, fov_deg=fov, up_m=0.0, pitch_deg=pitch)
    eye = VehicleState(x, -y, z, -math.radians(yaw), 0.0)
    if sensor.name == "sensor.camera.rgb":
        world.town.renderer.set_agents(*_others(world, sensor))
        rgb = world.town.renderer.view(camera, eye, world.frame)
    else:
        seen = _labelled(world, world.town, sensor, camera, eye)
        rgb = depth_levels(seen.depth_m) if sensor.name == "sensor.camera.depth" else label_levels(seen.labels)
    return wire.image(wire.header(wire.IMAGE, world.frame, world.time_s, pose), _bgra(rgb), fov)


def _labelled(world: World, town: Town, sensor: Actor, camera: CameraModel, eye: VehicleState) -> LabelledPicture:
    """Kinds and distances; depth and semantic cameras come in pairs, so the last look is kept for the other one."""
    look = (world.episode, world.frame, sensor.parent, camera, eye)
    if town.last_look is None or town.last_look[0] != look:
        scene = town.labels()
        scene.set_agents(*_others(world, sensor))
        town.last_look = look, scene.look(camera, eye)
    return town.last_look[1]


def depth_levels(depth_m: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Metres as CARLA's depth camera sends them: 24 bits from red, the lowest, to blue, with 1000 m at the top."""
    whole = np.round(np.clip(depth_m / FAR_M, 0.0, 1.0) * (2**24 - 1)).astype(np.uint32)
    return np.stack([whole & 255, (whole >> 8) & 255, whole >> 16], axis=-1).astype(np.uint8)


def label_levels(labels: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Kinds of things as CARLA's semantic camera sends them: its number in red."""
    numbers = np.array([OF_PIXELS[label] for label in Label], np.uint8)[labels]
    return np.stack([numbers, np.zeros_like(numbers), np.zeros_like(numbers)], axis=-1)


def collision_message(world: World, sensor: Actor, hit: Collision, port: int) -> bytes:
    """What a collision sensor sends of a hit; the impulse is what stops the car of 1500 kg."""
    start = wire.header(wire.COLLISION, world.frame, world.time_s, pose_in_world(world, sensor))
    x, y, z = hit.actor.velocity
    return wire.collision(start, hit.actor.wire(port), hit.other.wire(port), (-1500.0 * x, 1500.0 * y, -1500.0 * z))


def world_message(world: World, clock_s: float, *, changed: bool = False) -> bytes:
    """The state of a world for its own stream."""
    states = [
        wire.actor_state(
            actor.id,
            pose_in_world(world, actor) if actor.parent else actor.pose,
            (actor.velocity[0], -actor.velocity[1], actor.velocity[2]),
            wire.vehicle_state(actor.control) if actor.kind == "vehicle" else b"",
        )
        for actor in world.actors.values()
    ]
    return wire.episode_state(
        wire.header(wire.WORLD_OBSERVER, world.frame, world.time_s, wire.ORIGIN),
        episode=world.episode,
        clock_s=clock_s,
        dt_s=world.dt_s,
        changed=changed,
        actors=states,
    )


def _others(world: World, sensor: Actor) -> tuple[Agents, Agents]:
    """All cars and people as the town draws them, but for the one who carries the camera."""
    return _agents(world, "vehicle", sensor.parent), _agents(world, "walker", sensor.parent)


def _agents(world: World, kind: str, without: int) -> Agents:
    """All actors of a kind but one."""
    chosen = [actor for actor in world.actors.values() if actor.kind == kind and actor.id != without]
    states = [actor.state for actor in chosen]
    return Agents(
        x_m=np.array([state.x_m for state in states], float),
        y_m=np.array([state.y_m for state in states], float),
        yaw_rad=np.array([state.yaw_rad for state in states], float),
        speed_mps=np.array([state.speed_mps for state in states], float),
        travelled_m=np.array([actor.walked_m for actor in chosen], float),
        look=np.array([actor.look for actor in chosen], np.int64),
    )


def _bgra(rgb: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h w 4"]:
    opaque = np.full((*rgb.shape[:2], 1), 255, np.uint8)
    return np.concatenate([rgb[..., ::-1], opaque], axis=-1)
