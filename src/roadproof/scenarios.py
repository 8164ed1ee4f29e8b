"""Scenarios: where a drive starts, where it leads, where the canvas lies. 40 are built in.

A list of scenarios is a TOML file; the built-in one is read the same way. Whether start, goal and canvas lie on the
road is for the simulator that knows the map to say.
"""

from __future__ import annotations

import difflib
import json
import math
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

from roadproof.datatypes import VehicleState
from roadproof.errors import ScenarioError
from roadproof.geometry import CanvasPlacement
from roadproof.io.files import AnyPath, as_path, check_name, inside, is_plain_name, write_atomically, write_text
from roadproof.io.identity import digest
from roadproof.io.tables import build, first_twice
from roadproof.io.text import read_toml

Kind = Literal["straight", "left", "right"]
KINDS: tuple[Kind, ...] = get_args(Kind)

MAP = ".xodr"
"""How the name of a map ends that is a file: one in OpenDRIVE."""
BUILTIN_FILE = Path(__file__).with_name("scenarios.toml")
MAX_TIME_S, MAX_SPEED_MPS, MAX_CANVAS_M = 3600.0, 100.0, 100.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Scenario:
    """One stretch of road to be driven.

    Args:
        name: name for people and folders, for instance "left-03".
        kind: whether the route keeps straight or veers to a side, in a bend or at a junction.
        map_name: a map the simulator knows by name ("town"), or the path of an OpenDRIVE file.
        start: pose of the car and its speed when the drive begins.
        goal_m: world (x, y) at which the route ends, metres.
        canvas: the stretch of road that can be painted.
        time_limit_s: time after which the drive ends, seconds.

    Raises:
        ScenarioError: the name cannot name a folder, or a value is missing, not finite or out of range.
    """

    name: str
    kind: Kind
    map_name: str
    start: VehicleState
    goal_m: tuple[float, float]
    canvas: CanvasPlacement
    time_limit_s: float

    def __post_init__(self) -> None:
        check_name(self.name, "scenario", ScenarioError)
        numbers = {"goal x": self.goal_m[0], "goal y": self.goal_m[1], "time_limit_s": self.time_limit_s}
        numbers |= {f"start {key}": value for key, value in asdict(self.start).items()}
        for what, value in numbers.items():
            if not abs(value) < 1e9:
                raise ScenarioError(f"scenario {self.name}: {what} is {value}, expected a finite number below 1e9")
        if not 0 < self.time_limit_s <= MAX_TIME_S:
            raise ScenarioError(
                f"scenario {self.name}: time_limit_s is {self.time_limit_s}, expected more than 0, at most "
                f"{MAX_TIME_S:g}"
            )
        if not 0 <= self.start.speed_mps <= MAX_SPEED_MPS:
            raise ScenarioError(
                f"scenario {self.name}: start speed_mps is {self.start.speed_mps:g}, expected 0 to {MAX_SPEED_MPS:g}"
            )
        if max(self.canvas.width_m, self.canvas.length_m) > MAX_CANVAS_M:
            raise ScenarioError(
                f"scenario {self.name}: canvas is {self.canvas.width_m:g} × {self.canvas.length_m:g} m, expected "
                f"at most {MAX_CANVAS_M:g} m"
            )
        if math.dist(self.goal_m, (self.start.x_m, self.start.y_m)) < 1.0:
            raise ScenarioError(f"scenario {self.name}: the goal is less than 1 m from the start; move it")


def identity(scenario: Scenario) -> dict[str, Any]:
    """What identifies a scenario, wherever its map lies, for JSON.

    Raises:
        OSError: the file of the map cannot be read.
    """
    file = Path(scenario.map_name)
    content = digest(file.read_bytes()) if file.suffix == MAP and file.is_file() else ""
    return asdict(scenario) | {"map_name": file.name, "map": content}


def with_map_in(folder: Path, scenario: Scenario) -> Scenario:
    """A scenario whose map lies in a folder: where it is a file, that is copied there.

    Raises:
        OutputError: the copy cannot be written.
    """
    source = Path(scenario.map_name)
    if source.suffix != MAP or source.resolve().parent == folder.resolve():
        return scenario
    # Names in files are plain ones; a user's map may have any.
    own = folder / (source.name if is_plain_name(source.name) else "map.xodr")
    write_atomically(own, lambda part: shutil.copyfile(source, part))
    return replace(scenario, map_name=str(own))


def builtin_scenarios() -> tuple[Scenario, ...]:
    """The 40 built-in scenarios: 16 straight, 12 left, 12 right."""
    return load_scenarios(BUILTIN_FILE)


def find_scenario(name: str, scenarios: Sequence[Scenario] | None = None) -> Scenario:
    """The scenario with a given name.

    Args:
        name: name of the scenario, such as "left-03".
        scenarios: scenarios to search; the built-in ones by default.

    Raises:
        ScenarioError: no scenario has this name; the message names the nearest.
    """
    scenarios = builtin_scenarios() if scenarios is None else scenarios
    for scenario in scenarios:
        if scenario.name == name:
            return scenario
    names = [scenario.name for scenario in scenarios]
    nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.0)
    hint = f"did you mean {nearest[0]!r}?" if nearest else "the list is empty"
    raise ScenarioError(f"no scenario is called {name!r}; {hint}")


def load_scenarios(path: AnyPath) -> tuple[Scenario, ...]:
    """Read scenarios from a TOML file.

    A `map_name` that ends in ".xodr" is the name of an OpenDRIVE file in the folder of the TOML file.

    Raises:
        ScenarioError: the file cannot be read, or an entry is not a valid scenario; the message names it.
    """
    path = as_path(path)
    told = read_toml(path, ScenarioError)
    entries = told.pop("scenario", None)
    if told:
        raise ScenarioError(f"scenarios {path} has an unknown key {next(iter(told))!r}, expected [[scenario]] alone")
    if not isinstance(entries, list) or not entries:
        raise ScenarioError(f"scenarios {path} has no [[scenario]], expected at least one")
    scenarios = [
        _scenario(entry, f"scenarios {path}, entry {k + 1}", path.parent)
        for k, entry in enumerate(cast("list[object]", entries))
    ]
    if (name := first_twice(scenario.name for scenario in scenarios)) is not None:
        raise ScenarioError(f"scenarios {path}: the name {name!r} is used twice; names must differ")
    return tuple(scenarios)


def save_scenarios(scenarios: Sequence[Scenario], path: AnyPath) -> None:
    """Write scenarios as TOML, under a temporary name first.

    Raises:
        OutputError: the file cannot be written.
        ScenarioError: a scenario's map is an OpenDRIVE file in another folder.
    """
    path = as_path(path)
    blocks = [_block(scenario, path.parent) for scenario in scenarios]
    write_text(path, "\n".join(blocks))


def _block(scenario: Scenario, folder: Path) -> str:
    map_name = scenario.map_name
    if map_name.endswith(MAP):
        if Path(map_name).resolve().parent != folder.resolve():
            raise ScenarioError(f"scenario {scenario.name}: its map {map_name} is not in {folder}; copy it there first")
        map_name = Path(map_name).name
    lines = ["[[scenario]]"]
    lines += [f"{key} = {_string(value)}" for key, value in (("name", scenario.name), ("kind", scenario.kind))]
    lines += [f"map_name = {_string(map_name)}", f"start = {_table(asdict(scenario.start))}"]
    lines += [f"goal_m = [{float(scenario.goal_m[0])!r}, {float(scenario.goal_m[1])!r}]"]
    lines += [f"canvas = {_table(asdict(scenario.canvas))}", f"time_limit_s = {float(scenario.time_limit_s)!r}"]
    return "\n".join(lines) + "\n"


def _string(text: str) -> str:
    """A string of TOML: as JSON has it, but for the control character that JSON leaves as it is."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")


def _table(values: Mapping[str, float]) -> str:
    return "{ " + ", ".join(f"{key} = {float(value)!r}" for key, value in values.items()) + " }"


def _scenario(entry: object, what: str, folder: Path) -> Scenario:
    if not isinstance(entry, dict):
        raise ScenarioError(f"{what} is {entry!r:.60}, expected a table")
    values = cast("dict[str, Any]", entry)  # TOML's keys are strings
    name = values.get("map_name")
    if isinstance(name, str) and name.endswith(MAP):
        values = values | {"map_name": str(inside(folder, name, f"{what}: map_name", ScenarioError))}
    return build(Scenario, values, what, ScenarioError)
