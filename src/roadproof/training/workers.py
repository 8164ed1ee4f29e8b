"""Work spread over processes, one simulator in each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import cached_property
from typing import TypeVar

import torch

from roadproof.controllers import Controller, load_controller
from roadproof.errors import SimulatorError
from roadproof.processes import DIED, processes_beside
from roadproof.simulators.town.simulator import TownSimulator

Work = TypeVar("Work")
Result = TypeVar("Result")


class Seat:
    """What a process drives with: a simulator and a controller, each made when first wanted and then kept.

    Args:
        controller_spec: of the controller; None leaves the seat without one.
        dt_s: seconds per step of the simulator.
    """

    def __init__(self, controller_spec: str | None, dt_s: float) -> None:
        self.controller_spec = controller_spec
        self.dt_s = dt_s

    @cached_property
    def town(self) -> TownSimulator:
        """An open simulator; it closes with its process, or in `close`."""
        return TownSimulator(dt_s=self.dt_s).__enter__()

    @cached_property
    def controller(self) -> Controller | None:
        """The controller."""
        return None if self.controller_spec is None else load_controller(self.controller_spec)

    def close(self) -> None:
        """Close the simulator, if there is one."""
        if "town" in self.__dict__:
            self.town.__exit__(None, None, None)
            del self.town


def spread(
    function: Callable[[Seat, Work], Result], works: Sequence[Work], seat: Seat, *, processes: int
) -> Iterator[tuple[Work, Result]]:
    """Call a function for every piece of work, in as many processes as asked for; one means this one.

    Args:
        function: a module's own function; it gets the seat of its process and a piece of work.
        works: the pieces; they travel between processes.
        seat: the pattern of every process' seat; must be unused so far.
        processes: how many at once.

    Yields:
        Pieces of work and results, as they come.

    Raises:
        SimulatorError: a process died.
    """
    if processes <= 1 or len(works) <= 1:
        try:
            for work in works:
                yield work, function(seat, work)
        finally:
            seat.close()
        return
    with processes_beside(min(processes, len(works)), _sit_down, seat) as pool:
        waiting = {pool.submit(_call, function, work): work for work in works}
        try:
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        except BrokenProcessPool:
            raise SimulatorError(DIED) from None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


_seat: Seat | None = None


def _sit_down(seat: Seat) -> None:
    global _seat  # one seat a process, made by its initialiser
    _seat = seat
    torch.set_num_threads(1)


def _call(function: Callable[[Seat, Work], Result], work: Work) -> Result:
    assert _seat is not None
    return function(_seat, work)
