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
from roadproof.errors import SimulatorError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT
from roadproof.simulators.carla_server import blueprints, weather
from roadproof.simulators.carla_server.actors import Actor
from roadproof.simulators.carla_server.pieces import Piece, road_pieces
from roadproof.simulators.carla_server.wire import ORIGIN, Pose6, Value
from roadproof.simulators.town.judge import people_hit
from roadproof.simulators.town.labels import LabelledPicture, LabelScene
from roadproof.simulators.town.maps import BUILTIN_MAPS, builtin_map_file, load_map
from roadproof.simulators.town.meshes import Pose
from roadproof.simulators.town.physics import SUBSTEP_S, Physics
from roadproof.simulators.town.renderer import Renderer
from roadproof.simulators.town.roadmap import RoadMap
from roadproof.simulators.town.scenery import Scenery, build_scenery

FREE_RUN_S = 0.05
SPAWN_EVERY_M = 15.0
SPAWN_UP_M = 0.3
CAR_LENGTH_M = 4.5
SYNCHRONOUS, NO_RENDERING, FIXED_DT = 0, 1, 2
SETTINGS: Value = [False, False, [False], True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True]
"""CARLA's own defaults: synchronous, no rendering, fixed step, substepping, its step and number, culling distance,
ragdolls, two distances of tiles, the spectator as ego."""


@dataclass(slots=True)
class Town:
    """One map with all that stands on it.

    Args:
        last_look: from where and when it was last seen as kinds and distances, and what was seen.
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
        """The map as kinds and distances; made when first asked for."""
        if self.labelled is None:
            self.labelled = LabelScene(self.roads, self.scenery)
        return self.labelled

    def close(self) -> None:
        """Give everything back."""
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
        episode: counts the maps loaded.
        frame: counts the steps taken.
        time_s: simulated seconds since the map was loaded.
        settings: CARLA's, as they came.
        weather: CARLA's parameters.
        actors: by id, in order of their spawning.
        town: the map.

    Raises:
        SimulatorError: a map's file has another ending, or two have the same name.
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
            ScenarioError: it cannot be read.
        """
        if name not in self.maps:
            raise SimulatorError(f"there is no map {name!r}, expected one of {', '.join(self.maps)}")
        self.clear()
        if self.town is None or self.town.name != name:
            file = self.maps[name]
            roads = load_map(name if name in BUILTIN_MAPS else str(file))
            scenery = build_scenery(roads)
            if self.town is not None:
                self.town.close()
            pieces = {piece.name: piece for piece in road_pieces(name, roads)}
            self.town = Town(name, file, roads, scenery, Renderer(roads, scenery, CIL_CAMERA, CIL_INPUT), pieces)
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
        """Give everything back."""
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
            SimulatorError: the fixed step is not a multiple of the physics' own.
        """
        fixed = settings[FIXED_DT]
        if len(fixed) == 2 and fixed[1]:
            steps = fixed[1] / SUBSTEP_S
            if round(steps) < 1 or abs(steps - round(steps)) > 1e-4:
                raise SimulatorError(f"fixed_delta_seconds is {fixed[1]}, expected a multiple of {SUBSTEP_S}")
        self.settings = settings

    def spawn(self, description: Value, pose: Pose6, parent: int = 0) -> Actor:
        """Make an actor.

        Raises:
            SimulatorError: another vehicle is in the place, the blueprint is unknown, or the parent is not there.
        """
        uid, name, attributes = description
        if name not in {blueprint.name for blueprint in blueprints.LIBRARY}:
            raise SimulatorError(f"there is no blueprint {name!r}")
        if parent and parent not in self.actors:
            raise SimulatorError(f"there is no actor {parent} to attach to")
        actor = Actor(self._next_actor, uid, name, attributes, pose, parent)
        if actor.kind == "vehicle" and any(self._overlap(actor, other) for other in self._all("vehicle")):
            raise SimulatorError("Spawn failed because of collision at spawn position")
        if actor.kind == "sensor" and name != blueprints.LANE_SENSOR:
            actor.stream = self._next_stream
            self._next_stream += 1
        if actor.kind == "vehicle":
            actor.stand(replace(actor.state, z_m=0.0, speed_mps=0.0))
        self._next_actor += 1
        self.actors[actor.id] = actor
        return actor

    def destroy(self, key: int) -> bool:
        """Take an actor away, and the sensors on it; whether it was there."""
        if self.actors.pop(key, None) is None:
            return False
        if key in self._physics:
            self._physics.pop(key).close()
        for sensor in [actor for actor in self.actors.values() if actor.parent == key]:
            self.destroy(sensor.id)
        return True

    def move(self, key: int, pose: Pose6) -> None:
        """Put an actor elsewhere; a vehicle keeps its speed along its new heading."""
        actor = self.actors[key]
        speed = math.hypot(*actor.velocity)
        actor.pose = pose
        if actor.kind == "vehicle":
            actor.stand(replace(actor.state, z_m=0.0, speed_mps=speed))
        self._stop_physics(key)

    def push(self, key: int, velocity: Sequence[float]) -> None:
        """Give an actor a velocity of CARLA's world, m/s."""
        self.actors[key].velocity = (velocity[0], -velocity[1], velocity[2])
        self._stop_physics(key)

    def set_physics(self, key: int, enabled: bool) -> None:
        """Let a vehicle move by itself, or only as it is told to."""
        self.actors[key].physics = enabled
        if not enabled:
            self.actors[key].velocity = (0.0, 0.0, 0.0)
            self._stop_physics(key)

    def step(self) -> list[Collision]:
        """Go on for one step; what vehicles with a collision sensor touch afterwards."""
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

    def spawn_points(self) -> list[Pose6]:
        """Places along the driving lanes, outside of junctions."""
        assert self.town is not None
        places: list[Pose6] = []
        for lane in self.town.roads.lanes:
            if lane.kind != "driving" or lane.junction is not None:
                continue
            for k in range(int(lane.length_m // SPAWN_EVERY_M)):
                s = (k + 0.5) * SPAWN_EVERY_M
                x, y, z = (float(np.interp(s, lane.stations_m, lane.centre[:, axis])) for axis in range(3))
                heading = float(np.interp(s, lane.stations_m, lane.headings_rad))
                places.append((x, -y, z + SPAWN_UP_M, 0.0, -math.degrees(heading), 0.0))
        return places

    def _all(self, kind: str) -> list[Actor]:
        return [actor for actor in self.actors.values() if actor.kind == kind]

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
        push = -float(throttle) if reverse else float(throttle)
        physics.step(Control(float(steer), push, 1.0 if hand else float(brake)), self.dt_s)
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


def _pose(state: VehicleState) -> Pose:
    return Pose(state.x_m, state.y_m, state.yaw_rad)
