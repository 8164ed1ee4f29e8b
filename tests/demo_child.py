"""`roadproof demo` with a tiny budget on a short drive, in a process that can be killed."""

import contextlib
import os
import sys

from paint_shy import along_a_street
from roadproof.attacks import Heat, Schedule, SteeringShift
from roadproof.cli import main
from roadproof.datatypes import Weather
from roadproof.loop import BUDGETS, Budget
from roadproof.scenarios import save_scenarios

TINY = Budget(
    objective=SteeringShift(),
    deviations_m=(0.5,),
    frames=4,
    schedule=Schedule(iterations=12, drops=(), heats=(Heat(starts=3, iterations=12, every=2),)),
    restarts=2,
    select=2,
    weathers=(Weather.CLEAR_NOON,),
    runs=0,
)


def demo(folder, log):
    """The command, for one folder; what it prints goes to a file."""
    with log.open("a") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    BUDGETS["quick"] = TINY
    given = folder.with_suffix(".given")
    given.mkdir(exist_ok=True)
    save_scenarios([along_a_street(given, 3.2)], given / "scenarios.toml")
    options = ["--scenarios", given / "scenarios.toml", "--scenario", "street", "--controller", "pilotnet"]
    sys.argv = ["roadproof", "demo", *map(str, options), "--rounds", "1", "--figures", "1", "--out", str(folder)]
    with contextlib.suppress(SystemExit):
        main()
