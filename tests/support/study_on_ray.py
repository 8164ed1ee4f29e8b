"""Studies on a Ray cluster with two workers on this machine; in a process of their own, since Ray leaves some.

python study_on_ray.py NODE FOLDER:{dies_for_two_figures,run_job} ...

Each FOLDER holds a plan.toml; its results are left in FOLDER/there.
"""

from __future__ import annotations

import sys
from pathlib import Path

import ray

from roadproof.study.job import run_job
from roadproof.study.plan import load_study
from roadproof.study.run import run_study
from study_work import dies_for_two_figures

WORKS = {work.__name__: work for work in (dies_for_two_figures, run_job)}

if __name__ == "__main__":
    node, *studies = sys.argv[1:]
    ray.init(
        address="local",
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        runtime_env={"env_vars": {"PYTHONPATH": ":".join(sys.path), "TMPDIR": node}},
    )
    for study in studies:
        folder, work = study.rsplit(":", 1)
        run_study(load_study(Path(folder) / "plan.toml"), Path(folder) / "there", WORKS[work], cluster="local")
