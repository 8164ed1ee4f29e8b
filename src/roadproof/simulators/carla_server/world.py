"""The world that is served: a map of the town, the actors on it, and time.

Each vehicle that moves by itself has a physics world of its own, in which the other vehicles are moved as they move in
theirs; so each has the dynamics of the town's car.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from roadproof.datatypes import Control, VehicleState, Weather
from roadproof.errors import ScenarioError, SimulatorError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT
from roadproof.roads.maps import BUILTIN_MAPS, builtin_map_file, load_map
from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.carla_server import blueprints, limits, weather
from roadproof.simulators.carla_server.actors import Actor
from roadproof.simulators.carla_server.pieces import Piece, road_pieces
from roadproof.simulators.carla_server.wire import ORIGIN, WORLD_STREAM, Pose6, Value
from roadproof.simulators.town.labels import LabelledPicture, LabelScene
from roadproof.simulators.town.meshes import Pose
from roadproof.simulators.town.physics import SUBSTEP_S, Physics
from roadproof.simulators.town.renderer import Renderer
from roadproof.simulators.town.scenery import Scenery, build_scenery
from roadproof.simulators.tracker.judge import people_hit
from roadproof.traffic.agents import CAR_LENGTH_M

FREE_RUN_S = 0.05
SYNCHRONOUS, NO_RENDERING, FIXED_DT = 0, 1, 2
SETTINGS: Value = [False, False, [False], True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True]
"""CARLA's own defaults: synchronous, no rendering, fixed step, substepping, its step and number, culling distance,
ragdolls, two distances of tiles, the spectator as ego."""


@dataclass(slots=True)
class Town:
    """One map with all that stands on it.

    Args:
        last_look: the pose and time of the last look at kinds and distances, and what was seen; None before the first.
    """

    name: str
    file: Path
    roads: RoadMap
    scenery: Scenery
    renderer: Renderer
    pieces: dict[str, Piece]
    labelled: LabelScene | None = None
    last_look: tuple[tuple[object, ...], LabelledPicture] | None = None

    def labels(self) -> LabelScene:
        """The scene that shows the map as kinds and distances; made when first asked for."""
        if self.labelled is None:
            self.labelled = LabelScene(self.roads, self.scenery)
        return self.labelled

    def forget_views(self) -> None:
        """Give the memory of what was seen back."""
        self.last_look = None
        self.renderer.forget_views()
        if self.labelled is not None:
            self.labelled.forget_views()

    def close(self) -> None:
        """Give back everything that the town holds."""
        self.renderer.close()
        if self.labelled is not None:
            self.labelled.close()


@dataclass(frozen=True, slots=True)
class Collision:
    """A vehicle touches something: another actor, or a thing that stands about."""

    actor: Actor
    other: Actor


class World:
    """Maps, actors and time.

    Args:
        maps: OpenDRIVE files to offer besides the built-in towns.

    Attributes:
        episode: how many maps have been loaded.
        frame: how many steps have been taken.
        time_s: simulated seconds since the map was loaded.
        settings: CARLA's settings, as they came.
        weather: CARLA's weather parameters.
        actors: the actors by id, in order of their spawning.
        town: the map that is loaded; None before the first.

    Raises:
        SimulatorError: two maps have the same name.
    """

    def __init__(self, maps: Sequence[Path] = ()) -> None:
        self.maps = {path.stem: path for path in maps} | {name: builtin_map_file(name) for name in BUILTIN_MAPS}
        if len(self.maps) < len(maps) + len(BUILTIN_MAPS):
            raise SimulatorError("two maps have the same name; rename one of the files")
        self.episode, self.frame, self.time_s = 0, 0, 0.0
        self.settings: Value = list(SETTINGS)
        self.weather: Sequence[float] = weather.CLEAR
        self.actors: dict[int, Actor] = {}
        self.town: Town | None = None
        self._next_actor, self._next_stream = 100, 2
        self._physics: dict[int, Physics] = {}
        self._crowd: dict[int, int] = {}
        self._painted: dict[str, UInt8[np.ndarray, "400 400 4"]] = {}

    @property
    def dt_s(self) -> float:
        """Simulated seconds a step."""
        fixed = self.settings[FIXED_DT]
        return float(fixed[1]) if len(fixed) == 2 and fixed[1] else FREE_RUN_S

    @property
    def sky(self) -> Weather:
        """The town's weather that is shown."""
        return weather.nearest_weather(self.weather)

    def load(self, name: str) -> Town:
        """Begin anew on a map; settings stay as they are.

        Raises:
            SimulatorError: there is no such map.
            ScenarioError: the map cannot be read.
        """
        if name not in self.maps:
            raise SimulatorError(f"there is no map {name!r}, expected one of {', '.join(self.maps)}")
        self.clear()
        if self.town is None or self.town.name != name:
            file = self.maps[name]
            roads = load_map(name if name in BUILTIN_MAPS else str(file))
            try:
                file.read_text(encoding="utf-8")
            except UnicodeDecodeError:
                raise ScenarioError(f"map {file} is not UTF-8, as clients get it; save it as UTF-8") from None
            scenery = build_scenery(roads)
            if self.town is not None:
                self.town.close()
            pieces = {piece.name: piece for piece in road_pieces(name, roads)}
            self.town = Town(name, file, roads, scenery, Renderer(roads, scenery, CIL_CAMERA, CIL_INPUT), pieces)
        self.town.forget_views()
        self.town.renderer.paint_road({})
        self._painted.clear()
        self.weather = weather.CLEAR
        self.town.renderer.set_weather(self.sky)
        self.episode += 1
        self.time_s = 0.0
        return self.town

    def clear(self) -> None:
        """Take all actors away."""
        for key in list(self.actors):
            self.destroy(key)

    def close(self) -> None:
        """Give back everything that the world holds."""
        self.clear()
        if self.town is not None:
            self.town.close()
            self.town = None

    def set_weather(self, parameters: Sequence[float]) -> None:
        """Show the weather that is nearest to CARLA's parameters."""
        self.weather = parameters
        if self.town is not None:
            self.town.renderer.set_weather(self.sky)

    def paint(self, names: Sequence[str], picture: UInt8[np.ndarray, "h w 3"]) -> None:
        """Cover pieces of road with a picture until the map is loaded again; as in CARLA, other names do nothing."""
        if self.town is None:
            return
        pieces = self.town.pieces
        self._painted |= {name: pieces[name].pattern(picture) for name in names if name in pieces}
        self.town.renderer.paint_road({pieces[name].placement: paint for name, paint in self._painted.items()})

    def set_settings(self, settings: Value) -> None:
        """Take CARLA's settings.

        Raises:
            SimulatorError: the fixed step is not a multiple of the physics' own, or too long.
        """
        fixed = settings[FIXED_DT]
        if len(fixed) == 2 and fixed[1]:
            steps = fixed[1] / SUBSTEP_S
            if not SUBSTEP_S / 2 < fixed[1] <= limits.STEP_S or abs(steps - round(steps)) > 1e-4:
                raise SimulatorError(
                    f"fixed_delta_seconds is {fixed[1]}, expected a multiple of {SUBSTEP_S} up to {limits.STEP_S}"
                )
        self.settings = settings

    def actor(self, key: int, *kinds: str) -> Actor:
        """The actor with a number.

        Raises:
            SimulatorError: there is no such actor, or it is of none of these kinds.
        """
        if key not in self.actors:
            raise SimulatorError(f"there is no actor {key}")
        found = self.actors[key]
        if kinds and found.kind not in kinds:
            raise SimulatorError(f"actor {key} is a {found.kind}, expected a {' or '.join(kinds)}")
        return found

    def has_stream(self, stream: int) -> bool:
        """Whether the world or a sensor sends through a stream."""
        return stream == WORLD_STREAM or stream in {actor.stream for actor in self.actors.values() if actor.stream}

    def spawn(
        self, name: str, attributes: Sequence[tuple[str, int, str]], pose: Pose6, parent: int | None = None
    ) -> Actor:
        """Make an actor.

        Args:
            name: the name of the actor's blueprint.
            attributes: the attributes that are given, as (name, type, value); others have their defaults.
            pose: the actor's pose in the world, or relative to the parent.
            parent: id of the vehicle or walker that carries a sensor; None for no parent.

        Raises:
            SimulatorError: another vehicle is in the place, the blueprint is unknown, an attribute does not fit it, the
                parent is not there or carries none, or there are too many actors.
        """
        if name not in blueprints.NUMBERS:
            raise SimulatorError(f"there is no blueprint {name!r:.80}")
        if len(self.actors) >= limits.ACTORS:
            raise SimulatorError(f"there are {limits.ACTORS} actors, the most there may be; destroy some")
        uid = blueprints.NUMBERS[name]
        attributes = blueprints.LIBRARY[uid - 1].filled(attributes)
        actor = Actor(self._next_actor, uid, name, attributes, pose, parent or 0)
        if parent is not None:
            self.actor(parent, "vehicle", "walker")
            if actor.kind != "sensor":
                raise SimulatorError(f"{name} cannot be attached to an actor, expected a sensor")
        if actor.kind == "vehicle" and any(self._overlap(actor, other) for other in self._all("vehicle")):
            raise SimulatorError("Spawn failed because of collision at spawn position")
        if actor.kind == "sensor" and name != blueprints.LANE_SENSOR:
            actor.stream = self._next_stream
            self._next_stream += 1
        _stand_up(actor)
        if actor.kind == "vehicle":
            self._check_traffic([*self._all("vehicle"), actor])
            actor.stand(replace(actor.state, z_m=0.0, speed_mps=0.0))
        self._next_actor += 1
        self.actors[actor.id] = actor
        return actor

    def destroy(self, key: int) -> bool:
        """Take an actor away, and the sensors on it; say whether it was there."""
        if self.actors.pop(key, None) is None:
            return False
        self._stop_physics(key)
        self._crowd.pop(key, None)
        for sensor in [actor for actor in self.actors.values() if actor.parent == key]:
            self.destroy(sensor.id)
        return True

    def move(self, key: int, pose: Pose6) -> None:
        """Put an actor elsewhere; a vehicle keeps its speed along its new heading."""
        actor = self.actor(key)
        speed = math.hypot(*actor.velocity)
        actor.pose = pose
        _stand_up(actor)
        if actor.kind == "vehicle":
            actor.stand(replace(actor.state, z_m=0.0, speed_mps=speed))
        self._stop_physics(key)

    def push(self, key: int, velocity: Sequence[float]) -> None:
        """Give an actor a velocity of CARLA's world, m/s."""
        self.actor(key).velocity = (velocity[0], -velocity[1], velocity[2])
        self._stop_physics(key)

    def set_physics(self, key: int, enabled: bool) -> None:
        """Let a vehicle move by itself, or only as it is told to.

        Raises:
            SimulatorError: the vehicle is not there, or too many would move.
        """
        actor = self.actor(key)
        before, actor.physics = actor.physics, enabled
        if enabled and not before and actor.kind == "vehicle":
            try:
                self._check_traffic(self._all("vehicle"))
            except SimulatorError:
                actor.physics = before
                raise
        if not enabled:
            actor.velocity = (0.0, 0.0, 0.0)
            self._stop_physics(key)

    def step(self) -> list[Collision]:
        """Go on for one step, and return what vehicles with a collision sensor touch afterwards."""
        self.frame += 1
        self.time_s += self.dt_s
        for walker in self._all("walker"):
            self._walk(walker)
        vehicles = self._all("vehicle")
        poses = {vehicle.id: _pose(vehicle.state) for vehicle in vehicles}
        for vehicle in vehicles:
            if vehicle.physics:
                self._drive(vehicle, [poses[other.id] for other in vehicles if other is not vehicle])
        watched = {actor.parent for actor in self.actors.values() if actor.name == blueprints.COLLISION_SENSOR}
        return [hit for vehicle in vehicles if vehicle.id in watched for hit in self._collisions(vehicle)]

    def _all(self, kind: str) -> list[Actor]:
        return [actor for actor in self.actors.values() if actor.kind == kind]

    def _check_traffic(self, vehicles: Sequence[Actor]) -> None:
        moving = sum(vehicle.physics for vehicle in vehicles)
        if moving * len(vehicles) > limits.VEHICLE_PAIRS:
            raise SimulatorError(
                f"{moving} of {len(vehicles)} vehicles would move by themselves, expected at most "
                f"{limits.VEHICLE_PAIRS // len(vehicles)}; switch off the physics of some, or destroy them"
            )

    def _overlap(self, one: Actor, other: Actor) -> bool:
        away = math.dist(one.pose[:2], other.pose[:2])
        turned = abs(math.sin(math.radians(one.pose[4] - other.pose[4])))
        c, s = math.cos(math.radians(other.pose[4])), math.sin(math.radians(other.pose[4]))
        dx, dy = one.pose[0] - other.pose[0], one.pose[1] - other.pose[1]
        beside = abs(c * dy - s * dx)
        return away < CAR_LENGTH_M and (beside < 2.0 or turned > 0.3)

    def _stop_physics(self, key: int) -> None:
        """The next step starts from where the actor is then."""
        if key in self._physics:
            self._physics.pop(key).close()

    def _drive(self, vehicle: Actor, others: Sequence[Pose]) -> None:
        assert self.town is not None
        physics = self._physics.get(vehicle.id)
        if physics is None:
            physics = self._physics[vehicle.id] = Physics(self.town.scenery.solids, vehicle.state, others)
        elif self._crowd.get(vehicle.id) != len(others):
            physics.replace_cars(others)
        else:
            physics.move_cars(np.array([(pose.x_m, pose.y_m, pose.yaw_rad) for pose in others]).reshape(-1, 3))
        self._crowd[vehicle.id] = len(others)
        throttle, steer, brake, hand, reverse = vehicle.control[:5]
        given = Control(steer, throttle, 1.0 if hand else brake).clipped()
        push = -given.throttle if reverse else given.throttle
        physics.step(Control(given.steer, push, given.brake), self.dt_s)
        before, after = vehicle.state, physics.state()
        vehicle.walked_m += math.dist((before.x_m, before.y_m), (after.x_m, after.y_m))
        vehicle.stand(after)

    def _walk(self, walker: Actor) -> None:
        x, y, z, speed = walker.walk
        walker.velocity = (x * speed, -y * speed, z * speed)
        if speed <= 0.0:
            return
        ahead = speed * self.dt_s
        px, py, pz, pitch, _, roll = walker.pose
        walker.pose = (px + x * ahead, py + y * ahead, pz, pitch, math.degrees(math.atan2(y, x)), roll)
        walker.walked_m += ahead

    def _collisions(self, vehicle: Actor) -> list[Collision]:
        physics, vehicles = self._physics.get(vehicle.id), self._all("vehicle")
        if physics is None:
            return []
        others = [other for other in vehicles if other is not vehicle]
        hits: list[Collision] = []
        for contact in physics.contacts():
            what, number = contact.name.rsplit(" ", 1)
            if contact.kind == "vehicle":
                hits.append(Collision(vehicle, others[int(number)]))
            else:
                hits.append(Collision(vehicle, Actor(0, 0, f"static.{what.replace(' ', '_')}", [], ORIGIN)))
        walkers = self._all("walker")
        places = np.array([(walker.state.x_m, walker.state.y_m) for walker in walkers]).reshape(-1, 2)
        return hits + [Collision(vehicle, walkers[i]) for i in people_hit(vehicle.state, places)]


def _stand_up(actor: Actor) -> None:
    """A walker turns about the vertical only."""
    if actor.kind == "walker":
        actor.pose = (*actor.pose[:3], 0.0, actor.pose[4], 0.0)


def _pose(state: VehicleState) -> Pose:
    return Pose(state.x_m, state.y_m, state.yaw_rad)
