"""What a folder was made of: the first part that differs is named, with what it was and what it is."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from roadproof.errors import RecordingError, RoadproofError
from roadproof.io.identity import ANSWERS, CONTROLLER, digest, require_same, stated

NOW: dict[str, Any] = {
    "scenario": {"name": "left-03", "goal_m": (1.0, 2.0), "note": None},
    "budget": "Budget(" + "a" * 200 + "select=2, starts=5)",
    "seed": 3,
    ANSWERS: "0123",
}
BEFORE: dict[str, Any] = NOW | {"scenario": NOW["scenario"] | {"goal_m": [1.0, 2.0]}}


@pytest.mark.parametrize("before", [BEFORE, BEFORE | {"more": 1}], ids=["the same", "more"])
def test_a_folder_of_the_same_parts_is_gone_on_with(before: object) -> None:
    """What it says besides is not compared; tuples are JSON's lists."""
    require_same(Path("out"), "a run", before, NOW, RoadproofError)


@pytest.mark.parametrize(
    ("before", "lacks"),
    [
        *((nothing, "what it was made of") for nothing in (None, {}, [], "text")),
        ({name: BEFORE[name] for name in BEFORE if name != "seed"}, "its seed"),
        ({name: BEFORE[name] for name in BEFORE if name != ANSWERS}, "its controller"),
        ({"seed": 3}, "its scenario"),
    ],
)
def test_a_folder_that_does_not_say_all_that_it_was_made_of_is_refused(before: object, lacks: str) -> None:
    """Nobody knows whether it would have been the same."""
    message = f"out holds a run that does not say {lacks}; choose another folder, or remove it"
    with pytest.raises(RoadproofError, match=f"^{message}$"):
        require_same(Path("out"), "a run", before, NOW, RoadproofError)


OTHERS: dict[str, dict[str, Any]] = {
    "out holds a run with seed 4, now it is 3; choose another folder, or remove it": {"seed": 4},
    r"with scenario\.goal_m \[1\.0, 9\.0\], now it is \[1\.0, 2\.0\]": {
        "scenario": NOW["scenario"] | {"goal_m": [1.0, 9.0]}
    },
    r"with scenario\.note None, now it is None": {"scenario": {"name": "left-03", "goal_m": [1.0, 2.0]}},
    r"with scenario 'left-03', now it is \{'name': 'left-03', 'goal_m': \[1\.0, 2\.0\], 'note': None\}": {
        "scenario": "left-03"
    },
    r"with budget …a+select=1, starts=5\)', now it is …a+select=2, starts=5\)'; choose": {
        "budget": "Budget(" + "a" * 200 + "select=1, starts=5)"
    },
    "out holds a run of another controller, which answers otherwise, as before a training": {ANSWERS: "4567"},
    # The first of them.
    "with seed 4": {ANSWERS: "4567", "seed": 4},
}


@pytest.mark.parametrize("message", OTHERS)
def test_a_folder_of_other_parts_is_refused_in_one_line(message: str) -> None:
    """Short, whatever the parts are."""
    with pytest.raises(RecordingError, match=message) as refused:
        require_same(Path("out"), "a run", BEFORE | OTHERS[message], NOW, RecordingError)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 250


def test_a_controller_is_compared_by_its_digest_too() -> None:
    """Its answers come first, which say more."""
    before, now = BEFORE | {CONTROLLER: "cdef"}, NOW | {CONTROLLER: "89ab"}
    with pytest.raises(RoadproofError, match="a run of another controller, whose weights, settings or source are"):
        require_same(Path("out"), "a run", before, now, RoadproofError)
    with pytest.raises(RoadproofError, match="which answers otherwise"):
        require_same(Path("out"), "a run", before | {ANSWERS: "4567"}, now, RoadproofError)


def test_the_same_parts_have_one_digest() -> None:
    """In whatever order they are named."""
    assert stated({"a": 1, "b": (2, 3)}) == stated({"b": [2, 3], "a": 1}) == '{"a": 1, "b": [2, 3]}'
    assert digest("") == "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"
