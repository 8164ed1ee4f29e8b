"""Jobs of made-up studies: in a module of their own, since other processes import them."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from roadproof.study.plan import Job
from roadproof.study.rows import JobResult, job_columns


def counts(job: Job, scratch: Path) -> JobResult:
    """Rows that depend on the job alone; leaves a line in its folder each time it is done."""
    with (scratch / "runs").open("a") as file:
        file.write("run\n")
    length = len(f"{job.figures}{job.method.name}{job.scenario.name}")
    rows = [{**job_columns(job), "weather": str(weather), "deviation_m": length / 10} for weather in job.weathers]
    return JobResult(tuple(rows), {"pattern.json": b"{}"})


def fails_for_bo(job: Job, scratch: Path) -> JobResult:
    if job.method.name == "BO":
        raise ValueError("no luck")
    return counts(job, scratch)


def dies_for_two_figures(job: Job, scratch: Path) -> JobResult:
    if job.figures == 2 and not (scratch / "died").exists():
        (scratch / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return counts(job, scratch)


def tells_threads(job: Job, scratch: Path) -> JobResult:
    # As a real job does, it imports torch in its own process.
    import torch

    rows = [
        {**job_columns(job), "weather": str(weather), "points": torch.get_num_threads()} for weather in job.weathers
    ]
    return JobResult(tuple(rows), {"pattern.json": b"{}"})
