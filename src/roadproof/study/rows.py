"""The columns of a study's rows, for those who write them and for those who read them.

A row is one drive over a pattern against the same drive without it; all its numbers but the costs are of driving. A job
that failed has one row, with its own columns and `error` alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias, TypedDict

from roadproof.datatypes import Event
from roadproof.driving.trial import Trial
from roadproof.paint import Conspicuousness
from roadproof.study.plan import Job

Frame: TypeAlias = Any
"""A pandas DataFrame of rows: pandas, an extra, does not type its own."""


class JobColumns(TypedDict, total=False):
    """Which job a row belongs to."""

    job: str  # its key: the name of its folder in jobs/
    scenario: str
    kind: str  # of the scenario: straight, left or right
    figures: str  # K, or 1-b for one black figure
    method: str
    seed: int


class DriveColumns(TypedDict, total=False):
    """What one drive over a pattern did."""

    weather: str  # of both drives, as "clear-noon"
    traffic: bool  # whether there were cars and people
    traffic_seed: int  # of cars and people
    start_right_m: float  # metres: how far to the right of the scenario's start both drives begin,
    start_turned_rad: float  # radians: how far turned, left positive,
    start_faster_mps: float  # metres a second: and how much faster
    deviation_m: float  # metres: the paper's deviation between the two drives
    lateral_m: float  # metres: largest offset from the clean path, left positive
    points: float | None  # the CARLA challenge's infraction points with paint
    clean_points: float | None  # the same without
    leaderboard: float | None  # the CARLA Leaderboard's factor with paint, 1 where nothing happened
    clean_leaderboard: float | None  # the same without
    first_event_s: float | None  # seconds: when something first went wrong with paint; None where nothing did
    left_lane: bool  # whether the car left its lane (`driving.trial.Trial`)
    ending: str  # why the painted drive ended
    events: str  # of the painted drive, those that count, as JSON: kind, seconds, with what or where
    clean_events: str  # of the clean drive


class PaintColumns(TypedDict, total=False):
    """How conspicuous the pattern of a job is; the same in all its rows, None for what is not known of the road."""

    painted_figures: int  # figures
    area_m2: float | None  # square metres: the sum of the figures' areas
    contrast: float | None  # to the asphalt, 0 none, 1 black on white
    mark_distance_m: float | None  # metres from the nearest lane mark
    mark_likeness: float | None  # how like a lane mark its most similar figure is, 0 to 1


class CostColumns(TypedDict, total=False):
    """What a job took; the same in all its rows."""

    search_calls: int  # drives before the evaluation: recording, calibration, selection, or one a pattern tried
    search_seconds: float  # seconds that finding the pattern took
    evaluation_calls: int  # drives of the evaluation, clean ones included
    seconds: float  # seconds of the whole job; of an evaluation that was interrupted, only of what was left


class Row(JobColumns, DriveColumns, PaintColumns, CostColumns, total=False):
    """A row of rows.parquet."""

    controller: str  # spec of who drove
    error: str | None  # why the job failed; None where all went well


class TransferRow(JobColumns, DriveColumns, total=False):
    """A row of transfer.parquet: a pattern that was found against one controller, driven by another."""

    found_on: str  # spec of the controller it was found against
    controller: str  # spec of who drove


class JobId(NamedTuple):
    """A job as people name it."""

    scenario: str
    figures: str
    method: str
    seed: int

    def __str__(self) -> str:
        return f"{self.scenario}, K = {self.figures}, {self.method}, seed {self.seed}"


@dataclass(frozen=True, slots=True)
class JobResult:
    """What came of one job.

    Args:
        rows: one row for each drive that was judged, or a single one with an error.
        files: small files by name, kept with the rows.
    """

    rows: tuple[Row, ...]
    files: Mapping[str, bytes] = field(default_factory=dict[str, bytes])


def failed(job: Job, reason: str) -> JobResult:
    """The result of a job that did not come to its end."""
    return JobResult(({**job_columns(job), "error": reason},))


def job_columns(job: Job) -> JobColumns:
    """The columns that say which job a row belongs to."""
    return {
        "job": job.key,
        "scenario": job.scenario.name,
        "kind": str(job.scenario.kind),
        "figures": str(job.figures),
        "method": job.method.name,
        "seed": job.seed,
    }


def paint_columns(told: Conspicuousness) -> PaintColumns:
    """The columns of a job's pattern."""
    return {
        "painted_figures": told.figures,
        "area_m2": told.area_m2,
        "contrast": told.contrast,
        "mark_distance_m": told.mark_distance_m,
        "mark_likeness": told.mark_likeness,
    }


def drive_columns(trial: Trial) -> DriveColumns:
    """The columns of one drive over a pattern."""
    return {
        "weather": str(trial.weather),
        "traffic": trial.traffic,
        "traffic_seed": trial.seed,
        "start_right_m": trial.start.right_m,
        "start_turned_rad": trial.start.turned_rad,
        "start_faster_mps": trial.start.faster_mps,
        "deviation_m": trial.deviation_m,
        "lateral_m": trial.lateral_m,
        "points": trial.points,
        "clean_points": trial.clean_points,
        "leaderboard": trial.leaderboard,
        "clean_leaderboard": trial.clean_leaderboard,
        "first_event_s": trial.first_event_s,
        "left_lane": trial.leaves_lane,
        "ending": trial.ending,
        "events": _as_json(trial.events),
        "clean_events": _as_json(trial.clean_events),
    }


def _as_json(events: Sequence[Event]) -> str:
    return json.dumps([(each.kind, each.time_s, each.detail) for each in events])


def made_by_all(transfers: Frame) -> Frame:
    """The rows of a transfer whose drives all controllers made, over patterns of one origin and from one start.

    A controller that never comes to the canvas from some start has no drive from there; means over what each of them
    made would be over other drives.
    """
    # Rows of an older roadproof do not say from where.
    start = ("weather", "start_right_m", "start_turned_rad", "start_faster_mps")
    drive = ["found_on", *JobId._fields, *(column for column in start if column in transfers)]
    asked = transfers.groupby("found_on")["controller"].transform("nunique")
    return transfers[transfers.groupby(drive)["controller"].transform("nunique") == asked]
