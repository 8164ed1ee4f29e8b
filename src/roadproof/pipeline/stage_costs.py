"""What the stages of a run took: simulator calls and seconds, kept in its folder as it goes.

RUN/run.json   whose run it is, and the cost of every stage since it began
"""

from __future__ import annotations

import time
from collections.abc import Collection, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from roadproof.errors import RoadproofError
from roadproof.io.identity import require_same
from roadproof.io.records import RecordFile, plain

FILE = "run.json"
_EVERY_S = 1.0


@dataclass(frozen=True, slots=True)
class StageCost:
    """The cost of one stage of a run.

    Args:
        seconds: wall time, seconds.
        simulator_calls: number of simulator drives.
    """

    seconds: float = 0.0
    simulator_calls: int = 0


@dataclass(frozen=True, slots=True)
class _RunFile:
    """The content of run.json."""

    cost: dict[str, StageCost]
    made_of: dict[str, Any]


_FILE = RecordFile(kind=_RunFile, name="roadproof-run", error=RoadproofError, remedy="remove it, the stages stay")


class Ledger:
    """Records the cost of each stage of a run in run.json.

    Args:
        folder: path of the run folder.
        made_of: identity of the run, by name (`io.identity`).
        stages: names of all stages of the run, in order.
        what: the run in a word, for a message that refuses its folder.
        unused: names of the parts that nothing in the folder was made with yet, which may be others now.

    Raises:
        RoadproofError: the folder belongs to another run; the message names what differs.
        OutputError: run.json cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        made_of: Mapping[str, object],
        stages: Sequence[str],
        what: str = "a run",
        unused: Collection[str] = (),
    ) -> None:
        self._path, self._made_of = folder / FILE, cast("dict[str, Any]", plain(made_of))
        self._current, self._since = "", 0.0
        self.cost = {stage: StageCost() for stage in stages}
        if not self._path.exists():
            self._write()
            return
        before = _FILE.read(self._path)
        # Runs in the town as software draws it are older than this word.
        known = {"world": ""} | before.made_of | {name: self._made_of[name] for name in unused}
        require_same(folder, what, known, self._made_of, RoadproofError)
        self.cost |= before.cost
        if known != before.made_of:
            self._write()

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        """Time a stage; a resumed stage adds to the time it took before."""
        self._current, self._since = name, time.perf_counter()
        try:
            yield
        finally:
            self._note()
            self._current = ""

    def step(self) -> None:
        """Write the time down at intervals, so that a killed process loses a second of it at most."""
        if self._current and time.perf_counter() - self._since >= _EVERY_S:
            self._note()

    def calls(self, name: str, simulator_calls: int) -> None:
        """Record how many drives a stage took since the run began."""
        self.cost[name] = replace(self.cost[name], simulator_calls=simulator_calls)
        self._write()

    def _note(self) -> None:
        now = time.perf_counter()
        before = self.cost[self._current]
        self.cost[self._current] = replace(before, seconds=before.seconds + now - self._since)
        self._since = now
        self._write()

    def _write(self) -> None:
        _FILE.write(self._path, _RunFile(self.cost, self._made_of))


def read_cost(folder: Path) -> dict[str, StageCost]:
    """Cost of each stage of a run, in their order; empty if the run has no run.json.

    Raises:
        RoadproofError: run.json is damaged.
    """
    path = folder / FILE
    return _FILE.read(path).cost if path.exists() else {}
