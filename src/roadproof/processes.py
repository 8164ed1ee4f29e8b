"""Processes that work beside this one."""

from __future__ import annotations

import atexit
import io
import multiprocessing
import os
import pickle
import shutil
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, partial
from itertools import count
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar, cast

import torch

from roadproof import foreign
from roadproof.errors import ControllerError, OutputError, RoadproofError, SimulatorError
from roadproof.machine import digits, keep_digits, keep_freed_memory

DIED = "a driving process died; is there memory for all of them? try with fewer processes"
"""What is said of one that did not even raise an exception."""

_PICKLED = "several processes need a controller that can be pickled: define its class in a module, or use one process"

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
            # Never more than here: a controller's last digits depend on how many threads compute them.
            threads = max(1, min(torch.get_num_threads(), (os.cpu_count() or 1) // self.processes))
            self._stop = _Fresh().Event()
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
            travelled = _travelling(function)
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
            try:
                with path.open("wb") as file:
                    _Processor(file).dump(function)
            except OSError as error:
                path.unlink(missing_ok=True)
                raise OutputError(
                    f"cannot write what the processes of a search need to {self._folder.name}: {error.strerror}; let "
                    "TMPDIR be a folder with room for some hundred MB, or use one process"
                ) from None
            except Exception as error:  # of a user's controller
                path.unlink(missing_ok=True)
                raise ControllerError(f"a search's controller cannot travel: {error}; {_PICKLED}") from error
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
        call = partial(_call, file or _travelling(asked))
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
            raise SimulatorError(DIED) from None


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
    return ProcessPoolExecutor(count, mp_context=_Fresh(), initializer=_begin, initargs=given)


def require_opened(processes: int, opens: object | None) -> None:
    """Refuse several processes where nothing opens a simulator for each, and fewer than one.

    Raises:
        RoadproofError: the number of processes is not one that can work.
    """
    if processes < 1 or (processes > 1 and opens is None):
        raise RoadproofError(
            f"{processes} processes; expected 1, or more with a factory that opens a simulator for each"
        )


def require_picklable(driver: object) -> None:
    """Refuse a controller, or another driver, that cannot travel to processes beside this one.

    Raises:
        ControllerError: the driver cannot be pickled; the message says why and what to do.
    """
    try:
        foreign.call("pickling the controller", pickle.dumps, driver)
    except ControllerError as error:
        raise ControllerError(f"{error}; {_PICKLED}") from error.__cause__


class _FreshProcess(SpawnProcess):
    """A process to which a terminal's Ctrl-C does not come: it ends with its parent, and has nothing to say itself.

    Its handler stays, so that a foreign call that does not come back can be ended by it.
    """

    def start(self) -> None:
        """Begin; what is blocked here meanwhile stays so there, from its first import on."""
        with _ctrl_c_later():
            super().start()


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


class _Fresh(SpawnContext):
    Process = _FreshProcess  # pyright: ignore[reportAssignmentType]  # as the standard library's contexts have theirs


class _Processor(pickle.Pickler):
    """Pickles what is on a GPU as if it were on the processor."""

    def reducer_override(self, thing: Any) -> Any:  # noqa: ANN401  # as of `pickle`
        if isinstance(thing, torch.device) and thing.type == "cuda":
            return torch.device, ("cpu",)
        if not isinstance(thing, torch.Tensor) or not thing.is_cuda:
            return NotImplemented
        here = thing.detach().cpu().requires_grad_(thing.requires_grad)
        parameter = isinstance(thing, torch.nn.Parameter)
        here = torch.nn.Parameter(here, thing.requires_grad) if parameter else here
        return cast("Any", here).__reduce_ex__(2)


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


def _pickled_for_the_processor(thing: object) -> bytes:
    with io.BytesIO() as file:
        _Processor(file).dump(thing)
        return file.getvalue()


def _travelling(function: Callable[..., object]) -> bytes:
    """A function as it travels to a process, with whatever controller is in it."""
    try:
        return _pickled_for_the_processor(function)
    except Exception as error:  # of a user's controller
        raise ControllerError(f"a controller cannot travel to another process: {error}; {_PICKLED}") from error


_opens: Opens[Any] | None = None
_opened = ExitStack()
_stop: Event | None = None
_folder: Path | None = None


def _begin_work(opens: Opens[Any], stop: Event, threads: int, folder: Path) -> None:
    global _opens, _stop, _folder  # one of each a process, made by its initialiser
    _opens, _stop, _folder = opens, stop, folder
    atexit.register(_opened.close)
    torch.set_num_threads(threads)


@cache
def _inside() -> Any:  # noqa: ANN401  # whatever the process works in
    assert _opens is not None
    return _opened.enter_context(_opens())


def _call(travelled: bytes | Path, work: object) -> bytes:
    """What the function gives, as bytes: torch would have shared memory hold it, of which containers have little."""
    return _pickled_for_the_processor(_function(travelled)(_inside(), work))


@lru_cache(maxsize=1)
def _function(travelled: bytes | Path) -> Callable[[object, object], object]:
    """What a process is to call; a controller that came with it stays as the pieces before left it."""
    content = travelled.read_bytes() if isinstance(travelled, Path) else travelled
    return foreign.call("a controller that travelled to another process", pickle.loads, content)


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
    if _folder is not None:
        # A parent that was killed has left it.
        shutil.rmtree(_folder, ignore_errors=True)
    os._exit(1)
