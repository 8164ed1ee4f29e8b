"""A share of what `benchmarks/faults.py --part inputs` tries: each is refused with exit code 2 and one line."""

import subprocess
import sys
from itertools import islice
from pathlib import Path

import pytest

import needs
from bad_inputs import attempt, command_lines, damaged_files
from command import PROGRAM, roadproof

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


def test_what_a_message_quotes_is_shown_as_it_is_whatever_the_terminal_knows(tmp_path):
    seen = roadproof("scenarios", "--scenarios", "a:x:b.toml", folder=tmp_path)
    assert (seen.returncode, seen.stdout) == (2, "")
    assert "cannot read a:x:b.toml" in seen.stderr
    plain = roadproof("scenarios", before="import sys; sys.stdout.reconfigure(encoding='ascii')", folder=tmp_path)
    assert plain.returncode == 0, plain.stderr
    assert "left-03" in plain.stdout


def test_a_full_device_is_named(tmp_path):
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    with full.open("w") as out:
        command = [sys.executable, "-c", PROGRAM, "scenarios"]
        told = subprocess.run(command, stdout=out, stderr=subprocess.PIPE, text=True, check=False, cwd=tmp_path)
    assert told.returncode == 2
    assert told.stderr == "roadproof: the output: No space left on device; check the path\n"


def test_links_in_a_run_folder_lead_nowhere(tmp_path):
    needs.town()
    other = tmp_path / "other"
    other.mkdir()
    (tmp_path / "out" / "left-03").mkdir(parents=True)
    (tmp_path / "out" / "left-03" / "record").symlink_to(other)
    told = roadproof("record", "left-03", "--trajectories", 1, "--frames", 2, "--out", "out", folder=tmp_path)
    assert told.returncode == 2
    assert "reached by a link that leads out of" in told.stderr
    assert not list(other.iterdir())
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "attack").symlink_to(other)
    told = roadproof("report", "run", folder=tmp_path)
    assert told.returncode == 2
    assert "attack is a link that leads out of run" in told.stderr
