"""What the jobs of a study left in their folders besides rows: the pattern, the paths, the pictures, the search."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from jaxtyping import UInt8

from roadproof.driving.deviation import Path2D
from roadproof.driving.starts import StartPlan
from roadproof.errors import RoadproofError, StudyError
from roadproof.geometry import CanvasPlacement
from roadproof.io.arrays import read_archive
from roadproof.io.files import inside
from roadproof.io.pictures import read_picture
from roadproof.patterns import Pattern, load_pattern
from roadproof.study.history import Progress, read_history
from roadproof.study.passages import file_of
from roadproof.study.plan import TrafficPlan
from roadproof.study.rows import Frame, JobId

_RECORDING = ("trajectories", "scheme", "swerves_m", "weaves_m", "noise_deg")
"""Settings of a gradopt search that say how its drives are recorded and put together."""
_AGAIN = "remove its folder and run the study again"


@dataclass(frozen=True, kw_only=True, slots=True)
class StatedMethod:
    """What tables need to know of a method.

    Args:
        name: the method's name, as the rows have it.
        search: "gradopt", or the word of another search; empty where nobody said.
        trajectories: T, how many drives are recorded for a gradopt search; 0 where nobody said.
        scheme: "group", "group-all" or "random": how a gradopt search groups its drives; empty where nobody said.
        settings: all that job.json says of the method, by name, but for its name and what is empty; empty where nobody
            said.
    """

    name: str
    search: str = ""
    trajectories: int = 0
    scheme: Literal["", "group", "group-all", "random"] = ""
    settings: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def recording(self) -> tuple[object, ...]:
        """How drives are recorded for a gradopt search, and put together."""
        return self.scheme, self.trajectories, *map(self.settings.get, _RECORDING)

    def searches_as(self, other: StatedMethod) -> bool:
        """Whether both are gradopt, alike in all that is known of them but in their recordings."""
        mine, theirs = (
            {name: value for name, value in each.settings.items() if name not in _RECORDING} for each in (self, other)
        )
        return self.search == other.search == "gradopt" and mine == theirs


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
    method: dict[str, Any]
    weathers: tuple[str, ...] = ()
    starts: StartPlan | None = None
    traffic: TrafficPlan | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class KeptJob:
    """A job of which there are rows, and its folder.

    Args:
        id: the scenario, K, method and seed of the job.
        controller: spec of the controller that the pattern was found against.
        scenario: the map and the canvas of the scenario.
        method: how the pattern was searched.
        weathers: the weathers of its drives, also of those left out, that in which the pattern was found first; empty
            where job.json has none.
        starts: how many drives alone there are in each weather, and where they begin; None where job.json does not say.
        traffic: how many drives there are in traffic; None for none.
        folder: the folder with the job's files.
    """

    id: JobId
    controller: str
    scenario: StatedScenario
    method: StatedMethod
    weathers: tuple[str, ...]
    starts: StartPlan | None
    traffic: TrafficPlan | None
    folder: Path

    @property
    def planned(self) -> dict[tuple[str, bool], int]:
        """How many drives there are in each weather, alone and in traffic; empty where job.json does not say."""
        if self.starts is None:
            return {}
        alone = len(set(self.starts.range.draw(self.starts.count, self.id.seed)))  # as equal starts are driven once
        found = {(weather, False): alone for weather in self.weathers}
        if self.traffic is not None:
            among = self.weathers[:1] if self.traffic.weathers == "first" else self.weathers
            found |= {(weather, True): self.traffic.runs for weather in among}
        return found

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
            method = _method(told.method)
        except (OSError, msgspec.MsgspecError, RecursionError, RoadproofError) as error:
            raise StudyError(f"{path} is damaged ({error}); {_AGAIN}") from None
        job = JobId(*name)
        found[job] = KeptJob(
            id=job,
            controller=told.controller,
            scenario=told.scenario,
            method=method,
            weathers=told.weathers,
            starts=told.starts,
            traffic=told.traffic,
            folder=path.parent,
        )
    return found


def _method(told: Mapping[str, Any]) -> StatedMethod:
    """A method as job.json has it; what is empty may be missing in an older one."""
    settings = {name: value for name, value in told.items() if name != "name" and value}
    if "attack_weathers" in settings:
        settings["attack_weathers"] = msgspec.convert(settings["attack_weathers"], list[str])
    return replace(msgspec.convert(told, StatedMethod), settings=settings)
