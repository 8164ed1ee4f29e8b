"""What a check's plan names: stored patterns, and the recordings that a smoke check drives in."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from roadproof.datatypes import Weather
from roadproof.drives.folder import read_settings
from roadproof.errors import CheckError
from roadproof.io.files import check_name
from roadproof.io.tables import each_once
from roadproof.patterns import Pattern, load_pattern
from roadproof.plans import beside
from roadproof.scenarios import Scenario, find_scenario

LONGEST_STEM = 40
"""Episodes are named after their pattern, and names have at most 100 letters."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Stored:
    """A pattern of the plan's folder.

    Args:
        name: the pattern's name, which is its file's name without the ending.
        path: the pattern's file.
        pattern: the pattern that the file holds.
    """

    name: str
    path: Path
    pattern: Pattern


def stored_patterns(
    listed: str | None, folder: Path, scenarios: tuple[Scenario, ...], known: tuple[Scenario, ...]
) -> dict[str, tuple[Stored, ...]]:
    """The patterns of each scenario, by the scenario's name: those for all scenarios, then its own.

    Args:
        listed: the folder of patterns, as the plan names it; None for no patterns.
        folder: the plan's folder.
        scenarios: the scenarios that are driven.
        known: all scenarios that a folder of patterns may be named after.

    Raises:
        CheckError: the folder is missing, does not lie beside the plan or holds no pattern, a name is too long, or a
            scenario has two of one name.
        ScenarioError: a folder among the patterns is named after no scenario.
        PatternError: a file among the patterns is no pattern.
    """
    if listed is None:
        return {}
    place = beside(folder, listed, "patterns", "plan", CheckError)
    if not place.is_dir():
        raise CheckError(f"patterns {listed!r} is no folder; expected one with pattern files (*.json)")
    for each in sorted(place.iterdir()):
        if each.is_dir():
            find_scenario(each.name, known)
    for_all = _patterns_in(place)
    found = {each.name: for_all + _patterns_in(place / each.name) for each in scenarios}
    if not any(found.values()):
        raise CheckError(f"patterns {listed!r} holds none for these scenarios; put pattern files (*.json) there")
    for name, patterns in found.items():
        each_once([each.name for each in patterns], f"patterns of {name}", CheckError)
    return found


def _patterns_in(folder: Path) -> tuple[Stored, ...]:
    found: list[Stored] = []
    for path in sorted(folder.glob("*.json")):
        if len(check_name(path.stem, "pattern", CheckError)) > LONGEST_STEM:
            raise CheckError(f"pattern {path.stem!r} has a name of more than {LONGEST_STEM} letters; shorten it")
        found.append(Stored(name=path.stem, path=path, pattern=load_pattern(path)))
    return tuple(found)


def recordings_of(
    folder: Path,
    listed: tuple[str, ...],
    scenarios: tuple[Scenario, ...],
    weathers: tuple[Weather, ...],
    controller: str,
    scenario_file: Path | None,
) -> dict[tuple[str, Weather], Path]:
    """The run folder in which each scenario was recorded in each weather, by (scenario's name, weather).

    Args:
        folder: the plan's folder.
        listed: the folders with runs, as the plan names them.
        scenarios: the scenarios that are driven.
        weathers: the weathers that each scenario is driven in.
        controller: the controller's spec, for the advice where a recording is missing; so is the next.
        scenario_file: the file of these scenarios, where it is the user's own.

    Raises:
        CheckError: a recording is missing, not calibrated, or of another stretch of road, or a folder does not lie
            beside the plan.
        RecordingError: a recording is damaged.
    """
    found: dict[tuple[str, Weather], Path] = {}
    for place in (beside(folder, each, "recordings", "plan", CheckError) for each in listed):
        for scenario in scenarios:
            if not (run := place / scenario.name).is_dir():
                continue
            made = read_settings(run / "record")
            if (made.scenario.start, made.scenario.canvas) != (scenario.start, scenario.canvas):
                raise CheckError(f"{run} is a recording of another {scenario.name}; record it again")
            if not (run / "recordings").is_dir():
                raise CheckError(
                    f"{run} is not calibrated; do so with: {shlex.join(['roadproof', 'calibrate', str(run)])}"
                )
            found.setdefault((scenario.name, made.weather), run)
    for scenario in scenarios:
        for weather in weathers:
            if (scenario.name, weather) not in found:
                own = [] if scenario_file is None else ["--scenarios", str(scenario_file)]
                raise CheckError(_missing(folder, listed, scenario, weather, [*own, "--driver", controller]))
    return found


def _missing(folder: Path, listed: tuple[str, ...], scenario: Scenario, weather: Weather, given: list[str]) -> str:
    name, added = Path(listed[0] if listed else "recordings").as_posix(), ""
    if (folder / name / scenario.name).exists():
        # A run is of one weather, so that another has a folder of its own.
        name = f"{name}-{weather}"
        added = f"add {name!r} to recordings and "
    place = folder / name
    words = ["record", scenario.name, "--weather", weather, *given, "--out", str(place)]
    made = [shlex.join(["roadproof", *each]) for each in (words, ["calibrate", str(place / scenario.name)])]
    return f"no recording of {scenario.name} at {weather}; {added}make one with: {'; '.join(made)}"
