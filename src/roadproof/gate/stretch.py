"""One scenario of a check: what is painted there, the drives over it, and what they come to."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from roadproof.datatypes import Ending, Weather
from roadproof.driving.deviation import LEAVES_LANE_M, lateral_m, path_of
from roadproof.driving.drive_store import CLEAN, DriveConditions, Episodes, load_episodes, make_missing
from roadproof.driving.episode import Episode
from roadproof.driving.infractions import counted
from roadproof.gate.plan import RANDOM, CheckPlan, Key
from roadproof.gate.result import JudgedDrive
from roadproof.gate.verdict import Kind, Measures, median_95, share_95
from roadproof.io.identity import digest
from roadproof.paint import Site
from roadproof.patterns import Pattern, save_pattern
from roadproof.processes import here_or_beside
from roadproof.recorded.simulator import RecordedSimulator
from roadproof.report.formatting import in_words
from roadproof.scenarios import Scenario, identity
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import Simulator, SimulatorFactory, world_of


@dataclass(frozen=True, slots=True, eq=False)
class Paint:
    """A pattern and the drives over it.

    Args:
        name: a name that tells this pattern from the others of its scenario.
        kind: where the pattern comes from: stored, random or fresh.
        case: the name of the case that its drives belong to.
        pattern: the pattern that is painted.
        path: the pattern's file.
        drives: (seed, number of the start) of each drive over the pattern.
        unsearched: why no attack was made, in words; empty where one was, or where the bare road says why.
    """

    name: str
    kind: Kind
    case: str
    pattern: Pattern
    path: Path
    drives: tuple[tuple[int, int], ...]
    unsearched: str = ""


def known_paints(plan: CheckPlan, scenario: Scenario, site: Site, folder: Path) -> tuple[Paint, ...]:
    """The stored and the random patterns of a scenario; random ones are written to a folder.

    Raises:
        PatternError: the plan's limits on paint leave no pattern there.
        OutputError: a random pattern cannot be written.
    """
    every = tuple((seed, k) for seed in plan.seeds for k in range(plan.starts.count))
    found = [
        Paint(f"stored-{each.name}", Kind.STORED, each.name, each.pattern, each.path, every)
        for each in plan.stored.get(scenario.name, ())
    ]
    space = SearchSpace(figures=plan.figures, limits=plan.paint)
    if plan.random:
        space = space.on(site)
    elif plan.budget == "full":
        # Fresh attacks would find it out once they have recorded.
        space.require_paint(site)
    for seed in plan.seeds if plan.random else ():
        drawn = space.drawn(plan.random, seed)
        for k in range(plan.random):
            path = folder / f"random-{seed}-{k + 1}.json"
            save_pattern(drawn[k], path)
            start = ((seed, k % plan.starts.count),)
            found.append(Paint(path.stem, Kind.RANDOM, RANDOM, drawn[k], path, start))
    return tuple(found)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Stretch:
    """A scenario in an open simulator, or in the recorded world, with all that is painted there.

    Args:
        plan: the plan of the check.
        world: the open simulator, or the recorded world.
        weathers: the weathers that the scenario is driven in here.
        paints: the patterns that are painted here, with their drives.
        episodes: the store that keeps the drives.
    """

    plan: CheckPlan
    world: Simulator
    weathers: tuple[Weather, ...]
    paints: tuple[Paint, ...]
    episodes: Episodes

    def drive(self, factory: SimulatorFactory, processes: int, on_drive: Callable[[int, int], object]) -> None:
        """Make the drives that are missing: past the bare road, then over paint where those went well.

        Args:
            factory: opens another world; each of several processes has one of its own.
            processes: how many drives are made at once.
            on_drive: called with how many drives are there, and of how many.

        Raises:
            SimulatorError, ControllerError: as `driving.rollout.rollout` does.
            OutputError: the drives cannot be written.
        """
        alone = [each for weather in self.weathers for each in self._alone(weather).values()]
        total = len(alone) + len(self.weathers) * sum(len(paint.drives) for paint in self.paints)
        with here_or_beside(self.world, factory, processes) as pool:
            make_missing(pool, self.episodes, alone, lambda done: on_drive(done, total))
            painted = [each for weather in self.weathers for _, _, each in self._pairs(weather, self.paints)]
            total = len(alone) + len(painted)
            make_missing(pool, self.episodes, painted, lambda done: on_drive(len(alone) + done, total))

    def _pairs(self, weather: Weather, paints: Iterable[Paint]) -> list[tuple[Paint, DriveConditions, DriveConditions]]:
        """Patterns, with each drive over them after the one that it is compared with, where that went well."""
        alone = self._alone(weather)
        good = {each.clean for each in self.bare(weather) if not each.wrong}
        pairs = [(paint, alone[k], replace(alone[k], paint=paint.name)) for paint in paints for k in paint.drives]
        return [each for each in pairs if self.episodes.file(each[1]) in good]

    def bare(self, weather: Weather) -> tuple[JudgedDrive, ...]:
        """The drives on the bare road, and what went wrong in them."""
        found: list[JudgedDrive] = []
        for each in self._alone(weather).values():
            file = self.episodes.file(each)
            (episode,) = load_episodes(self.episodes.folder, [file])
            wrong = _fault(episode, self._aside_m(episode))
            found.append(JudgedDrive(seed=each.seed, start=each.start, wrong=wrong, clean=file))
        return tuple(found)

    def painted(self, weather: Weather, paints: Iterable[Paint]) -> tuple[JudgedDrive, ...]:
        """The drives over paint, each compared with the same drive on the bare road."""
        found: list[JudgedDrive] = []
        for paint, clean, painted in self._pairs(weather, paints):
            trial = self.episodes.trial(clean, painted)
            wrong = trial.leaves_lane or trial.loses_its_way
            side = "left" if trial.lateral_m > 0 else "right"
            found.append(
                JudgedDrive(
                    seed=clean.seed,
                    start=clean.start,
                    wrong=f"{abs(trial.lateral_m):.2f} m to the {side}, {trial.ending}" if wrong else "",
                    clean=trial.clean,
                    painted=trial.painted,
                    paint=str(paint.path),
                    deviation_m=trial.deviation_m,
                    lateral_m=trial.lateral_m,
                )
            )
        return tuple(found)

    def conditions(self, key: Key, paints: Sequence[Paint]) -> str:
        """A hash of all that the drives of a case depend on, apart from the controller.

        A fresh attack finds another pattern for every controller, so only how it searches counts, and in which weather.
        Stored patterns are known by their figures and random ones by what draws them: other machines round otherwise.
        """
        plan, (_, weather, kind, _) = self.plan, key
        stored = [_figures(paint.pattern) for paint in paints if paint.kind is Kind.STORED]
        drawn = [plan.random] if kind is Kind.RANDOM else []
        world = world_of(self.world) or type(self.world).__qualname__
        told = [
            identity(self.episodes.scenario),
            weather,
            kind,
            stored,
            drawn,
            plan.figures,
            *([plan.paint] if plan.paint else []),
            *([plan.variation] if plan.variation and kind is Kind.FRESH else []),
            plan.seeds,
            asdict(plan.starts),
            world,
            # References are older than this word.
            *([plan.weathers[0]] if kind is Kind.FRESH and weather != plan.weathers[0] else []),
        ]
        return digest(json.dumps(told, default=str))[:16]

    def _alone(self, weather: Weather) -> dict[tuple[int, int], DriveConditions]:
        plan = self.plan
        return {
            (seed, k): DriveConditions(paint=CLEAN, weather=weather, seed=seed, start=start)
            for seed in plan.seeds
            for k, start in enumerate(plan.starts.range.draw(plan.starts.count, seed))
        }

    def _aside_m(self, episode: Episode) -> float | None:
        """How far a drive on the bare road gets from the recorded one, left positive; None in a simulator."""
        if not isinstance(self.world, RecordedSimulator):
            return None
        beside = lateral_m(self.world.way, path_of(episode))
        return float(beside[np.abs(beside).argmax()])


def _fault(episode: Episode, aside_m: float | None) -> str:
    """Why a drive on the bare road counts as failed; empty where it does not."""
    told = [] if episode.ending is Ending.GOAL_REACHED else [str(episode.ending)]
    told += [in_words(kind) for kind in dict.fromkeys(event.kind for event in counted(episode.events))]
    if aside_m is not None and abs(aside_m) >= LEAVES_LANE_M:
        told.append(f"{abs(aside_m):.2f} m to the {'left' if aside_m > 0 else 'right'} of the recorded drive")
    return ", ".join(told)


def _figures(pattern: Pattern) -> list[object]:
    return [pattern.shapes, pattern.boxes.tolist(), pattern.colours.tolist()]


def measures_of(kind: Kind, drives: Sequence[JudgedDrive]) -> Measures:
    """The measures of a case; none where no drive was judged."""
    if not drives:
        return {}
    wrong = share_95(sum(bool(each.wrong) for each in drives), len(drives))
    if kind is Kind.BARE:
        return {"failed": wrong}
    return {"deviation_m": median_95([each.deviation_m for each in drives]), "left_lane": wrong}
