"""The study of hardening: however often it says how far it is, each stage is one line, and its results are one file."""

import runpy
import sys
from pathlib import Path

import needs
from runs import hardened

needs.town()

STUDY = Path(__file__).parents[2] / "studies" / "harden.py"


def test_the_study_says_each_stage_once_and_writes_its_results_where_asked(tmp_path, monkeypatch, capfd):
    found = hardened()

    def harden(*_, on_progress, **__):
        for done in range(40):
            on_progress("Round 1: learning", done + 1, 40, "loss 0.1")
        found.save(tmp_path)
        return found

    monkeypatch.setattr("roadproof.hardening.harden", harden)
    monkeypatch.setattr("roadproof.hardening.write_hardening", lambda *_: None)
    written = tmp_path / "new" / "rows.json"
    monkeypatch.setattr(sys, "argv", [str(STUDY), "--json", str(written), "--keep", str(tmp_path)])
    runpy.run_path(str(STUDY), run_name="__main__")
    said = capfd.readouterr()
    assert (said.out + said.err).count("Round 1: learning") == 1
    assert found.judgement.verdict().sentence in said.out
    assert written.read_text() == (tmp_path / "hardening.json").read_text()
