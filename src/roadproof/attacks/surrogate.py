"""The surrogate an attack searches on: recorded frames with a pattern composited in, shown to the controller.

Its numbers are predictions for drives near the recorded ones; what a car really does is measured by driving.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.batched import BatchedMeasure, pictures_at_once
from roadproof.attacks.groups import STEERED, Group, Points, Values, divergence, require_directions
from roadproof.compositing import CanvasView, Compositor, view_canvas
from roadproof.compositing.variation import Looks, Variation
from roadproof.controllers import Controller
from roadproof.controllers.asking import require_size, steer_of
from roadproof.controllers.identity import identity_of
from roadproof.errors import ControllerError, GeometryError
from roadproof.io.identity import digest, stated
from roadproof.io.known import known_by
from roadproof.patterns import Pattern
from roadproof.photometry import PixelMaps
from roadproof.recordings import Recording, RecordingSet
from roadproof.search_space import SearchSpace

FIXED = 0
"""The seed of the looks in which patterns are compared, whatever step of a search they come from."""

MAX_FRAMES = 256
"""Frames a controller on a CPU sees at once: bounds memory, and more make none faster."""


class Surrogate(BatchedMeasure):
    """Divergence of patterns on a set of recordings, for every group at once, with gradients.

    Args:
        recordings: calibrated recordings of the drives.
        controller: the controller that is attacked, on `device`; it is given float32 frames, whatever it computes in.
        groups: groups of drives, each attacked together with patterns of its own.
        device: torch device on which frames are composited.
        variation: variation of paint and camera over which the mean is taken; None for paint and camera as recorded.

    Raises:
        ControllerError: the controller takes frames of another size, or answers NaN to clean frames.
        RecordingError: a group names drives that the set lacks, or is of the speed.
    """

    def __init__(
        self,
        recordings: RecordingSet,
        controller: Controller,
        groups: Sequence[Group],
        *,
        device: torch.device | str = "cpu",
        variation: Variation | None = None,
    ) -> None:
        size = recordings.view.height_px, recordings.view.width_px
        advice = "use a controller for this input, or record for this controller"
        require_size(controller, size, "the recordings have", advice)
        require_directions(groups, STEERED, "steering shift")
        self.groups = tuple(groups)
        self.recordings = recordings
        self.controller = controller
        self.frames_evaluated = 0
        self.variation = variation
        self._looks: Looks | None = None
        self._kept: dict[int, Compositor] = {}
        self._replayed = False
        drives = [group.select(recordings) for group in groups]
        self.lengths = [[len(drive.frames) for drive in members] for members in drives]
        self.views = [_view(recordings, members, device) for members in drives]
        self._speed = [_joined([drive.speed_mps for drive in members], device, torch.float32) for members in drives]
        self._command = [_joined([drive.command for drive in members], device, torch.int64) for members in drives]
        self.show_clean()

    @property
    def device(self) -> torch.device:
        """The torch device on which frames are composited."""
        return self.views[0].frames.device

    def thinned(self, every: int) -> Surrogate:
        """The surrogate on every n-th frame of each drive, or on all where none of those shows the canvas."""
        few = replace(self.recordings, recordings=tuple(r.thinned(every) for r in self.recordings.recordings))
        try:
            return type(self)(few, self.controller, self.groups, device=self.device, variation=self.variation)
        except GeometryError:
            return self

    def of_controller(self, controller: Controller) -> Surrogate:
        """The surrogate of a controller with the same answers up to rounding."""
        other = copy.copy(self)
        vars(other).update(controller=controller, frames_evaluated=0, _kept={})
        other.show_clean()
        return other

    def of_groups(self, kept: Sequence[int]) -> Surrogate:
        """The surrogate of some of its groups alone."""
        part = copy.copy(self)
        of_each = ("lengths", "views", "_speed", "_command", "clean_steer", "_clean_looked")
        vars(part).update({name: [vars(self)[name][k] for k in kept] for name in of_each}, _kept={})
        part.groups, part.frames_evaluated = tuple(self.groups[k] for k in kept), 0
        return part

    def replayable(self) -> Surrogate | None:
        """The surrogate with the same operations in every step, as `BatchedMeasure` says; None with a variation."""
        if self.variation is not None:
            return None
        same = copy.copy(self)
        views = [replace(view, dense=True) for view in self.views]
        vars(same).update(views=views, _kept={}, _replayed=True, frames_evaluated=0)
        return same

    def redraw(self, seed: int) -> None:
        """Take the mean over the looks of another seed from now on; does nothing without a variation."""
        if self.variation is None:
            return
        self._looks = looks = self.variation.draw(seed, self.device)
        with torch.no_grad():
            self._clean_looked = [
                self._steer(
                    looks.seen(view.clean_frames.repeat(len(looks), 1, 1, 1), len(looks)),
                    speed.repeat(len(looks)),
                    command.repeat(len(looks)),
                ).view(len(looks), -1)
                for view, speed, command in zip(self.views, self._speed, self._command, strict=True)
            ]

    def open_loop(self) -> Surrogate:
        """The surrogate itself, since it is open loop already."""
        return self

    def divergences(self, patterns: Sequence[Pattern]) -> Values:
        """δ per frame of R patterns for each group, differentiable in the patterns.

        Args:
            patterns: one batch of R patterns per group.
        """
        shifts = self.shifts(patterns)
        return torch.stack(
            [
                divergence(shift, lengths, group.direction)
                for shift, lengths, group in zip(shifts, self.lengths, self.groups, strict=True)
            ]
        )

    def shifts(self, patterns: Sequence[Pattern]) -> list[Float[Tensor, "r f"]]:
        """Steer on composited minus steer on clean frames, for every group, pattern and frame."""
        looks = self._looks
        if looks is not None:
            times = len(looks)
            repeated = [each.mapped(lambda part: part.repeat_interleave(times, 0)) for each in patterns]
            patterns = [looks.placed(each, self.recordings.canvas) for each in repeated]
        copies = len(patterns[0].boxes)
        frames = self._compositor(copies)(patterns, looks)
        if looks is not None:
            parts = cast("tuple[Tensor, ...]", frames.split([copies * len(view.frames) for view in self.views]))
            frames = torch.cat([looks.seen(part, copies) for part in parts])
        speed = torch.cat([part.repeat(copies) for part in self._speed])
        command = torch.cat([part.repeat(copies) for part in self._command])
        steer = self._steer(frames, speed, command)
        parts = cast("tuple[Tensor, ...]", steer.split([copies * len(view.frames) for view in self.views]))
        if looks is None:
            return [part.view(copies, -1) - clean for part, clean in zip(parts, self.clean_steer, strict=True)]
        return [
            (part.view(-1, len(looks), len(view.frames)) - clean).mean(1)
            for part, clean, view in zip(parts, self._clean_looked, self.views, strict=True)
        ]

    def valued(self, space: SearchSpace, unit: Points) -> Values:
        """δ per frame of R points per group, all at once and differentiable in the points."""
        return self.divergences([space.pattern(points) for points in unit])

    @property
    def at_once(self) -> int:
        """How many points of each group make no more frames than are shown at once."""
        looks = 1 if self._looks is None else len(self._looks)
        most = pictures_at_once(self.device, MAX_FRAMES)
        return most // (looks * sum(len(view.frames) for view in self.views))

    def readings(self, space: SearchSpace, unit: Points) -> tuple[Values, None]:
        """The mean steering shift per frame; None for the deviation, which the surrogate does not know."""
        return self.values(space, unit), None

    def fingerprint(self) -> str:
        """A digest of the drives with their colours, the controller and the groups: of all that values depend on."""
        view, steer = self.recordings.view, [each.cpu().numpy() for each in self.clean_steer]
        try:
            which = identity_of(self.controller, (view.height_px, view.width_px))
        except ControllerError:  # one that cannot drive is known by what it is and how it steers
            which = stated(known_by(self.controller))
        return digest(repr((self.groups, self.variation)), self.recordings.digest(), which, *steer)

    def show_clean(self) -> None:
        """Learn what the controller answers to the frames without paint."""
        with torch.no_grad():
            self.clean_steer = [
                self._steer(view.clean_frames, speed, command)
                for view, speed, command in zip(self.views, self._speed, self._command, strict=True)
            ]
        self._clean_looked = self.clean_steer
        self.redraw(FIXED)

    def _compositor(self, copies: int) -> Compositor:
        # Batches of a search are of one size, or two: the frames are kept until another size comes, and for good where
        # steps are replayed, which write to where they wrote before.
        if copies not in self._kept:
            if not self._replayed:
                self._kept.clear()
            self._kept[copies] = Compositor(self.views, copies)
        return self._kept[copies]

    def steer_of(self, frames: Float[Tensor, "f 3 h w"], group: int) -> Float[Tensor, " f"]:
        """The controller's answers to a group's frames, in whatever way they were painted."""
        return self._steer(frames, self._speed[group], self._command[group])

    def _steer(self, frames: Tensor, speed: Tensor, command: Tensor) -> Tensor:
        self.frames_evaluated += len(frames)
        return steer_of(self.controller, frames, speed, command, finite=not self._replayed).float()


def _view(recordings: RecordingSet, drives: Sequence[Recording], device: torch.device | str) -> CanvasView:
    return view_canvas(
        np.concatenate([drive.frames for drive in drives]),
        np.concatenate([drive.image_from_canvas for drive in drives]),
        recordings.view,
        recordings.colour,
        camera=recordings.camera,
        maps=PixelMaps.joined([drive.maps for drive in drives]),
        device=device,
    )


def _joined(parts: Sequence[np.ndarray], device: torch.device | str, dtype: torch.dtype) -> Tensor:
    return torch.tensor(np.concatenate(parts), device=device, dtype=dtype)
