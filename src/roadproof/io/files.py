"""Files that are never half written, and JSON that says what it is."""

from __future__ import annotations

import json
import math
import os
import shutil
import stat
import tempfile
import tomllib
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias, cast

from roadproof.errors import OutputError, RoadproofError

if TYPE_CHECKING:
    from torch import Tensor


AnyPath: TypeAlias = str | os.PathLike[str]
"""What public functions take as a path."""

MOST_TEXT_BYTES = 32 * 2**20
"""A longer JSON or TOML file is not read."""

_MARKS = frozenset(" ._+-=,()[]")
_LONGEST_NAME = 100
_LONGEST_TEXT = 1000
_MOST_DIGITS = 20
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


def _text_of(path: Path, most_bytes: int) -> str:
    with open_file(path) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise ValueError(f"it is larger than {most_bytes:,} bytes")
    return content.decode("utf-8")


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


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write a JSON object, whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    write_text(path, json.dumps(content, indent=1, ensure_ascii=False) + "\n")


def _whole(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        raise ValueError(f"an integer has {len(text)} digits")
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text:.20} is no finite number")
    return value


def parse_json(text: str) -> dict[str, Any]:
    """Read a JSON object from a text.

    Raises:
        TypeError: the text is something else than an object.
        ValueError, RecursionError: the text is not JSON, is too deep, or has a number that is none (NaN, infinity,
            hundreds of digits).
    """
    content: object = json.loads(text, parse_int=_whole, parse_float=_finite, parse_constant=_finite)
    if not isinstance(content, dict):
        raise TypeError("it holds no JSON object")
    return cast("dict[str, Any]", content)


def check_format(
    fields: Mapping[str, object], path: Path, file_format: str, version: int, error: type[RoadproofError]
) -> None:
    """See that a file says the format that is expected, in a version that is understood.

    Args:
        fields: what the file says, by name.
        path: the path of the file, for the message.
        file_format: the "format" that the file must name.
        version: the newest "version" that is understood.
        error: the type of error to raise.

    Raises:
        error: the file is of another format, or of a newer version.
    """
    if fields.get("format") != file_format:
        raise error(f"{path} has format {fields.get('format')!r:.60}, expected {file_format!r}")
    known = fields.get("version")
    if not isinstance(known, int) or isinstance(known, bool) or known < 1:
        raise error(f"{path} has version {known!r:.40}, expected a whole number from 1")
    if known > version:
        raise error(f"{path} has version {known!r:.40}, this roadproof reads up to {version}; update it")


def read_toml(path: Path, error: type[RoadproofError]) -> dict[str, Any]:
    """Read a TOML file of the user's, such as a plan.

    Args:
        path: the TOML file to read.
        error: the type of error to raise.

    Raises:
        error: the file cannot be read, is not valid TOML, or has a text that can name nothing: of more than 1,000
            characters, or with a NUL; the message names it.
    """
    try:
        content = tomllib.loads(_text_of(path, MOST_TEXT_BYTES))
        odd = next((text for text in _texts(content) if len(text) > _LONGEST_TEXT or "\0" in text), None)
    except OSError as reason:
        raise error(f"cannot read {path}: {reason.strerror or reason}; check the path") from None
    except (MemoryError, ValueError, RecursionError) as reason:
        raise error(f"{path} is not valid TOML ({one_line(reason)})") from None
    if odd is not None:
        told = f"{odd!r:.40} of {len(odd)} characters"
        raise error(f"{path} has the text {told}, expected at most {_LONGEST_TEXT} and no NUL")
    return content


def _texts(value: object) -> Generator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for key, each in cast("dict[str, object]", value).items():
            yield key
            yield from _texts(each)
    elif isinstance(value, list):
        for each in cast("list[object]", value):
            yield from _texts(each)


def read_json(
    path: Path, file_format: str, version: int, error: type[RoadproofError], *, most_bytes: int = MOST_TEXT_BYTES
) -> dict[str, Any]:
    """Read a JSON file that names its format and version.

    Args:
        path: the JSON file to read.
        file_format: the "format" that the file must name.
        version: the newest "version" that is understood.
        error: the type of error to raise.
        most_bytes: how long the file may be.

    Raises:
        error: the file is missing, is no JSON object (`parse_json`), or is of another format or a newer version.
    """
    try:
        content = parse_json(_text_of(path, most_bytes))
    except OSError as reason:
        raise error(f"cannot read {path}: {reason.strerror or reason}") from None
    except (MemoryError, ValueError, RecursionError) as reason:
        raise error(f"{path} is not valid JSON ({one_line(reason)})") from None
    except TypeError:
        raise error(f"{path} holds no JSON object, expected a {file_format} file") from None
    check_format(content, path, file_format, version, error)
    return content
