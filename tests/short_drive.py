"""A scenario that is driven in a second: from a running start just before the canvas to just behind it."""

from __future__ import annotations

import dataclasses

from roadproof.scenarios import find_scenario, save_scenarios

_WHOLE = find_scenario("straight-01")
SHORT = dataclasses.replace(
    _WHOLE, name="short", start=dataclasses.replace(_WHOLE.start, x_m=40.0, speed_mps=8.0), time_limit_s=4.0
)


def write_plan(folder, text):
    """A study's plan, with the scenario beside it."""
    save_scenarios([SHORT], folder / "short.toml")
    path = folder / "plan.toml"
    path.write_text(text)
    return path
