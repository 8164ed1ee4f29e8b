"""The commands that made what is in a folder, as they were given: FOLDER/commands.txt, one a line."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path

from roadproof.errors import RoadproofError
from roadproof.io.files import bytes_of, write_text

FILE = "commands.txt"


def write_command(folder: Path, words: Iterable[str]) -> None:
    """Keep one command, unless the folder has it already.

    Raises:
        OutputError: the file cannot be written.
    """
    line, path = shlex.join(words), folder / FILE
    if read_commands(folder) != (line,):
        write_text(path, line + "\n")


def read_commands(folder: Path) -> tuple[str, ...]:
    """The commands that a folder keeps; none where it has no such file.

    Raises:
        RoadproofError: the file cannot be read.
    """
    path = folder / FILE
    try:
        lines = (bytes_of(path) or b"").decode("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise RoadproofError(f"{path} cannot be read ({error}); remove it") from None
    return tuple(line.strip() for line in lines if line.strip())
