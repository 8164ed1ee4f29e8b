"""What measures of drives in the recorded world share: patterns driven over side by side, with gradients.

Patterns × starts are driven side by side (`recorded.world`), in each weather that was recorded. A measure says what it
reads of each drive, such as the mean offset to the right in metres (`attacks.deviation`) or the mean change of the
speed in m/s (`attacks.speed`); the value of a pattern for a group is the mean of that over weathers, starts and looks,
positive in the group's direction.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Sequence
from threading import RLock
from typing import TypedDict, Unpack

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.batched import BatchedMeasure, pictures_at_once
from roadproof.attacks.groups import Group, Points, Values, to_side
from roadproof.attacks.surrogate import FIXED, Surrogate
from roadproof.compositing.variation import Looks, Variation
from roadproof.controllers import Controller
from roadproof.io.identity import digest
from roadproof.patterns import Pattern
from roadproof.recorded.world import UNSURE, Approach, BiasedStart, Predicted, RecordedWorld, Rolled
from roadproof.recordings import RecordingSet
from roadproof.search_space import SearchSpace

MAX_PICTURES = 800
"""Pictures whose gradients are kept at once on a CPU: bounds memory, and more make none faster."""


_ONCE = RLock()


class Rolling(TypedDict, total=False):
    """How patterns are driven over, beside what drives over them where.

    Args:
        starts: offsets from the clean drive at which the drives over each pattern begin; by default one, with none.
        every: number of steps from one picture to the next, 1 or more; 2 by default.
        device: torch device on which the cars drive, the CPU by default.
        variation: variation of paint and camera over which the mean is taken; None for paint and camera as recorded.
    """

    starts: tuple[BiasedStart, ...]
    every: int
    device: torch.device | str
    variation: Variation | None


class ClosedLoopMeasure(BatchedMeasure):
    """What patterns do to the drive in a recorded world, for every group at once.

    Args:
        recordings: recordings with canvas and tracks; the drives of each weather are a world of their own.
        controller: the controller that drives; it computes on `device`.
        groups: groups that state the directions; whatever group they belong to, all drives of the set are driven in.
        **rolling: starts, every, device and variation; see `Rolling`.

    Raises:
        RecordingError: the poses of a drive are not known, the vehicle cannot be identified, or a group has a direction
            that is not this measure's.
        ControllerError: the controller takes frames of another size, or answers NaN to clean frames.
    """

    def __init__(
        self, recordings: RecordingSet, controller: Controller, groups: Sequence[Group], **rolling: Unpack[Rolling]
    ) -> None:
        device, variation = rolling.get("device", "cpu"), rolling.get("variation")
        # Refuses controllers and groups that do not fit, and reads the steering shift in the end.
        self._steering = Surrogate(recordings, controller, self.steered(groups), device=device, variation=variation)
        self.groups = tuple(groups)
        self.controller = controller
        self.worlds = tuple(RecordedWorld(each, device=device) for each in recordings.by_weather())
        for world in self.worlds:
            world.fit(controller)
        self.device = torch.device(device)
        self.frames_evaluated = 0
        self._starts, self.every = rolling.get("starts", (BiasedStart(),)), rolling.get("every", 2)
        self.variation, self._looks = variation, variation and variation.draw(FIXED, self.device)
        self._bare: dict[tuple[int, int], Rolled] = {}
        self._unsure: dict[int, Rolled] = {}
        self._approaches: dict[tuple[int, int], Approach | None] = {}

    def steered(self, groups: Sequence[Group]) -> tuple[Group, ...]:
        """The groups whose steering shift stands beside a prediction: by default the same."""
        return tuple(groups)

    @abstractmethod
    def read(self, world: RecordedWorld, rolled: Rolled) -> Float[Tensor, " r"]:
        """What is made large, of each drive in one world: signed, differentiable in the patterns."""

    @abstractmethod
    def predict(self, world: RecordedWorld, patterns: Pattern, looks: Looks | None) -> Float[np.ndarray, "r s"]:
        """What is predicted of R patterns in one world, in each of the S drives with small errors."""

    @abstractmethod
    def open_loop(self) -> ClosedLoopMeasure | Surrogate:
        """The measure from which a search begins."""

    def thinned(self, every: int) -> ClosedLoopMeasure:
        """The same measure with a picture only every n steps, or as seldom as before: to choose among many starts."""
        thin = copy.copy(self)
        thin.every, thin.frames_evaluated = max(self.every, every), 0
        return thin

    def of_groups(self, kept: Sequence[int]) -> ClosedLoopMeasure:
        """The same measure for some of its groups alone."""
        part = copy.copy(self)
        part.groups, part.frames_evaluated = tuple(self.groups[k] for k in kept), 0
        vars(part)["_steering"] = self._steering.of_groups(kept)
        return part

    def of_controller(self, controller: Controller) -> ClosedLoopMeasure:
        """The same measure of a controller with the same answers up to rounding."""
        other = copy.copy(self)
        vars(other).update(controller=controller, frames_evaluated=0, _bare={}, _unsure={}, _approaches={})
        vars(other)["_steering"] = self._steering.of_controller(controller)
        return other

    def replayable(self) -> ClosedLoopMeasure | None:
        """The measure with the same operations in every step, as `BatchedMeasure` says; None with a variation."""
        if self.variation is not None:
            return None
        same = copy.copy(self)
        worlds = tuple(world.replayable() for world in self.worlds)
        # They ask for numbers from the device, which a replayed step may not.
        approaches = {(number, self.every): self._approach(usual) for number, usual in enumerate(self.worlds)}
        vars(same).update(worlds=worlds, frames_evaluated=0, _bare={}, _unsure={}, _approaches=approaches)
        return same

    def redraw(self, seed: int) -> None:
        """Take the mean over the looks of another seed from now on; does nothing without a variation."""
        if self.variation is not None:
            self._looks = self.variation.draw(seed, self.device)
            # Not cleared: a copy of this measure may have these drives with looks of its own.
            self._bare = {}

    def slope(self, gradient: Points) -> Points:
        """The gradient of each point, scaled to unit length.

        A closed loop amplifies, and by how much says nothing about how far a step should go.
        """
        flat = gradient.flatten(2)
        length = flat.square().sum(2, keepdim=True).sqrt().clamp_min(1e-12)
        return (flat / length).view_as(gradient)

    def readings(self, space: SearchSpace, unit: Points) -> tuple[Values, Float[Tensor, "g r s"]]:
        """Steering shift on the recorded frames, and what is predicted with small errors.

        The predictions of all weathers stand one after another.
        """
        patterns = space.pattern(unit.flatten(0, 1))
        looks = self.variation and self.variation.draw(FIXED, self.device, len(UNSURE))
        self._steering.redraw(FIXED)
        predicted = np.concatenate([self.predict(world, patterns, looks) for world in self.worlds], 1)
        return self._steering.values(space, unit), torch.tensor(predicted).view(*unit.shape[:2], -1)

    def predictions(self, world: RecordedWorld, patterns: Pattern, looks: Looks | None) -> Predicted:
        """What is predicted in one world with small errors; the drives over the bare road are made once."""
        # `readings` draws the same looks each time.
        number = self.worlds.index(world)
        with _ONCE, torch.no_grad():
            if number not in self._unsure:
                self._unsure[number] = world.roll(self.controller, starts=UNSURE, looks=looks)
        return world.predict(self.controller, patterns, UNSURE, looks, self._unsure[number])

    def fingerprint(self) -> str:
        """A digest of drives, calibration, controller and starts, which tells this measure from others."""
        # Variation, drives and controller are in the fingerprint of the steering shift.
        more = repr((*self.told(), [each.vehicle for each in self.worlds]))
        return digest(more, self._steering.fingerprint())

    def told(self) -> tuple[object, ...]:
        """What tells this measure from others on the same drives."""
        return self._starts, self.every

    @property
    def at_once(self) -> int:
        """How many points of each group make no more pictures than are kept at once."""
        return pictures_at_once(self.device, MAX_PICTURES) // (
            len(self.groups) * sum(self._pictures(each, self._approach(each)) for each in self.worlds)
        )

    def valued(self, space: SearchSpace, unit: Points) -> Values:
        """Mean towards each group's direction, at R points per group, all at once and differentiable in the points."""
        patterns = space.pattern(unit.flatten(0, 1))
        each = [self.read(world, self.roll(world, patterns)) for world in self.worlds]
        read = torch.cat([part.view(*unit.shape[:2], -1) for part in each], -1)
        sides = [to_side(part, group.direction) for group, part in zip(self.groups, read, strict=True)]
        return torch.stack(sides).mean(-1).float()

    def roll(self, world: RecordedWorld, patterns: Pattern | None) -> Rolled:
        """The drives over each pattern in one world, or over the bare road: each start once with every look.

        Over patterns they begin where the canvas is well seen; up to there they are those over the bare road.
        """
        starts = tuple(start for start in self._starts for _ in range(self._times))
        after = None if patterns is None else self._approach(world)
        self.frames_evaluated += (1 if patterns is None else len(patterns.boxes)) * self._pictures(world, after)
        return world.roll(self.controller, patterns, starts=starts, every=self.every, looks=self._looks, after=after)

    def _approach(self, world: RecordedWorld) -> Approach | None:
        """The drives over the bare road up to where the canvas is well seen; made once, and not where looks change."""
        if self._looks is not None:
            return None
        key = (self.worlds.index(world), self.every)
        with _ONCE:
            if key not in self._approaches:
                self._approaches[key] = world.approach(self.controller, self._starts, self.every)
        return self._approaches[key]

    def bare(self, world: RecordedWorld) -> Rolled:
        """The drives over the bare road in one world, from each start with every look; made once."""
        key = (self.worlds.index(world), self.every)
        with _ONCE:  # groups are valued side by side
            if key not in self._bare:
                counted = self.frames_evaluated
                with torch.no_grad():
                    self._bare[key] = self.roll(world, None)
                # Not part of a search's cost: every process that values a group makes them again.
                self.frames_evaluated = counted
        return self._bare[key]

    def changed(self, world: RecordedWorld, rolled: Rolled, of: Callable[[Rolled], Float[Tensor, "_ t"]]) -> Tensor:
        """A quantity of drives less that of the drives over the bare road from the same start in the same look."""
        now, bare = of(rolled), of(self.bare(world))
        return now - bare.repeat(len(now) // len(bare), 1)

    def _pictures(self, world: RecordedWorld, after: Approach | None) -> int:
        """Number of pictures that all drives over one pattern take, or those that go on from an approach."""
        steps = world.course.count - (0 if after is None else after.step)
        return len(self._starts) * self._times * -(-steps // self.every)

    @property
    def _times(self) -> int:
        return 1 if self._looks is None else len(self._looks)
