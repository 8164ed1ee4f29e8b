"""What long work says while it goes on, on standard error.

On a terminal bars with the time left. Elsewhere, in a log, a line where a stage ends and at least one a minute. With
`--verbose` a line for every step, with `--quiet` nothing.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from enum import Enum

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

_SECONDS_S, HOURS_S = 30.0, 6 * 3600.0
EVERY_S = 60.0
"""After so long without a line there is one."""

Show = Callable[[str, int, int, str], None]


class Loudness(Enum):
    """How much is said."""

    QUIET = 0
    USUAL = 1
    VERBOSE = 2


_loudness = Loudness.USUAL  # one command a process


def speak(loudness: Loudness) -> None:
    """Set how much is said from now on."""
    global _loudness
    _loudness = loudness


def is_quiet() -> bool:
    """Whether nothing is to be said but results and errors."""
    return _loudness is Loudness.QUIET


@contextmanager
def progress(
    title: str, total: int, value: str = "best {:.3f}", *, begun: int = 0, remember_s: float = _SECONDS_S
) -> Generator[Callable[[int, float], None]]:
    """Show one stage, and give the function that says how far it is.

    Args:
        title: the name of the stage.
        total: how many steps the stage has.
        value: format of the number that is shown beside the steps.
        begun: how many steps were done before; they say nothing on the time left.
        remember_s: as `stages` takes it.

    Yields:
        The function to call with how many steps are done and the number beside them.
    """
    with stages(remember_s) as show:
        show(title, begun, total, value.format(0.0))
        yield lambda done, number: show(title, done, total, value.format(number))


@contextmanager
def stages(remember_s: float = _SECONDS_S) -> Generator[Show]:
    """Show each of several stages, and give the function that says how far they are.

    Args:
        remember_s: how many seconds of past steps tell the time left; `HOURS_S` where each step takes minutes.

    Yields:
        The function to call with a stage's name, the steps done, how many there are, and what to show beside them.
    """
    console = Console(stderr=True)
    if _loudness is Loudness.QUIET:
        yield lambda _title, _done, _total, _value: None
    elif _loudness is Loudness.USUAL and console.is_terminal:
        with _Bars(console, remember_s) as bars:
            yield bars.show
    else:
        lines = _Lines()
        ended = threading.Event()
        watch = threading.Thread(target=lines.break_silence, args=(ended,), daemon=True)
        watch.start()
        try:
            yield lines.show
        finally:
            ended.set()
            watch.join()


class _Bars(Progress):
    """A bar for each stage."""

    def __init__(self, console: Console, remember_s: float) -> None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[value]}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
        )
        super().__init__(*columns, console=console, transient=True, speed_estimate_period=remember_s)
        self._by_title: dict[str, TaskID] = {}

    def show(self, title: str, done: int, total: int, value: str) -> None:
        if title not in self._by_title:
            self._by_title[title] = self.add_task(title, total=total, completed=done, value=value)
        self.update(self._by_title[title], completed=done, total=total, value=value)


class _Lines:
    """Lines in a log."""

    def __init__(self) -> None:
        self._stage, self._first, self._since_s = "", 0, 0.0
        self._now, self._ended = ("", 0, 0, ""), False
        self._told_s = time.monotonic()

    def show(self, title: str, done: int, total: int, value: str) -> None:
        self._now = (title, done, total, value)
        if title != self._stage:
            self._stage, self._first, self._since_s, self._ended = title, done, time.monotonic(), False
        ends = done >= total and not self._ended
        self._ended = self._ended or ends
        if ends or _loudness is Loudness.VERBOSE:
            self._tell()

    def break_silence(self, ended: threading.Event) -> None:
        """Say where the work is, every `EVERY_S` seconds of silence, until it is done."""
        while not ended.wait(max(self._told_s + EVERY_S - time.monotonic(), 0.01)):
            if time.monotonic() - self._told_s >= EVERY_S:
                self._tell()

    def _tell(self) -> None:
        self._told_s = time.monotonic()
        title, done, total, value = self._now
        said = " ".join(filter(None, (title or "Beginning", f"{done}/{total}" if total else "", value)))
        if title and (seconds := self._told_s - self._since_s) >= 1:
            said += f", {duration_in_words(seconds)}"
            if self._first < done < total:
                said += f", about {duration_in_words(seconds * (total - done) / (done - self._first))} left"
        tell(said)


def tell(line: str) -> None:
    """Print a line on standard error; nothing in it is read as markup."""
    Console(stderr=True, soft_wrap=True, highlight=False, markup=False, emoji=False).print(line)


def duration_in_words(seconds: float) -> str:
    """A time as people say it: "40 s", "12 min", "3.5 h"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 100 * 60 else f"{seconds / 3600:.1f} h"
