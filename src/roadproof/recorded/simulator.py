"""The recorded world behind the protocol of simulators: whatever drives in the town drives in calibrated recordings.

    with RecordedSimulator(load_recordings(Path("out/runs/left-03/recordings"))) as world:
        episode = rollout(world, controller, world.scenario, pattern=pattern)

What comes of it is predicted: nothing is driven for real. There is no map either, so nothing is known of infractions.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image

from roadproof.compositing.raster import composite_raster
from roadproof.datatypes import Command, Control, Ending, Observation, VehicleState, Weather
from roadproof.errors import SimulatorError
from roadproof.geometry import CanvasPlacement, homography_from_pose
from roadproof.homographies import Homography
from roadproof.io.files import is_plain_name
from roadproof.io.identity import digest
from roadproof.recorded.nearest import Apart, Gap, Poses
from roadproof.recorded.vehicle import Motion, Vehicle
from roadproof.recorded.world import BiasedStart, RecordedWorld
from roadproof.recordings import RecordingSet
from roadproof.scenarios import Kind, Scenario
from roadproof.simulators.protocol import PaintKind, PatternImage
from roadproof.simulators.tracker.drive import DriveTracker, Request
from roadproof.simulators.tracker.simulator import TrackedSimulator

FURTHEST_ASIDE_M = 3.0
"""A picture moved further to the side than this shows too much that was never recorded, so the drive ends."""

FURTHEST_TURNED_RAD = 0.6
"""The same for its turn: at more than a third of the field of view, too much of the picture is made up."""

SAME_PLACE_M = 0.01
"""A scenario's canvas is that of the recordings within this."""

SLOWEST = 4.0
"""The time limit of the set's own scenario, in durations of the recorded clean drive."""

TURNS_RAD = 0.35
"""A clean drive that turns by more than this goes to the left or to the right; else straight on."""


class _Drive(DriveTracker):
    car: Motion
    pattern: PatternImage | None


def light_of(weather: str) -> Weather:
    """The weather that recordings call by a name; clear noon where they say none, or one that is none of `Weather`."""
    return Weather(weather) if weather in set(Weather) else Weather.CLEAR_NOON


class RecordedSimulator(TrackedSimulator[_Drive]):
    """Drives in calibrated recordings, as a `Simulator`.

    A drive begins where the recorded stretch of the clean drive begins, at its speed there; a scenario that starts near
    that place, as `scenario` with another start, begins where it says. It ends at the canvas' end. Where the car leaves
    the band in which pictures can be trusted, it ends as well, and the ending says so.

    There are no full pictures. Where they are asked for, the frame is enlarged to the place that it has in the camera
    picture; around it, where nothing was recorded, the picture is black.

    A reset refuses other weathers than that of the recordings, others on the road, and a canvas elsewhere. The
    scenario's time limit counts from the beginning of the stretch; its goal and its map, and the seed, do not count.

    Args:
        recordings: calibrated recordings with a canvas and the tracks of all drives, the clean drive among them.
        vehicle: model of how the car answers to controls; None identifies it from the drives.
        weather: weather in whose light the set was recorded, by default what the set says (`light_of`); drives in
            another weather are refused.
        device: torch device on which pictures are made.

    Raises:
        RecordingError: there is no clean drive, poses are not known, or the vehicle cannot be identified.
        SimulatorError: the vehicle's time step is not the recordings'.
    """

    paint = PaintKind.COMPOSITED
    """How patterns are put on the road: composited into the pictures."""

    def __init__(
        self,
        recordings: RecordingSet,
        *,
        vehicle: Vehicle | None = None,
        weather: Weather | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        self.recordings = recordings
        self._given = vehicle
        self._world = RecordedWorld(recordings, vehicle=vehicle, device=device)
        super().__init__(recordings.camera, recordings.view, self._world.course.dt_s)
        self._weather = light_of(recordings.recordings[0].weather) if weather is None else Weather(weather)

    @cached_property
    def identity(self) -> str:
        """A hash of frames, poses, colours and of a given vehicle: other recordings are another world.

        A vehicle that is identified in them differs in its last digits from one kind of processor to another.
        """
        return digest(f"{self._given} {self.recordings.digest()}")

    @cached_property
    def scenario(self) -> Scenario:
        """The recorded stretch as a scenario: from its first frame to the canvas' end; no simulator has its map."""
        course = self._world.course
        first, last = course.first, course.first + course.count - 1
        goal_x_m, goal_y_m = self.way[-1].tolist()
        turned = float(course.poses.yaw_rad[last] - course.poses.yaw_rad[first])
        kind: Kind = "straight" if abs(turned) <= TURNS_RAD else "left" if turned > 0 else "right"
        name = self.recordings.origin.split(",")[0].strip()
        return Scenario(
            name=name if is_plain_name(name) else "recorded",
            kind=kind,
            map_name="recorded",
            start=self._state(self._world.begin()),
            goal_m=(goal_x_m, goal_y_m),
            canvas=course.canvas,
            time_limit_s=SLOWEST * course.count * course.dt_s,
        )

    @property
    def way(self) -> Float[np.ndarray, "n 2"]:
        """World x, y of the recorded clean drive along the stretch."""
        course, canvas = self._world.course, self._world.bank.canvas
        stretch = slice(course.first, course.first + course.count)
        path = torch.stack([course.poses.x_m[stretch] + canvas.x_m, course.poses.y_m[stretch] + canvas.y_m], 1)
        return path.cpu().numpy()

    @property
    def gap(self) -> Apart:
        """How far the car is from the recorded pose that its picture is made from.

        Raises:
            SimulatorError: no reset was made yet.
        """
        gap = self._world.bank.nearest(Poses(*self._running().car[:3]))
        return Apart(float(gap.ahead_m), float(gap.left_m), float(gap.turned_rad))

    def image_from_canvas(self) -> Homography:
        """The exact homography of the current state: canvas px to camera px.

        Raises:
            SimulatorError: no reset was made yet.
        """
        return homography_from_pose(self.camera, self.state, self._world.bank.canvas)

    def _begin(self, request: Request) -> _Drive:
        scenario = request.scenario
        if request.weather is not self._weather:
            raise SimulatorError(
                f"the recordings have one light, called {self._weather}, so there is no drive at {request.weather}; "
                "record one"
            )
        if request.cars or request.pedestrians:
            raise SimulatorError(
                f"{request.cars} cars and {request.pedestrians} pedestrians are asked for, but recordings hold no "
                "others on the road; expected 0 of both"
            )
        check_recorded_canvas(scenario.canvas, self._world.bank.canvas)
        drive = _Drive(request, self.dt_s)
        drive.pattern = request.pattern
        self._put(drive, self._world.begin((self._start(scenario.start),)))
        return drive

    def _advance(self, drive: _Drive, control: Control) -> None:
        controls = torch.tensor([[control.steer, control.throttle, control.brake]], dtype=torch.float64)
        self._put(drive, self._world.step(drive.car, controls.to(self._world.device)))

    def _put(self, drive: _Drive, car: Motion) -> None:
        drive.car, drive.state = car, self._state(car)

    def _start(self, asked: VehicleState) -> BiasedStart:
        """The offset of an asked start from the recorded one; zero if it is at another place."""
        here = self.scenario.start
        dx, dy = asked.x_m - here.x_m, asked.y_m - here.y_m
        c, s = math.cos(here.yaw_rad), math.sin(here.yaw_rad)
        turned = math.remainder(asked.yaw_rad - here.yaw_rad, 2 * math.pi)
        right_m = s * dx - c * dy
        if abs(c * dx + s * dy) > SAME_PLACE_M or not _can_be_shown(right_m, turned):
            return BiasedStart()
        return BiasedStart(right_m=right_m, turned_rad=turned, faster_mps=asked.speed_mps - here.speed_mps)

    def _state(self, car: Motion) -> VehicleState:
        canvas = self._world.bank.canvas
        x, y, yaw, speed = (float(value) for value in (car.x_m, car.y_m, car.yaw_rad, car.speed_mps))
        return VehicleState(x + canvas.x_m, y + canvas.y_m, canvas.z_m, yaw, speed)

    def _observe(self, drive: _Drive) -> Observation:
        course, poses = self._world.course, Poses(*drive.car[:3])
        nearest = self._world.bank.nearest(poses)
        shown = drive.shows_frame or drive.shows_picture
        frame = self._frame(poses, nearest, drive.pattern) if shown else self._black
        ending = None
        if not _can_be_shown(float(nearest.left_m), float(nearest.turned_rad)):
            ending = Ending.LEFT_RECORDED
        elif course.locate(poses).s_m >= course.arclength_m[course.first + course.count - 1]:
            ending = Ending.GOAL_REACHED
        elif drive.time_is_up:
            ending = Ending.TIME_LIMIT
        command = Command(int(self._world.bank.command[nearest.frame]))
        return drive.observation(frame, self._enlarged(frame) if drive.shows_picture else None, command, ending)

    def _frame(self, poses: Poses, nearest: Gap, pattern: PatternImage | None) -> UInt8[np.ndarray, "h w 3"]:
        with torch.no_grad():
            views = self._world.bank.show(poses, nearest, to_paint=pattern is not None)
            frames = views.frames
            if pattern is not None and views.canvas is not None:
                frames = composite_raster(pattern, frames, views.canvas)
        return (frames[0] * 255).round().to(torch.uint8).permute(1, 2, 0).contiguous().cpu().numpy()

    def _enlarged(self, frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "hc wc 3"]:
        """A black camera picture with the frame at the place it was cut from."""
        view, camera = self.input, self.camera
        picture = Image.new("RGB", (camera.width_px, camera.height_px))
        size = (view.right_px - view.left_px, view.bottom_px - view.top_px)
        picture.paste(Image.fromarray(frame).resize(size, Image.Resampling.NEAREST), (view.left_px, view.top_px))
        return np.asarray(picture)


def _can_be_shown(aside_m: float, turned_rad: float) -> bool:
    """Whether a picture made so far from the pose of its recorded frame can be trusted."""
    return abs(aside_m) <= FURTHEST_ASIDE_M and abs(turned_rad) <= FURTHEST_TURNED_RAD


def check_recorded_canvas(asked: CanvasPlacement, recorded: CanvasPlacement) -> None:
    """Check that recordings are of the stretch of road that is to be driven.

    Args:
        asked: canvas of the scenario that is to be driven.
        recorded: the canvas of the recordings.

    Raises:
        SimulatorError: the two lie apart or differ in size; the message says by how much.
    """
    turned = math.remainder(asked.yaw_rad - recorded.yaw_rad, 2 * math.pi)
    same = replace(asked, yaw_rad=recorded.yaw_rad + turned)
    # Radians count as metres do: so far is what lies a metre from the middle moved by a turn.
    off = {name: abs(getattr(same, name) - getattr(recorded, name)) for name in CanvasPlacement.__slots__}
    worst = max(off, key=lambda name: off[name])
    if off[worst] > SAME_PLACE_M:
        raise SimulatorError(
            f"the scenario's canvas has {worst} {getattr(asked, worst):g}, that of the recordings "
            f"{getattr(recorded, worst):g}; drive the scenario that was recorded"
        )
