"""The study of what limits on paint cost: a limit is held against the search without any, of the same seed."""

import runpy
from pathlib import Path

import needs

needs.town()

STUDY = Path(__file__).parents[2] / "studies" / "plausible.py"


def test_a_limit_is_held_against_its_own_seed():
    study = runpy.run_path(str(STUDY))
    shared = {"controller": "pilotnet", "scenario": "left-03", "left_lane": 1.0, "area_m2": 4.0, "contrast": 0.5}
    without, limited = study["NO_LIMIT"], next(name for name in study["LIMITS"] if name != study["NO_LIMIT"])
    driven = {(0, without): 2.0, (0, limited): 1.5, (1, without): 1.0, (1, limited): 0.75}
    rows = [shared | {"seed": seed, "limit": name, "deviation_m": metres} for (seed, name), metres in driven.items()]
    costs = {line.split(" | ")[0].strip("| "): line.split(" | ")[3] for line in study["table"](rows).splitlines()[2:]}
    assert costs == {without: "+0.00", limited: "+0.38"}
