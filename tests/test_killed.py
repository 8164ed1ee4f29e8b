"""A run that is killed in every stage, without warning, ends as one that is not."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import needs
from killable import EXPECTED, REFUSED, differences, kill_and_resume, starter
from roadproof.attacks import AttackResult
from roadproof.driving.evaluation import Evaluation
from roadproof.pipeline.selection import Selection
from roadproof.pipeline.stage_costs import read_cost
from roadproof.report.run import read_run

needs.town()
pytest.importorskip("av", reason="av is not installed")

FIRST_STEP = {
    "record": ("record/clean", "record/left"),
    "calibrate": ("calibration/*-light.npz", "recordings"),
    "attack": ("attack/search.safetensors", "attack/result.json"),
    "select": ("selection/episodes/*.npz", "selection/selection.json"),
    "rounds": ("round-1/attack/search.safetensors", "round-1/selection/selection.json"),
    "evaluate": ("evaluation/episodes/*.npz", "evaluation/evaluation.json"),
    "report": ("evaluation/evaluation.json", "report.html"),
}
"""What shows that a stage has done its first step, and what it leaves when it is done."""
PATIENCE_S = 600.0


@pytest.fixture(scope="module")
def start():
    return starter()


def finished(folder):
    """Drives, replays and episodes that are whole: each is moved into place when it is."""
    parts = {".npz"}
    return {
        path: (path.stat().st_ino, path.stat().st_mtime_ns)
        for path in folder.rglob("*")
        if path.suffix in parts and not any(name.startswith(".") for name in path.relative_to(folder).parts)
    }


def kill_at_first_step(process, folder, stage):
    sign, last = FIRST_STEP[stage]
    until = time.monotonic() + PATIENCE_S
    while not any(folder.glob(sign)):
        assert process.is_alive(), f"ended before {stage}: {folder.with_suffix('.log').read_text()}"
        assert time.monotonic() < until, f"{stage} does not begin"
        time.sleep(0.002)
    process.kill()
    process.join()
    assert not (folder / last).exists(), f"killed after {stage}, not in it"


@pytest.mark.slow
def test_a_run_killed_in_every_stage_ends_as_one_that_is_not(start, tmp_path):
    straight, killed = tmp_path / "straight", tmp_path / "killed"
    whole = start("demo", straight)
    before = {}
    for stage in FIRST_STEP:
        process = start("demo", killed)
        kill_at_first_step(process, killed, stage)
        now = finished(killed)
        assert before.items() <= now.items(), f"something was done twice before {stage}"
        before = now
    process = start("demo", killed)
    for each in (process, whole):
        each.join(PATIENCE_S)
        assert each.exitcode == 0
    assert (straight / "report.html").exists(), straight.with_suffix(".log").read_text()
    assert (killed / "report.html").exists(), killed.with_suffix(".log").read_text()
    assert before.items() <= finished(killed).items(), "something was done twice"
    check_same(straight, killed)


def check_same(one, two):
    assert {path.relative_to(one) for path in finished(one)} == {path.relative_to(two) for path in finished(two)}
    for place in ("attack", "round-1/attack"):
        results = [AttackResult.load(folder / place) for folder in (one, two)]
        np.testing.assert_array_equal(results[0].history, results[1].history)
        assert results[0].by_group == results[1].by_group
    for place in ("selection", "round-1/selection"):
        assert Selection.load(one / place).driven == Selection.load(two / place).driven
    assert (one / "pattern.json").read_bytes() == (two / "pattern.json").read_bytes()
    assert Evaluation.load(one / "evaluation").trials == Evaluation.load(two / "evaluation").trials
    costs = [read_cost(folder) for folder in (one, two)]
    assert {k: c.simulator_calls for k, c in costs[0].items()} == {k: c.simulator_calls for k, c in costs[1].items()}
    assert all((cost.seconds > 0) == (stage not in ("cheapest", "limits")) for stage, cost in costs[1].items())
    # Every file of the run can be read; what a killed process left half written is not among them.
    assert read_run(two).judged is not None
    numbers = [json.loads((folder / "result.json").read_text()) for folder in (one, two)]
    for content in numbers:
        content.pop("cost")
        content.pop("calibration")
        content.pop("name")
    assert numbers[0] == numbers[1]


@pytest.mark.slow
def test_what_is_killed_at_any_time_ends_as_what_is_not(start, tmp_path):
    name, straight = "attack", tmp_path / "straight"
    began = time.monotonic()
    process = start(name, straight)
    process.join(PATIENCE_S)
    assert process.exitcode == EXPECTED[name], straight.with_suffix(".log").read_text()
    whole_s = time.monotonic() - began
    rng = random.Random(name)
    assert [kill_and_resume(start, name, straight, whole_s, rng) for _ in range(2)] == ["", ""]


@pytest.mark.slow
def test_a_study_names_a_damaged_file_and_goes_on_without_it(start, tmp_path):
    """Its other jobs are done all the same, so it ends as with a failed job, not as one that is refused."""
    straight, damaged = tmp_path / "straight", tmp_path / "damaged"
    whole = start("study", straight)
    until = time.monotonic() + PATIENCE_S
    while not list(straight.glob("work/*/evaluation/episodes/[!.]*.npz")):
        assert whole.is_alive(), straight.with_suffix(".log").read_text()
        assert time.monotonic() < until, "no job drives"
        time.sleep(0.002)
    # As it is now, on a disk: what is written under another name first is not there yet.
    shutil.copytree(straight, damaged, ignore=shutil.ignore_patterns(".*"))
    whole.join(PATIENCE_S)
    assert whole.exitcode == 0, straight.with_suffix(".log").read_text()
    lost = min(damaged.glob("work/*/evaluation/episodes/*.npz"))
    os.truncate(lost, lost.stat().st_size // 2)
    log = damaged.with_suffix(".log")
    for expected in (REFUSED["study"], EXPECTED["study"]):
        process = start("study", damaged)
        process.join(PATIENCE_S)
        assert process.exitcode == expected, log.read_text()
        if expected == REFUSED["study"]:
            assert lost.name in log.read_text()
            assert "remove a file first that is called damaged" in log.read_text()
            lost.unlink()
    assert differences(straight, damaged) == []


@pytest.mark.slow
@pytest.mark.parametrize("of_all", [False, True], ids=["the command", "its group"])
@pytest.mark.parametrize("after_s", [0.0, 1.0, 3.0])
def test_ctrl_c_ends_a_run_with_processes_in_a_line(tmp_path, of_all, after_s):
    """At any time, also while the processes are still beginning, whether or not they get the signal too."""
    asked = [sys.executable, "-m", "roadproof", "demo", "--processes", "2", "--out", str(tmp_path / "demo")]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with subprocess.Popen(asked, **pipes, text=True, start_new_session=True) as run:
        until = time.monotonic() + PATIENCE_S
        while len(Path(f"/proc/{run.pid}/task/{run.pid}/children").read_text().split()) < 3:  # with what tracks them
            assert run.poll() is None
            assert time.monotonic() < until
            time.sleep(0.002)
        time.sleep(after_s)
        (os.killpg if of_all else os.kill)(run.pid, signal.SIGINT)
        _, said = run.communicate(timeout=PATIENCE_S)
    assert run.returncode == 130
    assert said.splitlines()[-1] == "roadproof: interrupted; give the same command again to go on"
    assert "Traceback" not in said
    assert "leaked" not in said
