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
    """The most threads of any library that computes, torch's and those of scikit-learn, which is loaded in the job."""
    import sklearn.gaussian_process  # noqa: F401
    import torch
    from threadpoolctl import threadpool_info

    threads = max(torch.get_num_threads(), *(library["num_threads"] for library in threadpool_info()))
    rows = [{**job_columns(job), "weather": str(weather), "points": threads} for weather in job.weathers]
    return JobResult(tuple(rows), {"pattern.json": b"{}"})
