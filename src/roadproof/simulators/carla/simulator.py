"""A CARLA server behind `roadproof.simulators.protocol`.

Route, commands, traffic and what counts as leaving the lane come from the town's own code, over the server's OpenDRIVE
map, so that the same scenario means the same on both. The server gives the car's motion, collisions and pictures.
"""

from __future__ import annotations

from typing import get_args

from roadproof.datatypes import Control, Observation, Obstacle
from roadproof.errors import RoadproofError, SimulatorError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CameraModel, CanvasPlacement, CropResize
from roadproof.homographies import Homography
from roadproof.roads.roadmap import RoadMap
from roadproof.scenarios import Scenario
from roadproof.simulators.carla.actors import Collisions, Crowd, place_driven, spawn_driven, vehicle_state
from roadproof.simulators.carla.beside import stand_beside
from roadproof.simulators.carla.cameras import Camera
from roadproof.simulators.carla.inject import Paint, Scene
from roadproof.simulators.carla.native import Ground, SeveralPiecesError, find_ground, lay
from roadproof.simulators.carla.places import scenario_between, spawn_places, straight_stretch
from roadproof.simulators.carla.session import Session, carla
from roadproof.simulators.carla.signals import Signals
from roadproof.simulators.carla.views import image_from_world, levels
from roadproof.simulators.carla.views import scene as seen_by
from roadproof.simulators.carla.weather import carla_weather
from roadproof.simulators.protocol import PaintChoice, PaintKind
from roadproof.simulators.tracker.drive import Request, RouteTracker
from roadproof.simulators.tracker.simulator import RouteSimulator

SETTLE_TICKS = 10
STOP = Control(0.0, brake=1.0)
TRIED_M = 60.0
# One of them lies on a single piece of road, if pieces are not much shorter than 20 m.
TRIED_AT_M = (18.0, 24.0, 30.0, 36.0)


class _Drive(RouteTracker):
    ego: carla.Vehicle
    crowd: Crowd | None
    cameras: dict[str, Camera]
    collisions: Collisions
    signals: Signals
    inject: Paint | None
    images: dict[str, carla.Image]
    image_from_canvas: Homography
    frame: int


class CarlaSimulator(RouteSimulator[_Drive]):
    """A CARLA server, driven in synchronous mode.

    A pattern is painted into the pictures, where the depth and semantic cameras see free road ("inject"), or on the
    server's own road ("native").

    Args:
        host: name or address of the server.
        port: the server's port for calls; sensor data comes through the next.
        camera: the camera on the car.
        input: how the controller's frame is cut from the camera picture.
        dt_s: simulated seconds per step.
        patience_s: longest wait for a call or a picture, seconds.
        loading_s: longest wait where a map is loaded or the weather changes, seconds.
        paint: "inject", "native", or "auto": native if it works on a straight stretch of the map that is loaded.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 2000,
        *,
        camera: CameraModel = CIL_CAMERA,
        input: CropResize = CIL_INPUT,  # noqa: A002
        dt_s: float = 0.05,
        patience_s: float = 20.0,
        loading_s: float = 300.0,
        paint: PaintChoice = "inject",
    ) -> None:
        """Make a simulator; nothing is connected before it is entered.

        Raises:
            SimulatorError: the crop leaves the camera picture, the camera has a lens, or paint is none of the three.
        """
        if paint not in get_args(PaintChoice):
            raise SimulatorError(f"paint is {paint!r}, expected one of {', '.join(get_args(PaintChoice))}")
        if camera.lens is not None:
            raise SimulatorError(
                f"CARLA renders through a pinhole and knows no {camera.lens.model} lens; give CarlaSimulator a camera "
                "without one"
            )
        super().__init__(camera, input, dt_s)
        self._host, self._port, self._patience_s, self._loading_s = host, port, patience_s, loading_s
        self._choice: PaintChoice = paint
        self.paint: PaintKind = PaintKind.NATIVE if paint == "native" else PaintKind.INJECT
        """How patterns are put on the road from the next reset on; entering decides it where "auto" is asked for."""
        self._session: Session | None = None
        self._ground: tuple[str, CanvasPlacement, Ground] | None = None

    @property
    def identity(self) -> str:
        """The server's version: physics and pictures differ from one to the next.

        Raises:
            SimulatorError: the simulator is not entered.
        """
        return f"{CarlaSimulator.__name__} {self.session.version}"

    @property
    def session(self) -> Session:
        """The connection.

        Raises:
            SimulatorError: the simulator is not entered.
        """
        if self._session is None:
            raise SimulatorError("the simulator is closed; use it in a with-block")
        return self._session

    def scene(self) -> Scene:
        """What the cameras saw last, before paint.

        Raises:
            SimulatorError: there was no reset, or none with a pattern to be painted into pictures: only for such a
                pattern depth and kinds are seen too.
        """
        drive = self._running()
        if drive.inject is None:
            raise SimulatorError("depth and kinds are seen in drives with a pattern only; reset with one")
        return seen_by(self.camera, drive.images, drive.scenario.canvas.z_m)

    def road_map(self, name: str) -> RoadMap:
        """The map a scenario names, loaded on the server.

        Raises:
            SimulatorError: the server does not answer.
            ScenarioError: the server has no such map.
        """
        return self.session.road_map(name)

    def obstacles(self, scenario: Scenario) -> tuple[Obstacle, ...] | None:
        """What a car could run into near a scenario's canvas; None if the server refuses to say. It needs no drive.

        Raises:
            SimulatorError: the server does not answer.
            ScenarioError: the server has no such map.
        """
        roads = self.road_map(scenario.map_name)
        try:
            return stand_beside(self.session, roads, scenario.canvas)
        except SimulatorError:
            if self.session.lost:
                raise
            return None

    def prove_native(self) -> tuple[Scenario, Ground]:
        """Find a piece of road that can be painted, on a straight stretch of the map that is loaded.

        Returns:
            A drive over a canvas on it, and the piece.

        Raises:
            RoadproofError: no such piece of road can be painted; the message says what was seen.
        """
        session = self.session
        name = session.map_name()
        roads = session.road_map(name)
        start, goal = straight_stretch(roads, spawn_places(session), TRIED_M)
        self._end_drive()
        session.clear()
        refused = SimulatorError(f"no place for a canvas was tried, expected one of {TRIED_AT_M}")
        for at_m in TRIED_AT_M:
            tried = scenario_between(roads, name, start, goal, canvas_at_m=at_m, name="tried")
            try:
                return tried, self._ground_of(tried)
            except SeveralPiecesError as several:
                refused = several
        raise refused

    def _open(self) -> None:
        self._session = Session(
            self._host, self._port, dt_s=self.dt_s, patience_s=self._patience_s, loading_s=self._loading_s
        )
        if self._choice == "auto":
            try:
                self.prove_native()
                self.paint = PaintKind.NATIVE
            except RoadproofError:
                if self.session.lost:
                    raise
                self.paint = PaintKind.INJECT

    def _close(self) -> None:
        self._ground = None
        if self._session is not None:
            session, self._session = self._session, None
            session.close()

    def _begin(self, request: Request) -> _Drive:
        session, scenario = self.session, request.scenario
        roads = session.road_map(scenario.map_name)
        drive = _Drive(request, roads, self.dt_s)
        self._end_drive()
        session.clear()
        if self.paint is PaintKind.INJECT and session.painted:
            session.reload()
        if self.paint is PaintKind.NATIVE:
            # The bare road as well: what is painted is compared with asphalt of the same make.
            lay(session, self._ground_of(scenario), request.pattern)
        session.set_weather(carla_weather(request.weather))
        drive.ego = spawn_driven(session, scenario.start)
        # The others stand where they were spawned while the car settles.
        drive.crowd = None
        crowd = None if drive.traffic is None else Crowd(session, roads, drive.traffic)
        for _ in range(SETTLE_TICKS):
            self._order(session, drive, STOP)
            session.tick()
        drive.crowd = crowd
        pattern = request.pattern if self.paint is PaintKind.INJECT else None
        drive.inject = None if pattern is None else Paint(pattern)
        kinds = ("rgb",) if pattern is None else ("rgb", "depth", "semantic_segmentation")
        drive.collisions = Collisions(session, drive.ego)
        drive.cameras = {kind: Camera(session, kind, self.camera, drive.ego) for kind in kinds}
        for camera in drive.cameras.values():
            camera.begin()
        drive.signals = Signals(session, roads)
        # Lights would go on from where the last drive left them; each drive has to find them alike, however many ticks
        # its cameras needed.
        session.ask("its traffic lights anew", session.world.reset_all_traffic_lights)
        self._start(session, drive)
        return drive

    def _advance(self, drive: _Drive, control: Control) -> None:
        drive.step_traffic()
        self._order(self.session, drive, control)
        drive.frame = self.session.tick()

    def image_from_canvas(self) -> Homography:
        """The exact homography of the last picture: canvas px to camera px.

        Raises:
            SimulatorError: there was no reset.
        """
        return self._running().image_from_canvas

    def _ground_of(self, scenario: Scenario) -> Ground:
        """The piece of road under a scenario's canvas; looked for where it is another one than before."""
        here = (scenario.map_name, scenario.canvas)
        if self._ground is None or self._ground[:2] != here:
            self._ground = None
            self._ground = (*here, find_ground(self.session, scenario.canvas))
        return self._ground[2]

    def _order(self, session: Session, drive: _Drive, control: Control) -> None:
        """Send the control, and the others' places, for the next tick."""
        pedals = carla.VehicleControl(throttle=control.throttle, steer=control.steer, brake=control.brake)
        moves = [] if drive.crowd is None else drive.crowd.moves()
        session.batch("a control", [carla.command.ApplyVehicleControl(drive.ego.id, pedals), *moves])

    def _start(self, session: Session, drive: _Drive) -> None:
        """Put the settled car where the drive starts, as fast as it starts."""
        start = drive.scenario.start
        # One tick is taken before the first picture.
        place_driven(session, drive.ego, start, start.speed_mps * self.dt_s)
        self._order(session, drive, STOP if start.speed_mps == 0.0 else Control(0.0))
        drive.frame = session.tick()

    def _observe(self, drive: _Drive) -> Observation:
        session = self.session
        drive.images = {kind: camera.picture(drive.frame) for kind, camera in drive.cameras.items()}
        snapshot = session.ask("where the car is", session.world.get_snapshot)
        if snapshot.frame != drive.frame:
            raise SimulatorError(
                f"the CARLA server at {session.where} is at frame {snapshot.frame}, expected {drive.frame}; check that "
                "no other client ticks it"
            )
        drive.state = vehicle_state(snapshot.find(drive.ego.id))
        rgb = drive.images["rgb"]
        drive.image_from_canvas = image_from_world(self.camera, rgb) @ drive.scenario.canvas.world_from_canvas
        picture = levels(rgb)
        if drive.inject is not None:
            picture = drive.inject.on(self.scene(), drive.image_from_canvas)
        contacts = drive.collisions.contacts(drive.crowd)
        signals = drive.signals.watch(drive.state, drive.time_s)
        return drive.judged(self.input(picture), picture if drive.shows_picture else None, contacts, signals)
