"""The cameras, on the car or above the road: pictures are waited for until they are those of the tick."""

from __future__ import annotations

import math
import queue

from roadproof.datatypes import VehicleState
from roadproof.errors import SimulatorError
from roadproof.geometry import CameraModel
from roadproof.simulators.carla.session import Session, carla

FIRST_TICKS = 100
FIRST_WAIT_S = 0.5
LOOK_S = 1.0
# As far as the server has them: a picture shows one moment.
STILL = {"motion_blur_intensity": "0.0", "motion_blur_max_distortion": "0.0", "lens_flare_intensity": "0.0"}


class Camera:
    """One camera.

    Args:
        session: the connection, which keeps the camera until the end of the drive.
        kind: "rgb", "depth" or "semantic_segmentation".
        model: the camera's size, field of view and place on the car.
        carrier: the car that the camera is fixed to, or where such a car would stand in the town's world.
    """

    def __init__(self, session: Session, kind: str, model: CameraModel, carrier: carla.Actor | VehicleState) -> None:
        self._session = session
        self._name = f"the {kind} camera of the CARLA server at {session.where}"
        self._arrived: queue.SimpleQueue[carla.Image] = queue.SimpleQueue()
        blueprint = session.library().find(f"sensor.camera.{kind}")
        size = {"image_size_x": str(model.width_px), "image_size_y": str(model.height_px), "fov": str(model.fov_deg)}
        for name, value in (size | STILL).items():
            if blueprint.has_attribute(name):
                blueprint.set_attribute(name, value)
        place = carla.Transform(
            carla.Location(x=model.forward_m, y=-model.left_m, z=model.up_m), carla.Rotation(pitch=model.pitch_deg)
        )
        parent: carla.Actor | None = None
        if isinstance(carrier, VehicleState):
            yaw, x, y = carrier.yaw_rad, model.forward_m, model.left_m
            place.location.x = carrier.x_m + x * math.cos(yaw) - y * math.sin(yaw)
            place.location.y = -(carrier.y_m + x * math.sin(yaw) + y * math.cos(yaw))
            place.location.z = carrier.z_m + model.up_m
            place.rotation.yaw = -math.degrees(yaw)
        else:
            parent = carrier
        sensor = session.ask(f"a {kind} camera", lambda: session.world.spawn_actor(blueprint, place, attach_to=parent))
        assert isinstance(sensor, carla.Sensor)
        session.keep(sensor)
        sensor.listen(self._arrived.put)

    def begin(self) -> None:
        """Tick until pictures come: those before the stream was open are lost.

        Raises:
            SimulatorError: no picture comes.
        """
        for _ in range(FIRST_TICKS):
            frame = self._session.tick()
            try:
                if self._arrived.get(timeout=FIRST_WAIT_S).frame <= frame:
                    return
            except queue.Empty:
                continue
        raise SimulatorError(
            f"{self._name} sent nothing in {FIRST_TICKS} ticks; "
            "check that it renders (no -nullrhi) and that the port after its own is open too"
        )

    def picture(self, frame: int) -> carla.Image:
        """The picture of a tick; older ones, which come late or twice, are dropped.

        Raises:
            SimulatorError: the picture does not come in time.
        """
        left_s = self._session.patience_s
        while left_s > 0:
            # In pieces, not until a time: while this process or its machine stood still, nothing could arrive.
            look_s = min(left_s, LOOK_S)
            try:
                image = self._arrived.get(timeout=look_s)
            except queue.Empty:
                left_s -= look_s
                continue
            if image.frame == frame:
                return image
            if image.frame > frame:
                raise SimulatorError(
                    f"{self._name} sent frame {image.frame} but never {frame}; check that no other client ticks it"
                )
        raise SimulatorError(
            f"{self._name} sent no picture of frame {frame} "
            f"within {self._session.patience_s:g} s; check the server's load and the network"
        )
