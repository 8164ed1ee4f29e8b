"""The rows of a study as numbers to be compared: one instance a pattern, weather and traffic; what failed, and why."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import product
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np

from roadproof.errors import StudyError
from roadproof.report.formatting import in_words
from roadproof.report.study.statistics import Case

Record: TypeAlias = Mapping[Any, Any]
"""A row of rows.parquet."""

BLACK = "1-b"
_NEEDED = ("scenario", "kind", "figures", "method", "seed", "error")
_NUMBERS = ("deviation_m", "left_lane", "points", "clean_points")
_DRIVEN = ("weather", "traffic", *_NUMBERS, "search_calls", "search_seconds")


class JobId(NamedTuple):
    """Which job of a study: one pattern that was, or was to be, found."""

    scenario: str
    figures: str
    method: str
    seed: int

    def __str__(self) -> str:
        return f"{self.scenario}, K = {self.figures}, {self.method}, seed {self.seed}"


@dataclass(frozen=True, kw_only=True, slots=True)
class Method:
    """What the tables need to know of a method.

    Args:
        name: as in the rows.
        search: "gradopt", or a black-box method; empty where nobody said.
        trajectories: gradopt: T.
        scheme: gradopt: "group", "group-all" or "random".
        reference: whether the plan says that tables compare it with the others.
    """

    name: str
    search: str = ""
    trajectories: int = 0
    scheme: str = ""
    reference: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Instance:
    """One pattern in one weather, alone or in traffic: the mean of its drives. All numbers are of driving.

    Args:
        job: the pattern's.
        kind: of the scenario.
        weather: of the drives.
        traffic: whether there were others.
        deviation_m: mean deviation.
        left_lane: share of its drives that left their lane.
        points: mean infraction penalty.
        clean_points: the same on the bare road.
        deviations_m: of each drive.
    """

    job: JobId
    kind: str
    weather: str
    traffic: bool
    deviation_m: float
    left_lane: float
    points: float
    clean_points: float
    deviations_m: tuple[float, ...]

    @property
    def drives(self) -> int:
        """How many."""
        return len(self.deviations_m)


@dataclass(frozen=True, kw_only=True, slots=True)
class SearchCost:
    """What finding one pattern took.

    Args:
        calls: of the simulator, each one drive.
        seconds: of the whole search.
    """

    calls: float
    seconds: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Results:
    """A study's numbers.

    Args:
        instances: in the rows' order.
        costs: of each job that came to its end.
        failures: why a job did not.
        methods: in the rows' order.
        kinds: of each scenario.
    """

    instances: tuple[Instance, ...]
    costs: Mapping[JobId, SearchCost]
    failures: Mapping[JobId, str]
    methods: tuple[Method, ...]
    kinds: Mapping[str, str]
    figures: tuple[str, ...]
    seeds: tuple[int, ...]
    weathers: tuple[str, ...]
    _values: dict[tuple[str, str, str, bool], list[Instance]] = field(default_factory=dict[Any, Any], repr=False)

    def __post_init__(self) -> None:
        for each in self.instances:
            self._values.setdefault((each.job.method, each.job.figures, each.weather, each.traffic), []).append(each)

    @property
    def home(self) -> str:
        """The weather in which patterns were found."""
        return self.weathers[0]

    def has(self, *, traffic: bool, weather: str | None = None) -> bool:
        """Whether any drive, of a weather or at all, was in traffic, or alone."""
        return any(each.traffic == traffic and weather in (None, each.weather) for each in self.instances)

    def values(
        self, metric: str, method: str, figures: str, *, weather: str, traffic: bool, kind: str | None = None
    ) -> dict[Case, float]:
        """A metric (a field of `Instance`) of every scenario and seed.

        Args:
            metric: "deviation_m" or "points", for instance.
            method: its name.
            figures: K.
            weather: of the drives.
            traffic: whether there were others.
            kind: of scenarios; None takes all.
        """
        found = self._values.get((method, figures, weather, traffic), [])
        return {
            (each.job.scenario, str(each.job.seed)): float(getattr(each, metric))
            for each in found
            if kind is None or each.kind == kind
        }

    def deviations(self, method: str, figures: str, weather: str, *, traffic: bool) -> tuple[float, ...]:
        """The deviation of every drive over a method's patterns, in metres."""
        found = self._values.get((method, figures, weather, traffic), [])
        return tuple(value for each in found for value in each.deviations_m)

    @property
    def jobs(self) -> tuple[JobId, ...]:
        """Every combination of the scenarios, K, methods and seeds that occur, done or not."""
        names = [method.name for method in self.methods]
        return tuple(JobId(*job) for job in product(self.kinds, self.figures, names, self.seeds))

    def gaps(
        self,
        methods: Iterable[str] | None = None,
        conditions: Iterable[tuple[str, bool]] | None = None,
    ) -> dict[JobId, str]:
        """What a table of these methods, weathers and traffic lacks, and why.

        Args:
            methods: names; None takes all.
            conditions: weather and whether in traffic; None takes all that occur.
        """
        seen = set(conditions) if conditions is not None else {(each.weather, each.traffic) for each in self.instances}
        wanted = set(methods) if methods is not None else {method.name for method in self.methods}
        have: dict[JobId, dict[tuple[str, bool], int]] = {}
        for each in self.instances:
            have.setdefault(each.job, {})[each.weather, each.traffic] = each.drives
        most = {where: max((own.get(where, 0) for own in have.values()), default=0) for where in seen}
        found: dict[JobId, str] = {}
        for job in self.jobs:
            if job.method not in wanted:
                continue
            own = have.get(job, {})
            lacking = sorted(where for where in seen if own.get(where, 0) < most[where])
            if job in self.failures and (lacking or not own):
                found[job] = self.failures[job]
            elif not own:
                found[job] = "no row; not done yet"
            elif lacking:
                found[job] = "; ".join(
                    f"{own.get((weather, traffic), 0)} of {most[weather, traffic]} drives at "
                    f"{in_words(weather)}{' in traffic' if traffic else ''}"
                    for weather, traffic in lacking
                )
        return found


def results_of(records: Iterable[Record], methods: Iterable[Method] = ()) -> Results:
    """Sort a study's rows: means over the drives of each pattern, weather and traffic; costs; failures.

    Args:
        records: rows as `study.job` writes them; the first weather is the one in which patterns were found.
        methods: what is known of them besides their names.

    Raises:
        StudyError: there is no row, a column is missing, a number is not finite, or every job failed.
    """
    rows = list(records)
    if not rows:
        raise StudyError("the study has no rows yet; run it first")
    _check_columns(rows[0], _NEEDED)
    failures: dict[JobId, str] = {}
    costs: dict[JobId, SearchCost] = {}
    kinds: dict[str, str] = {}
    drives: dict[tuple[JobId, str, bool], list[list[float]]] = {}
    for row in rows:
        job = JobId(str(row["scenario"]), str(row["figures"]), str(row["method"]), int(row["seed"]))
        kinds[job.scenario] = str(row["kind"])
        if isinstance(row["error"], str) and row["error"]:
            failures[job] = row["error"]
            continue
        _check_columns(row, _DRIVEN)
        where = (job, str(row["weather"]), bool(row["traffic"]))
        drives.setdefault(where, []).append([_finite(row, name, job) for name in _NUMBERS])
        costs[job] = SearchCost(calls=_finite(row, "search_calls", job), seconds=_finite(row, "search_seconds", job))
    if not drives:
        job, reason = next(iter(failures.items()))
        raise StudyError(f"no job came to its end; the first of {len(failures)} that failed ({job}): {reason}")
    known = {method.name: method for method in methods}
    names = dict.fromkeys(str(row["method"]) for row in rows)
    instances = tuple(
        Instance(
            job=job,
            kind=kinds[job.scenario],
            weather=weather,
            traffic=traffic,
            **dict(zip(_NUMBERS, np.mean(trials, 0).tolist(), strict=True)),
            deviations_m=tuple(trial[0] for trial in trials),
        )
        for (job, weather, traffic), trials in drives.items()
    )
    return Results(
        instances=instances,
        costs=costs,
        failures=failures,
        methods=tuple(known.get(name, Method(name=name)) for name in names),
        kinds=kinds,
        figures=tuple(sorted({str(row["figures"]) for row in rows}, key=_by_number)),
        seeds=tuple(sorted({int(row["seed"]) for row in rows})),
        weathers=tuple(dict.fromkeys(each.weather for each in instances)),
    )


def _by_number(figures: str) -> tuple[int, str]:
    return (0, "") if figures == BLACK else (int(figures) if figures.isdecimal() else 1 << 30, figures)


def _check_columns(row: Record, columns: Iterable[str]) -> None:
    for column in columns:
        if column not in row:
            raise StudyError(f"the study's rows have no column {column!r}; run the study again, finished jobs are kept")


def _finite(row: Record, column: str, job: JobId) -> float:
    value = cast("object", row[column])
    number = float(value) if isinstance(value, int | float) else math.nan
    if not math.isfinite(number):
        raise StudyError(f"{job}: {column} is {value!r}, expected a finite number; run the study again")
    return number
