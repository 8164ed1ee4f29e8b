"""What works on a CARLA server, and what does not: one page for its owner."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

from roadproof.checks import Check
from roadproof.datatypes import Control, Observation, VehicleState
from roadproof.geometry import CANVAS_SIZE_PX
from roadproof.scenarios import Scenario
from roadproof.simulators.carla.inject import ASPHALT_LEVEL, may_show
from roadproof.simulators.carla.places import scenario_between, spawn_places, straight_stretch
from roadproof.simulators.carla.simulator import CarlaSimulator
from roadproof.simulators.checks import BrokenPromiseError, SimulatorReport, check_simulator, checked
from roadproof.simulators.protocol import PaintKind

STRETCH_M, CANVAS_AT_M = 60.0, 30.0
STEPS = 20
AHEAD = Control(0.0, throttle=0.6)
COLOURS = ((200, 40, 40), (40, 180, 40), (50, 60, 200), (220, 220, 220))


def examine(simulator: CarlaSimulator, on_check: Callable[[Check], object] = lambda _: None) -> SimulatorReport:
    """Drive a server, not yet connected, over a straight stretch of the map it has loaded.

    Args:
        simulator: a simulator that is not yet entered.
        on_check: called with each check as it is made.

    Returns:
        Checks of connection, map, pictures, speed, repeatability, road, paint, native paint, traffic and clean-up.
        Whatever goes wrong is a failed check; only what cannot be done without it is left out.
    """
    checks: list[Check] = []

    def found(name: str, look: Callable[[], str]) -> bool:
        check = checked(name, look)
        checks.append(check)
        on_check(check)
        return check.passed

    server = _Examination(simulator)
    try:
        if found("connection", server.connection) and found("map", server.map):
            for name, look in (
                ("pictures", server.pictures),
                ("speed", server.speed),
                ("repeatability", server.repeatability),
                ("road", server.road),
                ("paint", server.paint),
                ("native paint", server.native),
                ("traffic", server.traffic),
            ):
                found(name, look)
    finally:
        simulator.__exit__(None, None, None)
    if server.connected:
        found("clean-up", server.clean_up)
    return SimulatorReport(tuple(checks))


class _Examination:
    """The checks of a server; each method returns what it saw or raises `BrokenPromiseError`."""

    def __init__(self, simulator: CarlaSimulator) -> None:
        self._simulator = simulator
        self._scenario: Scenario | None = None
        self._before: set[int] = set()
        self._found: tuple[object, object] = (None, None)
        self.connected = False

    @property
    def scenario(self) -> Scenario:
        assert self._scenario is not None
        return self._scenario

    def connection(self) -> str:
        self._simulator.__enter__()
        self.connected = True
        session = self._simulator.session
        session.tick()
        self._found = session.found
        self._before = {actor.id for actor in session.ask("its actors", session.world.get_actors)}
        return f"version {session.version}, {len(self._before)} actors there already"

    def map(self) -> str:
        session = self._simulator.session
        name = session.map_name()
        places = spawn_places(session)
        roads = self._simulator.road_map(name)
        start, goal = straight_stretch(roads, places, STRETCH_M)
        self._scenario = scenario_between(roads, name, start, goal, canvas_at_m=CANVAS_AT_M, name="doctor")
        return f"{name}, {len(places)} spawn points; driven from ({start.x_m:.0f}, {start.y_m:.0f})"

    def pictures(self) -> str:
        report = check_simulator(
            self._simulator, self.scenario, steps=STEPS, only=("observation", "picture", "start", "clock", "units")
        )
        report.require()
        return "frames fit their pictures; start, clock and units are right"

    def speed(self) -> str:
        self._simulator.reset(self.scenario)
        begin = time.perf_counter()
        for _ in range(STEPS):
            self._simulator.step(AHEAD)
        rate = STEPS / (time.perf_counter() - begin)
        return f"{rate:.1f} steps/s at {self._simulator.camera.width_px}×{self._simulator.camera.height_px}"

    def repeatability(self) -> str:
        """The noise floor: what two drives differ by that should be the same."""
        one, two = (self._drive() for _ in range(2))
        levels = max(float(np.abs(a.frame.astype(int) - b.frame).mean()) for a, b in zip(one, two, strict=True))
        metres = max(_apart(a.state, b.state) for a, b in zip(one, two, strict=True))
        return f"two equal drives of {STEPS} steps differ by up to {metres:.3f} m and {levels:.2f} levels a frame"

    def road(self) -> str:
        """Whether the canvas lies in the road, and how bright that is."""
        self._near(np.zeros((CANVAS_SIZE_PX, CANVAS_SIZE_PX, 4), np.uint8))
        scene = self._simulator.scene()
        here = (
            scene.asphalt
            & (np.abs(scene.height_m) < 1.0)
            & (np.arange(len(scene.asphalt)) > 0.6 * len(scene.asphalt))[:, None]
        )
        if here.sum() < 100:
            raise BrokenPromiseError(
                "the semantic camera sees no road ahead; paint will not show. Is the server 0.9.14 or newer?"
            )
        height, level = float(np.median(scene.height_m[here])), float(scene.picture[here].mean()) / 255
        if abs(height) > 0.1:
            raise BrokenPromiseError(f"the road is {height:+.2f} m from the plane of the canvas; paint will not show")
        return f"{height:+.3f} m from the plane of the canvas, level {level:.2f} (full light: {ASPHALT_LEVEL})"

    def paint(self) -> str:
        only = ("homography", "paint", "transparency", "colours")
        report = check_simulator(self._simulator, self.scenario, steps=STEPS, only=only)
        report.require()
        return f"{self._simulator.paint}: {report.checks[1].finding}; {report.checks[3].finding}"

    def native(self) -> str:
        """Whether paint can be part of the server's world, and how paint in pictures differs from it."""
        scenario, ground = self._simulator.prove_native()
        before, self._scenario = self._scenario, scenario
        try:
            views = [self._coloured()]
            self._simulator.paint = PaintKind.NATIVE
            seen = self.paint()
            views.append(self._coloured())
        finally:
            self._simulator.paint = PaintKind.INJECT
            self._scenario = before
        off = np.abs(views[0].astype(float) - views[1]).mean(axis=-1)
        within = may_show(self._simulator.image_from_canvas(), off.shape)
        return f"{ground}; {seen}; {off[within].mean():.1f} of 255 levels from paint in pictures"

    def _coloured(self) -> np.ndarray:
        """A picture of a canvas of four colours from where the doctor's drive begins."""
        pattern = np.full((CANVAS_SIZE_PX, CANVAS_SIZE_PX, 4), 255, np.uint8)
        half = CANVAS_SIZE_PX // 2
        for k, colour in enumerate(COLOURS):
            pattern[half * (k // 2) :, half * (k % 2) :, :3] = colour
        picture = self._near(pattern).picture
        assert picture is not None
        return picture

    def traffic(self) -> str:
        self._simulator.reset(self.scenario, cars=8, pedestrians=8, seed=1)
        for _ in range(STEPS):
            self._simulator.step(Control(0.0, brake=1.0))
        moved = float(np.mean(self._simulator.cars.travelled_m))
        return f"8 cars and 8 people spawned and moved; cars by {moved:.1f} m in {STEPS * self._simulator.dt_s:.1f} s"

    def clean_up(self) -> str:
        with self._simulator as again:
            again.session.tick()
            session = again.session
            left = {actor.id for actor in session.ask("its actors", session.world.get_actors)} - self._before
            found = session.found
        if left:
            raise BrokenPromiseError(f"{len(left)} actors are left")
        for what, before, now in zip(("settings are", "weather is"), self._found, found, strict=True):
            if now != before:
                raise BrokenPromiseError(f"the {what} not put back: {now}, {before} before")
        return "nothing is left, settings and weather are put back"

    def _drive(self) -> list[Observation]:
        seen = [self._simulator.reset(self.scenario)]
        return seen + [self._simulator.step(AHEAD) for _ in range(STEPS)]

    def _near(self, pattern: np.ndarray) -> Observation:
        return self._simulator.reset(self.scenario, pattern=pattern, full_pictures=True)


def _apart(a: VehicleState, b: VehicleState) -> float:
    return math.dist((a.x_m, a.y_m), (b.x_m, b.y_m))
