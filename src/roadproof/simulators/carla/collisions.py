"""What the car hits, from CARLA's collision sensor."""

from __future__ import annotations

import queue

from roadproof.simulators.carla.actors import Crowd
from roadproof.simulators.carla.session import Session, carla
from roadproof.simulators.tracker.judge import Contact


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
