"""A run folder from anyone: whatever was changed in it, opening it ends well or in one line."""

from __future__ import annotations

import pytest

import needs
from mutations import DOORS, REPORT, open_changed
from runs import write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    needs.town()
    folder = tmp_path_factory.mktemp("mutations") / "run"
    write_run(folder)
    return folder


@pytest.mark.parametrize(("doors", "count"), [(DOORS, 150), (REPORT, 40)])
def test_a_changed_run_is_opened_or_refused_in_one_line(run, doors, count):
    counted, wrong = open_changed(run, doors, count, seed=count)
    assert wrong == []
    assert counted["refused"] > count / 8
    assert counted["opened"] > count / 8
