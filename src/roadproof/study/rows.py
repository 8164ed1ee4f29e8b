"""What a job gives back, where it is kept in the folder of its study, and all of it as one table.

study.json            which method tables compare with the others
jobs/KEY/job.json     what was done, in words; for people
jobs/KEY/rows.json    its rows; there when the job is finished, or has failed
jobs/KEY/…            the job's files: pattern.json, paths.npz
work/KEY/             what a job keeps while it runs, to go on from
rows.parquet          every row of every job
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from roadproof.errors import StudyError
from roadproof.io.files import read_json, write_atomically
from roadproof.study.plan import Job, Study

if TYPE_CHECKING:
    from pandas import DataFrame

FORMAT = "roadproof-study-rows"
FORMAT_VERSION = 1
STUDY_FORMAT = "roadproof-study-run"
Row: TypeAlias = Mapping[str, str | int | float | bool | None]

JOB_COLUMNS = ("scenario", "kind", "figures", "method", "seed")
"""Which job a row belongs to; what follows it is `study.job.MEASURED`, and error, empty where all went well."""


@dataclass(frozen=True, slots=True)
class JobResult:
    """What came of one job.

    Args:
        rows: one for each drive that was judged, or a single one with an error.
        files: small files by name, kept with the rows.
    """

    rows: tuple[Row, ...]
    files: Mapping[str, bytes] = field(default_factory=dict[str, bytes])


def failed(job: Job, reason: str) -> JobResult:
    """The result of a job that did not come to its end."""
    return JobResult(({**job_columns(job), "error": reason},))


def job_columns(job: Job) -> dict[str, str | int]:
    """The columns that say which job a row belongs to."""
    return {
        "scenario": job.scenario.name,
        "kind": str(job.scenario.kind),
        "figures": str(job.figures),
        "method": job.method.name,
        "seed": job.seed,
    }


def write_result(job: Job, result: JobResult, folder: Path) -> None:
    """Keep what came of a job; its rows last, since they say that it is finished.

    Raises:
        OutputError: it cannot be written.
        StudyError: a file would leave the job's folder.
    """
    place = folder / "jobs" / job.key
    for name, content in result.files.items():
        if Path(name).name != name or name in ("rows.json", "job.json"):
            raise StudyError(f"a job gave a file {name!r}, expected a plain name of its own")
        write_atomically(place / name, lambda part, content=content: part.write_bytes(content))
    _write_json(place / "job.json", asdict(job))
    _write_json(place / "rows.json", {"format": FORMAT, "version": FORMAT_VERSION, "rows": list(result.rows)})


def write_study(study: Study, folder: Path) -> None:
    """Keep what a report cannot know from the jobs.

    Raises:
        OutputError: it cannot be written.
    """
    _write_json(folder / "study.json", {"format": STUDY_FORMAT, "version": 1, "reference": study.reference})


def read_rows(job: Job, folder: Path) -> tuple[Row, ...] | None:
    """The rows of a job, or None where it has none yet.

    Raises:
        StudyError: the file is damaged.
    """
    path = folder / "jobs" / job.key / "rows.json"
    if not path.exists():
        return None
    rows: list[dict[str, Any]] = read_json(path, FORMAT, FORMAT_VERSION, StudyError)["rows"]
    return tuple(rows)


def is_done(job: Job, folder: Path) -> bool:
    """Whether a job came to its end; one that failed is not done and is tried again."""
    rows = read_rows(job, folder)
    return rows is not None and not any(row.get("error") for row in rows)


def write_table(jobs: Iterable[Job], folder: Path) -> DataFrame:
    """Gather the rows of all jobs that have some, in the jobs' order, and write them as Parquet.

    Raises:
        StudyError: there is none, or pandas and pyarrow are not installed.
        OutputError: it cannot be written.
    """
    rows = [row for job in jobs for row in read_rows(job, folder) or ()]
    if not rows:
        raise StudyError(f"{folder} has no results yet; run the study first")
    frame = pandas().DataFrame(rows)
    if "error" not in frame:
        frame["error"] = None
    frame["error"] = frame["error"].astype("string")
    write_atomically(folder / "rows.parquet", lambda part: frame.to_parquet(part, index=False))
    return frame


def read_table(folder: Path, name: str = "rows.parquet") -> DataFrame:
    """Every row of a study.

    Args:
        folder: of the study.
        name: of the table in it; `study transfer` writes transfer.parquet.

    Raises:
        StudyError: there is none, it is damaged, or pandas and pyarrow are not installed.
    """
    path = folder / name
    if not path.is_file():
        raise StudyError(f"{folder} has no {name}; run the study first")
    try:
        return pandas().read_parquet(path)
    except (OSError, ValueError) as error:
        raise StudyError(f"{path} is damaged ({error}); run the study again, finished jobs are kept") from None


def records(frame: DataFrame) -> list[dict[str, Any]]:
    """The rows of a table, each by its columns' names."""
    return cast("list[dict[str, Any]]", frame.to_dict("records"))


def pandas() -> Any:  # noqa: ANN401  # the module
    """The library for tables, an extra."""
    try:
        import_module("pyarrow")  # pandas reads and writes Parquet by it
        return import_module("pandas")
    except ImportError as error:
        raise StudyError(f"studies need {error.name}; install roadproof[study]") from None


def _write_json(path: Path, content: object) -> None:
    text = json.dumps(content, indent=1, default=str, allow_nan=False) + "\n"
    write_atomically(path, lambda part: part.write_text(text, encoding="utf-8"))
