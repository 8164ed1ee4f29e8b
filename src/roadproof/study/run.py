"""Running the jobs of a study: side by side on this machine, or on a Ray cluster; what is done is not done again."""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, TypeAlias
from urllib.parse import urlsplit

from roadproof.errors import RoadproofError, StudyError
from roadproof.io.locks import own_folder, working_in
from roadproof.machine import keep_freed_memory
from roadproof.processes import processes_beside
from roadproof.simulators.loading import is_server
from roadproof.study.folder import is_done, pandas, write_result, write_study, write_table
from roadproof.study.plan import Job, Study
from roadproof.study.rows import Frame, JobResult, failed

Work: TypeAlias = Callable[[Job, Path], JobResult]
"""Does a job; the folder is its own, and holds what a run before this one left there."""

OnJob: TypeAlias = Callable[[int, Job, JobResult], object]
"""Called with how many jobs are done, the last one, and its result."""

_ANSWERS_S = 10.0
"""So long an address of a cluster has to answer."""


def run_study(
    study: Study,
    folder: Path,
    work: Work,
    *,
    workers: int = 1,
    cluster: str | None = None,
    on_job: OnJob = lambda _done, _job, _result: None,
) -> Frame:
    """Do every job of a study that is not done yet, and gather the rows.

    A job that fails becomes a row that says why, and the others go on. Killed in the middle, the same call does what
    is left; a job that failed is tried again.

    Args:
        study: the study whose jobs are done.
        folder: the folder where results are kept; may hold those of a run before.
        work: does one job; a function of a module, since it runs in other processes.
        workers: how many processes work on this machine, each with one thread; 1 with a cluster.
        cluster: address of a Ray cluster, "local" for one on this machine; None does without Ray.
        on_job: called after every job with how many are done, the job and its result.

    Raises:
        StudyError: an argument makes no sense, or an extra is missing.
        OutputError: the folder cannot be written, or another process works in it.
    """
    check_workers(study, workers, cluster)
    pandas()  # what writes the table is missed now, not after the night
    with working_in(folder), _ray_at(cluster) as ray:
        jobs = study.jobs  # once: the controller's file may be written again meanwhile
        left = [job for job in jobs if not is_done(job, folder)]
        done = len(jobs) - len(left)
        write_study(study, jobs, folder)
        # However this run ends, the table is of this plan, and has what is there.
        with suppress(StudyError):
            write_table(jobs, folder)
        results = _on_this_machine(left, folder, work, workers) if ray is None else _on_ray(left, work, ray)
        try:
            with closing(results):
                for job, result in results:
                    write_result(job, result, folder)
                    done += 1
                    on_job(done, job, result)
        except BaseException:
            with suppress(StudyError):
                write_table(jobs, folder)
            raise
        return write_table(jobs, folder)


def check_workers(study: Study, workers: int, cluster: str | None) -> None:
    """See that the jobs of a study can be done at once as asked.

    Raises:
        StudyError: an argument makes no sense.
    """
    if workers < 1:
        raise StudyError(f"workers is {workers}, expected 1 or more")
    if is_server(study.simulator) and (workers > 1 or cluster is not None):
        raise StudyError(f"the simulator {study.simulator} drives one job at a time; use one worker and no cluster")
    if cluster is not None and workers > 1:
        raise StudyError(f"workers is {workers}, but a cluster has as many as it has cores; leave one of them out")


@contextmanager
def _ray_at(cluster: str | None) -> Generator[Any]:
    """Ray, connected to a cluster; None where none is asked for, and this machine has what it needs."""
    if cluster is None:
        try:
            import_module("threadpoolctl")
        except ImportError as error:
            raise StudyError(f"studies need {error.name}; install roadproof[study]") from None
        yield None
        return
    try:
        ray: Any = import_module("ray")
    except ImportError:
        raise StudyError("a cluster needs ray; install roadproof[ray]") from None
    if ray.is_initialized():
        yield ray
        return
    try:
        _require_listening(cluster)
        ray.init(address=cluster, log_to_driver=False, include_dashboard=False if cluster == "local" else None)
    except (OSError, ValueError, RuntimeError) as error:
        raise StudyError(f"no Ray cluster answers at {cluster}: {error}; start one, or write local") from None
    try:
        yield ray
    finally:
        ray.shutdown()


def _require_listening(cluster: str) -> None:
    """See that somebody listens at an address with a port; Ray itself would ask there for minutes.

    Raises:
        OSError, ValueError: nobody does, or the port is none.
    """
    address = urlsplit(cluster if "//" in cluster else f"//{cluster}")
    if address.hostname is not None and address.port is not None:
        socket.create_connection((address.hostname, address.port), timeout=_ANSWERS_S).close()


def _attempt(job: Job, scratch: Path, work: Work) -> JobResult:
    """A job's result, whatever it raises: one bad job must not stop the night. The process is the job's own."""
    keep_freed_memory()
    # Where a search ends depends on its threads, and rows must not depend on how many jobs run. What is loaded already
    # keeps to limits, what is loaded later to the variable.
    import_module("threadpoolctl").threadpool_limits(1)
    os.environ["OMP_NUM_THREADS"] = "1"
    try:
        scratch.mkdir(parents=True, exist_ok=True)
        return work(job, scratch)
    except Exception as error:
        kind = "" if isinstance(error, RoadproofError) else f"{type(error).__name__}: "
        return failed(job, f"{kind}{error}")


def _on_this_machine(jobs: Sequence[Job], folder: Path, work: Work, workers: int) -> Generator[tuple[Job, JobResult]]:
    # Threads that each wait for a process of their own: one that dies takes its job with it and no other.
    pool = ThreadPoolExecutor(workers)
    try:
        for done in as_completed(pool.submit(_in_own_process, job, folder / "work" / job.key, work) for job in jobs):
            yield done.result()
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


def _in_own_process(job: Job, scratch: Path, work: Work) -> tuple[Job, JobResult]:
    with processes_beside(1) as process:
        try:
            return job, process.submit(_attempt, job, scratch, work).result()
        except BrokenProcessPool:
            return job, failed(job, "its process died, most likely for want of memory; use fewer workers")


def _on_ray(jobs: Sequence[Job], work: Work, ray: Any) -> Generator[tuple[Job, JobResult]]:  # noqa: ANN401  # the module
    running: dict[Any, Job] = {}
    try:
        remote = ray.remote(max_retries=1)(_on_node)
        running.update({remote.remote(job, work): job for job in jobs})
        while running:
            (reference,), _ = ray.wait(list(running), num_returns=1)
            job = running.pop(reference)
            try:
                result = ray.get(reference)
            except ray.exceptions.RayError as error:
                result = failed(job, f"its worker died: {str(error).splitlines()[0]}")
            yield job, result
    finally:
        # A study that is interrupted leaves no job behind on a cluster that goes on.
        for reference in running:
            ray.cancel(reference, force=True)


def _on_node(job: Job, work: Work) -> JobResult:
    # What a job keeps to go on from stays on its node, where others may compute too; its result travels.
    return _attempt(job, own_folder(Path(tempfile.gettempdir()), "study") / job.key, work)
