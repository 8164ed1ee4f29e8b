"""JSON as declared types, and numbers that are none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from roadproof.errors import RoadproofError
from roadproof.io.files import read_json
from roadproof.io.records import record


@dataclass(frozen=True, slots=True)
class Inner:
    """One number."""

    metres: float


@dataclass(frozen=True, slots=True)
class Outer:
    """Some of them, and a word."""

    word: str
    inner: tuple[Inner, ...] = ()
    spread: tuple[float, float] | None = None


def made(stored: object) -> Outer:
    """From what JSON holds."""
    return record(stored, Outer, Path("a.json"), RoadproofError, "make it again")


def test_fields_are_of_their_types_all_the_way_down() -> None:
    """Whole numbers are numbers, lists are tuples, what is not known is left out."""
    found = made({"word": "a", "inner": [{"metres": 1}], "spread": [0, 2.5], "more": True})
    assert found == Outer("a", (Inner(1.0),), (0.0, 2.5))
    assert type(found.inner[0].metres) is float


@pytest.mark.parametrize(
    "stored",
    [
        {},
        [],
        None,
        {"word": 1},
        {"word": "a", "inner": [{"metres": "1"}]},
        {"word": "a", "inner": [{"metres": None}]},
        {"word": "a", "inner": {"metres": 1}},
        {"word": "a", "spread": [1]},
        {"word": "a", "spread": [1, 2, 3]},
        {"word": "a", "inner": [{"metres": 10**400}]},
        {"word": "a", "inner": [{"metres": "\ud800"}]},
    ],
)
def test_anything_else_is_one_line(stored: object) -> None:
    """It says where, and what to do."""
    with pytest.raises(RoadproofError, match=r"a\.json is incomplete or damaged .*; make it again$"):
        made(stored)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "9" * 400])
def test_numbers_that_are_none_are_refused_wherever_they_stand(tmp_path: Path, number: str) -> None:
    """They would come back as NaN in a table, or as an error much later."""
    path = tmp_path / "a.json"
    path.write_text(f'{{"format": "f", "version": 1, "deep": [{{"a": {number}}}]}}')
    with pytest.raises(RoadproofError, match="is not valid JSON"):
        read_json(path, "f", 1, RoadproofError)
