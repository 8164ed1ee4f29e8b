"""A study on a Ray cluster of two nodes on this machine, of which one is lost; in a process of its own.

python study_on_nodes.py FOLDER

FOLDER holds a plan.toml of three jobs. The study is interrupted once two of its jobs are done, and goes on: its results
are left in FOLDER/there, and in FOLDER/nodes a file for every time a job began, JOB-NODE.
"""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path

import ray
from ray.cluster_utils import Cluster

from roadproof.study.plan import Job, load_study
from roadproof.study.rows import JobResult
from roadproof.study.run import run_study
from study_work import counts


def on_its_node(job: Job, scratch: Path) -> JobResult:
    """The first two jobs wait until both nodes are at work; then the one with two figures takes its node down."""
    nodes = Path(os.environ["NODES"])
    (nodes / f"{job.key}-{ray.get_runtime_context().get_node_id()}").touch()
    until = time.monotonic() + 120
    while len({each.name.split("-")[1] for each in nodes.iterdir()}) < 2 and time.monotonic() < until:
        time.sleep(0.1)
    if job.figures == 2 and not (scratch / "died").exists():
        (scratch / "died").touch()
        os.kill(os.getppid(), signal.SIGKILL)  # the node's raylet, without which its workers end
        time.sleep(120)
    return counts(job, scratch)


def stop_after_two(done: int, _job: Job, _result: JobResult) -> None:
    if done == 2:
        raise KeyboardInterrupt


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    told = {"PYTHONPATH": ":".join(sys.path), "TMPDIR": str(folder), "NODES": str(folder / "nodes")}
    ray.init(address=cluster.address, log_to_driver=False, runtime_env={"env_vars": told})
    study = load_study(folder / "plan.toml")
    try:
        run_study(study, folder / "there", on_its_node, cluster=cluster.address, on_job=stop_after_two)
    except KeyboardInterrupt:
        run_study(study, folder / "there", on_its_node, cluster=cluster.address)
    ray.shutdown()
    cluster.shutdown()
