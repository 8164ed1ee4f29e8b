"""What the jobs of a study left in their folders besides rows: the pattern, the paths, the pictures, the search."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np
from jaxtyping import UInt8

from roadproof.driving.deviation import Path2D
from roadproof.errors import StudyError
from roadproof.geometry import CanvasPlacement
from roadproof.io.arrays import read_archive
from roadproof.io.files import inside
from roadproof.io.pictures import read_picture
from roadproof.patterns import Pattern, load_pattern
from roadproof.study.history import Progress, read_history
from roadproof.study.passages import file_of
from roadproof.study.rows import Frame, JobId

_AGAIN = "remove its folder and run the study again"


@dataclass(frozen=True, kw_only=True, slots=True)
class StatedMethod:
    """What tables need to know of a method.

    Args:
        name: the method's name, as the rows have it.
        search: "gradopt", or the word of another search; empty where nobody said.
        trajectories: T, how many drives are recorded for a gradopt search; 0 where nobody said.
        scheme: "group", "group-all" or "random": how a gradopt search groups its drives; empty where nobody said.
    """

    name: str
    search: str = ""
    trajectories: int = 0
    scheme: Literal["", "group", "group-all", "random"] = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class StatedScenario:
    """What pictures need to know of a scenario."""

    map_name: str
    canvas: CanvasPlacement


@dataclass(frozen=True, kw_only=True, slots=True)
class _Stated:
    """What tables and pictures need of job.json."""

    controller: str
    scenario: StatedScenario
    method: StatedMethod


@dataclass(frozen=True, kw_only=True, slots=True)
class KeptJob(_Stated):
    """A job of which there are rows, and its folder.

    Args:
        id: the scenario, K, method and seed of the job.
        controller: spec of the controller that the pattern was found against.
        scenario: the map and the canvas of the scenario.
        method: how the pattern was searched.
        folder: the folder with the job's files.
    """

    id: JobId
    folder: Path

    def pattern(self) -> Pattern | None:
        """The pattern that the job found; None where the job has none.

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

    def passage(self, weather: str, *, traffic: bool) -> UInt8[np.ndarray, "h w 3"] | None:
        """What the car's camera sees while it passes the pattern; None where the job kept no pictures of that.

        Raises:
            StudyError: the file is damaged.
        """
        path = self.folder / file_of(weather, traffic=traffic)
        if path.parent != self.folder or not path.exists():
            return None
        return read_picture(path, StudyError, _AGAIN)

    def deviation(self) -> Progress | None:
        """The metres that the search's best patterns reached when driven; None where the job kept none.

        Raises:
            StudyError: the file is damaged.
        """
        path = self.folder / "history.json"
        return read_history(path).deviation if path.exists() else None


def read_jobs(folder: Path, rows: Frame) -> dict[JobId, KeptJob]:
    """The jobs that rows belong to, of those that left a folder.

    Args:
        folder: the folder of the study; one with rows.parquet alone has no jobs.
        rows: the rows of the study; their jobs are found by their keys.

    Raises:
        StudyError: a job's file is damaged, or the rows are so old that they have no keys.
    """
    if not (folder / "jobs").is_dir():
        return {}
    if "job" not in rows:
        raise StudyError(
            f"the rows of {folder} do not say which job they belong to, as those of an older roadproof; "
            "run the study again, finished jobs are kept"
        )
    found: dict[JobId, KeptJob] = {}
    for *name, key in rows[[*JobId._fields, "job"]].drop_duplicates().itertuples(index=False):
        path = inside(folder / "jobs", key, "job", StudyError) / "job.json"
        if not path.exists():
            continue
        try:
            told = msgspec.json.decode(path.read_bytes(), type=_Stated)
        except (OSError, msgspec.MsgspecError, RecursionError) as error:
            raise StudyError(f"{path} is damaged ({error}); {_AGAIN}") from None
        job = JobId(*name)
        found[job] = KeptJob(
            id=job, folder=path.parent, controller=told.controller, scenario=told.scenario, method=told.method
        )
    return found
