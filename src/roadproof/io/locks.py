"""One worker a folder: a second one is told who is there."""

from __future__ import annotations

import atexit
import os
import stat
import sys
import tempfile
from collections.abc import Generator
from contextlib import ExitStack, contextmanager, suppress
from datetime import datetime
from pathlib import Path

from filelock import FileLock, Timeout

from roadproof.errors import OutputError
from roadproof.io.files import check_writable, kept_inside, write_text
from roadproof.io.identity import digest

_held = ExitStack()
atexit.register(_held.close)


@contextmanager
def working_in(folder: Path) -> Generator[None]:
    """Keep other processes from writing to a folder meanwhile; in this one it can be asked for again.

    The lock is the system's own and ends with its process, however that ends; it holds on one machine, for one user.
    What is written to the folder meanwhile stays in it, whatever links are there.

    Args:
        folder: the folder to work in; made where it is not there, and taken away again where nothing came of it.

    Raises:
        OutputError: the folder cannot be written, or another process works in it.
    """
    new = not folder.exists()
    check_writable(folder)
    place = _place(folder)
    lock = FileLock(place.with_suffix(".lock"), is_singleton=True)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        raise OutputError(f"{_worker(place)} works in {folder}; wait for its end, or choose another folder") from None
    except (NotImplementedError, OSError):
        # A disk that knows no locks: better unguarded than not at all.
        with kept_inside(folder):
            yield
        return
    try:
        first = lock.lock_counter == 1
        if first:
            since = datetime.now().astimezone().isoformat(" ", "seconds")
            doing = " ".join([Path(sys.argv[0]).name, *sys.argv[1:2]]) or "roadproof"
            told = f"{doing} (process {os.getpid()}, since {since})\n"
            write_text(place, told)
        with kept_inside(folder):
            yield
        if first:
            place.unlink(missing_ok=True)
    finally:
        if new:
            with suppress(OSError):  # it is not empty
                folder.rmdir()
        lock.release()


def hold(folder: Path) -> None:
    """Work in a folder until this process ends (`working_in`): for a command, which does nothing else.

    Raises:
        OutputError: the folder cannot be written, or another process works in it.
    """
    _held.enter_context(working_in(folder))


def _place(folder: Path) -> Path:
    """The file that says who works in a folder: outside of the folder, which holds results alone."""
    # Where every process looks, whatever its TMPDIR says.
    shared = Path("/tmp")  # noqa: S108  # the folder in it is the user's own
    locks = own_folder(shared if shared.is_dir() else Path(tempfile.gettempdir()), "locks")
    return locks / digest(os.fsencode(folder.resolve()))[:32]


def own_folder(shared: Path, purpose: str) -> Path:
    """The user's own folder in one that all users write to, made where it is not there.

    Raises:
        OutputError: the folder cannot be made, belongs to another user, or is a link.
    """
    user: int = getattr(os, "getuid", int)()  # a user may have no name, or no number
    own = shared / f"roadproof-{purpose}-{user}"
    try:
        own.mkdir(mode=0o700, exist_ok=True)
        found = own.lstat()
    except OSError as error:
        raise OutputError(f"cannot keep {purpose} in {own}: {error.strerror}; remove what is there") from None
    # Another user's link would lead into any folder.
    if found.st_uid != user or not stat.S_ISDIR(found.st_mode):
        raise OutputError(f"{own} belongs to another user or is a link, expected a folder of yours; have it removed")
    return own


def _worker(place: Path) -> str:
    try:
        return place.read_text(encoding="utf-8").strip()[:200] or "another process"
    except (OSError, UnicodeError):
        return "another process"
