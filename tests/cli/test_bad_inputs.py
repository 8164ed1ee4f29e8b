"""A share of what `benchmarks/faults.py --part inputs` tries: each is refused with exit code 2 and one line."""

from itertools import islice

import needs
from bad_inputs import attempt, command_lines, damaged_files

EVERY = 15


def test_odd_values_of_every_option_are_refused(tmp_path, monkeypatch):
    needs.town()
    monkeypatch.chdir(tmp_path)
    wrong = {bad.words: happened for bad in islice(command_lines(), 7, None, EVERY) if (happened := attempt(bad))}
    assert wrong == {}
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_damaged_plans_scenarios_patterns_recordings_and_weights_are_refused(tmp_path):
    happened = [attempt(bad) for bad in damaged_files(tmp_path, 36, seed=3)]
    assert set(happened) <= {"", "taken"}
    assert happened.count("") > 18
