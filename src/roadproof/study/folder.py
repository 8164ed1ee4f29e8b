"""The folder of a study: what is kept of every job, and all rows as one table.

study.json                  which method tables compare with the others, and which jobs the plan has
jobs/KEY/job.json           what was asked for; KEY is a hash of it
jobs/KEY/rows.json          its rows; there when the job is finished, or has failed
jobs/KEY/pattern.json       what it found, and pattern.png
jobs/KEY/paths.npz          clean_xy, painted_xy: world x, y in metres of both drives alone in the first weather
jobs/KEY/passage-*.jpg      what the car's camera sees while it passes the pattern (`study.passages`)
jobs/KEY/history.json       how the search went (`study.history`)
work/KEY/                   what a job keeps while it runs, to go on from
work/shared/                what several jobs need (`study.shared`)
rows.parquet                every row of every job that has some (`study.rows`)
transfer.parquet            the patterns driven by other controllers (`study.transfer`)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import msgspec

from roadproof.errors import StudyError
from roadproof.foreign import in_one_line
from roadproof.io.files import check_closed, remove, write_atomically, write_json
from roadproof.io.records import plain
from roadproof.io.text import read_json
from roadproof.study.plan import Job, Study
from roadproof.study.rows import Frame, JobId, JobResult, Row

TRANSFERRED = "transfer.parquet"
ROWS = ("roadproof-study-rows", 1)
STUDY = ("roadproof-study-run", 1)


def write_result(job: Job, result: JobResult, folder: Path) -> None:
    """Keep what came of a job; its rows last, since they say that it is finished.

    Raises:
        OutputError: a file cannot be written.
        StudyError: a file would leave the job's folder.
    """
    place = folder / "jobs" / job.key
    for name, content in result.files.items():
        if Path(name).name != name or name in ("rows.json", "job.json"):
            raise StudyError(f"a job gave a file {name!r}, expected a plain name of its own")
        write_atomically(place / name, lambda part, content=content: part.write_bytes(content))
    write_json(place / "job.json", cast("dict[str, Any]", plain(job)))
    write_json(place / "rows.json", {"format": ROWS[0], "version": ROWS[1], "rows": result.rows})


def read_rows(job: Job, folder: Path) -> tuple[Row, ...] | None:
    """The rows of a job, or None where it has none yet.

    Raises:
        StudyError: the file is damaged.
    """
    path = folder / "jobs" / job.key / "rows.json"
    if not path.exists():
        return None
    rows: object = read_json(path, *ROWS, StudyError).get("rows")
    if not isinstance(rows, list) or not rows or not all(isinstance(row, dict) for row in cast("list[object]", rows)):
        raise StudyError(f"{path} is damaged (it has no list of rows); remove it, and the job is done again")
    # Rows of an older roadproof have no key of their own.
    return tuple(cast("Row", {"job": job.key, **row}) for row in cast("list[dict[str, Any]]", rows))


def is_done(job: Job, folder: Path) -> bool:
    """Whether a job came to its end; one that failed is not done and is tried again."""
    rows = read_rows(job, folder)
    return rows is not None and not any(row.get("error") for row in rows)


def named(job: Job) -> JobId:
    """What names a job in the rows."""
    return JobId(job.scenario.name, str(job.figures), job.method.name, job.seed)


def write_study(study: Study, jobs: Iterable[Job], folder: Path) -> None:
    """Keep what the tables need of a study's plan and cannot know from the rows.

    Raises:
        OutputError: the file cannot be written.
    """
    asked = [named(job) for job in jobs]
    content = {"format": STUDY[0], "version": STUDY[1], "reference": study.reference, "jobs": asked}
    write_json(folder / "study.json", content)


@dataclass(frozen=True, kw_only=True, slots=True)
class Planned:
    """What the folder says of a study's plan.

    Args:
        reference: the name of the method that tables compare with the others; None where it names none.
        jobs: what names each job; empty where nobody says, as in folders of earlier versions.
    """

    reference: str | None = None
    jobs: tuple[JobId, ...] = ()


def planned_in(folder: Path) -> Planned:
    """What a study's folder says of its plan.

    Raises:
        StudyError: the file is damaged.
    """
    path = folder / "study.json"
    if not path.exists():
        return Planned()
    content = read_json(path, *STUDY, StudyError)
    name, jobs = content.get("reference"), content.get("jobs", [])
    try:
        asked = msgspec.convert(jobs, tuple[JobId, ...])
    except msgspec.ValidationError as error:
        raise StudyError(f"{path} is damaged (jobs: {error}); run the study again, finished jobs are kept") from None
    return Planned(reference=None if name is None else str(name), jobs=asked)


def write_table(jobs: Iterable[Job], folder: Path) -> Frame:
    """Gather the rows of all jobs that have some, in the jobs' order, and write them as Parquet.

    Raises:
        StudyError: no job has rows, and none of an earlier plan stay; or pandas and pyarrow are not installed.
        OutputError: the file cannot be written.
    """
    rows = [row for job in jobs for row in read_rows(job, folder) or ()]
    if not rows:
        remove(folder / "rows.parquet")
        raise StudyError(f"{folder} has no results yet; run the study first")
    frame = pandas().DataFrame(rows)
    if "error" not in frame:
        frame["error"] = None
    frame["error"] = frame["error"].astype("string")
    write_atomically(folder / "rows.parquet", lambda part: frame.to_parquet(part, index=False))
    return frame


def read_table(folder: Path, name: str = "rows.parquet") -> Frame:
    """Read every row of a study.

    Args:
        folder: the folder of the study.
        name: the name of the table's file in it; `study transfer` writes transfer.parquet.

    Raises:
        StudyError: the file is missing or damaged, or pandas and pyarrow are not installed.
    """
    path = folder / name
    if not path.is_file():
        raise StudyError(f"{folder} has no {name}; run the study first")
    check_closed(folder, StudyError)
    library = pandas()
    again = "run the study again, finished jobs are kept"
    cure = again if name != TRANSFERRED else "remove it and run the transfer again, its drives are kept"
    try:
        return library.read_parquet(path)
    except Exception as error:  # of two libraries, by whatever is damaged
        raise StudyError(f"{path} is damaged ({in_one_line(error)}); {cure}") from None


def read_transfers(folder: Path) -> Frame | None:
    """The rows of a study's patterns under other controllers; None before the first `study transfer`.

    Raises:
        StudyError: as `read_table` does.
    """
    return read_table(folder, TRANSFERRED) if (folder / TRANSFERRED).exists() else None


def pandas() -> Any:  # noqa: ANN401  # the module
    """The pandas library, which an extra installs.

    Raises:
        StudyError: pandas is not installed, or pyarrow, by which it reads and writes Parquet.
    """
    try:
        import_module("pyarrow")
        return import_module("pandas")
    except ImportError as error:
        raise StudyError(f"studies need {error.name}; install roadproof[study]") from None
