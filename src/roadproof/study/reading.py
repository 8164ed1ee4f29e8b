"""From a plan's tables to objects, and from mistakes to one line that names them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, TypeVar, cast, get_args, get_origin, get_type_hints

import msgspec

from roadproof.compositing import Variation
from roadproof.controllers.loading import runs_code
from roadproof.errors import RoadproofError, StudyError
from roadproof.paint import LaneMark, PaintLimits
from roadproof.simulators.loading import is_elsewhere

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
    except RoadproofError as error:
        raise StudyError(f"{what}: {error}") from None
    except msgspec.ValidationError as error:
        if isinstance(error.__cause__, RoadproofError):  # one that is a ValueError too
            raise StudyError(f"{what}: {error.__cause__}") from None
        told = str(error).replace("`", "")
        if missing := re.fullmatch(r"Object missing required field (\w+)", told):
            raise StudyError(f"{what} lacks {missing[1]}") from None
        reason, _, where = told.partition(" - at $.")
        name = re.split(r"[.\[]", where)[0]
        if reason.startswith("Invalid enum value"):
            reason = f"expected one of {', '.join(_choices(get_type_hints(kind)[name]))}"
        raise StudyError(f"{what}: {where} is {values[name]!r:.60}, {reason[0].lower()}{reason[1:]}") from None


def paint_of(content: Mapping[str, Any], what: str) -> tuple[PaintLimits | None, Variation | None]:
    """Limits on paint and a variation from the tables [paint] and [variation], each None where it is not there.

    Raises:
        StudyError: there is another key, or a value makes no sense.
    """
    for key, table in content.items():
        if key not in ("paint", "variation") or not isinstance(table, dict):
            raise StudyError(f"{what}: {key!r:.60} is no table of it, expected [paint] and [variation]")
    limits, variation = content.get("paint"), content.get("variation")
    for mark in cast("list[Mapping[str, Any]]", (limits or {}).get("marks", [])):
        build(LaneMark, mark, "paint.marks")
    return (
        None if limits is None else build(PaintLimits, limits, "paint"),
        None if variation is None else build(Variation, variation, "variation"),
    )


def refuse_untrusted(controller: str, simulator: str | None) -> None:
    """See that following a plan of anyone's runs none of their code and calls no other machine.

    Args:
        controller: the spec of the controller that the plan names.
        simulator: the spec of its simulator; None where it opens none.

    Raises:
        StudyError: it would; the message names what it would do, and how to allow that.
    """
    if runs_code(controller):
        raise StudyError(
            f"controller {controller!r} runs what its author wrote; look at it, then give --trust (trust=True)"
        )
    if simulator is not None and is_elsewhere(simulator):
        raise StudyError(f"simulator {simulator!r} is another machine; give --trust (trust=True) to call it")


def _choices(hint: Any) -> tuple[str, ...]:  # noqa: ANN401  # whatever annotates a field
    """The words of a Literal or an enumeration, or of a tuple of them."""
    one = get_args(hint)[0] if get_origin(hint) is tuple else hint
    return get_args(one) or tuple(one)
