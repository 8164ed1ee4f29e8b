"""JSON and TOML that anyone may have written: read within bounds, and known by format and version."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Generator, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from roadproof.errors import RoadproofError
from roadproof.io.files import one_line, open_file

MOST_TEXT_BYTES = 32 * 2**20
"""A longer JSON or TOML file is not read."""

Leaf = TypeVar("Leaf", str, int)

_LONGEST_TEXT = 1000
_MOST_DIGITS = 20


def text_of(path: Path, most_bytes: int = MOST_TEXT_BYTES) -> str:
    """The text of a file, where it has no more bytes.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is larger, or not UTF-8.
    """
    with open_file(path) as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise ValueError(f"it is larger than {most_bytes:,} bytes")
    return content.decode("utf-8")


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
            hundreds of digits) or half a character.
    """
    content: object = json.loads(text, parse_int=_whole, parse_float=_finite, parse_constant=_finite)
    if "\\ud" in text.lower():  # of such a half nothing could be written or printed
        json.dumps(content, ensure_ascii=False).encode()
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
        error: the file cannot be read, is not valid TOML, or has a text that can name nothing, of more than 1,000
            characters or with a NUL; the message names it.
    """
    try:
        content = tomllib.loads(text_of(path, MOST_TEXT_BYTES))
        for number in _leaves(content, int):
            # A hexadecimal one may be of any length, and could not even be shown.
            if abs(number) >= 10**_MOST_DIGITS:
                raise ValueError(f"an integer has more than {_MOST_DIGITS} digits")
        odd = next((text for text in _leaves(content, str) if len(text) > _LONGEST_TEXT or "\0" in text), None)
    except OSError as reason:
        raise error(f"cannot read {path}: {reason.strerror or reason}; check the path") from None
    except (MemoryError, ValueError, RecursionError) as reason:
        raise error(f"{path} is not valid TOML ({one_line(reason)})") from None
    if odd is not None:
        told = f"{odd!r:.40} of {len(odd)} characters"
        raise error(f"{path} has the text {told}, expected at most {_LONGEST_TEXT} and no NUL")
    return content


def _leaves(value: object, kind: type[Leaf]) -> Generator[Leaf]:
    """All keys and values of a kind, however deep."""
    if isinstance(value, kind):
        yield value
    elif isinstance(value, dict):
        for key, each in cast("dict[str, object]", value).items():
            yield from _leaves(key, kind)
            yield from _leaves(each, kind)
    elif isinstance(value, list):
        for each in cast("list[object]", value):
            yield from _leaves(each, kind)


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
        content = parse_json(text_of(path, most_bytes))
    except OSError as reason:
        raise error(f"cannot read {path}: {reason.strerror or reason}") from None
    except (MemoryError, ValueError, RecursionError) as reason:
        raise error(f"{path} is not valid JSON ({one_line(reason)})") from None
    except TypeError:
        raise error(f"{path} holds no JSON object, expected a {file_format} file") from None
    check_format(content, path, file_format, version, error)
    return content


def count_of(count: int, what: str) -> str:
    """A number of things, as "1 job" or "2 jobs"."""
    return f"{count} {what}{'s' if count != 1 else ''}"
