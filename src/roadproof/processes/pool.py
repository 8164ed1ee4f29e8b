"""Processes that share out work, each in what it has opened."""

from __future__ import annotations

import atexit
import multiprocessing
import os
import pickle
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, ExitStack, nullcontext
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import count
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar, cast

import torch

from roadproof.errors import OutputError, RoadproofError, SimulatorError
from roadproof.foreign import in_one_line, place_of
from roadproof.processes.fresh import processes_beside, remove_if_orphaned
from roadproof.processes.travel import arrived, pickled, require_opens_travels, travelling

_DIED = (
    "a driving process died; is there memory for all of them? try with fewer processes; a script that makes some needs "
    "`if __name__ == '__main__':` before what it does"
)
"""What is said of one that did not even raise an exception."""

Inside = TypeVar("Inside")
Work = TypeVar("Work")
Result = TypeVar("Result")
Opens: TypeAlias = Callable[[], AbstractContextManager[Inside]]
"""Makes the context in which a process works, such as a simulator."""


@dataclass(frozen=True, slots=True)
class Settled(Generic[Inside, Work, Result]):
    """A function that the processes of a pool read from a file when they are first asked."""

    function: Callable[[Inside, Work], Result]
    file: Path | None


class Pool(Generic[Inside]):
    """Processes that stay open while they are wanted, each in a context of its own; one process means this one.

    Use it in a with-block. A piece of work that fails, or an interruption, ends the others, and then the pool.

    Args:
        opens: makes the context in which a process works, entered for its first piece; it travels there once.
        processes: how many processes work at once, at least 1; they share out the machine's cores.
    """

    def __init__(self, opens: Opens[Inside], processes: int) -> None:
        self.processes = processes
        self._opens, self._stack = opens, ExitStack()
        self._settled: Settled[Inside, Any, Any] | None = None
        self._number = count()

    def __enter__(self) -> Pool[Inside]:
        if self.processes > 1:
            require_opens_travels(self._opens)
            # Never more than here: a controller's last digits depend on how many threads compute them.
            threads = max(1, min(torch.get_num_threads(), (os.cpu_count() or 1) // self.processes))
            self._stop = multiprocessing.get_context("spawn").Event()
            self._folder = tempfile.TemporaryDirectory(prefix="roadproof-", ignore_cleanup_errors=True)
            given = (self._opens, self._stop, threads, Path(self._folder.name))
            self._beside = [processes_beside(1, _begin_work, *given) for _ in range(self.processes)]
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._stack.close()
        if self.processes == 1:
            return
        self._folder.cleanup()
        if kind is not None:
            self._stop.set()
        # All of them together: one after another takes half a second each. Python waits for them when it ends, so that
        # they are not cut off between giving a semaphore back and telling so.
        ends = [threading.Thread(target=_end, args=(each, self._stop)) for each in self._beside]
        for end in ends:
            end.start()
        if kind is None:
            for end in ends:
                end.join()

    @cached_property
    def _here(self) -> Inside:
        """What this process works in, where it is the only one."""
        return self._stack.enter_context(self._opens())

    def begin(self, function: Callable[[Inside, None], object]) -> None:
        """Let every process beside this one do something before its first work, and do not wait for it.

        Args:
            function: as of `each`; what it raises is not told.
        """
        if self.processes > 1:
            travelled = travelling(function)
            for process in self._beside:
                process.submit(_call, travelled, None)

    def settle(self, function: Callable[[Inside, Work], Result]) -> Settled[Inside, Work, Result]:
        """The same function for `each`, which then sends it to a process once for however many rounds of work.

        In each round the first process gets the first piece of work, and so on. One function is settled at a time: that
        one stays where it is, and any other is forgotten.

        Raises:
            OutputError: the folder for temporary files cannot hold it.
            ControllerError: something in it cannot be pickled.
        """
        if self.processes == 1:
            return Settled(function, None)
        if self._settled is None or self._settled.function is not function:
            path = Path(self._folder.name) / f"settled-{next(self._number)}"
            content = travelling(function)
            try:
                path.write_bytes(content)
            except OSError as error:
                path.unlink(missing_ok=True)
                raise OutputError(
                    f"cannot write what the processes of a search need to {self._folder.name}: {error.strerror}; let "
                    "TMPDIR be a folder with room for some hundred MB, or use one process"
                ) from None
            before, self._settled = self._settled, Settled(function, path)
            if before is not None and before.file is not None:
                before.file.unlink(missing_ok=True)
        return self._settled

    def each(
        self,
        function: Callable[[Inside, Work], Result] | Settled[Inside, Work, Result],
        works: Sequence[Work],
        *,
        alike: Callable[[Work], object] = lambda _: None,
    ) -> Iterator[tuple[Work, Result]]:
        """Call a function for every piece of work.

        Args:
            function: a module's own function, a `partial` of one, or one that was settled; it gets what its process has
                opened and a piece of work, and travels to a process once for all pieces. Long ones look now and then
                whether they are `stopping`. What it holds on a GPU is on the processor there: many processes with a
                picture at a time would wait for each other at one GPU.
            works: the pieces; they travel between processes.
            alike: tells kinds of pieces; a process goes on with the kind that it has, where it is dear to change.

        Yields:
            Each piece of work with its result, in the order in which they are finished.

        Raises:
            SimulatorError: a process died.
            ControllerError: something in the function cannot be pickled.
        """
        known = isinstance(function, Settled)
        settled = cast("Settled[Inside, Work, Result]", function) if known else Settled(function, None)
        asked, file = settled.function, settled.file
        if self.processes == 1:
            for work in works:
                yield work, asked(self._here, work)
            return
        call = partial(_call, file or travelling(asked))
        left = _Left(works, alike)
        try:
            free = self._beside if file is None else self._beside * -(-len(works) // self.processes)
            waiting = {process.submit(call, work): (process, work) for process, work in left.taken_by(free)}
            while waiting:
                done, _ = wait(waiting, return_when=FIRST_COMPLETED)
                finished = {future: waiting.pop(future) for future in done}
                free = [process for process, _ in finished.values()]
                waiting |= {process.submit(call, work): (process, work) for process, work in left.taken_by(free)}
                for future, (_, work) in finished.items():
                    yield work, cast("Result", pickle.loads(future.result()))  # noqa: S301  # of a process of ours
        except BrokenProcessPool:
            raise SimulatorError(_DIED) from None


def here_or_beside(inside: Inside, opens: Opens[Inside] | None, processes: int) -> Pool[Inside]:
    """Processes that each work in a context of their own; a single one is this process, in what is open already.

    Args:
        inside: what this process works in, where it is the only one.
        opens: makes a context of the same kind; needed for several processes.
        processes: how many work at once.
    """
    return Pool(partial(nullcontext, inside) if opens is None or processes == 1 else opens, processes)


def open_or_here(pool: Pool[Inside] | None, inside: Inside) -> AbstractContextManager[Pool[Inside]]:
    """Processes that are open already, and stay open; without them this process alone, working in what is given."""
    return nullcontext(pool) if pool is not None else here_or_beside(inside, None, 1)


def spread(
    function: Callable[[Inside, Work], Result], works: Sequence[Work], opens: Opens[Inside], *, processes: int
) -> Iterator[tuple[Work, Result]]:
    """Call a function for every piece of work, in as many processes as asked for, which are there for this alone.

    The arguments, what is yielded and what is raised are those of `Pool` and `Pool.each`.
    """
    with Pool(opens, max(1, min(processes, len(works)))) as pool:
        yield from pool.each(function, works)


def stopping() -> bool:
    """Whether this process should end its piece of work, since another piece failed or its parent was interrupted."""
    return _stop is not None and _stop.is_set()


def require_opened(processes: int, opens: object | None) -> None:
    """Refuse several processes where nothing opens a simulator for each, and fewer than one.

    Raises:
        RoadproofError: the number of processes is not one that can work.
    """
    if processes < 1 or (processes > 1 and opens is None):
        raise RoadproofError(
            f"{processes} processes; expected 1, or more with a factory that opens a simulator for each"
        )


class _Left(Generic[Work]):
    """Pieces of work that nobody has taken yet, in their order."""

    def __init__(self, works: Sequence[Work], alike: Callable[[Work], object]) -> None:
        self._works, self._alike = list(works), alike
        self._last: dict[ProcessPoolExecutor, object] = {}

    def taken_by(self, processes: Sequence[ProcessPoolExecutor]) -> list[tuple[ProcessPoolExecutor, Work]]:
        """Processes with a piece of work each, as far as there are some left."""
        return [(process, self._taken(process)) for process in processes[: len(self._works)]]

    def _taken(self, process: ProcessPoolExecutor) -> Work:
        """The first piece of the kind that the process had, else of a kind that none has, else the first."""
        kinds = [self._alike(work) for work in self._works]
        others = list(self._last.values())
        fresh = next((k for k, kind in enumerate(kinds) if kind not in others), 0)
        last = self._last.get(process, self)
        chosen = kinds.index(last) if last in kinds else fresh
        self._last[process] = kinds[chosen]
        return self._works.pop(chosen)


def _end(process: ProcessPoolExecutor, _: Event) -> None:
    """End a process, and keep its event until then: one that has only just begun complains where it is gone."""
    process.shutdown(cancel_futures=True)


_opens: Opens[Any] | None = None
_opened = ExitStack()
_stop: Event | None = None


def _begin_work(opens: Opens[Any], stop: Event, threads: int, folder: Path) -> None:
    global _opens, _stop  # one of each a process, made by its initialiser
    _opens, _stop = opens, stop
    remove_if_orphaned(folder)
    atexit.register(_opened.close)
    torch.set_num_threads(threads)


@cache
def _inside() -> Any:  # noqa: ANN401  # whatever the process works in
    assert _opens is not None
    return _opened.enter_context(_opens())


def _call(travelled: bytes | Path, work: object) -> bytes:
    try:
        return pickled(arrived(travelled)(_inside(), work))
    except Exception as error:
        if _travels(error):
            raise
        # Nobody would hear of it: the process that should read it dies of it.
        raise SimulatorError(f"a process raised {in_one_line(error, place_of(error))}") from None


def _travels(error: Exception) -> bool:
    try:
        pickle.loads(pickle.dumps(error))  # noqa: S301  # our own
    except Exception:  # of an author's own kind
        return False
    return True
