"""The examples, run as they are."""

from __future__ import annotations

import dataclasses
import functools
import runpy
import sys
from pathlib import Path

import pytest

import needs
import roadproof
from roadproof.attacks import GradOpt
from roadproof.controllers import check_controller
from roadproof.datatypes import Weather
from roadproof.drives import Swerve, Trajectories, Window
from roadproof.driving.evaluation import Evaluation
from roadproof.pipeline.budget import QUICK
from roadproof.pipeline.stress_test import stress_test

EXAMPLES = Path(__file__).parents[2] / "examples"


def run(name, *arguments, monkeypatch):
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    return runpy.run_path(str(EXAMPLES / name), run_name="__main__")


@pytest.mark.slow
def test_a_controller_of_ones_own_is_stress_tested(few_pictures, tmp_path, monkeypatch, capsys):
    needs.town()
    # The example's own stretch from 17 m before the canvas to 8 m behind it, and its own search, less of it.
    whole = roadproof.find_scenario("straight-04")
    start = dataclasses.replace(whole.start, x_m=whole.canvas.x_m + 17.0, speed_mps=6.0)
    stretch = dataclasses.replace(whole, start=start, goal_m=(whole.canvas.x_m - 8.0, whole.goal_m[1]))
    monkeypatch.setattr("roadproof.find_scenario", {"straight-04": stretch}.__getitem__)
    tiny = dataclasses.replace(
        QUICK,
        method=GradOpt(iterations=2, restarts=1, halving=False),
        trajectories=Trajectories(perturbation=Swerve((1.5,))),
        window=Window(frames=10, least_px=8),
        select=1,
        weathers=(Weather.CLEAR_NOON,),
        starts=0,
    )
    less = functools.partial(stress_test, budget=tiny)
    monkeypatch.setattr("roadproof.pipeline.stress_test.stress_test", less)
    names = run("own_controller.py", tmp_path, monkeypatch=monkeypatch)
    check_controller(names["LineFollower"]()).require()
    (trial,) = Evaluation.load(tmp_path / "evaluation").trials
    assert trial.clean_points == 0, "it drives where nothing is painted"
    assert trial.ending == "goal reached" or trial.points > 0
    assert f"clear-noon: {trial.deviation_m:.2f} m" in capsys.readouterr().out
    assert (tmp_path / "report.html").exists()
