"""How large a number may be, wherever it is given: on the command line, in a plan, in a file."""

from __future__ import annotations

from numbers import Integral
from typing import TypeGuard

from roadproof.errors import RoadproofError

MAX_SEED = 2**32 - 1
MAX_FIGURES = 64
MAX_CROWD = 500
MAX_PROCESSES = 256
MANY = 1_000_000
LEAST_PAINT_M2, MOST_PAINT_M2 = 0.01, 10_000.0
"""Of the limit on painted area: less than a square decimetre would not be seen."""
LEAST_WIDTH, MOST_WIDTH = 1 / 32, 8.0
"""Of the factor on CIL's channels and units."""


def is_whole(number: object) -> TypeGuard[int]:
    """Whether something is a whole number, of Python or numpy."""
    return not isinstance(number, bool) and isinstance(number, Integral)


def check_seed(seed: object, what: str, error: type[RoadproofError]) -> None:
    """See that a seed is a whole number in its range.

    Raises:
        error: it is none, or out of its range.
    """
    if not is_whole(seed) or not 0 <= seed <= MAX_SEED:
        raise error(f"{what} is {seed!r:.40}, expected a whole number from 0 to {MAX_SEED:,}")


def check_range(
    value: int | float, what: str, least: int | float, most: int | float, error: type[RoadproofError]
) -> None:
    """See that a number is in its range.

    Raises:
        error: the number is out of its range.
    """
    if not least <= value <= most:
        raise error(f"{what} is {value}, expected {least} to {most}")
