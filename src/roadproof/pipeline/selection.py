"""Choosing among what a search found by driving over it: a search ranks only coarsely.

SELECTION/selection.json      every candidate driven, with what came of it
SELECTION/pattern.json, .png  the one that was chosen
SELECTION/episodes/*.npz      the drives: clean, and one for each candidate (`driving.drive_store`)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, cast

from roadproof.attacks import Candidate, PathDeviation, SpeedChange
from roadproof.attacks.groups import Direction
from roadproof.controllers import Controller
from roadproof.datatypes import Weather
from roadproof.driving.deviation import canvas_missed
from roadproof.driving.drive_store import CLEAN, DriveConditions, Episodes, load_episodes, make_missing
from roadproof.driving.episode import Episode
from roadproof.driving.trial import Trial
from roadproof.errors import RoadproofError
from roadproof.io.files import AnyPath, as_path
from roadproof.io.identity import require_same
from roadproof.io.records import RecordFile, plain
from roadproof.patterns import Pattern, load_pattern, raster, save_pattern
from roadproof.processes import Pool, open_or_here
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import Simulator

DEVIATION, SPEED = PathDeviation.word, SpeedChange.word

UNITS = {DEVIATION: "m", SPEED: "m/s"}
"""What candidates are chosen by when they are driven, and its unit."""


def chosen_by(candidates: Sequence[Candidate]) -> str:
    """What a choice among candidates is made by: the speed where they were searched for it, else the deviation."""
    return SPEED if any(each.predicted_mps is not None for each in candidates) else DEVIATION


@dataclass(frozen=True, kw_only=True, slots=True)
class Driven:
    """One candidate and the drive over it, closed loop.

    Args:
        group: name of the group of drives that the candidate was found on.
        rank: rank of the candidate by the search, 1 for the strongest.
        trial: comparison of the drive over the candidate with the clean drive.
    """

    group: str
    rank: int
    trial: Trial

    def effect(self, chosen_by: str) -> float:
        """What the choice is made by: metres of deviation, or m/s of speed in the direction of the group."""
        if chosen_by == DEVIATION:
            return self.trial.deviation_m
        change_mps = self.trial.speed_change_mps or 0.0
        if self.group == Direction.SLOWER:
            return -change_mps
        return change_mps if self.group == Direction.FASTER else abs(change_mps)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Selection:
    """The candidate that deviated most when driven, or whose speed changed most.

    Args:
        pattern: pattern of the chosen candidate.
        driven: candidates that were driven over, in the search's order.
        chosen: index of the chosen candidate in `driven`.
        simulator_calls: number of drives, the clean one included if it was made for this; 0 if they are predicted.
        predicted: whether the drives are predicted, and nothing was driven for real.
        chosen_by: what the drives were compared by, "path deviation" in metres or "speed change" in m/s.
        made_of: identity of the selection, by name (`io.identity`).

    Raises:
        RoadproofError: `chosen` is not an index of the candidates, or `chosen_by` is another word.
    """

    pattern: Pattern
    driven: tuple[Driven, ...]
    chosen: int
    simulator_calls: int
    predicted: bool = False
    chosen_by: str = DEVIATION
    made_of: Mapping[str, Any] = field(default_factory=dict[str, Any])

    def __post_init__(self) -> None:
        if not 0 <= self.chosen < len(self.driven):
            raise RoadproofError(f"it has chosen {self.chosen} of {len(self.driven)} candidates")
        if self.chosen_by not in UNITS:
            raise RoadproofError(f"it was chosen by {self.chosen_by!r:.60}, expected {' or '.join(UNITS)}")

    @property
    def deviation_m(self) -> float:
        """The paper's deviation of the drive over the chosen pattern, in metres."""
        return self.driven[self.chosen].trial.deviation_m

    def episodes(self, folder: Path) -> tuple[Episode, ...]:
        """The drive over the bare road, and the one over the chosen pattern, from the folder of the drives.

        Raises:
            EpisodeError: a drive is missing or damaged.
        """
        trial = self.driven[self.chosen].trial
        return load_episodes(folder, (trial.clean, trial.painted))

    def save(self, folder: AnyPath) -> None:
        """Write the choice beside the drives.

        Raises:
            OutputError: the folder cannot be written.
        """
        folder = as_path(folder)
        save_pattern(self.pattern, folder / "pattern.json")
        SELECTION_FILE.write(folder / "selection.json", self, kind="predicted" if self.predicted else "closed loop")

    @staticmethod
    def load(folder: AnyPath) -> Selection:
        """Read the selection that `save` wrote.

        Raises:
            RoadproofError: a file is missing or damaged.
        """
        folder = as_path(folder)
        path = folder / "selection.json"
        content = SELECTION_FILE.content(path)
        return SELECTION_FILE.made(
            path, content, pattern=load_pattern(folder / "pattern.json"), predicted=content.get("kind") == "predicted"
        )


SELECTION_FILE = RecordFile(
    kind=Selection,
    name="roadproof-selection",
    error=RoadproofError,
    remedy="remove its folder to choose again",
    elsewhere=("pattern", "predicted"),
)


def select_by_driving(
    simulator: Simulator,
    controller: Controller,
    scenario: Scenario,
    candidates: Sequence[Candidate],
    *,
    best: int,
    weather: Weather = Weather.CLEAR_NOON,
    folder: Path,
    clean: Episode | None = None,
    pool: Pool[Simulator] | None = None,
    on_drive: Callable[[int, float], object] = lambda _done, _effect: None,
) -> Selection:
    """Drive over the strongest candidates of every group, once each, and keep the one that deviates most.

    Candidates of a search for a speed change are compared by how much the speed changed in their group's direction.
    Deviation rather than infraction points, which jump: what grazes a post at noon may touch nothing in the rain.

    Args:
        simulator: an open simulator.
        controller: controller that was attacked.
        scenario: scenario that is driven.
        candidates: candidates, the strongest first, as in `AttackResult.candidates`.
        best: number of candidates driven over, shared among the groups, as either side may give way.
        weather: weather of the drives, clear noon by default.
        folder: folder that keeps every drive and the choice; what it holds is not done again.
        clean: drive over the bare road; None to make it here.
        pool: processes that are open already and drive over the candidates instead.
        on_drive: called after each drive with the number done, the clean one included, and the largest deviation, m,
            or change of the speed, m/s.

    Raises:
        RoadproofError: there is nothing to drive, without paint the car never comes to the canvas, the folder is
            damaged, or it holds a choice among others.
        SimulatorError, ControllerError: as `rollout` does.
        OutputError: the folder cannot be written.
    """
    chosen = first_of_each_group(candidates, best)
    if not chosen:
        raise RoadproofError(f"{len(candidates)} candidates and {best} of them to drive; expected at least one")
    paints = {f"candidate-{rank}": raster(candidate.pattern) for rank, candidate in chosen}
    by = chosen_by(candidates)
    episodes = Episodes.of(simulator, controller, scenario, paints, folder)
    bare = DriveConditions(paint=CLEAN, weather=weather)
    over = [replace(bare, paint=name) for name in paints]
    made_of = _made_of(episodes, over, by)
    if (folder / "selection.json").exists():
        kept = Selection.load(folder)
        require_same(folder, "a choice", kept.made_of, made_of, RoadproofError)
        return kept
    calls = int(clean is None)
    if clean is not None and not episodes.has(bare):
        episodes.put(bare, clean)
    episodes.make(simulator, bare)
    if not episodes.sees_canvas(bare):
        raise canvas_missed(scenario.name)

    @cache
    def driven_over(place: int) -> Driven:
        rank, candidate = chosen[place]
        return Driven(group=candidate.group, rank=rank, trial=episodes.trial(bare, over[place]))

    def tell(done: int) -> None:
        made = (driven_over(place) for place in range(len(over)) if episodes.has(over[place]))
        on_drive(1 + done, max((each.effect(by) for each in made), default=0.0))

    with open_or_here(pool, simulator) as driving:
        make_missing(driving, episodes, over, tell)
    driven = [driven_over(place) for place in range(len(over))]
    winner = max(range(len(driven)), key=lambda index: driven[index].effect(by))
    selection = Selection(
        pattern=chosen[winner][1].pattern,
        driven=tuple(driven),
        chosen=winner,
        simulator_calls=0 if simulator.paint.predicted else calls + len(driven),
        predicted=simulator.paint.predicted,
        chosen_by=by,
        made_of=made_of,
    )
    selection.save(folder)
    return selection


def _made_of(episodes: Episodes, over: Sequence[DriveConditions], by: str) -> dict[str, Any]:
    """What identifies a choice among drives over candidates, as JSON has it."""
    made_of = {
        **episodes.made_of,
        "weather": over[0].weather,
        "candidates": len(over),
        "patterns": [episodes.digests[drive.paint][:16] for drive in over],
        "drives": [episodes.file(drive) for drive in over],
        "chosen_by": by,
    }
    return cast("dict[str, Any]", plain(made_of))


def first_of_each_group(candidates: Sequence[Candidate], count: int) -> list[tuple[int, Candidate]]:
    """The strongest of each group, then the second strongest, until there are `count`; with their ranks."""
    seen: dict[str, int] = {}
    placed: list[tuple[int, int, Candidate]] = []
    for rank, candidate in enumerate(candidates, 1):
        seen[candidate.group] = seen.get(candidate.group, 0) + 1
        placed.append((seen[candidate.group], rank, candidate))
    kept = sorted(placed, key=lambda each: each[:2])[:count]
    return sorted(((rank, candidate) for _, rank, candidate in kept), key=lambda each: each[0])
