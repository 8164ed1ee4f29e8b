"""`roadproof study` as its users call it."""

from __future__ import annotations

import functools

import pytest

import needs
from command import answered
from roadproof.driving.evaluate import evaluate
from roadproof.errors import EpisodeError
from roadproof.study.folder import pandas, read_table
from street_plan import write_plan

PLAN = """
format = "roadproof-study"
version = 2
controller = "pilotnet"
scenario_file = "street.toml"
scenarios = ["street"]
figures = ["1-b"]
starts = { count = 1 }
method = [{ name = "chance", search = "random", calls = 1 }]
"""


@pytest.fixture
def study(invoke):
    return functools.partial(invoke, "study")


@pytest.fixture
def plan(tmp_path):
    return write_plan(tmp_path, PLAN)


@pytest.mark.slow
def test_a_study_is_run_summed_up_found_done_and_transferred(study, plan, tmp_path, monkeypatch):
    needs.town()
    for _ in range(2):
        code, printed = study("run", plan, "--quiet", "--out", tmp_path / "out")
        assert code == 0, printed.err + printed.out
        assert "chance" in printed.out
        assert "found with 2 simulator calls" in printed.out
        assert "FAILED" not in printed.out
        assert printed.err == ""
    own = read_table(tmp_path / "out")
    code, printed = study("run", plan, "--json", "--out", tmp_path / "out")
    assert code == 0, printed.err
    (row,) = answered(printed.out)["rows"]
    assert (row["method"], row["deviation_m"], row["error"]) == ("chance", own["deviation_m"].iloc[0], None)
    assert set(row) == set(own)
    for _ in range(2):
        code, printed = study("transfer", plan, "--controllers", "pilotnet, cil", "--out", tmp_path / "out")
        assert code == 0, printed.err
        assert "chance, found against pilotnet" in printed.out
    code, printed = study("transfer", plan, "--controllers", "pilotnet, cil", "--out", tmp_path / "out", "--json")
    assert [row["controller"] for row in answered(printed.out)["rows"]] == ["pilotnet", "cil"]
    other = pandas().read_parquet(tmp_path / "out" / "transfer.parquet")
    assert list(other["controller"]) == ["pilotnet", "cil"]
    assert set(other["found_on"]) == {"pilotnet"}
    assert other["deviation_m"].iloc[0] == own["deviation_m"].iloc[0]
    assert other["deviation_m"].iloc[1] != own["deviation_m"].iloc[0]
    # A clean and a painted drive each; the second call found them.
    assert len(list((tmp_path / "out" / "transfer").rglob("episodes/*.npz"))) == 4

    def misses(*args, driver_name, **options):
        if driver_name == "pilotnet":
            raise EpisodeError("without paint the car never comes near the canvas")
        return evaluate(*args, driver_name=driver_name, **options)

    monkeypatch.setattr("roadproof.study.transfer.evaluate", misses)
    failure = "pilotnet: street, K = 1-b, chance, seed 0: without paint the car never comes near the canvas"
    code, printed = study("transfer", plan, "--controllers", "pilotnet, cil", "--out", tmp_path / "out")
    assert code == 1
    assert f"FAILED {failure}" in printed.out
    code, printed = study("transfer", plan, "--controllers", "pilotnet, cil", "--out", tmp_path / "out", "--json")
    assert (code, answered(printed.out)["failures"]) == (1, [failure])
    # The others are kept.
    assert list(read_table(tmp_path / "out", "transfer.parquet")["controller"]) == ["cil"]
    code, printed = study("transfer", plan, "--controllers", "pilotnet", "--out", tmp_path / "out")
    assert code == 2
    assert f"roadproof: no pattern could be driven over; the first of 1: {failure}\n" in printed.err
    assert list(read_table(tmp_path / "out", "transfer.parquet")["controller"]) == ["cil"]
    monkeypatch.setattr("roadproof.study.transfer.evaluate", evaluate)
    assert study("transfer", plan, "--controllers", "pilotnet", "--out", tmp_path / "out")[0] == 0
    # Those of an earlier call stay.
    assert list(read_table(tmp_path / "out", "transfer.parquet")["controller"]) == ["cil", "pilotnet"]


def test_a_dry_run_counts_traffic_in_the_weathers_that_have_some(study, tmp_path, monkeypatch):
    monkeypatch.setattr("roadproof.pipeline.workload.frame_seconds", lambda *_, **__: 0.002)
    text = PLAN.replace("starts =", 'weathers = ["clear-noon", "rainy-noon"]\nstarts =')
    drives = []
    for more in ("", '[traffic]\nruns = 3\nweathers = "first"', "[traffic]\nruns = 3"):
        plan = write_plan(tmp_path, text + more)
        code, printed = study("run", plan, "--dry-run", "--json", "--out", tmp_path / "out")
        assert code == 0, printed.err
        drives.append(answered(printed.out)["drives"])
    alone = 2 + 2 * 2  # one pattern tried, beside the bare road; then each way of driving in two weathers
    assert drives == [alone, alone + 2 * 3, alone + 2 * 3 * 2]


def test_a_dry_run_counts_all_looks_of_a_variation(study, tmp_path, monkeypatch):
    monkeypatch.setattr("roadproof.pipeline.workload.frame_seconds", lambda *_, **__: 0.01)
    text = PLAN.replace('search = "random", calls = 1', 'search = "gradopt"')
    seconds = []
    for more in ("", "[variation]\ndraws = 4"):
        plan = write_plan(tmp_path, text + more)
        code, printed = study("run", plan, "--dry-run", "--json", "--out", tmp_path / "out")
        assert code == 0, printed.err
        seconds.append(answered(printed.out)["seconds"])
    assert seconds[1] > 2 * seconds[0]


def test_a_dry_run_counts_the_evaluation_of_a_search_in_recordings_once(study, tmp_path):
    text = PLAN.replace("count = 1", "count = 3").replace('figures = ["1-b"]', "figures = [1]")
    plan = write_plan(tmp_path, text.replace('search = "random", calls = 1', 'search = "gradopt"'))
    code, printed = study("run", plan, "--dry-run", "--json", "--out", tmp_path / "out")
    assert code == 0, printed.err
    assert answered(printed.out)["drives"] == 16 + 2 * 3  # studies/small.toml says what GradOpt makes
    plan.write_text(plan.read_text().replace("figures = [1]", "figures = [1, 2]"))
    code, printed = study("run", plan, "--dry-run", "--json", "--out", tmp_path / "out")
    assert answered(printed.out)["drives"] == 15 + 3 + 2 * (1 + 3), "the second job makes no drives that the first made"


def test_jobs_of_one_scenario_are_shared_out_among_workers(study, tmp_path):
    plan = write_plan(tmp_path, PLAN.replace('["1-b"]', "[1, 2, 3, 4]").replace("calls = 1", "calls = 100"))
    said = []
    for workers in (1, 4):
        code, printed = study("run", plan, "--workers", workers, "--dry-run", "--json", "--out", tmp_path / "out")
        assert code == 0, printed.err
        said.append(answered(printed.out)["seconds"])
    assert 0.2 < said[1] / said[0] < 0.35


@pytest.mark.parametrize("more", [(), ("--dry-run",)])
def test_workers_that_a_cluster_has_itself_are_refused_before_an_estimate_too(study, plan, tmp_path, more):
    code, printed = study("run", plan, "--workers", 2, "--cluster", "local", "--out", tmp_path / "out", *more)
    assert (code, printed.out) == (2, "")
    assert printed.err.startswith("roadproof: workers is 2, but a cluster has as many as it has cores")
    assert not (tmp_path / "out").exists()


BLIND = """
class Blind:
    input_size = None

    def steer(self, frames, speed_mps, command):
        return 0 * speed_mps

    def act(self, frame, speed_mps, command):
        raise RuntimeError("sees nothing")
"""


@pytest.mark.slow
def test_jobs_that_fail_are_a_line_each(study, plan, tmp_path, monkeypatch):
    needs.town()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "blind_one.py").write_text(BLIND)
    plan.write_text(PLAN.replace('"pilotnet"', '"blind_one:Blind"'))
    code, printed = study("run", plan, "--trust", "--out", tmp_path / "out")
    assert code == 1
    assert "FAILED street, K = 1-b, chance, seed 0: " in printed.out
    assert "sees nothing" in printed.out.split("FAILED")[1]
    code, printed = study("run", plan, "--trust", "--out", tmp_path / "out", "--json")
    assert code == 1
    assert "FAILED street" in printed.err
    assert "sees nothing" in answered(printed.out)["rows"][0]["error"]


def test_mistakes_are_one_clear_line(study, plan, tmp_path):
    unknown = tmp_path / "unknown.toml"
    unknown.write_text(PLAN.replace("calls", "cals"))
    nobody = tmp_path / "nobody.toml"
    nobody.write_text(PLAN.replace('"pilotnet"', '"own:nobody"'))
    for arguments, message in (
        (["run", tmp_path / "none.toml"], "cannot read"),
        (["run", unknown], "did you mean 'calls'"),
        (["run", nobody], "'own:nobody' runs what its author wrote; look at it, then give --trust"),
        (["run", nobody, "--trust"], "cannot import own:nobody"),
        (["run", plan, "--workers", 0], "workers is 0"),
        (["transfer", plan, "--controllers", "cil"], "no results of this study"),
        (["transfer", plan, "--controllers", ","], "no controller"),
    ):
        code, printed = study(*arguments, "--out", tmp_path / "out")
        assert code == 2
        assert message in printed.err
        assert printed.err.count("\n") == 1
