"""What the stages of a run took: simulator calls and seconds, kept in its folder as it goes.

RUN/run.json   whose run it is, and the cost of every stage since it began
"""

from __future__ import annotations

import json
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from roadproof.errors import RoadproofError
from roadproof.io.files import read_json, write_atomically

FILE = "run.json"
FORMAT = "roadproof-run"
FORMAT_VERSION = 1
_EVERY_S = 1.0


@dataclass(frozen=True, slots=True)
class StageCost:
    """What a stage took.

    Args:
        seconds: wall time.
        simulator_calls: drives.
    """

    seconds: float = 0.0
    simulator_calls: int = 0


class Ledger:
    """Writes down what stages take.

    Args:
        folder: of the run.
        identity: tells this run from another.
        stages: there are.
        paint: how the simulator puts paint on the road, see `simulators.protocol.PaintKind`.
        controller: which one is tested (`controllers.identity`), whatever it is called.

    Raises:
        RoadproofError: the folder is another run's, or one painted in another way.
        OutputError: it cannot be written.
    """

    def __init__(
        self, folder: Path, identity: str, stages: Sequence[str], *, paint: str = "rendered", controller: str = ""
    ) -> None:
        self._path, self._identity, self._paint = folder / FILE, identity, paint
        self._controller = controller
        self._current, self._since = "", 0.0
        self.cost = {stage: StageCost() for stage in stages}
        if not self._path.exists():
            self._write()
            return
        stored = read_json(self._path, FORMAT, FORMAT_VERSION, RoadproofError)
        if stored.get("identity") != self._identity:
            raise RoadproofError(f"{folder} holds a run with other settings; choose another folder, or remove it")
        if stored.get("controller", controller) != controller:
            raise RoadproofError(
                f"{folder} holds a run of another controller, which answers otherwise, as before a training; choose "
                "another folder, or remove it"
            )
        before = stored.get("paint", "rendered")
        if before != paint:
            raise RoadproofError(
                f"{folder} holds a run whose paint is {before}, here it is {paint}; choose another folder"
            )
        self.cost |= _costs(stored, self._path)

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        """Time a stage; one that is gone on with adds to what it took before."""
        self._current, self._since = name, time.perf_counter()
        try:
            yield
        finally:
            self._note()
            self._current = ""

    def step(self) -> None:
        """Note the time from time to time, so that a killed process loses a second of it at most."""
        if self._current and time.perf_counter() - self._since >= _EVERY_S:
            self._note()

    def calls(self, name: str, simulator_calls: int) -> None:
        """Say how many drives a stage took, from its beginning."""
        self.cost[name] = replace(self.cost[name], simulator_calls=simulator_calls)

    def _note(self) -> None:
        now = time.perf_counter()
        before = self.cost[self._current]
        self.cost[self._current] = replace(before, seconds=before.seconds + now - self._since)
        self._since = now
        self._write()

    def _write(self) -> None:
        cost = {stage: asdict(cost) for stage, cost in self.cost.items()}
        content = {"format": FORMAT, "version": FORMAT_VERSION, "identity": self._identity, "cost": cost}
        content |= {"paint": self._paint, "controller": self._controller}
        write_atomically(self._path, lambda part: part.write_text(json.dumps(content, indent=1) + "\n"))


def read_cost(folder: Path) -> dict[str, StageCost]:
    """What the stages of a run took, in their order; nothing where the run keeps no ledger.

    Raises:
        RoadproofError: the ledger is damaged.
    """
    path = folder / FILE
    return _costs(read_json(path, FORMAT, FORMAT_VERSION, RoadproofError), path) if path.exists() else {}


def _costs(stored: dict[str, Any], path: Path) -> dict[str, StageCost]:
    try:
        cost: dict[str, dict[str, float]] = stored["cost"]
        return {stage: StageCost(float(each["seconds"]), int(each["simulator_calls"])) for stage, each in cost.items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RoadproofError(f"{path} is incomplete or damaged ({error}); remove it, the stages stay") from None
