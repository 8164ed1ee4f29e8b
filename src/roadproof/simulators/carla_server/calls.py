# ruff: noqa: D102 - the methods carry the names of CARLA's calls, which say what they do
"""What clients can call, by name. A call that cannot be met is refused with the reason, which the client raises."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np

from roadproof.errors import RoadproofError, SimulatorError
from roadproof.simulators.carla_server import blueprints, wire
from roadproof.simulators.carla_server.actors import Actor
from roadproof.simulators.carla_server.sensors import check_camera
from roadproof.simulators.carla_server.wire import DONE, ORIGIN, WORLD_STREAM, Value, granted, refused
from roadproof.simulators.carla_server.world import SETTINGS, World

SPAWN, DESTROY, CONTROL, WALK, TRANSFORM, WALKER_STATE, VELOCITY, PHYSICS = 0, 1, 2, 4, 6, 7, 8, 14
DIFFUSE = 2

NOT_THERE: dict[str, Value] = {
    "freeze_all_traffic_lights": DONE,
    "get_all_level_BBs": granted([]),
    "get_environment_objects": granted([]),
    "get_navigation_mesh": granted(b""),
    "get_required_files": granted([]),
    "get_vehicle_light_states": granted([]),
    "query_lights_state": granted([]),
    "reset_all_traffic_lights": DONE,
    "set_actor_autopilot": DONE,  # the client's own traffic manager drives
    "set_actor_collisions": DONE,
    "update_lights_state": DONE,
}
"""What clients call though there is nothing of the kind here, and what they are told."""


class Calls:
    """Answers calls on one world.

    Args:
        world: what is served.
        port: of the calls; streams are on the next.
        advance: takes a step.
    """

    def __init__(self, world: World, port: int, advance: Callable[[], None]) -> None:
        self._world, self._port, self._advance = world, port, advance
        self._managers: dict[int, Value] = {}

    def answer(self, name: str, args: list[Value]) -> Value:
        """The result of a call on the wire."""
        if name in NOT_THERE:
            return NOT_THERE[name]
        method = cast("Callable[..., Value] | None", getattr(self, f"call_{name}", None))
        if method is None:
            return refused(f"this server does not know {name}")
        try:
            return method(*args)
        except RoadproofError as error:
            return refused(str(error))
        except KeyError as error:
            return refused(f"there is no actor {error}")

    # The session

    def call_version(self) -> Value:
        return granted(wire.VERSION)

    def call_get_available_maps(self) -> Value:
        return granted([f"/Game/Carla/Maps/{name}" for name in self._world.maps])

    def call_get_episode_info(self) -> Value:
        return granted([self._world.episode, [wire.token(WORLD_STREAM, self._port + 1)]])

    def call_get_sensor_token(self, stream: int) -> Value:
        return granted([wire.token(stream, self._port + 1)])

    def call_get_episode_settings(self) -> Value:
        return granted(self._world.settings)

    def call_set_episode_settings(self, settings: Value) -> Value:
        self._world.set_settings(settings)
        return granted(self._world.frame)

    def call_load_new_episode(self, name: str, reset_settings: bool, _layers: int) -> Value:
        here = self._world.town.name if self._world.town is not None else ""
        self._world.load(name.rsplit("/", 1)[-1] or here)
        if reset_settings:
            self._world.set_settings(list(SETTINGS))
        return DONE

    def call_get_map_info(self) -> Value:
        assert self._world.town is not None
        places = [wire.transform(pose) for pose in self._world.spawn_points()]
        return granted([f"Carla/Maps/{self._world.town.name}", places])

    def call_get_map_data(self) -> Value:
        assert self._world.town is not None
        return granted(self._world.town.file.read_text(encoding="utf-8"))

    def call_tick_cue(self) -> Value:
        self._advance()
        return granted(self._world.frame)

    # The world

    def call_get_weather_parameters(self) -> Value:
        return granted(list(self._world.weather))

    def call_set_weather_parameters(self, parameters: list[float]) -> Value:
        self._world.set_weather(parameters)
        return DONE

    def call_get_actor_definitions(self) -> Value:
        return granted([blueprint.wire(i + 1) for i, blueprint in enumerate(blueprints.LIBRARY)])

    def call_get_spectator(self) -> Value:
        return granted(Actor(1, 0, "spectator", [], ORIGIN).wire(self._port + 1))

    def call_get_actors_by_id(self, ids: list[int]) -> Value:
        actors = self._world.actors
        return granted([actors[i].wire(self._port + 1) for i in ids if i in actors])

    def call_get_names_of_all_objects(self) -> Value:
        assert self._world.town is not None
        return granted(list(self._world.town.pieces))

    def call_apply_color_texture_to_objects(self, names: list[str], material: int, texture: Value) -> Value:
        width, height, colours = texture
        # As in CARLA, what cannot be painted is no error.
        if material == DIFFUSE and width * height == len(colours) > 0:
            levels = np.array(colours, np.uint8).reshape(height, width, 4)
            self._world.paint(names, levels[..., :3])
        return DONE

    # Actors

    def call_spawn_actor(self, description: Value, pose: Value) -> Value:
        return granted(self._spawned(description, pose).wire(self._port + 1))

    def call_spawn_actor_with_parent(self, description: Value, pose: Value, parent: int, *_: Value) -> Value:
        return granted(self._spawned(description, pose, parent).wire(self._port + 1))

    def _spawned(self, description: Value, pose: Value, parent: int = 0) -> Actor:
        actor = self._world.spawn(description, wire.pose_of(pose), parent)
        if actor.name in blueprints.CAMERAS:
            try:
                check_camera(actor)
            except SimulatorError:
                self._world.destroy(actor.id)
                raise
        return actor

    def call_destroy_actor(self, key: int) -> Value:
        return granted(True) if self._world.destroy(key) else refused(f"there is no actor {key}")

    def call_get_actor_bounding_box(self, key: int) -> Value:
        return granted([*self._world.actors[key].box, [0.0, 0.0, 0.0]])

    def call_apply_control_to_vehicle(self, key: int, control: Value) -> Value:
        self._world.actors[key].control = tuple(control)
        return DONE

    def call_apply_control_to_walker(self, key: int, control: Value) -> Value:
        (x, y, z), speed = control[:2]
        self._world.actors[key].walk = (x, y, z, speed)
        return DONE

    def call_set_actor_transform(self, key: int, pose: Value) -> Value:
        self._world.move(key, wire.pose_of(pose))
        return DONE

    def call_set_actor_location(self, key: int, place: Value) -> Value:
        x, y, z = place
        self._world.move(key, (x, y, z, *self._world.actors[key].pose[3:]))
        return DONE

    def call_set_actor_target_velocity(self, key: int, velocity: Value) -> Value:
        self._world.push(key, velocity)
        return DONE

    def call_set_actor_simulate_physics(self, key: int, enabled: bool) -> Value:
        self._world.set_physics(key, enabled)
        return DONE

    # Batches, and the registry of traffic managers

    def call_apply_batch(self, commands: list[Value], then_tick: bool) -> Value:
        results: list[Value] = []
        for (command,) in commands:
            try:
                results.append(granted(self._command(*command)))
            except RoadproofError as error:
                results.append(refused(str(error)))
            except KeyError as error:
                results.append(refused(f"there is no actor {error}"))
        if then_tick:
            self._advance()
        return results

    def _command(self, which: int, body: list[Value]) -> int:
        if which == SPAWN:
            return self._spawn_command(body)
        key = int(body[0])
        if key not in self._world.actors:
            raise KeyError(key)
        if which == DESTROY:
            self._world.destroy(key)
        elif which == CONTROL:
            self.call_apply_control_to_vehicle(key, body[1])
        elif which == WALK:
            self.call_apply_control_to_walker(key, body[1])
        elif which in (TRANSFORM, WALKER_STATE):
            self._world.move(key, wire.pose_of(body[1]))
        elif which == VELOCITY:
            self._world.push(key, body[1])
        elif which == PHYSICS:
            self._world.set_physics(key, body[1])
        return key

    def _spawn_command(self, body: list[Value]) -> int:
        """`body` holds blueprint, pose, perhaps a parent, and at last the commands for the new actor."""
        parent = int(body[2][1]) if len(body[2]) == 2 else 0
        key = self._spawned(body[0], body[1], parent).id
        for ((which, arguments),) in body[-1]:
            self._command(which, [key, *arguments[1:]])
        return key

    def call_is_traffic_manager_running(self, port: int) -> Value:
        return granted(port in self._managers)

    def call_get_traffic_manager_running(self, port: int) -> Value:
        return granted(list(self._managers.get(port, ("", 0))))

    def call_add_traffic_manager_running(self, manager: Value) -> Value:
        self._managers[manager[1]] = manager
        return granted(True)

    def call_destroy_traffic_manager(self, port: int) -> Value:
        self._managers.pop(port, None)
        return DONE
