"""Dataclasses in files: what is written is read as its declared types, and anything else is one line."""

from __future__ import annotations

import json
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float, Int, UInt8

from roadproof.errors import RecordingError, RoadproofError
from roadproof.io.arrays import write_archive
from roadproof.io.records import RecordFile
from roadproof.io.text import read_json


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


class Side(StrEnum):
    """Left or right."""

    LEFT = "left"
    RIGHT = "right"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Drive:
    """Arrays, and all else that a record may have."""

    name: str
    side: Side
    spread: tuple[float, float] | None
    where: Inner
    x_m: Float[np.ndarray, " n"]
    step: Int[np.ndarray, " n"]
    frames: UInt8[np.ndarray, "n h w 3"]
    count: int = 1

    def __post_init__(self) -> None:
        if self.count < 1:
            raise RecordingError(f"count is {self.count}, expected 1 or more")


OUTER = RecordFile(kind=Outer, name="roadproof-outer", error=RoadproofError, remedy="make it again")
DRIVE = RecordFile(
    kind=Drive, name="drive", version=2, error=RoadproofError, remedy="make it again", elsewhere=("name",)
)
SAMPLE = Drive(
    name="a",
    side=Side.RIGHT,
    spread=(0.5, 1.0),
    where=Inner(2.0),
    x_m=np.array([1.5, -2.0]),
    step=np.array([3, 7]),
    frames=np.arange(24, dtype=np.uint8).reshape(2, 2, 2, 3),
)


def made(stored: object) -> Outer:
    """From what JSON holds."""
    return OUTER.made(Path("a.json"), stored)  # type: ignore[arg-type]


def test_fields_are_of_their_types_all_the_way_down() -> None:
    """Whole numbers are numbers, lists are tuples, what is not known is left out."""
    found = made({"word": "a", "inner": [{"metres": 1}], "spread": [0, 2.5], "more": True})
    assert found == Outer("a", (Inner(1.0),), (0.0, 2.5))
    assert type(found.inner[0].metres) is float


@pytest.mark.parametrize(
    "stored",
    [
        {},
        {"word": 1},
        {"word": "a", "inner": [{"metres": "1"}]},
        {"word": "a", "inner": [{"metres": None}]},
        {"word": "a", "inner": {"metres": 1}},
        {"word": "a", "inner": [{"metres": 1, "more": 2}]},
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


@pytest.mark.parametrize("name", ["a.json", "a.npz"])
def test_a_record_is_the_same_when_read(tmp_path: Path, name: str) -> None:
    """In JSON arrays are lists; what is kept elsewhere is not in the file."""
    pictures = {"frames": SAMPLE.frames} if name == "a.json" else {}  # lists do not say that they are bytes
    DRIVE.write(tmp_path / name, SAMPLE, units={"x_m": "metres"})
    found = DRIVE.read(tmp_path / name, name="b", **pictures)
    assert (found.name, found.side, found.spread, found.where) == ("b", Side.RIGHT, (0.5, 1.0), Inner(2.0))
    for field in ("x_m", "step", "frames"):
        assert getattr(found, field).dtype == getattr(SAMPLE, field).dtype
        np.testing.assert_array_equal(getattr(found, field), getattr(SAMPLE, field))
    assert DRIVE.content(tmp_path / name)["units"] == {"x_m": "metres"}
    assert "name" not in DRIVE.content(tmp_path / name)


@pytest.mark.parametrize("text", ["[]", "null", "3"])
def test_what_is_no_object_is_said(tmp_path: Path, text: str) -> None:
    """A file of another kind."""
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(RoadproofError, match=r"a\.json holds no JSON object, expected a roadproof-outer file"):
        OUTER.read(tmp_path / "a.json")


ARRAYS = {"x_m": np.zeros(2), "step": np.arange(2), "frames": np.zeros((2, 1, 1, 3), np.uint8)}
HEADER = {"format": "drive", "version": 2, "side": "left", "spread": None, "where": {"metres": 1.0}}
WRONG = {
    "step of type float64, expected whole numbers": {"step": np.zeros(2)},
    r"frames is float64 of shape \(2, 1, 1, 3\), expected UInt8\[ndarray, 'n h w 3'\]": {
        "frames": np.zeros((2, 1, 1, 3))
    },
    r"x_m is float64 of shape \(2, 2\), expected Float\[ndarray, 'n'\]": {"x_m": np.zeros((2, 2))},
    "x_m: it is of type complex128, expected numbers": {"x_m": np.zeros(2, complex)},
    "count is 0, expected 1 or more": {"count": 0},
    "side: Invalid enum value 'up'": {"side": "up"},
    "required field `where`": {"where": None},
    "has version 3, this roadproof reads up to 2; update it": {"version": 3},
    "has format 'outer', expected 'drive'": {"format": "outer"},
    "NaN is no finite number": {"spread": [float("nan"), 1.0]},
}


@pytest.mark.parametrize("message", WRONG)
def test_what_an_archive_gets_wrong_is_named(tmp_path: Path, message: str) -> None:
    """Type, shape, range, format; in one line."""
    change = WRONG[message]
    header = {name: value for name, value in (HEADER | change).items() if name not in ARRAYS}
    if change.get("where", 0) is None:
        del header["where"]
    write_archive(tmp_path / "a.npz", {name: change.get(name, ARRAYS[name]) for name in ARRAYS}, header)
    with pytest.raises(RoadproofError, match=message) as refused:
        DRIVE.read(tmp_path / "a.npz", name="a")
    assert "a.npz" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_numbers_may_stand_alone_in_an_archive(tmp_path: Path) -> None:
    """Where it has no header, a field that is no array is an array of one number."""
    file = RecordFile(kind=Inner, error=RoadproofError, remedy="make it again", header=None)
    file.write(tmp_path / "a.npz", Inner(2.5))
    assert file.read(tmp_path / "a.npz") == Inner(2.5)
    write_archive(tmp_path / "a.npz", {"metres": np.zeros(3)})
    with pytest.raises(RoadproofError, match=r"metres of shape \(3,\), expected one number"):
        file.read(tmp_path / "a.npz")


def test_ragged_lists_are_no_array(tmp_path: Path) -> None:
    """JSON may hold anything."""
    content = HEADER | {"x_m": [[1.0], [2.0, 3.0]], "step": [1], "frames": []}
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(RoadproofError, match=r"a\.json is incomplete or damaged .*; make it again$"):
        DRIVE.read(tmp_path / "a.json", name="a")


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999", "9" * 400])
def test_numbers_that_are_none_are_refused_wherever_they_stand(tmp_path: Path, number: str) -> None:
    """They would come back as NaN in a table, or as an error much later."""
    path = tmp_path / "a.json"
    path.write_text(f'{{"format": "f", "version": 1, "deep": [{{"a": {number}}}]}}')
    with pytest.raises(RoadproofError, match="is not valid JSON"):
        read_json(path, "f", 1, RoadproofError)


def test_half_a_character_is_refused_and_a_whole_one_is_not(tmp_path: Path) -> None:
    """No file could be written with it."""
    path = tmp_path / "a.json"
    for text, whole in ((r"\ud83d\ude97", True), (r"\uD83D", False), (r"\ude97 \ud83d", False)):
        path.write_text(f'{{"format": "f", "version": 1, "deep": [{{"{text}": 1}}]}}')
        if whole:
            assert list(read_json(path, "f", 1, RoadproofError)["deep"][0]) == ["🚗"]
            continue
        with pytest.raises(RoadproofError, match=r"is not valid JSON .*surrogates not allowed"):
            read_json(path, "f", 1, RoadproofError)
