"""A conformance kit: does a simulator keep what `Simulator` promises? For ours, and for those that users bring."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from roadproof.checks import Check, CheckReport
from roadproof.datatypes import Command, Control, Observation, VehicleState, Weather
from roadproof.errors import RoadproofError, SimulatorError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, homography_from_pose
from roadproof.homographies import Homography, apply_homography, homogeneous
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import PatternImage, Simulator, uniform

STEPS = 25
AHEAD = Control(0.0, throttle=0.6)
VIEW_M = 12.0
APPROACH_STEPS = 400
PLACE_TOLERANCE_PX = 0.5
COLOUR_TOLERANCE = 3.0
SQUARES = ((40, 60), (170, 150), (280, 240))
SQUARE_PX = 90


@dataclass(frozen=True, slots=True)
class SimulatorReport(CheckReport):
    """What `check_simulator` found."""

    def require(self) -> None:
        """Raise what the first failed check saw.

        Raises:
            BrokenPromiseError: a promise is not kept.
        """
        for check in self.failures:
            raise BrokenPromiseError(f"{check.name}: {check.finding}")


class BrokenPromiseError(Exception):
    """A promise is not kept; the message says what was seen."""


def check_simulator(
    simulator: Simulator, scenario: Scenario, *, steps: int = STEPS, only: Sequence[str] = ()
) -> SimulatorReport:
    """Drive a simulator, already open, and check all it promises.

    Args:
        simulator: entered, that is inside its with-block.
        scenario: a scenario whose canvas lies straight ahead of the start, 15 to 60 m away, on a free road.
        steps: how many steps each of the short drives has.
        only: names of the checks to run; all where it is empty.

    Returns:
        A report with one entry per promise. Whatever the simulator raises is a failed check, never an exception.
    """
    kit = _Kit(simulator, scenario, steps)
    promises: tuple[tuple[str, Callable[[], str]], ...] = (
        ("observation", kit.observation),
        ("picture", kit.picture),
        ("start", kit.start),
        ("clock", kit.clock),
        ("units", kit.units),
        ("steering", kit.steering),
        ("refusals", kit.refusals),
        ("determinism", kit.determinism),
        ("reset", kit.reset_is_complete),
        ("frames", kit.frames),
        ("homography", kit.homography),
        ("paint", kit.paint),
        ("transparency", kit.transparency),
        ("colours", kit.colours),
    )
    return SimulatorReport(tuple(checked(name, promise) for name, promise in promises if not only or name in only))


def checked(name: str, promise: Callable[[], str]) -> Check:
    """Check one promise: it returns what it saw, or raises."""
    try:
        return Check(name, True, promise())
    except (BrokenPromiseError, RoadproofError) as broken:
        return Check(name, False, str(broken))
    except Exception as error:
        return Check(name, False, f"raised {type(error).__name__}: {error}")


def _expect(kept: bool, seen: str) -> None:
    if not kept:
        raise BrokenPromiseError(seen)


class _Kit:
    """The promises, each a method that returns what it saw or raises `BrokenPromiseError`."""

    def __init__(self, simulator: Simulator, scenario: Scenario, steps: int) -> None:
        self._simulator, self._scenario, self._steps = simulator, scenario, steps
        self._near: Scenario | None = None

    def observation(self) -> str:
        seen, crop = self._simulator.reset(self._scenario), self._simulator.input
        shape = (crop.height_px, crop.width_px, 3)
        _expect(seen.frame.shape == shape, f"the frame is {seen.frame.shape}, expected {shape}")
        _expect(seen.frame.dtype == np.uint8, f"the frame is {seen.frame.dtype}, expected uint8")
        _expect(float(seen.frame.std()) > 2.0, "the frame shows one flat colour")
        known = isinstance(seen.command, Command)  # pyright: ignore[reportUnnecessaryIsInstance]
        _expect(known, f"the command is {seen.command!r}, expected a Command")
        _expect(seen.picture is None, "a full picture came without being asked for")
        _expect(not seen.done, "the drive is done at its start")
        _expect(not seen.events, f"there are events at the start: {seen.events}")
        return f"{shape[1]}×{shape[0]} uint8"

    def picture(self) -> str:
        seen, camera = self._simulator.reset(self._scenario, full_pictures=True), self._simulator.camera
        picture = _picture(seen)
        shape = (camera.height_px, camera.width_px, 3)
        _expect(picture.shape == shape, f"the picture is {picture.shape}, expected {shape}")
        off = float(np.abs(self._simulator.input(picture).astype(float) - seen.frame).mean())
        _expect(off < 8.0, f"the frame and the crop of the picture differ by {off:.1f} levels on average")
        return f"the frame is its crop within {off:.1f} levels"

    def start(self) -> str:
        state, wanted = self._simulator.reset(self._scenario).state, self._scenario.start
        away = math.hypot(state.x_m - wanted.x_m, state.y_m - wanted.y_m)
        turned = abs((state.yaw_rad - wanted.yaw_rad + math.pi) % (2 * math.pi) - math.pi)
        _expect(away < 0.1 and turned < 0.02, f"{away:.2f} m and {turned:.3f} rad from the scenario's start")
        return f"{away:.3f} m and {turned:.4f} rad from the scenario's start"

    def clock(self) -> str:
        dt = self._simulator.dt_s
        times = [seen.time_s for seen in self._drive(AHEAD)]
        off = float(np.abs(np.array(times) - dt * np.arange(len(times))).max())
        _expect(off < 1e-6, f"time_s is up to {off:.4f} s off multiples of dt_s")
        return f"{dt} s a step"

    def units(self) -> str:
        """Speed is what positions say, and throttle makes it."""
        seen = self._drive(AHEAD)
        states = [observation.state for observation in seen[len(seen) // 2 :]]
        _expect(states[-1].speed_mps > 0.5, f"{states[-1].speed_mps:.2f} m/s after {len(seen)} steps of throttle")
        moved = [math.hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in itertools.pairwise(states)]
        by_position = sum(moved) / (len(moved) * self._simulator.dt_s)
        by_speed = sum(0.5 * (a.speed_mps + b.speed_mps) for a, b in itertools.pairwise(states))
        ratio = by_position / max(by_speed / len(moved), 1e-6)
        _expect(0.9 < ratio < 1.1, f"the car moves {ratio:.2f} times as fast as speed_mps says")
        return f"moves {ratio:.3f} times as fast as speed_mps says"

    def steering(self) -> str:
        right, left = (self._drive(Control(steer, throttle=0.6))[-1].state for steer in (0.4, -0.4))
        middle = self._drive(AHEAD)[-1].state.yaw_rad
        by_right, by_left = ((state.yaw_rad - middle + math.pi) % (2 * math.pi) - math.pi for state in (right, left))
        _expect(by_right < -0.01, f"steer +0.4 turns the yaw by {by_right:+.3f} rad, expected to the right (−)")
        _expect(by_left > 0.01, f"steer −0.4 turns the yaw by {by_left:+.3f} rad, expected to the left (+)")
        return f"steer ±0.4 turns by {by_right:+.2f} and {by_left:+.2f} rad"

    def refusals(self) -> str:
        try:
            self._simulator.reset(self._scenario, cars=-1)
        except SimulatorError as error:
            _expect("\n" not in str(error), "the refusal of −1 cars has more than one line")
            return "−1 cars are refused"
        raise BrokenPromiseError("−1 cars were accepted")

    def determinism(self) -> str:
        first, second = (self._drive(AHEAD, cars=3, pedestrians=3, seed=5) for _ in range(2))
        _same(first, second, "the same drive twice")
        return f"{self._steps} steps with traffic, twice the same to the bit"

    def reset_is_complete(self) -> str:
        fresh = self._drive(AHEAD)
        self._drive(
            Control(-0.3, throttle=0.8),
            pattern=uniform(255, 0, 0),
            weather=Weather.CLEAR_SUNSET,
            cars=4,
            full_pictures=True,
        )
        _same(fresh, self._drive(AHEAD), "a drive before and after another one")
        return "nothing of another drive is left"

    def frames(self) -> str:
        """What is asked for is seen, whatever else is."""
        asked = frozenset({0, self._steps})
        whole, some = self._drive(AHEAD, full_pictures=True), self._drive(AHEAD, frames=asked)
        _same([whole[k] for k in sorted(asked)], [some[k] for k in sorted(asked)], "a drive with two frames")
        some = self._drive(AHEAD, frames=frozenset(), full_pictures=asked)
        whole, some = ([_in_full(seen[k]) for k in sorted(asked)] for seen in (whole, some))
        _same(whole, some, "a drive with two full pictures and no frames")
        return "those asked for are the same, whatever else is seen"

    def homography(self) -> str:
        seen = self._at_canvas(None)
        given = self._simulator.image_from_canvas()
        wanted = homography_from_pose(self._simulator.camera, seen.state, self._scenario.canvas)
        corners = np.array([[0.0, 0.0], [CANVAS_SIZE_PX - 1.0, 0.0], [200.0, 200.0]])
        off = float(np.abs(apply_homography(given, corners) - apply_homography(wanted, corners)).max())
        _expect(off < 0.1, f"image_from_canvas is {off:.2f} px off what camera, pose and canvas say")
        return f"within {off:.4f} px of what camera, pose and canvas say"

    def paint(self) -> str:
        """Painted squares are seen where the homography says."""
        bare, full = (_picture(self._at_canvas(pattern)) for pattern in (None, uniform(255, 255, 255)))
        homography, camera = self._simulator.image_from_canvas(), self._simulator.camera
        errors: list[float] = []
        for left, top in SQUARES:
            pattern = np.zeros((CANVAS_SIZE_PX, CANVAS_SIZE_PX, 4), np.uint8)
            pattern[top : top + SQUARE_PX, left : left + SQUARE_PX] = 255
            found = _middle(_picture(self._at_canvas(pattern)), bare, full)
            errors.append(float(np.linalg.norm(found - _expected_middle(homography, camera, left, top))))
        worst = max(errors)
        _expect(
            worst < PLACE_TOLERANCE_PX, f"squares are seen up to {worst:.2f} px from where the homography puts them"
        )
        return f"squares are seen within {worst:.2f} px of where the homography puts them"

    def transparency(self) -> str:
        clear = uniform(255, 0, 255)
        clear[..., 3] = 0
        off = np.abs(self._at_canvas(None).frame.astype(int) - self._at_canvas(clear).frame)
        _expect(int(off.max()) == 0, f"a transparent pattern changes the frame by up to {int(off.max())} levels")
        return "a transparent pattern is not seen"

    def colours(self) -> str:
        black, grey, white = (
            _picture(self._at_canvas(uniform(level, level, level))).astype(float) for level in (0, 128, 255)
        )
        inside = (white - black).max(axis=-1) > 40
        _expect(int(inside.sum()) > 50, f"only {int(inside.sum())} pixels tell white paint from black")
        off = np.abs(grey - (black + (white - black) * 128 / 255))[inside]
        _expect(float(off.mean()) < COLOUR_TOLERANCE, f"grey paint is {off.mean():.1f} levels off linear on average")
        return f"grey paint is within {off.mean():.2f} levels of linear on average"

    def _drive(self, control: Control, **asked: Any) -> list[Observation]:  # noqa: ANN401
        """A short drive with one control; `asked` goes to its reset."""
        first = self._simulator.reset(self._scenario, **asked)
        return [first, *(self._simulator.step(control) for _ in range(self._steps))]

    def _at_canvas(self, pattern: PatternImage | None) -> Observation:
        """The view from before the canvas, always from the same place."""
        if self._near is None:
            self._near = dataclasses.replace(self._scenario, start=self._before_canvas())
        return self._simulator.reset(self._near, pattern=pattern, full_pictures=True)

    def _before_canvas(self) -> VehicleState:
        """Drive up to the canvas."""
        canvas = self._scenario.canvas
        state = self._simulator.reset(self._scenario).state
        for _ in range(APPROACH_STEPS):
            dx, dy = canvas.x_m - state.x_m, canvas.y_m - state.y_m
            if dx * math.cos(state.yaw_rad) + dy * math.sin(state.yaw_rad) < VIEW_M:
                return dataclasses.replace(state, speed_mps=0.0)
            state = self._simulator.step(AHEAD).state
        raise BrokenPromiseError(
            f"the canvas is not within {VIEW_M:.0f} m after {APPROACH_STEPS} steps of throttle straight on"
        )


def _picture(seen: Observation) -> UInt8[np.ndarray, "h w 3"]:
    if seen.picture is None:
        raise BrokenPromiseError("no full picture, though it was asked for")
    return seen.picture


def _in_full(seen: Observation) -> Observation:
    """An observation whose frame is its full picture."""
    return dataclasses.replace(seen, frame=_picture(seen))


def _same(first: list[Observation], second: list[Observation], what: str) -> None:
    for step, (a, b) in enumerate(zip(first, second, strict=True)):
        levels = int(np.abs(a.frame.astype(int) - b.frame).max())
        _expect(levels == 0, f"{what}: pictures differ by up to {levels} levels at step {step}")
        _expect(dataclasses.astuple(a.state) == dataclasses.astuple(b.state), f"{what}: states differ at step {step}")
        _expect(a.events == b.events, f"{what}: events differ at step {step}")


def _middle(
    painted: UInt8[np.ndarray, "h w 3"], bare: UInt8[np.ndarray, "h w 3"], full: UInt8[np.ndarray, "h w 3"]
) -> Float[np.ndarray, "2"]:
    """Centre of gravity of the paint: what changed, as a share of what a canvas all in paint changes."""
    whole = (full.astype(float) - bare).sum(axis=-1)
    share = np.where(whole > 30, (painted.astype(float) - bare).sum(axis=-1) / np.maximum(whole, 30), 0.0)
    _expect(float(share.sum()) > 10, "a white square on the canvas is not seen")
    y, x = np.mgrid[0 : share.shape[0], 0 : share.shape[1]]
    return np.array([(share * x).sum(), (share * y).sum()]) / share.sum()


def _expected_middle(image_from_canvas: Homography, camera: CameraModel, left: int, top: int) -> Float[np.ndarray, "2"]:
    """Centre of gravity in the picture of a square on the canvas."""
    inside = (np.arange(40) + 0.5) / 40 * SQUARE_PX - 0.5
    x, y = np.meshgrid(left + inside, top + inside)
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    seen, right, below = (
        camera.distorted(homogeneous(image_from_canvas, points + moved)) for moved in ((0, 0), (1e-4, 0), (0, 1e-4))
    )
    area = np.abs(np.linalg.det(np.stack([right - seen, below - seen], axis=-1)))[:, None]
    return (seen * area).sum(axis=0) / area.sum()
