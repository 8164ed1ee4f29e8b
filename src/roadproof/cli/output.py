"""What verbs print on standard output: their results, for people or, with --json, for programs."""

from __future__ import annotations

import json
import sys
from collections.abc import Generator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any, TextIO
from unicodedata import category

from rich import box
from rich.console import Console, RenderableType
from rich.table import Table

from roadproof.cli.progress import is_quiet

_answers: TextIO | None = None  # one command a process
_WIDEST = 1000


@contextmanager
def in_json() -> Generator[None]:
    """Keep standard output for `answer` in a with-block; all else that is printed in it goes to standard error."""
    global _answers
    _answers = sys.stdout
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _answers = None


def answer(results: Mapping[str, object]) -> None:
    """Print a verb's results as one JSON document where --json asks for it; nothing that can fail may follow.

    Args:
        results: the results by name, in the form of a results file where there is one (`stored`).
    """
    if _answers is None:
        return
    # Only here, so that `--help` stays quick.
    import msgspec

    # msgspec writes NaN as null; json escapes what is not ASCII, since a pipe may have any encoding.
    numbers = msgspec.json.encode(results, enc_hook=lambda value: value.tolist())
    _answers.write(json.dumps(msgspec.json.decode(numbers)) + "\n")


def stored(path: Path) -> dict[str, Any]:
    """What a results file in JSON holds."""
    return json.loads(path.read_text(encoding="utf-8"))


def say(*lines: RenderableType, wrapped: bool = False) -> None:
    """Print lines or tables; nothing in them is read as markup. With --json they go to standard error, if anywhere.

    A table is as wide as it needs to be where nobody's terminal ends, and closer where it would not fit.

    Args:
        *lines: the lines or tables.
        wrapped: whether they are wrapped where the terminal ends.
    """
    if _answers is not None and is_quiet():
        return
    console = Console(soft_wrap=not wrapped, highlight=False, markup=False, emoji=False)
    for line in (_harmless(line) if isinstance(line, str) else line for line in lines):
        if isinstance(line, Table):
            # Alone it would be made to fit, also into 80 columns of a file.
            wide = Console(width=_WIDEST).measure(line).maximum
            if not console.is_terminal:
                console.width = max(console.width, wide)
            elif wide > console.width:
                line.padding = 0
        console.print(line)


class _Harmless(Table):
    """A table of names that may come from anyone's files."""

    def add_row(self, *cells: RenderableType | None, **how: Any) -> None:  # noqa: ANN401  # as of `Table`
        super().add_row(*(_harmless(cell) if isinstance(cell, str) else cell for cell in cells), **how)


def _harmless(text: str) -> str:
    """A text without what would steer a terminal, which is shown by its code."""
    steers = (mark != "\n" and category(mark)[0] == "C" for mark in text)
    return "".join(repr(mark)[1:-1] if bad else mark for mark, bad in zip(text, steers, strict=True))


def table(words: tuple[str, ...], numbers: tuple[str, ...] = (), *, title: str | None = None, note: str = "") -> Table:
    """An empty table. Where it does not fit, names stay whole, and numbers wrap, or all texts but the first.

    Args:
        words: the columns that hold text.
        numbers: the columns after them, which hold numbers.
        title: a line above the table; None for none.
        note: a line below the table; empty for none.
    """
    made = _Harmless(box=box.SIMPLE, title=title, title_justify="left", caption=note, caption_justify="left")
    for column in words:
        made.add_column(column, no_wrap=bool(numbers) or column == words[0])
    for column in numbers:
        made.add_column(column, justify="right")
    return made
