"""What verbs print on standard output."""

from __future__ import annotations

from rich import box
from rich.console import Console, RenderableType
from rich.table import Table


def say(*lines: RenderableType) -> None:
    """Print lines or tables as they are: lines are not wrapped, and nothing in them is read as markup."""
    console = Console(soft_wrap=True, highlight=False, markup=False)
    for line in lines:
        console.print(line)


def table(words: tuple[str, ...], numbers: tuple[str, ...] = (), *, title: str | None = None, note: str = "") -> Table:
    """An empty table.

    Args:
        words: the columns that hold text.
        numbers: the columns after them, which hold numbers.
        title: a line above the table; None for none.
        note: a line below the table; empty for none.
    """
    made = Table(*words, box=box.SIMPLE, title=title, title_justify="left", caption=note, caption_justify="left")
    for column in numbers:
        made.add_column(column, justify="right", no_wrap=True)
    return made
