"""What JSON holds, as the types that a class declares."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec

from roadproof.errors import RoadproofError

T = TypeVar("T")


def record(stored: object, kind: type[T], path: Path, error: type[RoadproofError], remedy: str) -> T:
    """A value of a type, from what JSON holds: every field there, of the declared type, all the way down.

    Args:
        stored: objects, lists, numbers, text; keys that the type does not know are left out.
        kind: a dataclass, or any type that annotations can say.
        path: the file, for the message.
        error: what to raise.
        remedy: what the user can do.

    Raises:
        error: a field is missing, or of another type.
    """
    try:
        return msgspec.convert(stored, kind)
    except (msgspec.ValidationError, OverflowError, RecursionError, UnicodeError) as reason:
        raise error(f"{path} is incomplete or damaged ({reason}); {remedy}") from None
