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
from typing import Any, NamedTuple, TypeAlias, cast

import torch
from torch import Tensor

from roadproof.attacks.batched import BatchedMeasure
from roadproof.attacks.groups import Group, Points, Values
from roadproof.attacks.objective import Readings, RecordedMeasure
from roadproof.controllers.precision import is_torch_alone
from roadproof.machine import threads
from roadproof.processes import Pool
from roadproof.search_space import SearchSpace


class Sides:
    """Measures of one search, such as those of its rungs, whose groups are valued side by side.

    Args:
        measures: the measures; they travel to processes together, once, and what they share travels once too.
        pool: processes to value groups in; with None, or one process, each group has a thread.
    """

    def __init__(self, measures: Sequence[RecordedMeasure], pool: Pool[Any] | None = None) -> None:
        self._parts = _Parts(tuple(measures))
        self._of_a_user = any(not isinstance(each, BatchedMeasure) or each.is_derived for each in measures)
        self._pool = pool if pool is not None and pool.processes > 1 else None

    def of(self, number: int, measure: RecordedMeasure) -> Beside | RecordedMeasure:
        """The measure of this number with its groups side by side, where there are threads for that; else itself.

        A user's own controller or measure may not stand two calls at once, and a mean over new looks is drawn for all
        groups together: such measures stay as they are, and so does a measure on another device than the processor. In
        processes, where there are several, groups do not wait for each other as threads do.

        Args:
            number: number of the measure.
            measure: that measure, or the same of some of its groups.
        """
        if not isinstance(measure, BatchedMeasure) or self._of_a_user or measure.variation is not None:
            return measure
        free = measure.device.type == "cpu" and torch.get_num_threads() > 1
        if not free or not is_torch_alone(measure.controller):
            return measure
        return Beside(number, measure, self._parts, self._pool)


class Beside:
    """A measure whose groups are valued side by side; of one group alone, two halves of its points.

    Values are those of the measure but for rounding: its batches are smaller. `Sides` makes them.
    """

    def __init__(self, number: int, whole: RecordedMeasure, parts: _Parts, pool: Pool[Any] | None) -> None:
        self._number, self._whole, self._parts, self._pool = number, whole, parts, pool
        self._threads = min(max(2, len(whole.groups)), torch.get_num_threads())

    @property
    def groups(self) -> tuple[Group, ...]:
        """The groups of the measure."""
        return self._whole.groups

    @property
    def device(self) -> torch.device:
        """The torch device on which the measure computes."""
        return self._whole.device

    def values(self, space: SearchSpace, unit: Points) -> Values:
        """The values of R points per group, without gradients."""
        return self._joined(unit, [value for (value,) in self._each(_valued, space, unit)])

    def values_and_gradients(self, space: SearchSpace, unit: Points) -> tuple[Values, Points]:
        """The values of R points per group, and their gradients."""
        each = self._each(_climbed, space, unit)
        return self._joined(unit, [value for value, _ in each]), self._joined(unit, [slope for _, slope in each])

    def readings(self, space: SearchSpace, unit: Points) -> Readings:
        """What the measure reads of R points per group."""
        each = self._each(_read, space, unit)
        shifts, predicted = zip(*each, strict=True)
        return self._joined(unit, shifts), None if predicted[0] is None else self._joined(unit, predicted)

    def _joined(self, unit: Tensor, parts: Sequence[Tensor]) -> Tensor:
        return torch.cat(list(parts), 0 if len(unit) > 1 else 1)

    def _each(self, ask: _Ask, space: SearchSpace, unit: Tensor) -> list[tuple[Any, ...]]:
        usual = torch.get_num_threads()
        own = max(1, usual // self._threads)
        pieces = [_Piece(side, ask, space, points, own) for side, points in self._shared_out(unit)]
        if self._pool is not None:
            # Only here is it sent, and again where another search has worked there since.
            settled = self._pool.settle(self._parts)
            found = {piece.side: answer for piece, answer in self._pool.each(settled, pieces)}
            answers = [found[piece.side] for piece in pieces]
        else:
            try:
                with ThreadPoolExecutor(self._threads, initializer=torch.set_num_threads, initargs=(own,)) as pool:
                    answers = list(pool.map(self._parts.answer, pieces))
            finally:
                torch.set_num_threads(usual)
        self._whole.frames_evaluated += sum(frames for _, frames in answers)
        return [answer for answer, _ in answers]

    def _shared_out(self, unit: Tensor) -> list[tuple[_Side, Tensor]]:
        """The points of each side."""
        known = self._parts.measures[self._number].groups
        groups = [known.index(group) for group in self.groups]
        parts = cast("tuple[Tensor, ...]", unit.split(1) if len(groups) > 1 else unit.tensor_split(2, 1))
        sides = [(self._number, groups[k % len(groups)], k // len(groups)) for k in range(len(parts))]
        return [(side, part) for side, part in zip(sides, parts, strict=True) if part.numel()]


_Side: TypeAlias = tuple[int, int, int]
"""Number of a measure, that of a group, and 1 for the second half of a group's points, else 0."""

_Ask: TypeAlias = Callable[[BatchedMeasure, SearchSpace, Tensor], tuple[Any, ...]]


class _Piece(NamedTuple):
    """What is asked of a side, of so many points, on so many threads."""

    side: _Side
    ask: _Ask
    space: SearchSpace
    points: Tensor
    threads: int


class _Parts:
    """Each group of some measures by itself, here or in another process."""

    def __init__(self, measures: tuple[RecordedMeasure, ...]) -> None:
        self.measures = measures
        self._made: dict[_Side, BatchedMeasure] = {}

    def __reduce__(self) -> tuple[type[_Parts], tuple[object]]:
        return _Parts, (self.measures,)

    def __call__(self, _: object, piece: _Piece) -> tuple[tuple[Any, ...], int]:
        """What a side answers in another process, and how many frames that took."""
        with threads(piece.threads):
            return self.answer(piece)

    def answer(self, piece: _Piece) -> tuple[tuple[Any, ...], int]:
        """What a side answers on this thread, and how many frames that took."""
        if piece.side not in self._made:
            number, group, _ = piece.side
            for other in list(self._made):  # the frames of rungs that are done
                if other[0] != number:
                    self._made.pop(other, None)
            self._made[piece.side] = cast("BatchedMeasure", self.measures[number]).of_groups([group])
        part = self._made[piece.side]
        part.frames_evaluated = 0
        return piece.ask(part, piece.space, piece.points), part.frames_evaluated


def _valued(part: BatchedMeasure, space: SearchSpace, points: Tensor) -> tuple[Tensor, ...]:
    return (part.values(space, points),)


def _climbed(part: BatchedMeasure, space: SearchSpace, points: Tensor) -> tuple[Tensor, ...]:
    return part.values_and_gradients(space, points)


def _read(part: BatchedMeasure, space: SearchSpace, points: Tensor) -> Readings:
    return part.readings(space, points)
