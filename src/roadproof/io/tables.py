"""From the tables of a user's TOML file to objects, and from mistakes to one line that names them."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from itertools import product
from typing import Any, Literal, TypeVar, cast, get_args, get_origin, get_type_hints

import msgspec

from roadproof.errors import RoadproofError

T = TypeVar("T")


def build(kind: type[T], values: Mapping[str, Any], what: str, error: type[RoadproofError]) -> T:
    """An object of a dataclass from a table: every key known, every value of the declared type, all the way down.

    Args:
        kind: the dataclass to make.
        values: the table as TOML has it.
        what: what the table is called in messages, such as "the study".
        error: the type of error to raise.

    Raises:
        error: a key is unknown or missing, or a value is of another type or makes no sense.
    """
    for where, key, known in unknown_keys(kind, values, ""):
        nearest = difflib.get_close_matches(key, known, n=1, cutoff=0.0)
        place = f"{what}: {where}" if where else what
        raise error(f"{place} has an unknown key {key!r:.60}; did you mean {nearest[0]!r}?")
    try:
        return msgspec.convert(values, kind)
    except RoadproofError as reason:
        raise error(f"{what}: {reason}") from None
    except msgspec.ValidationError as reason:
        if isinstance(reason.__cause__, RoadproofError):  # one that is a ValueError too
            raise error(f"{what}: {reason.__cause__}") from None
        raise error(_told(kind, values, what, str(reason).replace("`", ""))) from None


def unknown_keys(declared: Any, stored: object, where: str) -> Iterator[tuple[str, str, list[str]]]:  # noqa: ANN401
    """Keys of a table, and of the tables in it, that no dataclass declares: what nobody reads is a mistake.

    Args:
        declared: the annotation of what is stored, such as a dataclass, a tuple of one, or one or None.
        stored: tables as dicts, arrays as lists.
        where: what `stored` is called, if anything; its parts are called so, with their names behind a point.

    Yields:
        Where the key stands, the key, and the keys that are known there.
    """
    if is_dataclass(declared):
        if not isinstance(stored, Mapping):
            return
        known = declared_types(cast("type", declared))
        for key, value in cast("Mapping[str, object]", stored).items():
            if key in known:
                yield from unknown_keys(known[key], value, f"{where}.{key}" if where else key)
            else:
                yield where, key, list(known)
        return
    if get_origin(declared) is dict and isinstance(stored, Mapping):
        parts = list(cast("Mapping[str, object]", stored).values())
    else:
        parts = cast("list[object]", stored) if isinstance(stored, list) else [stored]
    for each, part in product(get_args(declared), parts):
        yield from unknown_keys(each, part, where)


@cache
def declared_types(kind: type) -> dict[str, Any]:
    """The types that a dataclass declares, by its fields' names."""
    hints = get_type_hints(kind)
    return {each.name: hints[each.name] for each in fields(kind)}


def _told(kind: type, values: Mapping[str, Any], what: str, mistake: str) -> str:
    """The line that says of a value of the wrong type where it is, what it is and what was expected."""
    reason, _, where = mistake.partition(" - at $.")
    if missing := re.fullmatch(r"Object missing required field (\w+)", reason.removesuffix(" - at $")):
        return f"{what}: {where} lacks {missing[1]}" if where else f"{what} lacks {missing[1]}"
    value: Any = values
    declared: Any = kind
    for name, row in re.findall(r"(\w+)|\[(\d+)\]", where.partition("[...]")[0]):
        if name:
            value, declared = value[name], declared_types(_part(declared, is_dataclass))[name]
        else:
            value = value[int(row)]
    if reason.startswith("Invalid enum value"):
        words = _part(declared, _names_words)
        reason = f"expected one of {', '.join(get_args(words) or tuple(words))}"
    reason = reason.replace(" | null", "").replace("object", "table")  # TOML's word
    return f"{what}: {where} is {value!r:.60}, {reason[0].lower()}{reason[1:]}"


def _part(declared: Any, fits: Callable[[Any], bool]) -> Any:  # noqa: ANN401
    """What fits in an annotation: itself, or what it has one or several of."""
    if fits(declared):
        return declared
    return next((found for each in get_args(declared) if (found := _part(each, fits)) is not None), None)


def _names_words(declared: object) -> bool:
    return get_origin(declared) is Literal or (isinstance(declared, type) and issubclass(declared, Enum))


def first_twice(values: Iterable[T]) -> T | None:
    """The first value that came before; None where each is there once."""
    seen: set[T] = set()
    for value in values:
        if value in seen:
            return value
        seen.add(value)
    return None


def each_once(values: Sequence[object], what: str, error: type[RoadproofError]) -> None:
    """See that a list is not empty, and that nothing stands in it twice.

    Raises:
        error: the list is empty, or something stands in it twice.
    """
    if not values:
        raise error(f"{what} is empty, expected at least one")
    if (twice := first_twice(values)) is not None:
        raise error(f"{what} has {twice} twice, expected each once")
