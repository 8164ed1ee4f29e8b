"""Progress with time left; quiet where nobody looks."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager

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


@contextmanager
def progress(
    title: str, total: int, value: str = "best {:.3f}", *, begun: int = 0, remember_s: float = _SECONDS_S
) -> Generator[Callable[[int, float], None]]:
    """A bar on standard error, and the function that moves it.

    Args:
        title: what is going on.
        total: steps there are.
        value: how the number beside the bar is shown.
        begun: how many of them were done before; they say nothing on the time left.
        remember_s: how far back the steps go from which the time left is told; `HOURS_S` where each takes minutes.

    Yields:
        What to call with the steps done and that number.
    """
    with _bars(remember_s) as bar:
        task = bar.add_task(title, total=total, completed=begun, value=value.format(0.0))
        yield lambda done, number: bar.update(task, completed=done, value=value.format(number))


@contextmanager
def stages() -> Generator[Callable[[str, int, int, str], None]]:
    """A bar for each of several stages, and the function that moves them.

    Yields:
        What to call with a stage's name, the steps done, how many there are, and what to show beside the bar.
    """
    with _bars() as bar:
        tasks: dict[str, TaskID] = {}

        def show(title: str, done: int, total: int, value: str) -> None:
            if title not in tasks:
                tasks[title] = bar.add_task(title, total=total, value=value)
            bar.update(tasks[title], completed=done, total=total, value=value)

        yield show


def _bars(remember_s: float = _SECONDS_S) -> Progress:
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[value]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    return Progress(
        *columns, console=console, disable=not console.is_terminal, transient=True, speed_estimate_period=remember_s
    )
