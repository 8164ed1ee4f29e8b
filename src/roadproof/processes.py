"""Processes that work beside this one."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, ExitStack
from functools import cached_property
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import torch

from roadproof import foreign
from roadproof.errors import ControllerError, SimulatorError
from roadproof.machine import keep_freed_memory

DIED = "a driving process died; is there memory for all of them? try with fewer processes"
"""What is said of one that did not even raise an exception."""


@runtime_checkable
class Worker(Protocol):
    """What pieces of work are done with, such as an open simulator; one a process."""

    def close(self) -> None:
        """Give back what it holds."""
        ...


AnyWorker = TypeVar("AnyWorker", bound=Worker)
Work = TypeVar("Work")
Result = TypeVar("Result")


class Opened(Generic[Result]):
    """A worker that enters a context, such as a simulator, when it is first wanted.

    Args:
        factory: makes the context; it travels between processes.
    """

    def __init__(self, factory: Callable[[], AbstractContextManager[Result]]) -> None:
        self._factory, self._stack = factory, ExitStack()

    @cached_property
    def inside(self) -> Result:
        """What the context gives; it is left in `close`."""
        return self._stack.enter_context(self._factory())

    def close(self) -> None:
        """Leave the context, if it was entered."""
        self._stack.close()


def spread(
    function: Callable[[AnyWorker, Work], Result], works: Sequence[Work], worker: AnyWorker, *, processes: int
) -> Iterator[tuple[Work, Result]]:
    """Call a function for every piece of work, in as many processes as asked for; one means this one.

    Args:
        function: a module's own function; it gets the worker of its process and a piece of work. Long ones look now
            and then whether they are `stopping`.
        works: the pieces; they travel between processes.
        worker: what every process gets a copy of; must be unused so far.
        processes: how many processes work at once; they share out the machine's cores.

    Yields:
        Each piece of work with its result, in the order in which they are finished.

    Raises:
        SimulatorError: a process died.
    """
    count = min(processes, len(works))
    if count <= 1:
        try:
            for work in works:
                yield work, function(worker, work)
        finally:
            worker.close()
        return
    stop = multiprocessing.get_context("spawn").Event()
    with processes_beside(count, _begin_work, worker, stop, max(1, (os.cpu_count() or 1) // count)) as pool:
        try:
            # A process that dies at once breaks the pool before all is handed to it.
            waiting = {pool.submit(_call, function, work): work for work in works}
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        except BrokenProcessPool:
            raise SimulatorError(DIED) from None
        except BaseException:
            # Not where all went well: a pool that is not waited for may complain when Python ends.
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def stopping() -> bool:
    """Whether this process should end its piece of work, since another piece failed or its parent was interrupted."""
    return _stop is not None and _stop.is_set()


def processes_beside(count: int, begin: Callable[..., object] | None = None, *arguments: object) -> ProcessPoolExecutor:
    """A pool of fresh processes that end with this one, however it ends.

    Fresh, since graphics and torch's threads do not survive a fork. One that outlived its parent would go on writing to
    the folder in which the next run goes on. As in `load_controller` the current directory is importable, for
    controllers that travel; foreign calls end as in this process.

    Args:
        count: number of processes, at least 1.
        begin: function of a module that each process calls before its first work; None for none.
        arguments: arguments of `begin`.
    """
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(
        count, mp_context=context, initializer=_begin, initargs=(foreign.limit_s(), begin, arguments)
    )


def require_picklable(driver: object) -> None:
    """Refuse a controller, or another driver, that cannot travel to processes beside this one.

    Raises:
        ControllerError: the driver cannot be pickled; the message says why and what to do.
    """
    try:
        foreign.call("pickling the controller", pickle.dumps, driver)
    except ControllerError as error:
        raise ControllerError(
            f"{error}; several processes need a controller that can be pickled: define its class in a module, or "
            "use one process"
        ) from error.__cause__


_worker: Worker | None = None
_stop: Event | None = None


def _begin_work(worker: Worker, stop: Event, threads: int) -> None:
    global _worker, _stop  # one of each a process, made by its initialiser
    _worker, _stop = worker, stop
    torch.set_num_threads(threads)


def _call(function: Callable[[Any, Work], Result], work: Work) -> Result:
    return function(_worker, work)


def _begin(limit_s: float, begin: Callable[..., object] | None, arguments: tuple[object, ...]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_freed_memory()
    foreign.end_calls_after(limit_s)
    # What a user's code prints is none of the results, for which standard output is.
    sys.stdout = sys.stderr
    # Last, so that nothing in the folder hides an installed module.
    sys.path.append(str(Path.cwd()))
    if begin is not None:
        begin(*arguments)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
