"""A study on a Ray cluster with two workers on this machine; in a process of its own, since Ray leaves some.

python study_on_ray.py STUDY.toml OUT NODE {counts,dies_for_two_figures,run_job}
"""

from __future__ import annotations

import sys
from pathlib import Path

import ray

from roadproof.study.job import run_job
from roadproof.study.plan import load_study
from roadproof.study.run import run_study
from study_work import counts, dies_for_two_figures

WORKS = {work.__name__: work for work in (counts, dies_for_two_figures, run_job)}

if __name__ == "__main__":
    plan, out, node, work = sys.argv[1:]
    ray.init(
        address="local",
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        runtime_env={"env_vars": {"PYTHONPATH": ":".join(sys.path), "TMPDIR": node}},
    )
    run_study(load_study(Path(plan)), Path(out), WORKS[work], cluster="local")
