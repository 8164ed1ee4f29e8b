"""Scenarios: where a drive starts, where it leads, where the canvas lies. 40 are built in.

A list of scenarios is a TOML file; the built-in one is read the same way. Whether start, goal and canvas lie on the
road is for the simulator that knows the map to say.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Literal, cast, get_args

from roadproof.datatypes import VehicleState
from roadproof.errors import GeometryError, ScenarioError
from roadproof.geometry import CanvasPlacement
from roadproof.io.files import AnyPath, as_path, check_name, inside, read_toml, write_text
from roadproof.io.tables import first_twice

Kind = Literal["straight", "left", "right"]
KINDS: tuple[Kind, ...] = get_args(Kind)

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
        numbers = {**asdict(self.start), **asdict(self.canvas), "goal x": self.goal_m[0], "goal y": self.goal_m[1]}
        for what, value in {**numbers, "time_limit_s": self.time_limit_s}.items():
            if not math.isfinite(value):
                raise ScenarioError(f"scenario {self.name}: {what} is {value}, expected a finite number")
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
    content = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""
    return asdict(scenario) | {"map_name": file.name, "map": content}


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
    entries = read_toml(path, ScenarioError).get("scenario")
    if not isinstance(entries, list) or not entries:
        raise ScenarioError(f"scenarios {path} has no [[scenario]], expected at least one")
    scenarios: list[Scenario] = []
    for k, entry in enumerate(cast("list[object]", entries)):
        try:
            scenarios.append(_scenario(entry, path.parent))
        except (ScenarioError, GeometryError) as error:
            raise ScenarioError(f"scenarios {path}, entry {k + 1}: {error}") from error
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
    if map_name.endswith(".xodr"):
        if Path(map_name).resolve().parent != folder.resolve():
            raise ScenarioError(f"scenario {scenario.name}: its map {map_name} is not in {folder}; copy it there first")
        map_name = Path(map_name).name
    lines = ["[[scenario]]"]
    # JSON's strings, escaped to ASCII, are TOML's.
    lines += [f"{key} = {json.dumps(value)}" for key, value in (("name", scenario.name), ("kind", scenario.kind))]
    lines += [f"map_name = {json.dumps(map_name)}", f"start = {_table(asdict(scenario.start))}"]
    lines += [f"goal_m = [{float(scenario.goal_m[0])!r}, {float(scenario.goal_m[1])!r}]"]
    lines += [f"canvas = {_table(asdict(scenario.canvas))}", f"time_limit_s = {float(scenario.time_limit_s)!r}"]
    return "\n".join(lines) + "\n"


def _table(values: Mapping[str, float]) -> str:
    return "{ " + ", ".join(f"{key} = {float(value)!r}" for key, value in values.items()) + " }"


def _scenario(entry: object, folder: Path) -> Scenario:
    values = _known(entry, {field.name for field in fields(Scenario)}, "the scenario")
    missing = [field.name for field in fields(Scenario) if field.name not in values]
    if missing:
        raise ScenarioError(f"{missing[0]} is missing")
    goal = cast("list[object]", values["goal_m"])
    if not isinstance(values["goal_m"], list) or len(goal) != 2:
        raise ScenarioError(f"goal_m is {goal!r}, expected [x, y]")
    start = _numbers(values["start"], {field.name for field in fields(VehicleState)}, "start")
    canvas = _numbers(values["canvas"], {field.name for field in fields(CanvasPlacement)}, "canvas")
    for key in ("x_m", "y_m"):
        for what, table in (("start", start), ("canvas", canvas)):
            if key not in table:
                raise ScenarioError(f"{what} has no {key}")
    return Scenario(
        name=_string(values, "name"),
        kind=_kind(_string(values, "kind")),
        map_name=_map_name(_string(values, "map_name"), folder),
        start=VehicleState(**{"z_m": 0.0, "yaw_rad": 0.0, "speed_mps": 0.0, **start}),
        goal_m=(_float(goal[0], "goal_m"), _float(goal[1], "goal_m")),
        canvas=CanvasPlacement(**canvas),
        time_limit_s=_float(values["time_limit_s"], "time_limit_s"),
    )


def _kind(text: str) -> Kind:
    for kind in KINDS:
        if text == kind:
            return kind
    raise ScenarioError(f"kind is {text!r}, expected straight, left or right")


def _map_name(name: str, folder: Path) -> str:
    if not name.endswith(".xodr"):
        return name
    return str(inside(folder, name, "map_name", ScenarioError))


def _known(entry: object, keys: set[str], what: str) -> dict[str, Any]:
    if not isinstance(entry, dict):
        raise ScenarioError(f"{what} is {entry!r}, expected a table")
    table = cast("dict[str, Any]", entry)  # TOML's keys are strings
    for key in table:
        if key not in keys:
            nearest = difflib.get_close_matches(key, sorted(keys), n=1, cutoff=0.0)
            raise ScenarioError(f"{what} has an unknown key {key!r}; did you mean {nearest[0]!r}?")
    return table


def _numbers(entry: object, keys: set[str], what: str) -> dict[str, float]:
    return {key: _float(value, f"{what} {key}") for key, value in _known(entry, keys, what).items()}


def _float(value: object, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ScenarioError(f"{what} is {value!r:.120}, expected a number")
    if not abs(value) < 1e9:
        raise ScenarioError(f"{what} is {value!r:.40}, expected a finite number below 1e9")
    return float(value)


def _string(values: Mapping[str, Any], key: str) -> str:
    if not isinstance(values[key], str) or not values[key]:
        raise ScenarioError(f"{key} is {values[key]!r}, expected a text")
    return values[key]
