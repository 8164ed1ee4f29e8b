from __future__ import annotations

import time

import pytest

from roadproof.errors import RoadproofError
from roadproof.pipeline.stage_costs import FILE, Ledger, StageCost, read_cost

STAGES = ("record", "attack")


def test_a_stage_that_is_gone_on_with_adds_to_what_it_took_before(tmp_path):
    ledger = Ledger(tmp_path, "one", STAGES)
    with pytest.raises(KeyboardInterrupt), ledger.stage("record"):
        time.sleep(0.02)
        raise KeyboardInterrupt
    again = Ledger(tmp_path, "one", STAGES)
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
    ledger = Ledger(tmp_path, "one", STAGES)
    with ledger.stage("attack"):
        time.sleep(0.02)
        ledger.step()
        # What a process that is killed here leaves behind.
        noted = read_cost(tmp_path)["attack"].seconds
    assert 0.02 <= noted < ledger.cost["attack"].seconds
    ledger.step()
    assert read_cost(tmp_path) == ledger.cost


def test_another_run_and_a_damaged_ledger_are_refused(tmp_path):
    Ledger(tmp_path, "one", STAGES)
    with pytest.raises(RoadproofError, match="other settings"):
        Ledger(tmp_path, "two", STAGES)
    path = tmp_path / FILE
    path.write_text(path.read_text().replace('"seconds": 0.0', '"seconds": "long"'))
    with pytest.raises(RoadproofError, match="damaged"):
        read_cost(tmp_path)
    assert read_cost(tmp_path / "elsewhere") == {}
