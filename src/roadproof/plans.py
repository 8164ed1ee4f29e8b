"""What the plans of studies and checks have in common: their head, the scenarios they name, and whom they may trust."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from roadproof.controllers.loading import runs_code
from roadproof.errors import RoadproofError
from roadproof.scenarios import Scenario, find_scenario
from roadproof.simulators.loading import is_elsewhere


def take_head(
    content: dict[str, Any], file_format: str, version: int, error: type[RoadproofError], *, advice: str = ""
) -> None:
    """Take format and version out of a plan.

    Args:
        content: the plan as TOML has it.
        file_format: the "format" that the plan must name.
        version: the "version" that it must be of.
        error: the type of error to raise.
        advice: what follows in the message where the version is another.

    Raises:
        error: the plan is of another format or version.
    """
    if content.pop("format", None) != file_format:
        raise error(f'expected format = "{file_format}"')
    known = content.pop("version", None)
    if type(known) is not int or known != version:
        raise error(f"version is {known!r:.40}, expected {version}{advice}")


def beside(folder: Path, listed: str, what: str, plan: str, error: type[RoadproofError]) -> Path:
    """The path of a file or folder that a plan names.

    Args:
        folder: the plan's folder.
        listed: the file or folder, as the plan names it.
        what: the key that names it, for the message.
        plan: what the plan is called in the message, such as "study".
        error: the type of error to raise.

    Raises:
        error: the file lies outside the folder.
    """
    path = folder / listed
    if not path.resolve().is_relative_to(folder.resolve()):
        raise error(f"{what} {listed!r} leaves the {plan}'s folder; put it beside the {plan}")
    return path


def chosen_scenarios(patterns: Iterable[str], known: tuple[Scenario, ...]) -> tuple[Scenario, ...]:
    """Scenarios by name or pattern of names, each once, in the order first named.

    Raises:
        ScenarioError: no scenario has such a name; the message names the nearest.
    """
    chosen: dict[str, Scenario] = {}
    for pattern in patterns:
        found = [each for each in known if fnmatch.fnmatchcase(each.name, pattern)]
        chosen |= {each.name: each for each in found or [find_scenario(pattern, known)]}
    return tuple(chosen.values())


def refuse_untrusted(controller: str, simulator: str | None, error: type[RoadproofError]) -> None:
    """See that following a plan of anyone's runs none of their code and calls no other machine.

    Args:
        controller: the spec of the controller that the plan names.
        simulator: the spec of its simulator; None where it opens none.
        error: the type of error to raise.

    Raises:
        error: the plan would run code or call another machine; the message says which, and how to allow that.
    """
    if runs_code(controller):
        raise error(f"controller {controller!r} runs what its author wrote; look at it, then give --trust (trust=True)")
    if simulator is not None and is_elsewhere(simulator):
        raise error(f"simulator {simulator!r} is another machine; give --trust (trust=True) to call it")
