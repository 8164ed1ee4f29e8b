"""What came of an evaluation, its table, and its folder.

Where a simulator composites paint into recorded frames, all that is told here is predicted, and nothing is known of
infractions.

    EVALUATION/evaluation.json   conditions, every trial with its numbers, cost
    EVALUATION/scenario.toml     what was driven
    EVALUATION/paint.png         what was painted
    EVALUATION/episodes/*.npz    every drive (`driving.episode`), clean and painted

Nothing is pickled, and no path in a file leaves the folder.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from roadproof.datatypes import Weather
from roadproof.driving.intervals import Estimate, mean_95
from roadproof.driving.starts import NOMINAL, USUAL_STARTS, StartRange
from roadproof.driving.trial import Trial, runs_of
from roadproof.errors import EpisodeError, RoadproofError
from roadproof.io.files import AnyPath, as_path, remove, write_atomically
from roadproof.io.html import table
from roadproof.io.records import Form, RecordFile
from roadproof.patterns import read_paint
from roadproof.scenarios import Scenario, load_scenarios, save_scenarios, with_map_in
from roadproof.simulators.protocol import PaintKind, PatternImage

ATTACK = "attack"
_UNITS = {
    "deviation_m": "metres, the paper's equation, from the clean drive of the same weather, traffic and seed",
    "speed_change_mps": "m/s, mean over the passage of the speed less that of the clean drive, negative = slower",
    "most_speed_change_mps": "m/s, that difference at the instant at which it was largest",
    "lateral_m": "metres beside the clean path where the car was furthest from it, left positive",
    "points": "sum of the 2019 CARLA challenge's points, as clean_points without paint",
    "leaderboard": "product of today's CARLA Leaderboard's factors, 1 = no infraction, as clean_leaderboard",
    "first_event_s": "seconds since the start of the drive; null where nothing happened",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class EvaluationRow:
    """Means over the trials of one pattern kind, weather and traffic; their intervals are over starts and seeds.

    Args:
        pattern: "attack" or "random".
        weather: weather of the trials; None for all weathers together.
        traffic: whether there were other cars and pedestrians.
        deviation_m: mean of the paper's deviation, metres.
        lateral_m: mean of the largest offset from the clean path, to whichever side, metres.
        count: number of trials.
        speed_change_mps: mean change of the speed, m/s, negative where the drives are slower; None if a trial of an
            earlier version does not know its own.
        median_m: median of the deviation, metres.
        least_m: smallest deviation, metres; most_m is the largest.
        left_lane: share of the drives that leave their lane (`Trial.leaves_lane`): the success rate.
        points: mean infraction points with paint; None, as in the next three, if infractions are not known.
        clean_points: mean infraction points without paint.
        leaderboard: mean of the Leaderboard's factor with paint.
        failed: share of the painted drives with any event.
        first_event_s: mean time of the first event over the drives that have one, seconds; None if there is none.
    """

    pattern: str
    weather: Weather | None
    traffic: bool
    deviation_m: Estimate
    lateral_m: Estimate
    speed_change_mps: Estimate | None
    count: int
    median_m: float
    least_m: float
    most_m: float
    left_lane: float
    points: Estimate | None
    clean_points: Estimate | None
    leaderboard: Estimate | None
    failed: float | None
    first_event_s: Estimate | None

    @property
    def metres(self) -> str:
        """The deviations in metres as people read them: the median, and in brackets the least and the most."""
        return f"{self.median_m:.2f} ({self.least_m:.2f}–{self.most_m:.2f})"


@dataclass(frozen=True, kw_only=True, slots=True)
class Evaluation:
    """The outcome of driving over one pattern in many conditions, closed loop.

    Args:
        scenario: scenario that was driven.
        controller: name of the driver.
        weathers: weathers of the drives.
        runs: number of drives with traffic per weather.
        cars: number of other cars in drives with traffic.
        pedestrians: number of pedestrians in drives with traffic.
        seed: seed of the first run with traffic; the others count on from it.
        starts: number of drives alone per weather, each from a drawn start; 0 for one from the scenario's own start.
        start_range: range that the starts were drawn from.
        left_out: number of drives over paint that are compared with nothing, since the one without paint never came to
            where the canvas is in view, as behind a queue.
        trials: comparison of every drive over paint with its clean drive.
        simulator_calls: number of drives that the evaluation takes, clean ones included; 0 if they are predicted.
        seconds: wall time in seconds of the drives made in this call; those found in the folder cost nothing.
        paint: how the simulator put a pattern on the road; rendered in older files, which are all of the town.

    Raises:
        EpisodeError: no drive over the pattern is without traffic.
    """

    scenario: Scenario
    controller: str
    weathers: tuple[Weather, ...]
    runs: int
    cars: int
    pedestrians: int
    seed: int
    trials: tuple[Trial, ...]
    simulator_calls: int
    seconds: float
    paint: PaintKind = PaintKind.RENDERED
    starts: int = 0
    start_range: StartRange = USUAL_STARTS
    left_out: int = 0

    def __post_init__(self) -> None:
        if not self.of(traffic=False):
            raise EpisodeError("the evaluation has no drive over its pattern alone, expected one or more; drive again")

    @property
    def predicted(self) -> bool:
        """Whether the drives are predicted, and nothing was driven for real."""
        return self.paint.predicted

    @property
    def drives(self) -> int:
        """How many drives are compared, clean ones included."""
        return len({name for trial in self.trials for name in (trial.clean, trial.painted)})

    def of(self, pattern: str = ATTACK, *, traffic: bool, weather: Weather | None = None) -> tuple[Trial, ...]:
        """The trials of "attack" or "random", with or without traffic, in one weather, or in all."""
        return tuple(
            trial
            for trial in self.trials
            if trial.pattern.startswith(pattern)
            and trial.traffic == traffic
            and (weather is None or trial.weather == weather)
        )

    def rows(self) -> tuple[EvaluationRow, ...]:
        """The table: pattern kinds, static before traffic, every weather and then all together."""
        found: list[EvaluationRow] = []
        for pattern in (ATTACK, "random"):
            for traffic in (False, True):
                for weather in (*self.weathers, None) if len(self.weathers) > 1 else self.weathers:
                    trials = self.of(pattern, traffic=traffic, weather=weather)
                    if trials:
                        found.append(_row(pattern, weather, traffic, trials))
        return tuple(found)

    def shown(self) -> Trial:
        """The trial that stands for all in pictures: the first over the pattern without traffic."""
        return self.of(traffic=False)[0]

    def _repr_html_(self) -> str:
        """How a notebook shows it: a row for the drives of each weather, and of all of them."""
        metres = "predicted m" if self.predicted else "driven m"
        head = ("pattern", "weather", "traffic", "drives", f"{metres}: median (least–most)", "leave the lane", "points")
        return table(head, map(_shown, self.rows()))

    def save(self, folder: AnyPath, paint: PatternImage) -> None:
        """Write everything but the episodes, which are there already.

        Raises:
            OutputError: the folder cannot be written.
            ScenarioError: the scenario's map cannot be written beside it.
        """
        folder = as_path(folder)
        # First, so that no trials stand beside another scenario or paint.
        remove(folder / "evaluation.json")
        save_scenarios([with_map_in(folder, self.scenario)], folder / "scenario.toml")
        picture = Image.fromarray(paint)
        write_atomically(folder / "paint.png", lambda part: picture.save(part, format="PNG"))
        EVALUATION_FILE.write(
            folder / "evaluation.json",
            self,
            kind=kind_of(self.paint),
            rows=self.rows(),
        )

    @staticmethod
    def load(folder: AnyPath) -> Evaluation:
        """Read the evaluation that `save` wrote.

        Raises:
            EpisodeError: a file is missing, damaged or of another format.
        """
        folder = as_path(folder)
        path = folder / "evaluation.json"
        content = EVALUATION_FILE.content(path)
        try:
            scenario = load_scenarios(folder / "scenario.toml")[0]
        except RoadproofError as error:
            raise EpisodeError(f"{path} is incomplete or damaged ({error}); evaluate again") from None
        return EVALUATION_FILE.made(path, content, scenario=scenario)


EVALUATION_FILE = RecordFile(
    kind=Evaluation,
    name="roadproof-evaluation",
    error=EpisodeError,
    remedy="evaluate again",
    forms={"scenario": Form(str, lambda scenario: scenario.name, lambda name: name)},
    notes={"units": _UNITS},
)


def kind_of(paint: PaintKind) -> str:
    """What numbers over paint of this kind are called in files: "predicted" or "closed loop"."""
    return "predicted" if paint.predicted else "closed loop"


def _row(pattern: str, weather: Weather | None, traffic: bool, trials: tuple[Trial, ...]) -> EvaluationRow:
    # From one start alone, one pattern has one drive a weather, and the weathers are no sample of all there are.
    drawn = traffic or pattern != ATTACK or any(trial.start != NOMINAL for trial in trials)
    deviations = [trial.deviation_m for trial in trials]

    def mean(value: Callable[[Trial], float], of: Sequence[Trial] = trials) -> Estimate:
        found = mean_95(runs_of(of, value))
        return found if drawn else replace(found, low=None, high=None)

    def known(value: Callable[[Trial], float | None]) -> Estimate | None:
        return None if any(value(trial) is None for trial in trials) else mean(lambda trial: value(trial) or 0.0)

    points = known(lambda trial: trial.points)
    failing = [trial for trial in trials if trial.first_event_s is not None]
    return EvaluationRow(
        pattern=pattern,
        weather=weather,
        traffic=traffic,
        count=len(trials),
        deviation_m=mean(lambda trial: trial.deviation_m),
        median_m=float(np.median(deviations)),
        least_m=min(deviations),
        most_m=max(deviations),
        left_lane=sum(trial.leaves_lane for trial in trials) / len(trials),
        lateral_m=mean(lambda trial: abs(trial.lateral_m)),
        speed_change_mps=known(lambda trial: trial.speed_change_mps),
        points=points,
        clean_points=known(lambda trial: trial.clean_points),
        leaderboard=known(lambda trial: trial.leaderboard),
        failed=None if points is None else len(failing) / len(trials),
        first_event_s=mean(lambda trial: trial.first_event_s or 0.0, failing) if failing else None,
    )


def _shown(row: EvaluationRow) -> tuple[object, ...]:
    points = "not known" if row.points is None else f"{row.points.value:.1f}"
    traffic = "yes" if row.traffic else "no"
    return row.pattern, row.weather or "all", traffic, row.count, row.metres, f"{row.left_lane:.0%}", points


def load_paint(folder: Path) -> PatternImage:
    """The picture of what was painted in an evaluation.

    Raises:
        PatternError: the file is missing or damaged.
    """
    return read_paint(folder / "paint.png")
