# ruff: noqa: D102 - the methods carry the names of CARLA's calls, which say what they do
"""What clients can call, by name. A call that cannot be met is refused with the reason, which the client raises."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import msgspec
import numpy as np
from msgspec import Raw
from msgspec.msgpack import Decoder

from roadproof.errors import RoadproofError, SimulatorError
from roadproof.simulators.carla_server import arguments as sent
from roadproof.simulators.carla_server import blueprints, wire
from roadproof.simulators.carla_server.actors import Actor
from roadproof.simulators.carla_server.arguments import Signature, read
from roadproof.simulators.carla_server.labels import OF_ACTORS, CarlaLabel
from roadproof.simulators.carla_server.pieces import level_boxes, spawn_points
from roadproof.simulators.carla_server.requests import Request
from roadproof.simulators.carla_server.sensors import check_camera
from roadproof.simulators.carla_server.wire import DONE, ORIGIN, WORLD_STREAM, Value, granted, refused
from roadproof.simulators.carla_server.world import SETTINGS, World

SPAWN, LAST_COMMAND = 0, 19
COMMANDS = {
    1: "destroy_actor",
    2: "apply_control_to_vehicle",
    4: "apply_control_to_walker",
    6: "set_actor_transform",
    7: "set_walker_state",
    8: "set_actor_target_velocity",
    14: "set_actor_simulate_physics",
}
"""The calls that commands of a batch stand for; the other numbers, as of autopilot and lights, change nothing here."""

DIFFUSE = 2

NOT_THERE: dict[str, tuple[Signature, Value]] = {
    "freeze_all_traffic_lights": (Signature.taking(frozen=bool), None),
    "get_environment_objects": (Signature.taking(label=sent.Byte), []),
    "get_navigation_mesh": (Signature.taking(), b""),
    "get_required_files": (Signature.taking(folder=sent.Text), []),
    "get_vehicle_light_states": (Signature.taking(), []),
    "query_lights_state": (Signature.taking(client=sent.Text), []),
    "reset_all_traffic_lights": (Signature.taking(), None),
    "update_lights_state": (Signature.taking(client=sent.Text, lights=Raw, discard=bool), None),
}
"""What clients call though there is nothing of the kind here, and what they are told."""

_FIELDS: Decoder[list[Raw]] = Decoder(list[Raw])
_ID: Decoder[int] = Decoder(sent.Id)
_SPAWN: Decoder[sent.SpawnCommand] = Decoder(sent.SpawnCommand)


class Calls:
    """Answers calls on one world: what the method of a call returns, where None is nothing.

    Args:
        world: the world that is served.
        port: the port for calls; streams are on the next.
        advance: the function that takes a step of the world.
    """

    def __init__(self, world: World, port: int, advance: Callable[[], None]) -> None:
        self._world, self._port, self._advance = world, port, advance
        self._managers: dict[int, Value] = {}
        methods: dict[str, Callable[..., Value]] = {
            name.removeprefix("call_"): getattr(self, name) for name in dir(self) if name.startswith("call_")
        }
        self._methods = {name: (Signature.of(method), method) for name, method in methods.items()}

    def answer(self, request: Request) -> bytes:
        """The answer to a call on the wire."""
        try:
            result = self._result(request.name, request.arguments)
            if request.name != "apply_batch":  # whose result is a list of answers
                result = DONE if result is None else granted(result)
            return wire.request_answer(request.id, result)
        except RoadproofError as error:
            text = f"{error!s:.1000}"
        except Exception as error:
            # A mistake of this server; the other clients are not to suffer for it.
            logging.getLogger(__name__).exception("%s failed", request.name)
            text = f"{request.name} failed in the server: {type(error).__name__}"
        if request.name == "apply_batch":  # in whose list of answers the error would be hidden
            return wire.request_error(request.id, text)
        return wire.request_answer(request.id, refused(text))

    def _result(self, name: str, arguments: Sequence[Raw]) -> Value:
        if name in NOT_THERE:
            signature, result = NOT_THERE[name]
            signature.read(name, arguments)
            return result
        if name not in self._methods:
            raise SimulatorError(f"this server does not know {name!r:.80}")
        signature, method = self._methods[name]
        return method(*signature.read(name, arguments))

    # The session

    def call_version(self) -> Value:
        return wire.VERSION

    def call_get_available_maps(self) -> Value:
        return [f"/Game/Carla/Maps/{name}" for name in self._world.maps]

    def call_get_episode_info(self) -> Value:
        return [self._world.episode, [wire.token(WORLD_STREAM, self._port + 1)]]

    def call_get_sensor_token(self, stream: sent.Id) -> Value:
        if not self._world.has_stream(stream):
            raise SimulatorError(f"there is no stream {stream}")
        return [wire.token(stream, self._port + 1)]

    def call_get_episode_settings(self) -> Value:
        return self._world.settings

    def call_set_episode_settings(self, settings: sent.Settings) -> Value:
        self._world.set_settings(settings)
        return self._world.frame

    def call_load_new_episode(self, name: sent.Text, reset_settings: bool, layers: sent.Id) -> None:
        del layers
        here = self._world.town.name if self._world.town is not None else ""
        self._world.load(name.rsplit("/", 1)[-1] or here)
        if reset_settings:
            self._world.set_settings(SETTINGS)

    def call_get_map_info(self) -> Value:
        assert self._world.town is not None
        places = [wire.transform(pose) for pose in spawn_points(self._world.town.roads)]
        return [f"Carla/Maps/{self._world.town.name}", places]

    def call_get_map_data(self) -> Value:
        assert self._world.town is not None
        return self._world.town.file.read_text(encoding="utf-8")

    def call_tick_cue(self) -> Value:
        self._advance()
        return self._world.frame

    # The world

    def call_get_weather_parameters(self) -> Value:
        return list(self._world.weather)

    def call_set_weather_parameters(self, parameters: sent.Weather) -> None:
        self._world.set_weather(parameters)

    def call_get_actor_definitions(self) -> Value:
        return [blueprint.wire(i + 1) for i, blueprint in enumerate(blueprints.LIBRARY)]

    def call_get_spectator(self) -> Value:
        return Actor(1, 0, "spectator", [], ORIGIN).wire(self._port + 1)

    def call_get_actors_by_id(self, ids: sent.Ids) -> Value:
        actors = self._world.actors
        return [actors[i].wire(self._port + 1) for i in ids if i in actors]

    def call_get_all_level_BBs(self, label: sent.Byte) -> Value:  # noqa: N802
        assert self._world.town is not None
        actors = [actor for actor in self._world.actors.values() if actor.kind in OF_ACTORS]
        boxes = [actor.world_box for actor in actors if label in (OF_ACTORS[actor.kind], CarlaLabel.ANY)]
        return level_boxes(self._world.town.scenery, label) + boxes

    def call_get_names_of_all_objects(self) -> Value:
        assert self._world.town is not None
        return list(self._world.town.pieces)

    def call_apply_color_texture_to_objects(
        self, names: sent.Texts, material: sent.Byte, texture: sent.Texture
    ) -> None:
        width, height, colours = texture
        # As in CARLA, what cannot be painted is no error.
        if material == DIFFUSE and width * height == len(colours) > 0:
            levels = np.array(colours, np.uint8).reshape(height, width, 4)
            self._world.paint(names, levels[..., :3])

    # Actors

    def call_spawn_actor(self, description: sent.Description, pose: sent.WirePose) -> Value:
        return self._spawned(description, pose).wire(self._port + 1)

    def call_spawn_actor_with_parent(
        self, description: sent.Description, pose: sent.WirePose, parent: sent.Id, attachment: int, bone: sent.Text
    ) -> Value:
        del attachment, bone
        return self._spawned(description, pose, parent).wire(self._port + 1)

    def _spawned(self, description: sent.Description, pose: sent.WirePose, parent: int | None = None) -> Actor:
        _, name, attributes = description
        actor = self._world.spawn(name, attributes, wire.pose_of(pose), parent)
        if actor.name in blueprints.CAMERAS:
            try:
                check_camera(self._world, actor)
            except SimulatorError:
                self._world.destroy(actor.id)
                raise
        return actor

    def call_destroy_actor(self, key: sent.Id) -> Value:
        if not self._world.destroy(key):
            raise SimulatorError(f"there is no actor {key}")
        return True

    def call_get_actor_bounding_box(self, key: sent.Id) -> Value:
        return [*self._world.actor(key).box, [0.0, 0.0, 0.0]]

    def call_apply_control_to_vehicle(self, key: sent.Id, control: sent.VehicleControl) -> None:
        self._world.actor(key, "vehicle").control = control

    def call_apply_control_to_walker(self, key: sent.Id, control: sent.WalkerControl) -> None:
        (x, y, z), speed, _ = control
        self._world.actor(key, "walker").walk = (x, y, z, speed)

    def call_set_actor_transform(self, key: sent.Id, pose: sent.WirePose) -> None:
        actor = self._world.actor(key)
        before = actor.pose
        self._world.move(key, wire.pose_of(pose))
        if actor.name in blueprints.CAMERAS:
            try:
                check_camera(self._world, actor)
            except SimulatorError:
                actor.pose = before
                raise

    def call_set_walker_state(self, key: sent.Id, pose: sent.WirePose, speed: sent.Mps) -> None:
        del speed
        self.call_set_actor_transform(key, pose)

    def call_set_actor_location(self, key: sent.Id, place: sent.Place) -> None:
        self._world.move(key, (*place, *self._world.actor(key).pose[3:]))

    def call_set_actor_target_velocity(self, key: sent.Id, velocity: sent.Velocity) -> None:
        self._world.push(key, velocity)

    def call_set_actor_simulate_physics(self, key: sent.Id, enabled: bool) -> None:
        self._world.set_physics(key, enabled)

    def call_set_actor_autopilot(self, key: sent.Id, enabled: bool) -> None:
        del enabled  # the client's own traffic manager drives
        self._world.actor(key, "vehicle")

    def call_set_actor_collisions(self, key: sent.Id, enabled: bool) -> None:
        del enabled  # all actors always collide
        self._world.actor(key)

    # Batches, and the registry of traffic managers

    def call_apply_batch(self, commands: sent.Commands, then_tick: bool) -> Value:
        results: list[Value] = []
        for ((which, fields),) in commands:
            try:
                results.append(granted(self._command(which, fields)))
            except RoadproofError as error:
                results.append(refused(str(error)))
        if then_tick:
            self._advance()
        return results

    def _command(self, which: int, fields: Raw, spawned: int | None = None) -> int:
        """Follow one command; the id of its actor, which is `spawned` where the command follows a spawn."""
        if which > LAST_COMMAND or (which == SPAWN and spawned is not None):
            raise SimulatorError(f"a batch has a command of type {which} where there can be none")
        if which == SPAWN:
            return self._spawn_command(read("a command to spawn", _SPAWN, fields))
        own, *arguments = read("a command", _FIELDS, fields) or [Raw()]
        key = read("the actor of a command", _ID, own) if spawned is None else spawned
        self._world.actor(key)
        if which in COMMANDS:
            self._result(COMMANDS[which], [Raw(msgspec.msgpack.encode(key)), *arguments])
        return key

    def _spawn_command(self, command: sent.SpawnCommand) -> int:
        description, pose, parent, _, _, afterwards = command
        key = self._spawned(description, pose, parent[1] if len(parent) == 2 else None).id
        for ((which, fields),) in afterwards:
            self._command(which, fields, key)
        return key

    def call_is_traffic_manager_running(self, port: sent.Port) -> Value:
        return port in self._managers

    def call_get_traffic_manager_running(self, port: sent.Port) -> Value:
        return list(self._managers.get(port, ("", 0)))

    def call_add_traffic_manager_running(self, manager: tuple[sent.Text, sent.Port]) -> Value:
        self._managers[manager[1]] = manager
        return True

    def call_destroy_traffic_manager(self, port: sent.Port) -> None:
        self._managers.pop(port, None)
