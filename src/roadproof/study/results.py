"""The rows of a study as numbers to be compared: a case is one pattern in one weather, alone or in traffic."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from numbers import Integral

import numpy as np

from roadproof.errors import StudyError
from roadproof.report.formatting import in_words
from roadproof.study.kept_jobs import StatedMethod
from roadproof.study.plan import BLACK
from roadproof.study.rows import Frame, JobColumns, JobId
from roadproof.study.statistics import Values

JOB, CONDITION = list(JobId._fields), ["weather", "traffic"]
LEFT_OUT = "left out where the drive over the bare road did not reach the canvas"
NUMBERS = ["deviation_m", "left_lane", "points", "clean_points", "search_calls", "search_seconds"]


@dataclass(frozen=True, slots=True)
class Metric:
    """A column of the rows, and how tables call it."""

    column: str
    title: str
    unit: str


DEVIATION = Metric("deviation_m", "Deviation", "m")
LEFT_LANE = Metric("left_lane", "Leave the lane", "share of drives")
PENALTY = Metric("points", "Infraction penalty", "points")


@dataclass(frozen=True, slots=True)
class Block:
    """Columns of a table that belong together: one metric under one condition.

    Args:
        heading: the heading over the columns.
        metric: the metric that the columns hold.
        weather: the weather of the drives.
        traffic: whether there were others on the road.
        kind: the kind of the scenarios; None takes all kinds.
    """

    heading: str
    metric: Metric
    weather: str
    traffic: bool
    kind: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Results:
    """A study's numbers. All of them but the costs are of driving.

    Args:
        drives: the rows of jobs that came to their end, one a drive.
        failures: why each job that did not come to its end failed.
        methods: the methods, in the rows' order.
        named: the method that the plan compares with the others; None where it names none.
        kinds: the kind of each scenario, by the scenario's name.
        figures: the values of K as text, in rising order, one black figure first.
        seeds: the seeds, in rising order.
        weathers: that in which patterns were found, then the others of the drives.
        planned: how many drives a job has in a weather, alone or in traffic; empty where nobody says.
        asked: what names each job of the plan; empty where nobody says.
    """

    drives: Frame
    failures: Mapping[JobId, str]
    methods: tuple[StatedMethod, ...]
    named: str | None
    kinds: Mapping[str, str]
    figures: tuple[str, ...]
    seeds: tuple[int, ...]
    weathers: tuple[str, ...]
    planned: Mapping[tuple[str, bool], int]
    asked: tuple[JobId, ...] = ()

    @property
    def home(self) -> str:
        """The weather in which patterns were found."""
        return self.weathers[0]

    def has(self, *, traffic: bool, weather: str | None = None) -> bool:
        """Whether any drive was in traffic, or any alone, in one weather or in all."""
        drives = self.drives if weather is None else self.drives[self.drives["weather"] == weather]
        return bool((drives["traffic"] == traffic).any())

    @property
    def overall(self) -> tuple[Block, Block]:
        """Deviation alone and penalty in traffic, as the paper has them, in the weather in which patterns were found.

        Where the study drove only alone, or only in traffic, both are of that.
        """
        return (
            Block(DEVIATION.title, DEVIATION, self.home, not self.has(traffic=False)),
            Block(PENALTY.title, PENALTY, self.home, self.has(traffic=True)),
        )

    @property
    def reference(self) -> StatedMethod:
        """The method others are compared with: the plan's, else GradOpt in groups of three, any GradOpt, the first."""
        named = [method for method in self.methods if method.name == self.named]
        gradopt = [method for method in self.methods if method.search == "gradopt"]
        usual = [method for method in gradopt if (method.scheme, method.trajectories) == ("group", 3)]
        return [*named, *usual, *gradopt, *self.methods][0]

    @property
    def rivals(self) -> tuple[StatedMethod, ...]:
        """The methods that the reference is compared with; GradOpt with other recordings alone has the ablation."""
        ours = self.reference
        return tuple(
            method
            for method in self.methods
            if method != ours and not (method.searches_as(ours) and method.recording != ours.recording)
        )

    @property
    def ablation(self) -> tuple[StatedMethod, ...]:
        """Variants of GradOpt that differ in their recordings alone: the reference's, else the first there are."""
        gradopt = [method for method in self.methods if method.search == "gradopt" and method.scheme]
        for one in sorted(gradopt, key=lambda method: method != self.reference):
            alike = tuple(method for method in gradopt if method.searches_as(one))
            if len(alike) > 1:
                return alike
        return ()

    @property
    def compared(self) -> list[str]:
        """Names of the reference and its rivals; in pictures, variants of GradOpt would only hide one another."""
        return [self.reference.name, *(method.name for method in self.rivals)]

    def drives_of(self, block: Block, methods: Collection[str], figures: str | None = None) -> Frame:
        """The drives under a block's condition over the patterns of some methods, of one K or all."""
        drives = self.drives
        kept = drives["method"].isin(methods)
        wanted = {"figures": figures, "weather": block.weather, "traffic": block.traffic, "kind": block.kind}
        for column, value in wanted.items():
            if value is not None:
                kept &= drives[column] == value
        return drives[kept]

    def values(self, block: Block, method: str, figures: str | None = None) -> Values:
        """A block's metric of every scenario and seed, the mean of their drives; with None for K, of every K too."""
        cases = ["scenario", "seed", *([] if figures else ["figures"])]
        return self.drives_of(block, [method], figures).groupby(cases, sort=False)[block.metric.column].mean()

    @property
    def jobs(self) -> tuple[JobId, ...]:
        """The plan's jobs, done or not; where nobody says, every combination of scenarios, K, methods and seeds."""
        if self.asked:
            return self.asked
        names = [method.name for method in self.methods]
        return tuple(JobId(*job) for job in product(self.kinds, self.figures, names, self.seeds))

    @property
    def undone(self) -> list[JobId]:
        """The jobs that failed or are not done yet; the others may lack drives and yet are finished."""
        done = {JobId(*job) for job in self.drives[JOB].drop_duplicates().itertuples(index=False)}
        return [job for job in self.jobs if job not in done]

    def gaps(
        self, methods: Collection[str] | None = None, conditions: Collection[tuple[str, bool]] | None = None
    ) -> dict[JobId, str]:
        """The jobs that lack drives for a table of some methods, weathers and traffic, and why they do.

        A job has as many as are planned; where nobody says, as many as any other.

        Args:
            methods: names of the methods in the table; None takes all.
            conditions: (weather, whether in traffic) of the drives in the table; None takes all that occur.
        """
        counts = self.drives.groupby([*JOB, *CONDITION]).size().unstack(CONDITION, fill_value=0)
        of_job, whole = counts.to_dict("index"), {**counts.max(), **self.planned}
        most = {where: count for where, count in whole.items() if conditions is None or where in conditions}
        found: dict[JobId, str] = {}
        for job in self.jobs:
            if methods is not None and job.method not in methods:
                continue
            own = of_job.get(job, {})
            lacking = [where for where in most if own.get(where, 0) < most[where]]
            if job not in of_job:
                found[job] = self.failures.get(job, "no row; not done yet")
            elif lacking:
                told = (
                    f"{own.get(where, 0)} of {most[where]} drives at {in_words(where[0])}"
                    f"{' in traffic' if where[1] else ''}"
                    for where in lacking
                )
                found[job] = f"{'; '.join(told)}; {LEFT_OUT}"
        return found


def results_of(
    rows: Frame,
    methods: Iterable[StatedMethod] = (),
    named: str | None = None,
    weathers: Sequence[str] = (),
    planned: Mapping[tuple[str, bool], int] | None = None,
    asked: Sequence[JobId] = (),
) -> Results:
    """Sort a study's rows into drives and failures.

    Args:
        rows: the rows of the study.
        methods: what is known of the methods besides their names.
        named: the method that the plan compares with the others; None where it names none.
        weathers: the plan's weathers, that in which patterns were found first; where nobody says, they are in the order
            of the rows.
        planned: how many drives a job has in a weather, alone or in traffic; None where nobody says.
        asked: what names each job of the plan; empty where nobody says.

    Raises:
        StudyError: there is no row, a column is missing, a number is not finite, or every job failed.
    """
    check_jobs(rows)
    is_bad = (rows["error"].notna() & (rows["error"] != "")).astype(bool)
    bad, drives = rows[is_bad], rows[~is_bad]
    failures = {JobId(*row): reason for *row, reason in bad[[*JOB, "error"]].itertuples(index=False)}
    if drives.empty:
        job, reason = next(iter(failures.items()))
        raise StudyError(f"no job came to its end; the first of {len(failures)} that failed ({job}): {reason}")
    _check_columns(drives, [*CONDITION, *NUMBERS])
    check_kind(drives, "weather", str, "text")
    check_kind(drives, "traffic", (bool, np.bool_), "true or false")
    for name in NUMBERS:
        check_finite(drives, name)
    known = {method.name: method for method in methods}
    # The first weather of a job, or of all, may have no drive: where none over the bare road reached the canvas.
    driven = list(drives["weather"].unique())
    order = dict.fromkeys([*weathers[:1], *(weather for weather in weathers if weather in driven), *driven])
    return Results(
        drives=drives.astype({"traffic": bool, **dict.fromkeys(NUMBERS, float)}),
        failures=failures,
        methods=tuple(known.get(name, StatedMethod(name=name)) for name in rows["method"].unique()),
        named=named,
        kinds=dict(zip(rows["scenario"], rows["kind"], strict=True)),
        figures=tuple(sorted(rows["figures"].unique(), key=_by_number)),
        seeds=tuple(sorted(map(int, rows["seed"].unique()))),
        weathers=tuple(order),
        planned=planned or {},
        asked=tuple(asked),
    )


def check_jobs(rows: Frame) -> None:
    """See that rows say which job each belongs to, and whether it failed.

    Raises:
        StudyError: there is no row, a column is missing, or a job's column holds something else than it should.
    """
    if rows.empty:
        raise StudyError("the study has no rows yet; run it first")
    _check_columns(rows, [name for name in (*JobColumns.__annotations__, "error") if name != "job"])
    check_names(rows, ["kind", *(["job"] if "job" in rows else [])])
    check_kind(rows[rows["error"].notna()], "error", str, "text")


def check_names(rows: Frame, others: Sequence[str]) -> None:
    """See that what names a job is text, its seed a whole number, and other columns text too.

    Raises:
        StudyError: a value is of another kind; the message names the first.
    """
    for name in (*others, *JOB):
        whole = name == "seed"
        check_kind(rows, name, Integral if whole else str, "a whole number" if whole else "text")


def check_finite(rows: Frame, column: str) -> None:
    """See that a column holds finite numbers.

    Raises:
        StudyError: a number is not finite; the message names the first.
    """
    try:
        wrong = rows[~np.isfinite(rows[column].astype(float))]
    except (TypeError, ValueError) as error:
        raise StudyError(f"{column} of the rows is not all numbers ({error}); run the study again") from None
    for *job, value in wrong[[*JOB, column]].itertuples(index=False):
        raise StudyError(f"{JobId(*job)}: {column} is {value}, expected a finite number; run the study again")


def check_kind(rows: Frame, column: str, kind: type | tuple[type, ...], expected: str) -> None:
    """See that a column holds values of one kind.

    Raises:
        StudyError: a value is of another; the message names the first.
    """
    for value in rows[column]:  # which need not be what can be hashed
        if not isinstance(value, kind):
            shown = " ".join(repr(value).split())[:40]  # arrays are several lines
            found = f"{column} of the rows is {shown}, expected {expected}"
            raise StudyError(f"{found}; run the study again, finished jobs are kept")


def _by_number(figures: str) -> tuple[int, str]:
    return (0, "") if figures == BLACK else (int(figures) if figures.isdecimal() else 1 << 30, figures)


def _check_columns(rows: Frame, columns: Iterable[str]) -> None:
    for column in columns:
        if column not in rows:
            raise StudyError(f"the study's rows have no column {column!r}; run the study again, finished jobs are kept")
