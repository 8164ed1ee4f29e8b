"""How a search went, against simulator calls and seconds: history.json in the folder of a job."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from roadproof.errors import StudyError
from roadproof.io.records import RecordFile


@dataclass(frozen=True, kw_only=True, slots=True)
class Progress:
    """A value as a search went on: three lists of equal length.

    Args:
        calls: how many simulator calls had been made when each value was known.
        seconds: seconds since the search began when each value was known.
        best: value of the best pattern so far, as long as `calls`.
    """

    calls: tuple[int, ...]
    seconds: tuple[float, ...]
    best: tuple[float, ...]

    def __post_init__(self) -> None:
        if not len(self.calls) == len(self.seconds) == len(self.best):
            raise ValueError("its lists are not equally long")


@dataclass(frozen=True, kw_only=True, slots=True)
class History(Progress):
    """The course of a search in its own measure, and what is known of it in metres.

    Args:
        kind: whether the values come from drives, from drives in the recorded world, or from composited frames.
        measure: name of the objective that the search maximises; empty where nobody said.
        deviation_m: deviation of the pattern that was best by then in the search's own measure, metres; None where the
            search does not drive.
        driven: deviation of the pattern that was driven after a search that does not drive, metres; its lists are empty
            where none was driven, and it is None for a search that drives.
    """

    kind: Literal["closed loop", "predicted", "surrogate"]
    measure: str = ""
    deviation_m: tuple[float, ...] | None = None
    driven: Progress | None = None

    def __post_init__(self) -> None:
        Progress.__post_init__(self)
        if self.deviation_m and len(self.deviation_m) != len(self.calls):
            raise ValueError("its deviation_m is not as long as its calls")

    @property
    def deviation(self) -> Progress | None:
        """The metres that the best patterns reached when driven, never a stand-in for them; None where unknown."""
        if self.kind != "closed loop":
            return self.driven if self.driven is not None and self.driven.best else None
        return Progress(calls=self.calls, seconds=self.seconds, best=self.deviation_m) if self.deviation_m else None

    def to_json(self) -> bytes:
        """The content of history.json."""
        kept = {name: value for name, value in _FILE.stated(self).items() if value is not None}
        return (json.dumps({"format": _FILE.name, "version": _FILE.version, **kept}) + "\n").encode()


_FILE = RecordFile(
    kind=History,
    name="roadproof-study-history",
    error=StudyError,
    remedy="remove its folder and run the study again",
)


def read_history(path: Path) -> History:
    """Read what `History.to_json` wrote.

    Raises:
        StudyError: the file is missing, damaged or of another format.
    """
    return _FILE.read(path)
