"""The embedded town as a simulator: its renderer and physics behind `roadproof.simulators.protocol`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from roadproof.datatypes import Control, Observation, Obstacle
from roadproof.errors import SimulatorError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CameraModel, CropResize, homography_from_pose
from roadproof.homographies import Homography
from roadproof.roads.maps import load_map
from roadproof.roads.roadmap import RoadMap
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import BESIDE_M, PaintKind
from roadproof.simulators.town.engine import Graphics, make_pipe
from roadproof.simulators.town.meshes import Pose
from roadproof.simulators.town.physics import SUBSTEP_S, Physics
from roadproof.simulators.town.renderer import Renderer
from roadproof.simulators.town.scenery import Scenery, build_scenery
from roadproof.simulators.tracker.drive import RouteTracker
from roadproof.simulators.tracker.simulator import Request, RouteSimulator


@dataclass(slots=True)
class _Town:
    """What is kept from drive to drive: one map with all that stands on it."""

    roads: RoadMap
    scenery: Scenery
    renderer: Renderer


class _Drive(RouteTracker):
    physics: Physics


class TownSimulator(RouteSimulator[_Drive]):
    """A small town without a screen or a server, on one CPU core unless OpenGL draws it.

    Args:
        camera: the camera on the car.
        input: how the controller's frame is cut from the camera picture; it is rendered at twice its resolution and
            reduced by a box, so the simulator's own `input` says "area", whatever this one said.
        dt_s: simulated seconds per step, a multiple of 0.01.
        graphics: what draws: "software" by default, whose pixels are the same on every machine; "egl" for OpenGL, on a
            GPU where there is one, whose pictures differ a little at edges.

    Raises:
        SimulatorError: there are no such graphics, `dt_s` is not a positive multiple of 0.01, the crop leaves the
            camera picture, or the camera has a lens.
    """

    paint = PaintKind.RENDERED
    """How patterns are put on the road: rendered with the road."""

    def __init__(
        self,
        *,
        camera: CameraModel = CIL_CAMERA,
        input: CropResize = CIL_INPUT,  # noqa: A002
        dt_s: float = 0.05,
        graphics: str = Graphics.SOFTWARE,
    ) -> None:
        if graphics not in tuple(Graphics):
            raise SimulatorError(f"graphics is {graphics!r}, expected {' or '.join(Graphics)}")
        substeps = dt_s / SUBSTEP_S
        if not (math.isfinite(dt_s) and round(substeps) >= 1 and abs(substeps - round(substeps)) < 1e-6):
            raise SimulatorError(f"dt_s is {dt_s}, expected a positive multiple of {SUBSTEP_S}")
        if camera.lens is not None:
            raise SimulatorError("the town is drawn as a pinhole sees it; give TownSimulator a camera without a lens")
        super().__init__(camera, replace(input, resampling="area"), dt_s)
        self._graphics = Graphics(graphics)
        self._town: _Town | None = None

    @property
    def identity(self) -> str:
        """What tells this town's pictures from those that software draws; empty for these."""
        return "" if self._graphics is Graphics.SOFTWARE else f"drawn by {self._graphics}"

    def road_map(self, name: str) -> RoadMap:
        """The map a scenario names; it needs no drive.

        Raises:
            ScenarioError: there is no such map, or it cannot be read.
        """
        return load_map(name)

    def obstacles(self, scenario: Scenario) -> tuple[Obstacle, ...]:
        """What a car could run into near a scenario's canvas; it needs no drive.

        Raises:
            ScenarioError: there is no such map, or it cannot be read.
        """
        canvas = scenario.canvas
        return tuple(
            Obstacle(
                x_m=solid.pose.x_m,
                y_m=solid.pose.y_m,
                yaw_rad=solid.pose.yaw_rad,
                half_length_m=solid.half_m[0],
                half_width_m=solid.half_m[1],
            )
            for solid in build_scenery(load_map(scenario.map_name)).solids
            if solid.apart_m(canvas.x_m, canvas.y_m) < BESIDE_M
        )

    def image_from_canvas(self) -> Homography:
        """The exact homography of the current state: canvas px to camera px.

        Raises:
            SimulatorError: there was no reset.
        """
        drive = self._running()
        return homography_from_pose(self.camera, drive.state, drive.scenario.canvas)

    def _open(self) -> None:
        make_pipe(self._graphics)

    def _close(self) -> None:
        if self._town is not None:
            self._town.renderer.close()
            self._town = None

    def _end_drive(self) -> None:
        if self._drive is not None:
            self._drive.physics.close()
            self._drive = None

    def _begin(self, request: Request) -> _Drive:
        scenario = request.scenario
        town = self._town_of(scenario.map_name)
        drive = _Drive(request, town.roads, self.dt_s)
        self._end_drive()
        places = zip(drive.cars.x_m.tolist(), drive.cars.y_m.tolist(), drive.cars.yaw_rad.tolist(), strict=True)
        drive.physics = Physics(town.scenery.solids, scenario.start, [Pose(*place) for place in places])
        town.renderer.set_weather(request.weather)
        town.renderer.set_canvas(scenario.canvas, request.pattern)
        town.renderer.set_agents(drive.cars, drive.pedestrians)
        return drive

    def _advance(self, drive: _Drive, control: Control) -> None:
        if drive.traffic is not None:
            assert self._town is not None
            drive.step_traffic()
            drive.physics.move_cars(np.stack([drive.cars.x_m, drive.cars.y_m, drive.cars.yaw_rad], axis=1))
            self._town.renderer.set_agents(drive.cars, drive.pedestrians)
        drive.physics.step(control, self.dt_s)
        drive.state = drive.physics.state()

    def _observe(self, drive: _Drive) -> Observation:
        assert self._town is not None
        renderer = self._town.renderer
        # They take most of a step's time, a full picture several times as long as a frame.
        frame = renderer.frame(drive.state, drive.steps) if drive.shows_frame else self._black
        picture = renderer.picture(drive.state, drive.steps) if drive.shows_picture else None
        return drive.judged(frame, picture, drive.physics.contacts())

    def _town_of(self, map_name: str) -> _Town:
        """A map with everything on it; built when the map changes."""
        roads = load_map(map_name)
        if self._town is None or self._town.roads is not roads:
            self._end_drive()
            self._close()
            scenery = build_scenery(roads)
            self._town = _Town(roads, scenery, Renderer(roads, scenery, self.camera, self.input, self._graphics))
        return self._town
