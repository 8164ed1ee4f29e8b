from __future__ import annotations

import json
import time

import pytest

from roadproof.errors import RoadproofError
from roadproof.io.identity import ANSWERS
from roadproof.pipeline.stage_costs import FILE, Ledger, StageCost, read_cost

STAGES = ("record", "attack")
ONE = {"seed": 1, "scenario": {"name": "left-03", "goal_m": (1.0, 2.0)}, ANSWERS: "0123"}


def test_a_stage_that_is_gone_on_with_adds_to_what_it_took_before(tmp_path):
    ledger = Ledger(tmp_path, ONE, STAGES)
    with pytest.raises(KeyboardInterrupt), ledger.stage("record"):
        time.sleep(0.02)
        raise KeyboardInterrupt
    again = Ledger(tmp_path, ONE, STAGES)
    before = again.cost["record"].seconds
    assert before >= 0.02
    with again.stage("record"):
        time.sleep(0.02)
        again.calls("record", 3)
    assert read_cost(tmp_path) == again.cost
    assert again.cost["record"].seconds >= before + 0.02
    assert again.cost["record"].simulator_calls == 3
    assert again.cost["attack"] == StageCost()


def test_time_is_noted_while_a_stage_lasts(tmp_path, monkeypatch):
    monkeypatch.setattr("roadproof.pipeline.stage_costs._EVERY_S", 0.01)
    ledger = Ledger(tmp_path, ONE, STAGES)
    with ledger.stage("attack"):
        time.sleep(0.02)
        ledger.step()
        # What a process that is killed here leaves behind.
        noted = read_cost(tmp_path)["attack"].seconds
    assert 0.02 <= noted < ledger.cost["attack"].seconds
    ledger.step()
    assert read_cost(tmp_path) == ledger.cost


def test_another_run_and_a_damaged_ledger_are_refused(tmp_path):
    Ledger(tmp_path, ONE, STAGES)
    with pytest.raises(
        RoadproofError, match="holds a run with seed 1, now it is 2; choose another folder, or remove it"
    ):
        Ledger(tmp_path, ONE | {"seed": 2}, STAGES)
    with pytest.raises(RoadproofError, match=r"with scenario\.goal_m \[1\.0, 2\.0\], now it is \[1\.0, 3\.0\]"):
        Ledger(tmp_path, ONE | {"scenario": {"name": "left-03", "goal_m": (1.0, 3.0)}}, STAGES)
    with pytest.raises(RoadproofError, match="a run of another controller, which answers otherwise"):
        Ledger(tmp_path, ONE | {ANSWERS: "4567"}, STAGES)
    path = tmp_path / FILE
    path.write_text(path.read_text().replace('"seconds": 0.0', '"seconds": "long"'))
    with pytest.raises(RoadproofError, match="damaged"):
        read_cost(tmp_path)
    assert read_cost(tmp_path / "elsewhere") == {}


def test_parts_that_nothing_was_made_with_yet_may_change(tmp_path):
    Ledger(tmp_path, ONE, STAGES)
    Ledger(tmp_path, ONE | {"seed": 2}, STAGES, unused=["seed"])
    Ledger(tmp_path, ONE | {"seed": 2}, STAGES)
    with pytest.raises(RoadproofError, match="holds a run with seed 2, now it is 1"):
        Ledger(tmp_path, ONE, STAGES)


@pytest.mark.parametrize(
    "said",
    [{"identity": json.dumps([{"name": "left-03"}, "Budget(select=1)", {"figures": 5}, 0, "pilotnet"])}, {}],
    ids=["identity as text", "nothing"],
)
def test_a_ledger_that_says_in_no_parts_whose_run_it_is_is_refused_in_one_line(tmp_path, said):
    content = {"format": "roadproof-run", "version": 1, "cost": {"record": {"seconds": 2.5, "simulator_calls": 5}}}
    (tmp_path / FILE).write_text(json.dumps(content | said))
    for ask in (lambda: Ledger(tmp_path, ONE, STAGES), lambda: read_cost(tmp_path)):
        with pytest.raises(RoadproofError, match=r"run\.json is incomplete .*`made_of`.*; remove it, the stages stay$"):
            ask()
