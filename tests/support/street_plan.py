"""A study of one scenario that is driven in a second."""

from __future__ import annotations

from paint_shy import along_a_street
from roadproof.scenarios import save_scenarios


def write_plan(folder, text):
    """A study's plan, with the scenario "street" beside it."""
    save_scenarios([along_a_street(folder)], folder / "street.toml")
    path = folder / "plan.toml"
    path.write_text(text)
    return path
