"""The published search: binary compositing and locally linearised gradients, to compare with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.surrogate import Surrogate
from roadproof.compositing.published import (
    RANGES,
    composite_published,
    local_gradients,
    view_canvas_published,
)
from roadproof.controllers import Controller
from roadproof.errors import PatternError
from roadproof.objectives import Group, divergence
from roadproof.recordings import RecordingSet
from roadproof.search_space import SearchSpace

COARSE_STEP, FINE_STEP = 10.0, 1.0
"""Grid widths of the local linearisation before and after the first drop of the learning rate, as published."""


class PublishedSurrogate(Surrogate):
    """Divergence as the released code computes it, one restart after another.

    Takes the same arguments as `Surrogate`.
    """

    def __init__(
        self,
        recordings: RecordingSet,
        controller: Controller,
        groups: Sequence[Group],
        *,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__(recordings, controller, groups, device=device, dtype=dtype)
        drives = [group.select(recordings) for group in groups]
        self._published_views = [
            view_canvas_published(
                np.concatenate([drive.frames for drive in members]),
                np.concatenate([drive.image_from_canvas for drive in members]),
                recordings.view,
                recordings.colour,
                device=device,
            )
            for members in drives
        ]

    def fingerprint(self) -> str:
        """Another search than the exact one on the same drives."""
        return f"published {super().fingerprint()}"

    def values(self, space: SearchSpace, unit: Float[Tensor, "g r k n"]) -> Float[Tensor, "g r"]:
        """δ per frame at points of the published search space."""
        with torch.no_grad():
            rows = [
                torch.stack([self._value(group, self._frames(space, group, point)) for point in points])
                for group, points in enumerate(unit)
            ]
        return torch.stack(rows)

    def values_and_gradients(
        self, space: SearchSpace, unit: Float[Tensor, "g r k n"], *, coarse: bool = False
    ) -> tuple[Float[Tensor, "g r"], Float[Tensor, "g r k n"]]:
        """δ per frame and the paper's approximation of its gradient."""
        values = unit.new_empty(unit.shape[:2])
        gradients = torch.empty_like(unit)
        for group, points in enumerate(unit):
            for restart, point in enumerate(points):
                frames = self._frames(space, group, point).requires_grad_()
                value = self._value(group, frames)
                (on_frames,) = torch.autograd.grad(value, frames)
                values[group, restart] = value.detach()
                gradients[group, restart] = self._gradient(space, group, point, on_frames, coarse=coarse)
        return values, gradients

    def _frames(self, space: SearchSpace, group: int, point: Float[Tensor, "k n"]) -> Float[Tensor, "f h w 3"]:
        if space.family != "published" or not space.colour or space.max_painted_share is not None:
            raise PatternError("the published gradient needs coloured rectangles of the published family, no area limit")
        return composite_published(space.pattern(point), self._published_views[group])

    def _value(self, group: int, frames: Float[Tensor, "f h w 3"]) -> Float[Tensor, ""]:
        steer = self._steer(frames.permute(0, 3, 1, 2).to(self.dtype), self._speed[group], self._command[group])
        return divergence(steer - self.clean_steer[group], self.lengths[group], self.groups[group].direction)

    def _gradient(
        self, space: SearchSpace, group: int, point: Tensor, on_frames: Tensor, *, coarse: bool
    ) -> Float[Tensor, "k n"]:
        ranges = point.new_tensor(RANGES)
        step = COARSE_STEP if coarse else FINE_STEP
        colours = space.pattern(point).colours
        view = self._published_views[group]
        shape, colour = local_gradients(point[:, :4] * ranges, colours, view, on_frames, step=step)
        darkest, brightest = space.albedo
        return torch.cat([shape * ranges, colour * (brightest - darkest)], -1)
