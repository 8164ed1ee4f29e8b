"""Options that take one of a few words."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import TypeVar

from roadproof.errors import RoadproofError

Word = TypeVar("Word", bound=str)


def choice(value: str, option: str, allowed: Sequence[Word]) -> Word:
    """The allowed word that was given.

    Raises:
        RoadproofError: it is none of them; the message names the nearest.
    """
    for word in allowed:
        if value == word:
            return word
    near = difflib.get_close_matches(value, allowed, 1)
    hint = f"; did you mean {near[0]}?" if near else ""
    raise RoadproofError(f"--{option} is {value!r}, expected one of {', '.join(allowed)}{hint}")
