"""A CARLA server behind `roadproof.simulators.protocol`.

Route, commands, traffic and what counts as leaving the lane come from the town's own code, over the server's OpenDRIVE
map, so that the same scenario means the same on both. The server gives the car's motion, collisions and pictures.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import TracebackType

import numpy as np

from roadproof.datatypes import Control, Observation, VehicleState, Weather
from roadproof.errors import RoadproofError, SimulatorError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CameraModel, CanvasPlacement, CropResize, Homography
from roadproof.roads.maps import scenario_route
from roadproof.roads.roadmap import RoadMap
from roadproof.roads.routes import Route
from roadproof.scenarios import Scenario
from roadproof.simulators.arguments import check_crop, check_pattern
from roadproof.simulators.carla.actors import Crowd, place_driven, spawn_driven, vehicle_state
from roadproof.simulators.carla.cameras import Camera
from roadproof.simulators.carla.collisions import Collisions
from roadproof.simulators.carla.inject import Paint, Scene
from roadproof.simulators.carla.native import Ground, SeveralPiecesError, find_ground, lay
from roadproof.simulators.carla.places import scenario_between, spawn_places, straight_stretch
from roadproof.simulators.carla.session import Session, carla
from roadproof.simulators.carla.signals import Signals
from roadproof.simulators.carla.views import image_from_world, levels
from roadproof.simulators.carla.views import scene as seen_by
from roadproof.simulators.carla.weather import set_weather
from roadproof.simulators.protocol import PaintChoice, PaintKind, PatternImage, Pictures
from roadproof.simulators.tracker.endings import Endings
from roadproof.simulators.tracker.judge import Judge
from roadproof.traffic.agents import NOBODY, Agents
from roadproof.traffic.traffic import Traffic

SETTLE_TICKS = 10
STOP = Control(0.0, brake=1.0)
TRIED_M = 60.0
# One of them lies on a single piece of road, if pieces are not much shorter than 20 m.
TRIED_AT_M = (18.0, 24.0, 30.0, 36.0)


@dataclass(slots=True, eq=False)
class _Drive:
    """One drive under way."""

    scenario: Scenario
    route: Route
    judge: Judge
    endings: Endings
    ego: carla.Vehicle
    crowd: Crowd | None
    cameras: dict[str, Camera]
    collisions: Collisions
    signals: Signals
    paint: Paint | None
    full_pictures: Pictures
    state: VehicleState
    image_from_canvas: Homography = field(default_factory=lambda: np.eye(3))
    images: dict[str, carla.Image] = field(default_factory=dict[str, carla.Image])
    steps: int = 0
    arclength_m: float = 0.0


class CarlaSimulator:
    """A CARLA server, driven in synchronous mode.

    A pattern is painted into the pictures, where the depth and semantic cameras see free road ("inject"), or on the
    server's own road ("native").

    Args:
        host: of the server.
        port: of its calls; sensor data comes through the next.
        camera: the camera on the car.
        input: how the controller's frame is cut from its picture.
        dt_s: seconds per step.
        patience_s: longest wait for a call or a picture.
        loading_s: longest wait where a map is loaded or the weather changes.
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
        """Nothing is connected before the simulator is entered.

        Raises:
            SimulatorError: the crop leaves the camera picture.
        """
        check_crop(camera, input)
        self._camera, self._input, self._dt_s = camera, input, dt_s
        self._host, self._port, self._patience_s, self._loading_s = host, port, patience_s, loading_s
        self._choice: PaintChoice = paint
        self._paint = PaintKind.NATIVE if paint == "native" else PaintKind.INJECT
        self._session: Session | None = None
        self._drive: _Drive | None = None
        self._ground: tuple[str, CanvasPlacement, Ground] | None = None

    @property
    def camera(self) -> CameraModel:
        """The camera on the car; full pictures have its size."""
        return self._camera

    @property
    def input(self) -> CropResize:
        """How the controller's frame is cut from the camera picture."""
        return self._input

    @property
    def dt_s(self) -> float:
        """Simulated seconds per step."""
        return self._dt_s

    @property
    def paint(self) -> PaintKind:
        """How patterns are put on the road; "auto" is decided when the simulator is entered."""
        return self._paint

    @property
    def route(self) -> Route:
        """The way of the current drive.

        Raises:
            SimulatorError: there was no reset.
        """
        return self._running().route

    @property
    def cars(self) -> Agents:
        """The other cars as they are now.

        Raises:
            SimulatorError: there was no reset.
        """
        crowd = self._running().crowd
        return NOBODY if crowd is None else crowd.traffic.cars

    @property
    def pedestrians(self) -> Agents:
        """The people as they are now.

        Raises:
            SimulatorError: there was no reset.
        """
        crowd = self._running().crowd
        return NOBODY if crowd is None else crowd.traffic.pedestrians

    @property
    def where(self) -> str:
        """HOST:PORT of the server."""
        return f"{self._host}:{self._port}"

    @property
    def session(self) -> Session:
        """The connection.

        Raises:
            SimulatorError: there is none.
        """
        if self._session is None:
            raise SimulatorError("the simulator is closed; use it in a with-block")
        return self._session

    def scene(self) -> Scene:
        """What the cameras saw last, before paint.

        Raises:
            SimulatorError: there was no reset with a pattern to be painted into pictures, so that there is but one
                camera.
        """
        drive = self._running()
        if drive.paint is None:
            raise SimulatorError("depth and kinds are seen in drives with a pattern only; reset with one")
        return seen_by(self._camera, drive.images, drive.scenario.canvas.z_m)

    def road_map(self, name: str) -> RoadMap:
        """The map a scenario names, loaded on the server.

        Raises:
            SimulatorError: the server does not answer.
            ScenarioError: it has no such map.
        """
        return self.session.road_map(name)

    def __enter__(self) -> CarlaSimulator:
        self._session = Session(
            self._host, self._port, dt_s=self._dt_s, patience_s=self._patience_s, loading_s=self._loading_s
        )
        if self._choice == "auto":
            try:
                self.prove_native()
                self.paint_by(PaintKind.NATIVE)
            except RoadproofError:
                if self.session.lost:
                    self.__exit__(None, None, None)
                    raise
                self.paint_by(PaintKind.INJECT)
        return self

    def paint_by(self, paint: PaintKind) -> None:
        """Change how patterns are put on the road, from the next reset on.

        Raises:
            SimulatorError: a CARLA server has no such way.
        """
        if paint is PaintKind.RENDERED:
            raise SimulatorError(f"paint is {paint}, expected {PaintKind.INJECT} or {PaintKind.NATIVE}")
        self._paint = paint

    def prove_native(self) -> tuple[Scenario, Ground]:
        """Find a piece of road that can be painted, on a straight stretch of the map that is loaded.

        Returns:
            A drive over a canvas on it, and the piece.

        Raises:
            RoadproofError: there is none; the message says what was seen.
        """
        session = self.session
        name = session.map_name()
        roads = session.road_map(name)
        start, goal = straight_stretch(roads, spawn_places(session), TRIED_M)
        self._drive = None
        session.clear()
        refused = SimulatorError(f"no place for a canvas was tried, expected one of {TRIED_AT_M}")
        for at_m in TRIED_AT_M:
            tried = scenario_between(roads, name, start, goal, canvas_at_m=at_m, name="tried")
            try:
                return tried, self._ground_of(tried)
            except SeveralPiecesError as several:
                refused = several
        raise refused

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._drive = self._ground = None
        if self._session is not None:
            self._session.close()
            self._session = None

    def reset(
        self,
        scenario: Scenario,
        *,
        weather: Weather = Weather.CLEAR_NOON,
        pattern: PatternImage | None = None,
        cars: int = 0,
        pedestrians: int = 0,
        seed: int = 0,
        full_pictures: Pictures = False,
    ) -> Observation:
        """Begin a drive; see `roadproof.simulators.protocol.Simulator.reset`.

        Raises:
            SimulatorError: the simulator is not open, the server does not answer or refuses, or an argument does not
                fit.
            ScenarioError: the scenario does not fit the server's map.
        """
        session = self.session
        weather = Weather(weather)
        check_pattern(pattern)
        roads = session.road_map(scenario.map_name)
        route = scenario_route(scenario, roads)
        traffic = None
        if cars != 0 or pedestrians != 0:
            traffic = Traffic(roads, cars=cars, pedestrians=pedestrians, seed=seed, ego=scenario.start)
        self._drive = None
        session.clear()
        if self._paint is PaintKind.INJECT and session.painted:
            session.reload()
        if self._paint is PaintKind.NATIVE:
            # The bare road as well: what is painted is compared with asphalt of the same make.
            lay(session, self._ground_of(scenario), pattern)
        set_weather(session, weather)
        ego = spawn_driven(session, scenario.start)
        crowd = None if traffic is None else Crowd(session, traffic)
        # Lights would go on from where the last drive left them; each drive has to find them alike.
        session.ask("its traffic lights anew", session.world.reset_all_traffic_lights)
        for _ in range(SETTLE_TICKS):
            self._order(session, ego, STOP)
            session.tick()
        paint = Paint(pattern) if pattern is not None and self._paint is PaintKind.INJECT else None
        kinds = ("rgb",) if paint is None else ("rgb", "depth", "semantic_segmentation")
        collisions = Collisions(session, ego)
        cameras = {kind: Camera(session, kind, self._camera, ego) for kind in kinds}
        for camera in cameras.values():
            camera.begin()
        self._drive = _Drive(
            scenario=scenario,
            route=route,
            judge=Judge(roads),
            endings=Endings(route, scenario.time_limit_s),
            ego=ego,
            crowd=crowd,
            cameras=cameras,
            collisions=collisions,
            signals=Signals(session, roads),
            paint=paint,
            full_pictures=full_pictures,
            state=scenario.start,
        )
        return self._observe(self._drive, self._start(session, self._drive))

    def step(self, control: Control) -> Observation:
        """Drive on for `dt_s`; values of the control outside their range are clipped.

        Raises:
            SimulatorError: there was no reset, or the server does not answer in time.
        """
        session, drive = self.session, self._running()
        if drive.crowd is not None:
            drive.crowd.traffic.step(self._dt_s, drive.state)
        self._order(session, drive.ego, control.clipped(), drive.crowd)
        frame = session.tick()
        drive.steps += 1
        return self._observe(drive, frame)

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

    def _running(self) -> _Drive:
        if self._drive is None:
            raise SimulatorError("there is no drive; call reset first")
        return self._drive

    def _order(self, session: Session, ego: carla.Vehicle, control: Control, crowd: Crowd | None = None) -> None:
        """Send the control, and the others' places, for the next tick."""
        pedals = carla.VehicleControl(throttle=control.throttle, steer=control.steer, brake=control.brake)
        moves = [] if crowd is None else crowd.moves()
        session.batch("a control", [carla.command.ApplyVehicleControl(ego.id, pedals), *moves])

    def _start(self, session: Session, drive: _Drive) -> int:
        """Put the settled car where the drive starts, as fast as it starts; the frame that shows it."""
        start = drive.scenario.start
        # One tick is taken before the first picture.
        place_driven(session, drive.ego, start, start.speed_mps * self._dt_s)
        self._order(session, drive.ego, STOP if start.speed_mps == 0.0 else Control(0.0), drive.crowd)
        return session.tick()

    def _observe(self, drive: _Drive, frame: int) -> Observation:
        session = self.session
        images = drive.images = {kind: camera.picture(frame) for kind, camera in drive.cameras.items()}
        snapshot = session.ask("where the car is", session.world.get_snapshot)
        if snapshot.frame != frame:
            raise SimulatorError(
                f"the CARLA server at {session.where} is at frame {snapshot.frame}, expected {frame}; check that no "
                "other client ticks it"
            )
        state = drive.state = vehicle_state(snapshot.find(drive.ego.id))
        drive.image_from_canvas = (
            image_from_world(self._camera, images["rgb"]) @ drive.scenario.canvas.world_from_canvas
        )
        picture = levels(images["rgb"])
        if drive.paint is not None:
            picture = drive.paint.on(self.scene(), drive.image_from_canvas)
        time_s = drive.steps * self._dt_s
        place = drive.route.locate(state.x_m, state.y_m, drive.arclength_m if drive.steps else None)
        drive.arclength_m = place.arclength_m
        people = np.column_stack([self.pedestrians.x_m, self.pedestrians.y_m])
        events = drive.judge.watch(state, time_s, drive.collisions.contacts(drive.crowd), people)
        events += drive.signals.watch(state, time_s)
        ending = drive.endings.watch(state, place, time_s, events)
        return Observation(
            frame=self._input(picture),
            state=state,
            command=place.command,
            time_s=time_s,
            events=events,
            done=ending is not None,
            picture=picture if drive.full_pictures else None,
            ending=ending,
        )
