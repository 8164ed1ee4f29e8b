"""Traffic lights and stop signs of a CARLA server, and which of them the car runs."""

from __future__ import annotations

import math

from roadproof.datatypes import Event, VehicleState
from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.carla.session import Session, carla
from roadproof.simulators.tracker.signals import RedLights, StopSigns, TriggerVolume

STOP_SIGN = "traffic.stop"


class Signals:
    """Watches one drive for red lights and stop signs that the car runs.

    The rules are those of `simulators.tracker.signals`. The server is asked once, when the drive begins, what lights
    and signs it has; where it has none, nothing is ever found. What a light shows comes with each step, without a call.
    """

    def __init__(self, session: Session, roads: RoadMap) -> None:
        """Read all lights and signs.

        Raises:
            SimulatorError: the server does not answer.
        """
        self._session = session
        actors = sorted(
            session.ask("its traffic lights and stop signs", session.world.get_actors), key=lambda actor: actor.id
        )
        self._lights = [actor for actor in actors if isinstance(actor, carla.TrafficLight)]
        signs = [actor for actor in actors if isinstance(actor, carla.TrafficSign) and actor.type_id == STOP_SIGN]
        self._red_lights = RedLights(roads, [trigger_volume(light) for light in self._lights])
        self._stop_signs = StopSigns(roads, [trigger_volume(sign) for sign in signs])

    def watch(self, state: VehicleState, time_s: float) -> tuple[Event, ...]:
        """Lights and signs that are run now.

        Raises:
            SimulatorError: a light is no longer there.
        """
        return self._red_lights.watch(state, time_s, self._is_red) + self._stop_signs.watch(state, time_s)

    def _is_red(self, light: int) -> bool:
        shown = self._session.ask("what a traffic light shows", self._lights[light].get_state)
        return shown == carla.TrafficLightState.Red


def trigger_volume(signal: carla.TrafficSign) -> TriggerVolume:
    """The trigger volume of a light or a sign in the town's world."""
    box, pose = signal.trigger_volume, signal.get_transform()
    place = box.location
    x, y, z = (
        ahead * place.x + right * place.y + up * place.z + origin for ahead, right, up, origin in pose.get_matrix()[:3]
    )
    return TriggerVolume(
        x_m=x,
        y_m=-y,
        z_m=z,
        yaw_rad=-math.radians(pose.rotation.yaw + box.rotation.yaw),
        half_x_m=box.extent.x,
        half_y_m=box.extent.y,
    )
