"""The folder of a study: what is kept of every job, and all rows as one table.

study.json                  which method tables compare with the others
jobs/KEY/job.json           what was asked for; KEY is a hash of it
jobs/KEY/rows.json          its rows; there when the job is finished, or has failed
jobs/KEY/pattern.json       what it found, and pattern.png
jobs/KEY/paths.npz          clean_xy, painted_xy: world x, y in metres of both drives alone in the first weather
jobs/KEY/passage-*.jpg      what the car's camera sees while it passes the pattern (`study.passages`)
jobs/KEY/history.json       how the search went (`study.history`)
work/KEY/                   what a job keeps while it runs, to go on from
work/shared/                what several jobs need (`study.shared`)
rows.parquet                every row of every job (`study.rows`)
transfer.parquet            the patterns driven by other controllers (`study.transfer`)
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any, cast

from roadproof.errors import StudyError
from roadproof.io.files import check_closed, write_atomically, write_text
from roadproof.io.text import read_json
from roadproof.study.plan import Job, Study
from roadproof.study.rows import Frame, JobResult, Row

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
    _write_json(place / "job.json", asdict(job))
    _write_json(place / "rows.json", {"format": ROWS[0], "version": ROWS[1], "rows": result.rows})


def read_rows(job: Job, folder: Path) -> tuple[Row, ...] | None:
    """The rows of a job, or None where it has none yet.

    Raises:
        StudyError: the file is damaged.
    """
    path = folder / "jobs" / job.key / "rows.json"
    if not path.exists():
        return None
    rows: object = read_json(path, *ROWS, StudyError).get("rows")
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in cast("list[object]", rows)):
        raise StudyError(f"{path} is damaged (it has no list of rows); remove it, and the job is done again")
    # Rows of an older roadproof have no key of their own.
    return tuple(cast("Row", {"job": job.key, **row}) for row in cast("list[dict[str, Any]]", rows))


def is_done(job: Job, folder: Path) -> bool:
    """Whether a job came to its end; one that failed is not done and is tried again."""
    rows = read_rows(job, folder)
    return rows is not None and not any(row.get("error") for row in rows)


def write_study(study: Study, folder: Path) -> None:
    """Keep what the tables need of a study's plan and cannot know from the jobs.

    Raises:
        OutputError: the file cannot be written.
    """
    _write_json(folder / "study.json", {"format": STUDY[0], "version": STUDY[1], "reference": study.reference})


def reference_of(folder: Path) -> str | None:
    """The name of the method that the study's plan compares with the others; None where it names none.

    Raises:
        StudyError: the file is damaged.
    """
    path = folder / "study.json"
    name = read_json(path, *STUDY, StudyError).get("reference") if path.exists() else None
    return None if name is None else str(name)


def write_table(jobs: Iterable[Job], folder: Path) -> Frame:
    """Gather the rows of all jobs that have some, in the jobs' order, and write them as Parquet.

    Raises:
        StudyError: no job has rows, or pandas and pyarrow are not installed.
        OutputError: the file cannot be written.
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
    try:
        return library.read_parquet(path)
    except (OSError, ValueError) as error:
        raise StudyError(f"{path} is damaged ({error}); run the study again, finished jobs are kept") from None


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


def _write_json(path: Path, content: object) -> None:
    write_text(path, json.dumps(content, indent=1, default=str, allow_nan=False) + "\n")
