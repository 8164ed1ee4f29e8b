"""A made-up study on a Ray cluster with two workers on this machine; in a process of its own, since Ray leaves some.

python study_on_ray.py STUDY.toml OUT NODE {counts,dies_for_two_figures}
"""

from __future__ import annotations

import sys
from pathlib import Path

import ray

import study_work
from roadproof.study.plan import load_study
from roadproof.study.run import run_study

if __name__ == "__main__":
    plan, out, node, work = sys.argv[1:]
    ray.init(
        address="local",
        num_cpus=2,
        include_dashboard=False,
        log_to_driver=False,
        runtime_env={"env_vars": {"PYTHONPATH": ":".join(sys.path), "TMPDIR": node}},
    )
    run_study(load_study(Path(plan)), Path(out), getattr(study_work, work), cluster="local")
