"""`--json`: one document on standard output, and nothing else there; the verbs' own tests hold it to their files."""

import json
import math
import textwrap
from importlib import import_module

import numpy as np
import pytest
from typer.main import get_command

import needs
from bad_inputs import GATES, NOWHERE
from command import answered
from roadproof.cli import app
from roadproof.cli.output import answer, in_json, say, stored
from roadproof.hardening.result import Hardened, Round

NOISY = textwrap.dedent(
    """
    print("imported")

    class Noisy:
        input_size = (88, 200)

        def steer(self, frames, speed_mps, command):
            print("asked")
            return frames.mean((1, 2, 3))

        def act(self, frame, speed_mps, command):
            raise RuntimeError("cannot")
    """
)
SILENT = {"train", "open", "convert-cil", "carla serve", "carla scenario", "study tables"}
"""The verbs that print no results but where they are."""


def verbs():
    """The words of every verb, with whether it takes --json."""

    def of(group, words):
        for name, each in group.commands.items():
            if hasattr(each, "commands"):
                yield from of(each, (*words, name))
            else:
                yield (*words, name), "json" in {option.name for option in each.params}

    return dict(of(get_command(app), ()))


def test_every_verb_that_prints_results_takes_it():
    assert {" ".join(words) for words, takes in verbs().items() if not takes} == SILENT


@pytest.mark.parametrize("words", [words for words, takes in verbs().items() if takes], ids=" ".join)
def test_bad_input_leaves_standard_output_empty(invoke, words, tmp_path, monkeypatch):
    needs.town()
    monkeypatch.chdir(tmp_path)
    code, printed = invoke(*words, *GATES.get(words, ("--out", NOWHERE)), "--json")
    assert (code, printed.out) == (2, "")
    assert printed.err.startswith("roadproof: ")


def test_what_a_users_code_prints_is_on_standard_error(invoke, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own_noisy.py").write_text(NOISY)
    code, printed = invoke("check-controller", "own_noisy:Noisy", "--json")
    assert code == 1
    assert printed.err.startswith("imported\nasked\n")
    assert "BAD drives" in printed.err
    told = answered(printed.out)
    assert (told["controller"], told["passed"], told["drives"]) == ("own_noisy:Noisy", False, None)
    assert [each["name"] for each in told["checks"] if not each["passed"]] == ["drives"]


def test_quiet_leaves_nothing_but_the_document(invoke):
    code, printed = invoke("check-controller", "cil", "--no-drive", "--json", "--quiet")
    assert (code, printed.err) == (0, "")
    assert answered(printed.out)["passed"] is True


def test_a_dry_run_answers_what_it_would_take(invoke, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, printed = invoke("demo", "--dry-run", "--json")
    assert code == 0
    told = answered(printed.out)
    assert (set(told), told["drives"]) == ({"drives", "seconds", "megabytes", "basis"}, 32)
    assert printed.err.startswith("32 drives, about ")


def test_a_dry_run_counts_the_search_for_less_paint_and_the_drive_over_it(invoke, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("roadproof.pipeline.workload.frame_seconds", lambda *_, **__: 0.002)
    usual, less = (
        answered(invoke("demo", "--dry-run", "--json", *more)[1].out) for more in ((), ("--cheapest", "0.8"))
    )
    assert less["drives"] == usual["drives"] + 1
    assert less["seconds"] > 1.2 * usual["seconds"]


def test_what_is_no_number_is_null_and_every_terminal_can_show_the_rest(capsys):
    with in_json():
        say("in words")
        answer({"x_m": math.nan, "y_m": np.array([1.5, np.inf]), "count": np.int64(3), "name": "Straße"})
    printed = capsys.readouterr()
    assert printed.out.isascii()
    assert answered(printed.out) == {"x_m": None, "y_m": [1.5, None], "count": 3, "name": "Straße"}
    assert printed.err == "in words\n"
    answer({"nobody": "asked"})
    say("in words")
    assert capsys.readouterr().out == "in words\n"


def test_shipped_controllers_are_objects(invoke):
    code, printed = invoke("controllers", "--json")
    assert (code, printed.err) == (0, "")
    listed = answered(printed.out)["controllers"]
    code, printed = invoke("controllers", "cil", "--json")
    assert answered(printed.out)["controllers"] == [each for each in listed if each["name"] == "cil"]
    assert {"summary", "cannot", "megabytes"} <= set(listed[0])


def test_a_hardening_is_answered_as_its_file_has_it(invoke, tmp_path, monkeypatch):
    needs.town()

    def hardened(world, controller, training, out, **how):
        (out / "hardening.json").write_text(json.dumps({"format": "roadproof-hardening", "best": how["rounds"]}))
        done = (Round(0, {"left-07": 1.0}, 1.0),)
        return Hardened(controller=controller, hardened=f"{out}/hardened", rounds=done, best=1, judgement=None, cost={})

    for room, name, made_up in (("harden", "harden", hardened), ("page", "write_hardening", lambda _, out: out)):
        monkeypatch.setattr(import_module(f"roadproof.hardening.{room}"), name, made_up)
    words = ["harden", "pilotnet", "--train-on", "left-07", "--rounds", 1, "--device", "cpu"]
    code, printed = invoke(*words, "--out", tmp_path, "--json")
    assert code == 0, printed.err
    assert answered(printed.out) == stored(tmp_path / "hardening.json")
    assert "1.00 m on the streets trained on" in printed.err
