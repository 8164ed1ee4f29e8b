"""Processes that begin fresh, and end with this one however it ends."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Generator
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

from roadproof import foreign
from roadproof.machine import digits, keep_digits, keep_freed_memory

_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def processes_beside(count: int, begin: Callable[..., object] | None = None, *arguments: object) -> ProcessPoolExecutor:
    """A pool of fresh processes that end with this one, however it ends.

    Fresh, since graphics and torch's threads do not survive a fork. One that outlived its parent would go on writing to
    the folder in which the next run goes on. As in `load_controller` the current directory is importable, for
    controllers that travel; foreign calls end, and a GPU multiplies, as in this process. Ctrl-C in a terminal reaches
    the parent alone.

    Args:
        count: number of processes, at least 1.
        begin: function of a module that each process calls before its first work; None for none.
        arguments: arguments of `begin`.
    """
    given = (foreign.limit_s(), digits(), begin, arguments)
    return _Beside(count, mp_context=multiprocessing.get_context("spawn"), initializer=_begin, initargs=given)


def remove_if_orphaned(folder: Path) -> None:
    """Let this process remove a folder of its parent's if that is killed, which then leaves it."""
    _left_by_parent.append(folder)


_left_by_parent: list[Path] = []


class _Beside(ProcessPoolExecutor):
    """Processes to which a terminal's Ctrl-C does not come: they end with their parent, and have nothing to say.

    Their handler stays, so that a foreign call that does not come back can be ended by it.
    """

    def submit(self, fn: Callable[_Given, _Result], /, *args: _Given.args, **kwargs: _Given.kwargs) -> Future[_Result]:
        """Hold Ctrl-C back meanwhile: a process that begins here blocks it from its first import on, as this thread.

        Nor can it come between making the thread that minds the processes and starting it; the pool could not end then.
        """
        with _ctrl_c_later():
            return super().submit(fn, *args, **kwargs)


@contextmanager
def _ctrl_c_later() -> Generator[None]:
    """Block this thread's SIGINT, and let one that comes to the process meanwhile interrupt it at the end.

    A process whose beginning is interrupted half way would complain of it.
    """
    came, handler = list[int](), signal.getsignal(signal.SIGINT)
    defers = callable(handler) and threading.current_thread() is threading.main_thread()
    masks = hasattr(signal, "pthread_sigmask")
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if masks else set[Any]()
    if defers:
        signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        if defers:
            signal.signal(signal.SIGINT, handler)
        if masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if came:
            signal.raise_signal(signal.SIGINT)


def _begin(
    limit_s: float, kept: tuple[bool, str], begin: Callable[..., object] | None, arguments: tuple[object, ...]
) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    keep_freed_memory()
    foreign.end_calls_after(limit_s)
    keep_digits(*kept)
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
    for folder in _left_by_parent:
        shutil.rmtree(folder, ignore_errors=True)
    os._exit(1)
