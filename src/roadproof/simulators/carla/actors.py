"""The car, what it hits, the other cars and the people, between the town's world and CARLA's.

Convention:
    CARLA's world is left-handed: y and yaw change their sign. A walker's place is its middle, a car's the ground.
"""

from __future__ import annotations

import math
import queue

from roadproof.datatypes import VehicleState
from roadproof.errors import SimulatorError
from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.carla.session import Session, carla
from roadproof.simulators.tracker.judge import Contact
from roadproof.traffic.agents import Agents
from roadproof.traffic.traffic import Traffic

DRIVEN = ("vehicle.ford.mustang", "vehicle.lincoln.mkz_2017", "vehicle.lincoln.mkz_2020", "vehicle.tesla.model3")
SPAWN_UP_M = 0.3
PERSON_UP_M = 0.95


def carla_transform(x_m: float, y_m: float, z_m: float, yaw_rad: float) -> carla.Transform:
    """A pose of the town's world in CARLA's."""
    return carla.Transform(carla.Location(x=x_m, y=-y_m, z=z_m), carla.Rotation(yaw=-math.degrees(yaw_rad)))


def vehicle_state(seen: carla.ActorSnapshot) -> VehicleState:
    """Where an actor is in the town's world, and how fast it goes ahead."""
    pose, velocity = seen.get_transform(), seen.get_velocity()
    yaw = -math.radians(pose.rotation.yaw)
    speed = velocity.x * math.cos(yaw) - velocity.y * math.sin(yaw)
    return VehicleState(pose.location.x, -pose.location.y, pose.location.z, yaw, speed)


def spawn_driven(session: Session, start: VehicleState) -> carla.Vehicle:
    """The car that is driven, above where it starts.

    Raises:
        SimulatorError: the car cannot stand there, or the server has none of the cars known.
    """
    library = session.library()
    known = {blueprint.id for blueprint in library}
    name = next((name for name in DRIVEN if name in known), None)
    if name is None:
        raise SimulatorError(f"the CARLA server at {session.where} has none of the cars {', '.join(DRIVEN)}")
    blueprint = library.find(name)
    blueprint.set_attribute("role_name", "hero")
    place = carla_transform(start.x_m, start.y_m, start.z_m + SPAWN_UP_M, start.yaw_rad)
    what = f"the car at ({start.x_m:.1f}, {start.y_m:.1f})"
    car = session.ask(what, lambda: session.world.spawn_actor(blueprint, place))
    session.keep(car)
    assert isinstance(car, carla.Vehicle)
    return car


def place_driven(session: Session, car: carla.Actor, start: VehicleState, back_m: float) -> None:
    """Put the car, once it has settled, where a drive starts, at the height where it settled.

    Args:
        session: the connection to the server.
        car: the car that is driven.
        start: the pose and speed that the drive starts with.
        back_m: how far behind that pose the car is put.

    Raises:
        SimulatorError: the server refuses or does not answer.
    """
    settled = session.ask("where the car is", session.world.get_snapshot).find(car.id).get_transform()
    forward = carla_transform(0.0, 0.0, 0.0, start.yaw_rad).get_forward_vector()
    place = carla_transform(start.x_m, start.y_m, settled.location.z, start.yaw_rad)
    place.location -= forward * back_m
    session.batch(
        "the start",
        [
            carla.command.ApplyTransform(car.id, place),
            carla.command.ApplyTargetVelocity(car.id, forward * start.speed_mps),
        ],
    )


class Crowd:
    """The town's traffic on a CARLA server: its cars and people are put where the town's traffic says, every step.

    So they are the same on every server, for the same seed, to the bit.
    """

    def __init__(self, session: Session, roads: RoadMap, traffic: Traffic) -> None:
        """Spawn everybody.

        Raises:
            SimulatorError: the server refuses.
        """
        self._session, self._roads, self.traffic = session, roads, traffic
        self._level = not any(lane.centre[:, 2].any() for lane in roads.lanes)
        library = session.library()
        cars = [b for b in library.filter("vehicle.*") if _is_car(b)]
        people = list(library.filter("walker.pedestrian.*"))
        self._cars = self._spawn("a car of the traffic", cars, traffic.cars, 0.0)
        self._people = self._spawn("a pedestrian", people, traffic.pedestrians, PERSON_UP_M)

    def car_index(self, actor_id: int) -> int | None:
        """Which of the traffic's cars an actor is."""
        return self._cars.index(actor_id) if actor_id in self._cars else None

    def moves(self) -> list[carla.command.Command]:
        """The commands that put everybody where they are now."""
        agents = ((self._cars, self.traffic.cars, 0.0), (self._people, self.traffic.pedestrians, PERSON_UP_M))
        return [
            carla.command.ApplyTransform(actor, self._place(group, i, up))
            for ids, group, up in agents
            for i, actor in enumerate(ids)
        ]

    def _spawn(self, what: str, blueprints: list[carla.ActorBlueprint], agents: Agents, up_m: float) -> list[int]:
        if len(agents) and not blueprints:
            raise SimulatorError(f"the CARLA server at {self._session.where} has no blueprint for {what}")
        blueprints.sort(key=lambda blueprint: blueprint.id)
        commands: list[carla.command.Command] = []
        for i in range(len(agents)):
            look = int(agents.look[i])
            blueprint = blueprints[look % len(blueprints)]
            if blueprint.has_attribute("color"):
                colours = blueprint.get_attribute("color").recommended_values
                if colours:
                    blueprint.set_attribute("color", colours[look // len(blueprints) % len(colours)])
            still = carla.command.SetSimulatePhysics(carla.command.FutureActor, False)
            commands.append(carla.command.SpawnActor(blueprint, self._place(agents, i, up_m)).then(still))
        ids = self._session.batch(what, commands) if commands else []
        self._session.keep(*ids)
        return ids

    def _place(self, agents: Agents, i: int, up_m: float) -> carla.Transform:
        """Where one of them is, so far above the road."""
        at = float(agents.x_m[i]), float(agents.y_m[i])
        yaw = float(agents.yaw_rad[i])
        road_m = 0.0 if self._level else self._roads.height_m(*at, yaw)
        return carla_transform(*at, road_m + up_m, yaw)


class Collisions:
    """The collision sensor on the car; the session keeps it until the end of the drive."""

    def __init__(self, session: Session, ego: carla.Actor) -> None:
        self._session = session
        self._hits: queue.SimpleQueue[carla.CollisionEvent] = queue.SimpleQueue()
        blueprint = session.library().find("sensor.other.collision")
        sensor = session.ask(
            "a collision sensor", lambda: session.world.spawn_actor(blueprint, carla.Transform(), attach_to=ego)
        )
        assert isinstance(sensor, carla.Sensor)
        session.keep(sensor)
        sensor.listen(self._hits.put)

    def contacts(self, crowd: Crowd | None) -> list[Contact]:
        """What was hit since the last call, people aside: where they are is known, and the judge looks there."""
        found: dict[str, Contact] = {}
        while not self._hits.empty():
            hit = self._hits.get_nowait()
            # The server is asked who that is.
            other = self._session.ask("what was hit", lambda hit=hit: hit.other_actor)
            if other.type_id.startswith("walker."):
                continue
            index = None if crowd is None else crowd.car_index(other.id)
            if not other.type_id.startswith("vehicle."):
                contact = Contact("static", other.type_id)
            else:
                contact = Contact("vehicle", f"{other.type_id} {other.id}" if index is None else f"car {index}")
            found[contact.name] = contact
        return [found[name] for name in sorted(found)]


def _is_car(blueprint: carla.ActorBlueprint) -> bool:
    if not blueprint.has_attribute("number_of_wheels") or int(blueprint.get_attribute("number_of_wheels")) != 4:
        return False
    kind = blueprint.get_attribute("base_type").as_str() if blueprint.has_attribute("base_type") else "car"
    return kind in ("car", "")
