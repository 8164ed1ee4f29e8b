"""Groups of a search side by side, on a thread each.

Left to itself torch splits every single operation among its threads, which wait for each other after each, and beside
other work on the machine one of them is always late. Here each thread computes a group by itself from beginning to end.
Seconds a step of the search with PilotNet, on two cores (measured):

    rung                                     free: torch's way   here    beside two others: torch's way   here
    last, 6 starts in the recorded world                  1.0     1.2                       9.2 to 11.2    2.6
    first in the recorded world, 64 starts                2.7     2.7                         22 to 28     7.9
    steering shift, 48 starts                             1.1     1.1                          4 to 10     3.2
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar, cast

import torch
from torch import Tensor

from roadproof.attacks.batched import BatchedMeasure
from roadproof.attacks.groups import Group, Points, Values
from roadproof.attacks.objective import RecordedMeasure
from roadproof.controllers.precision import is_torch_alone
from roadproof.search_space import SearchSpace

Result = TypeVar("Result")


def side_by_side(measure: RecordedMeasure) -> Beside | RecordedMeasure:
    """The measure with its groups side by side, where there are threads for that; else the measure itself.

    A user's own code may not stand two calls at once, and a mean over new looks is drawn for all groups together: such
    measures stay as they are, and so does a measure on another device than the processor.
    """
    if not isinstance(measure, BatchedMeasure) or measure.variation is not None:
        return measure
    free = measure.device.type == "cpu" and torch.get_num_threads() > 1
    return Beside(measure) if free and is_torch_alone(measure.controller) else measure


class Beside:
    """A measure whose groups are valued side by side; of one group alone, two halves of its points.

    Values are those of the measure but for rounding: its batches are smaller.

    Args:
        whole: the measure. What is valued here counts among its `frames_evaluated`.
    """

    def __init__(self, whole: BatchedMeasure) -> None:
        self._whole = whole
        self._parts = [whole.of_groups([k]) for k in range(len(whole.groups))]
        if len(self._parts) == 1:
            self._parts.append(whole.of_groups([0]))
        self._threads = min(len(self._parts), torch.get_num_threads())

    @property
    def groups(self) -> tuple[Group, ...]:
        """The groups of the measure."""
        return self._whole.groups

    def values(self, space: SearchSpace, unit: Points) -> Values:
        """The values of R points per group, without gradients."""

        def valued(part: BatchedMeasure, points: Tensor) -> Tensor:
            return part.values(space, points)

        return self._joined(unit, self._each(valued, unit))

    def values_and_gradients(self, space: SearchSpace, unit: Points) -> tuple[Values, Points]:
        """The values of R points per group, and their gradients."""

        def climbed(part: BatchedMeasure, points: Tensor) -> tuple[Tensor, Tensor]:
            return part.values_and_gradients(space, points)

        each = self._each(climbed, unit)
        return self._joined(unit, [value for value, _ in each]), self._joined(unit, [slope for _, slope in each])

    def _joined(self, unit: Tensor, parts: Sequence[Tensor]) -> Tensor:
        return torch.cat(list(parts), 0 if len(unit) > 1 else 1)

    def _each(self, function: Callable[[BatchedMeasure, Tensor], Result], unit: Tensor) -> list[Result]:
        points = cast("tuple[Tensor, ...]", unit.split(1) if len(unit) > 1 else unit.tensor_split(2, 1))
        busy = [(part, some) for part, some in zip(self._parts, points, strict=True) if some.numel()]
        threads = torch.get_num_threads()
        own = (max(1, threads // self._threads),)
        try:
            with ThreadPoolExecutor(self._threads, initializer=torch.set_num_threads, initargs=own) as pool:
                return list(pool.map(function, *zip(*busy, strict=True)))
        finally:
            torch.set_num_threads(threads)
            for part in self._parts:
                self._whole.frames_evaluated += part.frames_evaluated
                part.frames_evaluated = 0
