"""A study on a Ray cluster of two nodes on this machine, of which one is lost; in a process of its own.

python study_on_nodes.py FOLDER

FOLDER holds a plan.toml of three jobs. The study is interrupted once two of its jobs are done, and goes on: its results
are left in FOLDER/there, and in FOLDER/nodes a file for every time a job began, JOB-NODE.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from pathlib import Path

import ray
from ray.cluster_utils import Cluster

from roadproof.study.plan import Job, load_study
from roadproof.study.rows import JobResult
from roadproof.study.run import run_study
from study_work import counts


def on_its_node(job: Job, scratch: Path) -> JobResult:
    """The job with two figures has its node taken down, and is done when it is begun again."""
    node, nodes = ray.get_runtime_context().get_node_id(), Path(os.environ["NODES"])
    (nodes / f"{job.key}-{node}").touch()
    lost = nodes.parent / "lost"
    if job.figures == 2 and not lost.exists():
        lost.write_text(node)
        time.sleep(400)
    return counts(job, scratch)


def lose(cluster: Cluster, lost: Path) -> None:
    """Take down the node that `lost` will name, as soon as it does."""
    while not lost.exists() or not lost.read_text():
        time.sleep(0.1)
    # Killed from here, which began the node: nobody else could wait for it, and a node that is killed but not waited
    # for still counts as alive to its workers, which then go on.
    (node,) = (each for each in cluster.worker_nodes if each.node_id == lost.read_text())
    cluster.remove_node(node, allow_graceful=False)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    for _ in range(2):
        cluster.add_node(num_cpus=1)
    told = {"PYTHONPATH": ":".join(sys.path), "TMPDIR": str(folder), "NODES": str(folder / "nodes")}
    ray.init(address=cluster.address, log_to_driver=False, runtime_env={"env_vars": told})
    loss = threading.Thread(target=lose, args=(cluster, folder / "lost"), daemon=True)
    loss.start()

    def stop_after_two(done: int, _job: Job, _result: JobResult) -> None:
        loss.join()
        if done == 2:
            raise KeyboardInterrupt

    study = load_study(folder / "plan.toml")
    try:
        run_study(study, folder / "there", on_its_node, cluster=cluster.address, on_job=stop_after_two)
    except KeyboardInterrupt:
        run_study(study, folder / "there", on_its_node, cluster=cluster.address)
    ray.shutdown()
    cluster.shutdown()
