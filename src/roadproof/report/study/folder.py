"""What the jobs of a study left in its folder besides rows: patterns, paths, the course of each search.

DIR/study.json                  which method tables compare with the others
DIR/jobs/KEY/job.json           what was to be done
DIR/jobs/KEY/rows.json          what came of it
DIR/jobs/KEY/pattern.json       the pattern
DIR/jobs/KEY/view-WEATHER.jpg   what the car's camera sees of it
DIR/jobs/KEY/paths.npz          clean_xy, painted_xy in metres, alone in the first weather
DIR/jobs/KEY/history.json       how the search went, against simulator calls and seconds
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from roadproof.driving.deviation import Path2D
from roadproof.errors import StudyError
from roadproof.geometry import CanvasPlacement
from roadproof.io.arrays import read_archive
from roadproof.io.files import read_json
from roadproof.io.pictures import read_picture
from roadproof.patterns import Pattern, load_pattern
from roadproof.report.study.results import JobId, Method, Record

HISTORY_FORMAT, HISTORY_VERSION = "roadproof-study-history", 1
STUDY = ("roadproof-study-run", 1)
CLOSED_LOOP = "closed loop"

Series = Float[np.ndarray, " n"]

_AGAIN = "remove its folder and run the study again"


@dataclass(frozen=True, slots=True, eq=False)
class History:
    """The deviation that the patterns of one search reached as it went on, driven; no number of the surrogate.

    Args:
        calls: simulator calls so far.
        seconds: since the search began.
        deviation_m: of the pattern that was best by then, in the search's own measure.
    """

    calls: Series
    seconds: Series
    deviation_m: Series


@dataclass(frozen=True, kw_only=True, slots=True)
class Found:
    """A job and its folder.

    Args:
        job: which.
        controller: its spec.
        kind: of the scenario.
        map_name: the scenario's.
        canvas: the scenario's.
        method: how the pattern was searched.
        folder: with its files.
    """

    job: JobId
    controller: str
    kind: str
    map_name: str
    canvas: CanvasPlacement
    method: Method
    folder: Path

    def pattern(self) -> Pattern | None:
        """What was found; None where the job has none.

        Raises:
            PatternError: the file is damaged.
        """
        path = self.folder / "pattern.json"
        return load_pattern(path) if path.exists() else None

    def paths(self) -> tuple[Path2D, Path2D] | None:
        """World x, y of the drives without and with paint, alone in the first weather; None where the job has none.

        Raises:
            StudyError: the file is damaged.
        """
        path = self.folder / "paths.npz"
        if not path.exists():
            return None
        stored = read_archive(path, ("clean_xy", "painted_xy"), StudyError, _AGAIN)
        clean, painted = (stored[name].astype(np.float64) for name in ("clean_xy", "painted_xy"))
        for each in (clean, painted):
            if each.ndim != 2 or each.shape[1] != 2 or not len(each) or not np.isfinite(each).all():
                raise StudyError(f"{path} holds {each.shape}, expected finite x, y; {_AGAIN}")
        return clean, painted

    def view(self, weather: str) -> UInt8[np.ndarray, "h w 3"] | None:
        """What the car's camera sees of the pattern in a weather; None where the job kept no picture of it.

        Raises:
            StudyError: the file is damaged.
        """
        path = self.folder / f"view-{weather}.jpg"
        if path.parent != self.folder or not path.exists():
            return None
        return read_picture(path, StudyError, _AGAIN)

    def history(self) -> History | None:
        """The driven course of the search; None where the job kept none.

        A black-box search in the simulator has a deviation after every call; one on composited frames has none before
        its answer is driven.

        Raises:
            StudyError: the file is damaged.
        """
        path = self.folder / "history.json"
        if not path.exists():
            return None
        content: Any = read_json(path, HISTORY_FORMAT, HISTORY_VERSION, StudyError)
        try:
            if content["kind"] == CLOSED_LOOP:
                kept = [content["calls"], content["seconds"], content.get("deviation_m", [])]
            else:
                driven = content.get("driven", {"calls": [], "seconds": [], "best": []})
                kept = [driven["calls"], driven["seconds"], driven["best"]]
            calls, seconds, deviation_m = (np.asarray(each, np.float64) for each in kept)
            if not len(deviation_m):
                return None
            if not (calls.shape == seconds.shape == deviation_m.shape) or calls.ndim != 1:
                raise ValueError("its lists are not equally long")
            return History(calls, seconds, deviation_m)
        except (ValueError, KeyError, TypeError) as error:
            raise StudyError(f"{path} is damaged ({error}); {_AGAIN}") from None


def read_found(folder: Path, records: Iterable[Record]) -> dict[JobId, Found]:
    """The jobs' folders that belong to a study's rows.

    A folder of an earlier plan, whose job went by the same names with other settings, is known by its other numbers
    and left out.

    Args:
        folder: of the study.
        records: its rows.

    Raises:
        StudyError: a job's file is damaged.
    """
    wanted: dict[JobId, list[float | None]] = {}
    for row in records:
        job = JobId(str(row["scenario"]), str(row["figures"]), str(row["method"]), int(row["seed"]))
        wanted.setdefault(job, []).append(_number(row.get("deviation_m")))
    found: dict[JobId, Found] = {}
    for path in sorted((folder / "jobs").glob("*/job.json")):
        each = _read(path)
        rows = path.with_name("rows.json")
        if each.job in wanted and rows.exists():
            stored = read_json(rows, "roadproof-study-rows", 1, StudyError)["rows"]
            if [_number(row.get("deviation_m")) for row in stored] == wanted[each.job]:
                found[each.job] = each
    return found


def reference_of(folder: Path) -> str | None:
    """The name of the method that the study's plan compares with the others; None where it names none.

    Raises:
        StudyError: the file is damaged.
    """
    path = folder / "study.json"
    name = read_json(path, *STUDY, StudyError).get("reference") if path.exists() else None
    return None if name is None else str(name)


def _read(path: Path) -> Found:
    try:
        content: Any = json.loads(path.read_text(encoding="utf-8"))
        scenario, method = content["scenario"], content["method"]
        return Found(
            job=JobId(str(scenario["name"]), str(content["figures"]), str(method["name"]), int(content["seed"])),
            controller=str(content["controller"]),
            kind=str(scenario["kind"]),
            map_name=str(scenario["map_name"]),
            canvas=CanvasPlacement(**scenario["canvas"]),
            method=Method(
                name=str(method["name"]),
                search=str(method["search"]),
                trajectories=int(method.get("trajectories", 0)),
                scheme=str(method.get("scheme", "")),
            ),
            folder=path.parent,
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StudyError(f"{path} is damaged ({error!r}); {_AGAIN}") from None


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and value == value else None  # NaN is no number
