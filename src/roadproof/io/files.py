"""Files and folders: names that stay inside, and what is never half written."""

from __future__ import annotations

import json
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias

from roadproof.errors import OutputError, RoadproofError

if TYPE_CHECKING:
    from torch import Tensor


AnyPath: TypeAlias = str | os.PathLike[str]
"""What public functions take as a path."""

_MARKS = frozenset(" ._+-=,()[]")
_LONGEST_NAME = 100
_DEVICES = frozenset({"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in "0123456789¹²³")})

_kept_inside: list[Path] = []
"""Folders that are worked in: what is written to them stays inside."""


def as_path(path: Any) -> Path:  # noqa: ANN401  # users without a type checker give anything
    """A path as users of the library give it.

    Raises:
        OutputError: the value is no path at all; the message says what came.
    """
    try:
        if os.fspath(path):
            return Path(path)
    except TypeError:
        pass
    raise OutputError(f"{path!r:.60} is no path, expected a text or a pathlib.Path")


def is_plain_name(name: object) -> bool:
    """Whether a text can name a file or folder, and nothing else, on every system.

    Letters, digits and " ._+-=,()[]", at most 100 of them; it begins with a letter, a digit or "_", does not end with
    "." or a blank, and is no device ("nul").
    """
    if not isinstance(name, str) or not 0 < len(name) <= _LONGEST_NAME:
        return False
    if not all(mark.isalnum() or mark in _MARKS for mark in name):
        return False
    return (name[0].isalnum() or name[0] == "_") and name[-1] not in ". " and name.split(".")[0].lower() not in _DEVICES


def check_name(name: object, what: str, error: type[RoadproofError]) -> str:
    """Check that a name from a file is plain, and return it.

    Args:
        name: the name as it was read.
        what: what the name stands for, for the message, such as "pattern".
        error: the type of error to raise.

    Raises:
        error: the name is not plain (`is_plain_name`).
    """
    if not is_plain_name(name):
        raise error(
            f"{what} {name!r:.120} is not a plain name; expected letters, digits, blanks and ._+-=,()[] alone, "
            "beginning with a letter, a digit or _"
        )
    return str(name)


def inside(folder: Path, name: object, what: str, error: type[RoadproofError]) -> Path:
    """The path of a name in a folder: the one way from a name in a file to a place on the disk.

    Args:
        folder: the folder that the path stays in.
        name: the name of a file or folder there.
        what: what the name stands for, for the message, such as "pattern".
        error: the type of error to raise.

    Raises:
        error: the name is not plain, or a link of this name leads out of the folder.
    """
    path = folder / check_name(name, what, error)
    if path.is_symlink() and not path.resolve().is_relative_to(folder.resolve()):
        raise error(f"{path} is a link that leads out of {folder}; remove it, or choose another folder")
    return path


def check_closed(folder: Path, error: type[RoadproofError]) -> None:
    """Check that no link in a folder leads out of it, before anything in it is read.

    Raises:
        error: a link leads out; the message names it.
    """
    root = folder.resolve()
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(place) / name
            if path.is_symlink() and not path.resolve().is_relative_to(root):
                raise error(f"{path} is a link that leads out of {folder}; put what it leads to in its place")


@contextmanager
def kept_inside(folder: Path) -> Generator[None]:
    """Refuse, meanwhile, to write anything to a folder that a link in it would put elsewhere."""
    # Known from here on by one name, since a user's controller may go to another directory meanwhile.
    whole = folder.absolute()
    _kept_inside.append(whole)
    try:
        yield
    finally:
        _kept_inside.remove(whole)


def _check_inside(path: Path) -> None:
    """Check that a file or folder to write lies where its name says, in a folder that is worked in."""
    for root in _kept_inside:
        if path.absolute().is_relative_to(root) and not path.parent.resolve().is_relative_to(root.resolve()):
            raise OutputError(f"{path.parent} is reached by a link that leads out of {root}; remove the link")


def open_file(path: Path) -> BinaryIO:
    """Open a file to read its bytes; a pipe or a device, which would be waited for, is refused.

    Raises:
        OSError: the file cannot be opened, or is none.
    """
    mode = path.stat().st_mode
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise OSError("it is a pipe or a device, expected a file")
    return path.open("rb")


def bytes_of(path: Path) -> bytes | None:
    """What a file holds that need not be there; None where it is not.

    Raises:
        RoadproofError: the file cannot be read.
    """
    try:
        with open_file(path) as file:
            return file.read()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RoadproofError(f"{path} cannot be read ({error.strerror or error}); remove it") from None


def write_atomically(path: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary file beside `path`, then move it into place.

    Raises:
        OutputError: the folder cannot be made or written, or the disk is full; nothing is left behind.
    """
    with writing(path):
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=path.suffix)
        os.close(handle)
        part = Path(name)
        try:
            write(part)
            part.chmod(0o644)
            _settle(part)
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def write_folder_atomically(folder: Path, write: Callable[[Path], object]) -> None:
    """Let `write` fill a temporary folder beside `folder`, then move it into place.

    Args:
        folder: the folder to make; it must not exist yet, or be empty.
        write: called with the temporary folder.

    Raises:
        OutputError: the folder cannot be made or written, or the disk is full; nothing is left behind.
    """
    with writing(folder):
        part = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        try:
            write(part)
            part.chmod(0o755)
            for each in part.rglob("*"):
                if each.is_file():
                    _settle(each)
            part.replace(folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)


def _settle(path: Path) -> None:
    """Wait until the disk has a file, so that a power cut cannot leave its name with half of it."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


@contextmanager
def writing(path: Path) -> Generator[None]:
    """Make the folder that `path` is to be in; what the system refuses is an `OutputError`."""
    _check_inside(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(
            f"cannot write {path}: {error.strerror or error}; choose a folder that can be written"
        ) from None


def remove(path: Path) -> None:
    """Remove a file, where there is one.

    Raises:
        OutputError: the system refuses to.
    """
    with writing(path):
        path.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file as UTF-8, whole or not at all."""
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))


def write_tensors(path: Path, tensors: dict[str, Tensor], metadata: dict[str, str]) -> None:
    """Write tensors as safetensors, whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.torch import save_file  # pyright: ignore[reportUnknownVariableType]

    try:
        write_atomically(path, lambda part: save_file(tensors, part, metadata))
    except SafetensorError as error:  # safetensors' own word for a full disk
        raise OutputError(f"cannot write {path}: {error}") from None


def check_writable(folder: Path) -> None:
    """Find out before long work whether its results can be written.

    Raises:
        OutputError: the folder cannot be made or written.
    """
    probe = folder / ".writable"
    write_atomically(probe, lambda part: part.write_bytes(b"\0"))
    probe.unlink(missing_ok=True)


def one_line(reason: BaseException) -> str:
    """What an error says, as a part of a line; its name where it says nothing."""
    words = " ".join(str(reason).split())
    return f"{words or type(reason).__name__:.400}"


def printable(text: str) -> str:
    """A text of anyone's in one line, fit for a terminal and for any file: what cannot be printed by its code."""
    return "".join(mark if mark.isprintable() else repr(mark)[1:-1] for mark in text)


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write a JSON object, whole or not at all.

    Raises:
        OutputError: the file cannot be written, or the object holds a number that is none, which nobody could read.
    """
    try:
        text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    except ValueError as error:
        raise OutputError(f"{path} is not written: {one_line(error)}") from None
    write_text(path, text + "\n")
