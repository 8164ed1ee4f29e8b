"""Progress with time left; quiet where nobody looks."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn


@contextmanager
def progress(title: str, total: int, value: str = "best {:.3f}") -> Generator[Callable[[int, float], None]]:
    """A bar on standard error, and the function that moves it.

    Args:
        title: what is going on.
        total: steps there are.
        value: how the number beside the bar is shown.

    Yields:
        What to call with the steps done and that number.
    """
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
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task(title, total=total, value=value.format(0.0))
        yield lambda done, number: bar.update(task, completed=done, value=value.format(number))
