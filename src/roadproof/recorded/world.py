"""The recorded world: driving, with or without paint, in what calibrated recordings hold.

pose → picture → controller → vehicle → pose, for any number of cars at once, differentiable in the patterns.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.compositing.composite import composite_own
from roadproof.compositing.variation import Looks
from roadproof.constants import constant
from roadproof.controllers import Controller
from roadproof.controllers.asking import next_controls_of, steer_of
from roadproof.driving.deviation import deviation_m
from roadproof.driving.starts import StartOffset
from roadproof.errors import RecordingError, SimulatorError
from roadproof.patterns import Pattern
from roadproof.recorded.course import Course, Place
from roadproof.recorded.nearest import Gap, Poses
from roadproof.recorded.obstacles import Obstacles
from roadproof.recorded.pictures import FrameBank
from roadproof.recorded.vehicle import Motion, Vehicle, followed
from roadproof.recordings import RecordingSet

PAST_M = 1.0
"""So far beyond the last recorded frame a picture can still be made."""

AT_ONCE = {"cpu": 32, "cuda": 512}
"""Drives rolled side by side where there may be thousands: more make no CPU faster, and a GPU holds more."""

SEEN = 0.01
"""Where the canvas covers less of the picture than this share, paint hardly moves a car (measured)."""

_LOOK_AHEAD_M, _LOOK_AHEAD_S = 1.5, 0.5


@dataclass(frozen=True, kw_only=True, slots=True)
class BiasedStart(StartOffset):
    """How a drive's start differs from the clean drive's, and its steering from the controller's.

    Args:
        steer: steer added to all of the controller's answers, which stands for the errors of pictures.
    """

    steer: float = 0.0


UNSURE = (
    *(BiasedStart(steer=steer) for steer in (-0.02, -0.01, 0.0, 0.01, 0.02)),
    *(BiasedStart(right_m=right_m) for right_m in (-0.1, 0.1)),
    *(BiasedStart(faster_mps=faster_mps) for faster_mps in (-0.3, 0.3)),
)
"""Drives that show whether a prediction hangs by a thread: pictures are wrong by about so much steering (measured), and
a car comes to the paint a little beside its clean path, or at another speed."""


@dataclass(frozen=True, slots=True, eq=False)
class Rolled:
    """R drives in the recorded world, T instants each.

    Args:
        x_m: world x of each car at each instant, metres, (R, T); y_m likewise.
        yaw_rad: heading, radians, left positive, (R, T).
        speed_mps: forward speed, m/s, (R, T).
        right_m: offset from the recorded clean path, metres, right positive, (R, T); differentiable in the patterns.
        steer: steer given at each instant, (R, T).
        left_m: distance to the left of the recorded frame that the picture was made from, metres, (R, T).
        turned_rad: turn to the left from that frame, radians, (R, T).
    """

    x_m: Float[Tensor, "r t"]
    y_m: Float[Tensor, "r t"]
    yaw_rad: Float[Tensor, "r t"]
    speed_mps: Float[Tensor, "r t"]
    right_m: Float[Tensor, "r t"]
    steer: Float[Tensor, "r t"]
    left_m: Float[Tensor, "r t"]
    turned_rad: Float[Tensor, "r t"]

    def path(self, index: int) -> Float[np.ndarray, "t 2"]:
        """World x, y of one drive."""
        return torch.stack([self.x_m[index], self.y_m[index]], 1).detach().cpu().numpy()


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """Drives over the bare road from S starts, up to a step that cars may go on from.

    Args:
        step: the number of steps done.
        car: where the cars are then.
        controls: steer, throttle and brake that they were given last, (S, 3).
        memory: what the controller remembers.
        rows: the columns of `Rolled` at each step done.
    """

    step: int
    car: Motion
    controls: Float[Tensor, "s 3"]
    memory: object
    rows: tuple[tuple[Tensor, ...], ...]

    def repeated(self, times: int) -> Approach:
        """The same drives so many times, one set after the other; nothing may be remembered in them."""
        rows = tuple(tuple(column.repeat(times) for column in row) for row in self.rows)
        car = Motion(*(part.repeat(times) for part in self.car))
        return Approach(self.step, car, self.controls.repeat(times, 1), self.memory, rows)


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """What R patterns are predicted to do in each of S drives.

    Args:
        deviation_m: the paper's deviation from the bare drive from the same start, metres, (R, S).
        speed_change_mps: mean change of the speed from that drive (`driving.speed`), m/s, negative where the car is
            slower, (R, S).
    """

    deviation_m: Float[np.ndarray, "r s"]
    speed_change_mps: Float[np.ndarray, "r s"]


class RecordedWorld:
    """A set of recordings to drive in.

    Args:
        recordings: calibrated recordings with a canvas and the tracks of all drives, the clean drive among them.
        vehicle: model of how the car answers to controls; None identifies it from the drives.
        device: torch device on which pictures are made and cars are driven.

    Raises:
        RecordingError: there is no clean drive, the drives are of several weathers, poses are not known, or the vehicle
            cannot be identified.
        SimulatorError: the vehicle's time step is not the recordings'.
    """

    def __init__(
        self, recordings: RecordingSet, *, vehicle: Vehicle | None = None, device: torch.device | str = "cpu"
    ) -> None:
        weathers = sorted({drive.weather for drive in recordings.recordings})
        if len(weathers) > 1:
            raise RecordingError(
                f"the set has drives in {', '.join(weathers)}, a recorded world has one light; take one of by_weather()"
            )
        clean = recordings.clean
        if clean is None:
            raise RecordingError("the set has no clean drive, which a recorded world begins with; record one")
        self.bank = FrameBank(recordings, device=device)
        assert clean.track is not None
        tracks = [drive.track for drive in recordings.recordings if drive.track is not None]
        self.vehicle = vehicle or Vehicle.identified(tracks)
        self.course = Course(clean.track, self.bank.canvas, int(clean.frame_number[0]), device=device)
        if self.vehicle.dt_s != self.course.dt_s:
            raise SimulatorError(
                f"the vehicle has steps of {self.vehicle.dt_s} s, the recordings have {self.course.dt_s} s; expected "
                "one and the same"
            )
        reach, first = self.vehicle.steer_rate_per_s * self.vehicle.dt_s, self.course.first
        self._wheels = float(followed(self.course.steer.cpu().numpy(), reach)[max(first - 1, 0)])
        path = torch.stack(self.course.poses[:2], 1).cpu().numpy()
        middle = (self.course.canvas.x_m, self.course.canvas.y_m)
        self.obstacles = Obstacles(recordings.obstacles or (), path, middle, device=device)
        self._shown_m = float(self.course.locate(self.bank.poses).s_m.max()) + PAST_M
        self.device = self.bank.device
        self._replayed = False

    def replayable(self) -> RecordedWorld:
        """The same world, driven in by the same operations on tensors of the same shapes in every drive.

        It does not look whether poses and answers are finite: whoever drives in it has to.
        """
        same = copy.copy(self)
        vars(same).update(_replayed=True, bank=self.bank.replayable())
        return same

    def fit(self, controller: Controller) -> None:
        """Fit the law of steering on the bare road, from a controller's answers to all recorded frames.

        Raises:
            ControllerError: the controller raises, or answers wrongly.
        """
        frames = (self.bank.levels, self.bank.speed_mps, self.bank.command)
        with torch.no_grad():
            answers = torch.cat(
                [
                    steer_of(controller, levels / 255, speed, command).float()
                    for levels, speed, command in zip(*map(_in_parts, frames), strict=True)
                ]
            )
        self.course.fit_law(self.bank.poses, answers)

    def roll(
        self,
        controller: Controller,
        pattern: Pattern | None = None,
        *,
        starts: tuple[BiasedStart, ...] = (BiasedStart(),),
        every: int = 1,
        looks: Looks | None = None,
        after: Approach | None = None,
    ) -> Rolled:
        """Drive R cars past the canvas, closed loop.

        Args:
            controller: the controller, on the world's device; `fit` must have been called with it.
            pattern: batch of R / len(starts) patterns, each driven over from every start before the next one; None
                leaves the road bare.
            starts: offsets from the clean drive at which the drives begin.
            every: number of steps from one picture to the next, 1 or more; controls are held in between.
            looks: looks of paint and camera, given to the drives in turn; None for paint and camera as recorded.
            after: drives over the bare road from these starts (`approach`), which all go on from; None drives all the
                way.

        Raises:
            RecordingError: a car leaves all bounds, or its pose is NaN.
        """
        count = len(starts) * (1 if pattern is None else len(pattern.boxes))
        begun = self._at_start(starts) if after is None else after
        if pattern is not None:
            pattern = pattern.mapped(lambda part: part.repeat_interleave(len(starts), 0))
            pattern = pattern if looks is None else looks.placed(pattern, self.bank.canvas)
        off = self._offsets_of(starts)[:, 3].repeat(count // len(starts))
        begun = begun.repeated(count // len(starts))
        whole = self._driven(controller, pattern, begun, self.course.count, off, every=every, looks=looks)
        columns = [torch.stack(each, 1) for each in zip(*whole.rows, strict=True)]
        columns[0], columns[1] = columns[0] + self.course.canvas.x_m, columns[1] + self.course.canvas.y_m
        return Rolled(*columns)

    def approach(self, controller: Controller, starts: tuple[BiasedStart, ...], every: int = 1) -> Approach | None:
        """The drives over the bare road from each start, up to where the canvas covers `SEEN` of a picture.

        Returns:
            The drives; None where the canvas is seen from the first picture on, or the controller remembers pictures.
        """
        begun, off, end = self._at_start(starts), self._offsets_of(starts)[:, 3], self.course.count
        with torch.no_grad():
            while begun.step < end and float(self.covered(Poses(*begun.car[:3])).max()) < SEEN:
                begun = self._driven(controller, None, begun, min(begun.step + every, end), off, every=every)
        return None if begun.memory is not None or begun.step in (0, end) else begun

    def covered(self, poses: Poses) -> Float[Tensor, " r"]:
        """Which share of the picture at each pose the canvas covers, on the CPU."""
        canvas, view = self.bank.show(poses, self.bank.nearest(poses)).canvas, self.bank.view
        shown = torch.zeros(len(poses.x_m)) if canvas is None else canvas.valid.sum(1).cpu()
        return shown / (view.height_px * view.width_px)

    def _at_start(self, starts: tuple[BiasedStart, ...]) -> Approach:
        car = self.begin(starts)
        return Approach(0, car, torch.zeros(len(starts), 3, dtype=torch.float64, device=self.device), None, ())

    def _driven(
        self,
        controller: Controller,
        pattern: Pattern | None,
        begun: Approach,
        until: int,
        off: Float[Tensor, " r"],
        *,
        every: int,
        looks: Looks | None = None,
    ) -> Approach:
        """Drive on from where cars are, up to a step; `off` is added to the controller's steer."""
        course, car, controls, memory = self.course, begun.car, begun.controls, begun.memory
        rows = list(begun.rows)
        gap = self.bank.nearest(Poses(*car[:3]).detached())
        for step in range(begun.step, until):
            poses = Poses(*car[:3])
            place = course.locate(poses)
            if step % every == 0:
                gap = self.bank.nearest(poses.detached())
                frames = self._frames(pattern, poses, gap, looks, step)
                seen = (frames, car.speed_mps.float(), self.bank.command[gap.frame])
                elapsed_s = min(step, every) * self.vehicle.dt_s
                found, memory = next_controls_of(controller, memory, *seen, elapsed_s, finite=not self._replayed)
                answer = found.double()
                past = place.s_m > self._shown_m
                steer = torch.where(past, course.law(place), answer[:, 0] + off + course.feedback(place))
                steer = steer.clamp(-1.0, 1.0)
                pedals = answer[:, 1:] if answer.shape[1] == 3 else self._recorded_pedals(place, car)
                controls = torch.cat([steer[:, None], pedals], 1)
            here = (car.x_m, car.y_m, car.yaw_rad, car.speed_mps, place.right_m)
            rows.append((*here, controls[:, 0], gap.left_m, gap.turned_rad))
            car = self.step(car, controls)
        return Approach(until, car, controls, memory, tuple(rows))

    def step(self, car: Motion, controls: Float[Tensor, "r 3"]) -> Motion:
        """Where R cars are a time step later, given steer, throttle and brake; what stands in their way holds them."""
        after = self.vehicle.step(car, *controls.unbind(1))
        return self.obstacles.hold(car, after, self.vehicle.dt_s, asks=not self._replayed)

    def whole_path(self, rolled: Rolled, index: int) -> Float[np.ndarray, "n 2"]:
        """World x, y of one drive at all instants at which the canvas is in view.

        Before the first recorded frame the clean drive's own positions stand.
        """
        course = self.course
        before = slice(course.seen.start, course.first)
        x, y = (values[before].cpu().numpy() for values in (course.poses.x_m, course.poses.y_m))
        clean = np.stack([x + course.canvas.x_m, y + course.canvas.y_m], 1)
        return np.concatenate([clean, rolled.path(index)])

    def predict(
        self,
        controller: Controller,
        patterns: Pattern,
        starts: tuple[BiasedStart, ...] = (BiasedStart(),),
        looks: Looks | None = None,
        bare: Rolled | None = None,
    ) -> Predicted:
        """What each pattern of a batch is predicted to do to the path and to the speed, from each start.

        Args:
            controller: the controller, on the world's device; `fit` must have been called with it.
            patterns: batch of R patterns.
            starts: S offsets from the clean drive, from each of which every pattern is driven over.
            looks: one look per start, for the bare and the painted drive alike; None for paint and camera as recorded.
            bare: what `roll` gave for the bare road from these starts in these looks; None drives there now.
        """
        at_once = max(1, AT_ONCE[self.device.type] // len(starts))
        with torch.no_grad():
            bare = bare or self.roll(controller, starts=starts, looks=looks)
            each = [
                self.compared(
                    bare, self.roll(controller, patterns[first : first + at_once], starts=starts, looks=looks)
                )
                for first in range(0, len(patterns.boxes), at_once)
            ]
        return Predicted(
            np.concatenate([found.deviation_m for found in each]),
            np.concatenate([found.speed_change_mps for found in each]),
        )

    def compared(self, bare: Rolled, painted: Rolled) -> Predicted:
        """What R patterns do, from S drives over the bare road and R·S over the patterns from the same starts."""
        count, starts = len(painted.x_m), len(bare.x_m)
        paths = [self.whole_path(bare, k) for k in range(starts)]
        deviations = [deviation_m(paths[k % starts], self.whole_path(painted, k)) for k in range(count)]
        change = painted.speed_mps - bare.speed_mps.repeat(count // starts, 1)
        # Before the first recorded frame the two drives are one.
        share = self.course.count / (self.course.seen.stop - self.course.seen.start)
        changes = share * change.mean(1).view(-1, starts)
        return Predicted(np.array(deviations).reshape(-1, starts), changes.cpu().numpy())

    def begin(self, starts: tuple[BiasedStart, ...] = (BiasedStart(),)) -> Motion:
        """Cars at the first recorded frame of the clean drive, one for each start."""
        course, first = self.course, self.course.first
        right, turned, faster, _ = self._offsets_of(starts).unbind(1)
        yaw = course.poses.yaw_rad[first]
        o = torch.zeros_like(right)
        return Motion(
            course.poses.x_m[first] + torch.sin(yaw) * right,
            course.poses.y_m[first] - torch.cos(yaw) * right,
            yaw + turned,
            (course.speed_mps[first] + faster).clamp_min(0.0),
            o + course.curvature[first],
            o + self._wheels,
        )

    def _offsets_of(self, starts: tuple[BiasedStart, ...]) -> Float[Tensor, "s 4"]:
        """The numbers of some starts."""
        rows = tuple((start.right_m, start.turned_rad, start.faster_mps, start.steer) for start in starts)
        return constant(rows, self.course.arclength_m)

    def _frames(
        self, pattern: Pattern | None, poses: Poses, gap: Gap, looks: Looks | None, step: int
    ) -> Float[Tensor, "r 3 h w"]:
        """What R cars see."""
        with torch.no_grad():
            views = self.bank.show(poses.detached(), gap, to_paint=pattern is not None)
        frames = views.frames
        if pattern is not None and views.canvas is not None:
            frames = composite_own(pattern, frames, views.canvas, looks)
        if looks is not None:
            frames = looks.seen(frames, len(frames), step)
        return frames

    def _recorded_pedals(self, place: Place, car: Motion) -> Float[Tensor, "r 2"]:
        """Pedals that aim at the clean drive's speed a little way ahead, so that a car does not stand for ever."""
        ahead = _LOOK_AHEAD_M + _LOOK_AHEAD_S * car.speed_mps
        wanted = self.course.at(self.course.speed_mps, place.s_m + ahead)
        e, f, g, h, _ = self.vehicle.pulling
        pull = (wanted.square() - car.speed_mps.square()) / (2 * ahead) - g - h * car.speed_mps
        return torch.stack([(pull / e).clamp(0.0, 1.0), (pull / f).clamp(0.0, 1.0)], 1)


def _in_parts(values: Tensor) -> tuple[Tensor, ...]:
    return cast("tuple[Tensor, ...]", values.split(128))
