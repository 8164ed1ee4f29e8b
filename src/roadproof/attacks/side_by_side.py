"""Groups of a search side by side, on a thread or in a process each.

Left to itself torch splits every single operation among its threads, which wait for each other after each, and beside
other work on the machine one of them is always late. Here each thread computes a group by itself from beginning to end.
Seconds a step of the search with PilotNet, on two cores (measured):

    rung                                     free: torch's way   here    beside two others: torch's way   here
    last, 6 starts in the recorded world                  1.0     1.2                       9.2 to 11.2    2.6
    first in the recorded world, 64 starts                2.7     2.7                         22 to 28     7.9
    steering shift, 48 starts                             1.1     1.1                          4 to 10     3.2

Threads of one process still wait for each other wherever Python goes from one small operation to the next. In
processes, where a run has several, the whole search took 80 s in place of 110 (PilotNet) and 90 in place of 116 (CIL).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeAlias, cast

import torch
from torch import Tensor

from roadproof.attacks.batched import BatchedMeasure
from roadproof.attacks.groups import Group, Points, Values
from roadproof.attacks.objective import RecordedMeasure
from roadproof.controllers.precision import is_torch_alone
from roadproof.machine import threads
from roadproof.processes import Pool
from roadproof.search_space import SearchSpace


def side_by_side(measure: RecordedMeasure, pool: Pool[Any] | None = None) -> Beside | RecordedMeasure:
    """The measure with its groups side by side, where there are threads for that; else the measure itself.

    A user's own code may not stand two calls at once, and a mean over new looks is drawn for all groups together: such
    measures stay as they are, and so does a measure on another device than the processor. In processes, where there are
    several, groups do not wait for each other as threads do.
    """
    if not isinstance(measure, BatchedMeasure) or measure.variation is not None:
        return measure
    free = measure.device.type == "cpu" and torch.get_num_threads() > 1
    return Beside(measure, pool) if free and is_torch_alone(measure.controller) else measure


class Beside:
    """A measure whose groups are valued side by side; of one group alone, two halves of its points.

    Values are those of the measure but for rounding: its batches are smaller.

    Args:
        whole: the measure. What is valued here counts among its `frames_evaluated`.
        pool: processes to value groups in; with None, or one process, each has a thread.
    """

    def __init__(self, whole: BatchedMeasure, pool: Pool[Any] | None = None) -> None:
        self._whole = whole
        self._parts = [whole.of_groups([k]) for k in range(len(whole.groups))]
        if len(self._parts) == 1:
            self._parts.append(whole.of_groups([0]))
        self._threads = min(len(self._parts), torch.get_num_threads())
        self._pool = pool if pool is not None and pool.processes > 1 else None
        self._settled = self._pool and self._pool.settle(partial(_answered_beside, self._parts))

    @property
    def groups(self) -> tuple[Group, ...]:
        """The groups of the measure."""
        return self._whole.groups

    def values(self, space: SearchSpace, unit: Points) -> Values:
        """The values of R points per group, without gradients."""
        return self._joined(unit, [value for (value,) in self._each(_valued, space, unit)])

    def values_and_gradients(self, space: SearchSpace, unit: Points) -> tuple[Values, Points]:
        """The values of R points per group, and their gradients."""
        each = self._each(_climbed, space, unit)
        return self._joined(unit, [value for value, _ in each]), self._joined(unit, [slope for _, slope in each])

    def _joined(self, unit: Tensor, parts: Sequence[Tensor]) -> Tensor:
        return torch.cat(list(parts), 0 if len(unit) > 1 else 1)

    def _each(self, ask: _Ask, space: SearchSpace, unit: Tensor) -> list[tuple[Tensor, ...]]:
        points = cast("tuple[Tensor, ...]", unit.split(1) if len(unit) > 1 else unit.tensor_split(2, 1))
        usual = torch.get_num_threads()
        own = max(1, usual // self._threads)
        pieces = [_Piece(number, ask, space, some, own) for number, some in enumerate(points) if some.numel()]
        if self._pool is not None and self._settled is not None:
            found = {piece.number: answer for piece, answer in self._pool.each(self._settled, pieces)}
        else:
            try:
                with ThreadPoolExecutor(self._threads, initializer=torch.set_num_threads, initargs=(own,)) as pool:
                    found = dict(enumerate(pool.map(partial(_answered, self._parts), pieces)))
            finally:
                torch.set_num_threads(usual)
        self._whole.frames_evaluated += sum(frames for _, frames in found.values())
        return [found[number][0] for number in sorted(found)]


_Ask: TypeAlias = Callable[[BatchedMeasure, SearchSpace, Tensor], tuple[Tensor, ...]]


class _Piece(NamedTuple):
    """What is asked of the group of this number, of so many points, on so many threads."""

    number: int
    ask: _Ask
    space: SearchSpace
    points: Tensor
    threads: int


def _answered(parts: Sequence[BatchedMeasure], piece: _Piece) -> tuple[tuple[Tensor, ...], int]:
    """What a group's measure answers, and how many frames that took."""
    part = parts[piece.number]
    part.frames_evaluated = 0
    return piece.ask(part, piece.space, piece.points), part.frames_evaluated


def _answered_beside(parts: Sequence[BatchedMeasure], _: object, piece: _Piece) -> tuple[tuple[Tensor, ...], int]:
    """The same in another process."""
    with threads(piece.threads):
        return _answered(parts, piece)


def _valued(part: BatchedMeasure, space: SearchSpace, points: Tensor) -> tuple[Tensor, ...]:
    return (part.values(space, points),)


def _climbed(part: BatchedMeasure, space: SearchSpace, points: Tensor) -> tuple[Tensor, ...]:
    return part.values_and_gradients(space, points)
