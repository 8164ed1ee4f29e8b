"""What roadproof's own measures on recordings share: many points valued a batch at a time, with their gradients."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TypeVar, cast

import torch
from torch import Tensor

from roadproof.attacks.groups import Group, Points, Values
from roadproof.compositing.variation import Variation
from roadproof.controllers import Controller
from roadproof.search_space import SearchSpace

MeasureT = TypeVar("MeasureT", bound="BatchedMeasure")


PICTURE_MB = 16
"""What a picture takes on a GPU while its gradient is wanted, in shipped controllers: at most 11 measured."""


def pictures_at_once(device: torch.device, usual: int) -> int:
    """How many pictures whose gradients are kept are shown at once.

    On a GPU as many as a quarter of its memory holds, which leaves room for larger controllers; on a CPU `usual`.
    """
    if device.type != "cuda":
        return usual
    # Of all its memory, not of what is free: another batch has other last digits.
    whole = cast("int", torch.cuda.get_device_properties(device).total_memory)
    return max(1, whole // (4 * PICTURE_MB * 2**20))


class BatchedMeasure(ABC):
    """Values points of a search space with gradients, no more at once than memory holds.

    Unlike a measure of the user's own it can be had for some of its groups alone, with other looks, and so that its
    steps can be replayed.
    """

    groups: tuple[Group, ...]
    controller: Controller
    variation: Variation | None
    frames_evaluated: int

    @property
    def is_derived(self) -> bool:
        """Whether a user has derived it from one of roadproof's own, so that little is known of what it does."""
        return not type(self).__module__.startswith("roadproof.")

    @abstractmethod
    def of_groups(self: MeasureT, kept: Sequence[int]) -> MeasureT:
        """The same measure for some of its groups alone; its frames are counted from nought."""

    @abstractmethod
    def of_controller(self: MeasureT, controller: Controller) -> MeasureT:
        """The same measure of a controller with the same answers up to rounding."""

    @abstractmethod
    def replayable(self: MeasureT) -> MeasureT | None:
        """The measure with the same operations on tensors of the same shapes in every step; None with a variation.

        It paints densely, and does not look whether what it computes is finite: whoever asks it for values has to. Its
        frames are counted from nought.
        """

    @abstractmethod
    def redraw(self, seed: int) -> None:
        """Take the mean over the looks of another seed from now on; does nothing without a variation."""

    @abstractmethod
    def valued(self, space: SearchSpace, unit: Points) -> Values:
        """Values of R points per group, all at once and differentiable in the points."""

    @abstractmethod
    def readings(self, space: SearchSpace, unit: Points) -> tuple[Values, Tensor | None]:
        """Steering shift and predictions of R points per group, as a `RecordedMeasure` has them."""

    @property
    @abstractmethod
    def at_once(self) -> int:
        """How many points of each group memory holds at once; less than one where it does not hold one."""

    def slope(self, gradient: Points) -> Points:
        """The direction and length of a step, from the gradient of the values: by default the gradient itself."""
        return gradient

    def values(self, space: SearchSpace, unit: Points) -> Values:
        """Values of R points per group of a search space, without gradients."""
        with torch.no_grad():
            return torch.cat([self.valued(space, part) for part in self._batches(unit)], 1)

    def values_and_gradients(self, space: SearchSpace, unit: Points) -> tuple[Values, Points]:
        """Values of R points per group of a search space, and their slopes."""
        values: list[Tensor] = []
        slopes: list[Tensor] = []
        for part in self._batches(unit):
            leaf = part.detach().requires_grad_()
            value = self.valued(space, leaf)
            (gradient,) = torch.autograd.grad(value.sum(), leaf)
            values.append(value.detach())
            slopes.append(self.slope(gradient))
        return torch.cat(values, 1), torch.cat(slopes, 1)

    def _batches(self, unit: Points) -> tuple[Tensor, ...]:
        """The points in as few parts as memory allows, as even as can be; at least one point a group each."""
        return unit.chunk(-(-unit.shape[1] // max(1, self.at_once)), 1)
