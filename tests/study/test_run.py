from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import needs
from roadproof.errors import StudyError
from roadproof.study.folder import Planned, named, planned_in, read_table
from roadproof.study.job import run_job
from roadproof.study.plan import load_study
from roadproof.study.run import run_study
from street_plan import write_plan
from study_work import counts, dies_for_two_figures, fails_for_bo, tells_threads


@pytest.fixture
def two_jobs(small_study):
    """One method; each job is a process, which starts slowly."""
    return dataclasses.replace(small_study, methods=small_study.methods[:1])


def test_a_table_without_pandas_is_not_called_damaged(tmp_path, monkeypatch):
    (tmp_path / "rows.parquet").touch()
    with pytest.raises(StudyError, match="is damaged"):
        read_table(tmp_path)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(StudyError, match=r"^studies need pandas; install roadproof\[study\]$"):
        read_table(tmp_path)


def test_every_job_gives_its_rows_and_what_is_done_is_not_done_again(small_study, tmp_path):
    told = []
    frame = run_study(small_study, tmp_path, counts, workers=2, on_job=lambda done, job, _: told.append((done, job)))
    assert [done for done, _ in told] == list(range(1, 5))
    assert len(frame) == 8
    assert set(frame["figures"]) == {"1-b", "2"}
    assert frame["error"].isna().all()
    assert read_table(tmp_path).equals(frame)
    assert all((tmp_path / "jobs" / job.key / "pattern.json").read_bytes() == b"{}" for job in small_study.jobs)
    lost = small_study.jobs[3]
    (tmp_path / "jobs" / lost.key / "rows.json").unlink()
    assert run_study(small_study, tmp_path, counts).equals(frame)
    runs = {job.key: (tmp_path / "work" / job.key / "runs").read_text().count("run") for job in small_study.jobs}
    assert runs.pop(lost.key) == 2
    assert set(runs.values()) == {1}


def test_an_interrupted_study_has_the_rows_of_its_plan_and_says_which_are_not_done(two_jobs, tmp_path):
    before, now = two_jobs.figures
    run_study(dataclasses.replace(two_jobs, figures=(before,)), tmp_path, counts)

    def stop(done, _job, _result):
        raise KeyboardInterrupt

    study = dataclasses.replace(two_jobs, figures=(now, 3), reference="GradOpt")
    with pytest.raises(KeyboardInterrupt):
        run_study(study, tmp_path, counts, on_job=stop)
    assert set(read_table(tmp_path)["figures"]) == {str(now)}
    assert planned_in(tmp_path) == Planned(reference="GradOpt", jobs=tuple(named(job) for job in study.jobs))
    with pytest.raises(KeyboardInterrupt):
        run_study(dataclasses.replace(two_jobs, figures=(4,)), tmp_path, counts, on_job=stop)
    assert set(read_table(tmp_path)["figures"]) == {"4"}


def test_a_run_that_is_refused_leaves_a_study_as_it_was(two_jobs, tmp_path):
    pytest.importorskip("ray", reason="ray is not installed")
    run_study(two_jobs, tmp_path, counts)
    kept = {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()}
    other = dataclasses.replace(two_jobs, figures=(3,))
    with pytest.raises(StudyError, match="no Ray cluster answers"):
        run_study(other, tmp_path, counts, cluster="nowhere")
    with pytest.raises(StudyError, match=r"no Ray cluster answers at 127\.0\.0\.1:1: .*refused"):
        run_study(other, tmp_path, counts, cluster="127.0.0.1:1")
    with pytest.raises(StudyError, match="workers is 2, but a cluster has as many"):
        run_study(other, tmp_path, counts, cluster="local", workers=2)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.*") if path.is_file()} == kept


@pytest.mark.parametrize("name", ["rows.parquet", "transfer.parquet"])
def test_a_table_damaged_anywhere_is_one_line(two_jobs, tmp_path, name):
    frame = run_study(two_jobs, tmp_path, counts)
    path = tmp_path / name
    frame.to_parquet(path, index=False)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    refused = 0
    for at in rng.integers(0, len(whole), 400).tolist():
        path.write_bytes(whole[:at] + bytes([whole[at] ^ int(rng.integers(1, 256))]) + whole[at + 1 :])
        try:
            read_table(tmp_path, name)
        except StudyError as error:
            refused += 1
            cure = "run the study again" if name == "rows.parquet" else "remove it and run the transfer again"
            assert cure in str(error)
    assert refused > 100


def test_a_job_that_fails_is_a_row_that_says_why_and_is_tried_again(small_study, tmp_path):
    study = dataclasses.replace(small_study, figures=("1-b",))
    frame = run_study(study, tmp_path, fails_for_bo, workers=2)
    bad = frame[frame["error"].notna()]
    assert set(bad["method"]) == {"BO"}
    assert set(bad["error"]) == {"ValueError: no luck"}
    assert len(frame) == 1 + 2
    again = run_study(study, tmp_path, counts, workers=2)
    assert len(again) == 4
    assert again["error"].isna().all()


@pytest.mark.parametrize("workers", [1, 2])
def test_a_job_has_one_thread_however_many_are_done_at_once(two_jobs, tmp_path, monkeypatch, workers):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    study = dataclasses.replace(two_jobs, figures=("1-b",))
    assert set(run_study(study, tmp_path, tells_threads, workers=workers)["points"]) == {1}


def test_a_process_that_dies_takes_its_job_and_no_other(two_jobs, tmp_path):
    frame = run_study(two_jobs, tmp_path, dies_for_two_figures, workers=2)
    bad = frame[frame["error"].notna()]
    assert set(bad["figures"]) == {"2"}
    assert "its process died" in bad["error"].iloc[0]
    assert len(frame) == 1 + 2
    assert len(run_study(two_jobs, tmp_path, dies_for_two_figures)) == 4


COUNTED = """
format = "roadproof-study"
version = 2
controller = "cil"
scenarios = ["left-01"]
figures = [1, 2]
method = [{ name = "GradOpt", search = "gradopt" }]
"""
DRIVEN = """
format = "roadproof-study"
version = 2
controller = "pilotnet"
scenario_file = "street.toml"
scenarios = ["street"]
figures = [1]
starts = { count = 1 }

[[method]]
name = "GradOpt"
search = "gradopt"
objective = "steering"
halving = false
trajectories = 1
restarts = 1
iterations = 2
frames = 4
select = 1

[[method]]
name = "chance"
search = "random"
calls = 2
"""


@pytest.fixture(scope="module")
def on_a_cluster(tmp_path_factory):
    """Folders of both studies, done on one Ray cluster of this machine; in the first a worker dies."""
    pytest.importorskip("ray", reason="ray is not installed")
    needs.town()
    folder = tmp_path_factory.mktemp("cluster")
    done = {dies_for_two_figures: folder / "counted", run_job: folder / "driven"}
    for place, plan in zip(done.values(), (COUNTED, DRIVEN), strict=True):
        place.mkdir()
        write_plan(place, plan)
    (folder / "node").mkdir()
    words = [f"{place}:{work.__name__}" for work, place in done.items()]
    on_ray("study_on_ray.py", folder / "node", *words)
    return done


def on_ray(script, *words):
    """Run a script of `support` in a process of its own, where it begins a cluster."""
    # By default Ray's workers let all others go first, so that beside other tests they hardly get to work.
    fair = os.environ | {"RAY_raylet_start_wait_time_s": "240", "RAY_worker_niceness": "0"}
    command = [sys.executable, str(Path(__file__).parents[1] / "support" / script), *map(str, words)]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=600, env=fair)
    assert ran.returncode == 0, ran.stderr


@pytest.mark.slow
def test_a_cluster_gives_the_same_rows_also_when_a_worker_dies(on_a_cluster, tmp_path):
    place = on_a_cluster[dies_for_two_figures]
    here = run_study(load_study(place / "plan.toml"), tmp_path, counts)
    # A worker that died costs its job one more try, and nobody else anything.
    assert read_table(place / "there").equals(here)


@pytest.mark.slow
def test_a_cluster_finds_and_drives_as_this_machine_does(on_a_cluster, tmp_path):
    place = on_a_cluster[run_job]
    here = run_study(load_study(place / "plan.toml"), tmp_path, run_job)
    assert here["error"].isna().all()
    assert (here["deviation_m"] > 0).all()
    # The same jobs two at once and one by one: the same rows but for the time they took.
    time = ["search_seconds", "seconds"]
    assert read_table(place / "there").drop(columns=time).equals(here.drop(columns=time))


@pytest.mark.slow
def test_a_cluster_loses_a_node_and_goes_on_with_the_others(tmp_path):
    pytest.importorskip("ray", reason="ray is not installed")
    write_plan(tmp_path, COUNTED.replace("[1, 2]", "[1, 2, 3]"))
    (tmp_path / "nodes").mkdir()
    on_ray("study_on_nodes.py", tmp_path)
    study = load_study(tmp_path / "plan.toml")
    began = [each.name.split("-") for each in (tmp_path / "nodes").iterdir()]
    by_job = {job.figures: [node for key, node in began if key == job.key] for job in study.jobs}
    # The job that lost its node was begun again on the other.
    assert len({node for _, node in began}) == 2
    assert len(by_job[2]) == 2
    assert read_table(tmp_path / "there").equals(run_study(study, tmp_path / "here", counts))
    # What was done before the interruption was not done again; the third job may have been under way.
    runs = [each.read_text().count("run") for each in tmp_path.glob("roadproof-study-*/*/runs")]
    assert len(runs) == 3
    assert sum(runs) in (3, 4)


def test_less_than_one_worker_is_refused(small_study, tmp_path):
    with pytest.raises(StudyError, match="workers is 0"):
        run_study(small_study, tmp_path, counts, workers=0)


def test_one_server_is_not_asked_for_two_jobs_at_once(two_jobs, tmp_path):
    study = dataclasses.replace(two_jobs, simulator="carla://localhost")
    for options in ({"workers": 2}, {"cluster": "local"}):
        with pytest.raises(StudyError, match="use one worker and no cluster"):
            run_study(study, tmp_path, counts, **options)
    assert run_study(study, tmp_path, counts)["error"].isna().all()
