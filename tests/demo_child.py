"""`roadproof demo` with a tiny budget on a short drive, in a process that can be killed."""

import contextlib
import os
import sys

from paint_shy import along_a_street
from roadproof.attacks import GradOpt, SteeringShift, methods
from roadproof.attacks.gradopt import Rung
from roadproof.cli import main
from roadproof.datatypes import Weather
from roadproof.drives import Swerve, Trajectories, Window
from roadproof.pipeline.budget import BUDGETS, Budget
from roadproof.scenarios import save_scenarios

TINY = Budget(
    objective=SteeringShift(),
    method=GradOpt(iterations=12, restarts=2),
    trajectories=Trajectories(perturbation=Swerve((0.5,))),
    window=Window(frames=4),
    select=2,
    weathers=(Weather.CLEAR_NOON,),
    starts=0,
    runs=0,
)


def demo(folder, log):
    """The command, for one folder; what it prints goes to a file."""
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    BUDGETS["quick"] = TINY
    methods.SHIFT_RUNGS = (Rung(3, 12, every=2),)
    given = folder.with_suffix(".given")
    given.mkdir(exist_ok=True)
    save_scenarios([along_a_street(given, 3.2)], given / "scenarios.toml")
    options = ["--scenarios", given / "scenarios.toml", "--scenario", "street", "--controller", "pilotnet"]
    sys.argv = ["roadproof", "demo", *map(str, options), "--rounds", "1", "--figures", "1", "--out", str(folder)]
    with contextlib.suppress(SystemExit):
        main()
