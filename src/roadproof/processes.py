"""Processes that work beside this one."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from roadproof import foreign
from roadproof.errors import ControllerError

DIED = "a driving process died; is there memory for all of them? try with fewer processes"
"""What is said of one that did not even raise an exception."""


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


def _begin(limit_s: float, begin: Callable[..., object] | None, arguments: tuple[object, ...]) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
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
