"""From a plan's tables to objects, and from mistakes to one line that names them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any, TypeVar

import msgspec

from roadproof.errors import StudyError

T = TypeVar("T")


def build(kind: type[T], values: Mapping[str, Any], what: str) -> T:
    """An object of a dataclass from a table: every key known, every value of the declared type.

    Raises:
        StudyError: a key is unknown or missing, or a value is of another type or makes no sense.
    """
    known = [field.name for field in fields(kind)]  # pyright: ignore[reportArgumentType]  # a dataclass
    for key in values:
        if key not in known:
            nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
            raise StudyError(f"{what} has an unknown key {key!r}; did you mean {nearest[0]!r}?")
    try:
        return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        told = str(error).replace("`", "")
        if missing := re.fullmatch(r"Object missing required field (\w+)", told):
            raise StudyError(f"{what} lacks {missing[1]}") from None
        reason, _, where = told.partition(" - at $.")
        at = where or "it"
        raise StudyError(f"{what}: {at} is {_value(values, where)!r:.60}, {reason[0].lower()}{reason[1:]}") from None


def one_of(value: str, name: str, choices: Iterable[str]) -> None:
    """See that a word is known.

    Raises:
        StudyError: it is not.
    """
    if value not in choices:
        raise StudyError(f"{name} is {value!r}, expected one of {', '.join(choices)}")


def within(value: int | float, name: str, least: int | float, most: int | float) -> None:
    """See that a number is in its range.

    Raises:
        StudyError: it is not.
    """
    if not least <= value <= most:
        raise StudyError(f"{name} is {value}, expected {least} to {most}")


def _value(values: Mapping[str, Any], where: str) -> object:
    return values.get(where.partition("[")[0].partition(".")[0])
