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


class Worker:
    """What a process drives with: a simulator and a controller, each made when first wanted and then kept.

    Args:
        controller_spec: spec of the controller; None for no controller.
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
        """The controller, or None where there is none."""
        return None if self.controller_spec is None else load_controller(self.controller_spec)

    def close(self) -> None:
        """Close the simulator, if there is one."""
        if "town" in self.__dict__:
            self.town.__exit__(None, None, None)
            del self.town


def spread(
    function: Callable[[Worker, Work], Result], works: Sequence[Work], worker: Worker, *, processes: int
) -> Iterator[tuple[Work, Result]]:
    """Call a function for every piece of work, in as many processes as asked for; one means this one.

    Args:
        function: a module's own function; it gets the worker of its process and a piece of work.
        works: the pieces; they travel between processes.
        worker: what every process gets a copy of; must be unused so far.
        processes: how many processes work at once.

    Yields:
        Each piece of work with its result, in the order in which they are finished.

    Raises:
        SimulatorError: a process died.
    """
    if processes <= 1 or len(works) <= 1:
        try:
            for work in works:
                yield work, function(worker, work)
        finally:
            worker.close()
        return
    with processes_beside(min(processes, len(works)), _begin, worker) as pool:
        waiting = {pool.submit(_call, function, work): work for work in works}
        try:
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        except BrokenProcessPool:
            raise SimulatorError(DIED) from None
        except BaseException:
            # Not where all went well: a pool that is not waited for may complain when Python ends.
            pool.shutdown(wait=False, cancel_futures=True)
            raise


_worker: Worker | None = None


def _begin(worker: Worker) -> None:
    global _worker  # one a process, made by its initialiser
    _worker = worker
    torch.set_num_threads(1)


def _call(function: Callable[[Worker, Work], Result], work: Work) -> Result:
    assert _worker is not None
    return function(_worker, work)
