"""What a study compares, as a TOML file says it, and the independent jobs that come of it.

format = "roadproof-study"
version = 1
controller = "cil"
simulator = "town"                        # or carla://HOST:PORT, for one worker
scenario_file = "own.toml"                # beside the study; left out, the built-in scenarios
scenarios = ["straight-01", "left-*"]     # names or patterns of names
figures = ["1-b", 1, 3, 5]                # K; 1-b is one black figure
seeds = [0]
weathers = ["clear-noon", "rainy-noon"]   # of the evaluation; attacks are found in the first

[traffic]                                 # leave it out for static objects only
cars = 20
pedestrians = 20
runs = 10
weathers = "all"                          # or "first": the others are driven alone

[[method]]
name = "GradOpt"                          # stands in the tables
search = "gradopt"                        # or a black-box method: random, published-bo, gp, tpe, cma-es
trajectories = 3                          # gradopt: recorded drives; scheme: group, group-all or random
scheme = "group"
restarts = 4
iterations = 250
schedule = "published"                    # or "heats": many starts on few frames, the best go on
calibration = "two-paint"                 # or published, or pose
frames = 24                               # kept of every recorded drive
select = 6                                # of the best starts, driven to keep the strongest; 0 believes the surrogate

[[method]]
name = "BO"
search = "published-bo"
calls = 1000                              # black box: how many patterns are tried, each in a whole drive
random_calls = 400
objective = "steering"                    # as published, or "deviation": what is reported
start = "gradopt"                         # left out as published: the patterns that are tried first are GradOpt's, with
                                          # the settings above; `select` of them
"""

from __future__ import annotations

import difflib
import fnmatch
import hashlib
import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from itertools import product
from pathlib import Path
from typing import Any, Literal, cast, get_args

from roadproof.controllers.loading import runs_code
from roadproof.datatypes import Weather
from roadproof.errors import StudyError
from roadproof.limits import MANY, MAX_CROWD, MAX_FIGURES, MAX_SEED
from roadproof.scenarios import BUILTIN_FILE, Scenario, find_scenario, load_scenarios
from roadproof.simulators.loading import SPECS, is_elsewhere, is_server

FORMAT = "roadproof-study"
FORMAT_VERSION = 1
JOB_VERSION = 2
"""Raised when a job of the same settings would come out differently: old results are then not taken for new ones."""

Scheme = Literal["group", "group-all", "random"]
SCHEMES: tuple[Scheme, ...] = get_args(Scheme)
SCHEDULES = ("published", "heats")
BLACK = "1-b"


@dataclass(frozen=True, kw_only=True, slots=True)
class MethodPlan:
    """One way of finding a pattern.

    Args:
        name: stands in the tables.
        search: "gradopt", or a black-box method of `attacks.blackbox`.
        trajectories: gradopt: T, how many drives are recorded.
        scheme: gradopt: how they are perturbed and pooled.
        restarts: gradopt: starts of every group.
        iterations: gradopt: steps of every start.
        select: gradopt: how many of the best starts are driven, to keep the strongest; 0 believes the surrogate.
        calls: black box: patterns tried, each in a whole drive.
        random_calls: published-bo: how many of them before the model guides.
        schedule: gradopt: "published" steps, or in "heats".
        calibration: gradopt: how recorded drives are calibrated, a `calibration.Method`.
        frames: gradopt: kept of every recorded drive, at most.
        objective: what is made large. Black box: of a drive, an `evaluation.objective.Measure`. gradopt: "steering",
            the shift on recorded frames, or "deviation", the car's path in the recorded world.
        start: black box: "gradopt" tries `select` patterns first that a gradopt search of these settings found.
    """

    name: str
    search: str
    trajectories: int = 3
    scheme: str = "group"
    restarts: int = 4
    iterations: int = 250
    select: int = 0
    calls: int = 1000
    random_calls: int = 400
    schedule: str = "published"
    calibration: str = "two-paint"
    frames: int = 24
    objective: str = "steering"
    start: str = ""

    def __post_init__(self) -> None:
        # Late, since torch comes with it; a process that only passes plans on is spared.
        from roadproof.attacks.blackbox import METHODS
        from roadproof.calibration import METHODS as CALIBRATIONS
        from roadproof.drives.trajectories import COUNTS
        from roadproof.evaluation.objective import MEASURES

        _one_of(self.search, "search", ("gradopt", *METHODS))
        _one_of(self.scheme, "scheme", SCHEMES)
        _one_of(self.schedule, "schedule", SCHEDULES)
        _one_of(self.calibration, "calibration", CALIBRATIONS)
        _one_of(self.objective, "objective", MEASURES)
        _one_of(self.start, "start", ("", "gradopt"))
        for name in ("restarts", "iterations", "calls", "random_calls", "frames"):
            _within(getattr(self, name), name, 1, MANY)
        _within(self.select, "select", 0, 1000)
        if self.search == "published-bo" and self.random_calls >= self.calls:
            raise StudyError(f"random_calls is {self.random_calls} of {self.calls} calls; leave some for the model")
        if self.start and (self.search == "gradopt" or not self.select):
            raise StudyError(f"start is {self.start!r}, expected it with a black-box search and select of 1 or more")
        sides = self.scheme == "group" and self.trajectories > 1
        if self.search == "gradopt" and self.objective == "deviation" and not sides:
            raise StudyError(
                "objective deviation is searched for each side apart; expected scheme group and trajectories 3 or more"
            )
        if self.trajectories not in COUNTS:
            raise StudyError(f"trajectories is {self.trajectories}, expected {', '.join(map(str, COUNTS))}")


@dataclass(frozen=True, kw_only=True, slots=True)
class TrafficPlan:
    """Evaluation among others: seeded runs whose mean counts.

    Args:
        cars: on the road.
        pedestrians: about.
        runs: in each weather.
        weathers: "all", or "first": the study's other weathers are driven alone.
    """

    cars: int = 20
    pedestrians: int = 20
    runs: int = 10
    weathers: str = "all"

    def __post_init__(self) -> None:
        for name in ("cars", "pedestrians"):
            _within(getattr(self, name), name, 0, MAX_CROWD)
        if not self.cars + self.pedestrians:
            raise StudyError("cars and pedestrians are 0; leave [traffic] out to drive alone")
        _within(self.runs, "runs", 1, 10_000)
        _one_of(self.weathers, "weathers", ("all", "first"))


@dataclass(frozen=True, kw_only=True, slots=True)
class Job:
    """One pattern to be found and evaluated; independent of every other.

    Args:
        controller: its spec.
        scenario: where.
        figures: K, or "1-b".
        method: how.
        seed: of the recording and the search.
        weathers: of the evaluation; found in the first.
        traffic: of the evaluation, or None.
        simulator: its spec, see `simulators.loading`.
        weights: digest of the file that the controller's spec names; empty for one that comes with the package, and for
            a function of yours, whose weights a study does not see.
    """

    controller: str
    scenario: Scenario
    figures: int | str
    method: MethodPlan
    seed: int
    weathers: tuple[Weather, ...]
    traffic: TrafficPlan | None
    simulator: str = "town"
    weights: str = ""

    @property
    def key(self) -> str:
        """What tells this job from every other: a hash of all it depends on."""
        told = {"job_version": JOB_VERSION, **asdict(self)}
        if not self.weights:
            del told["weights"]
        content = json.dumps(told, sort_keys=True, default=str)
        return hashlib.sha256(content.encode()).hexdigest()[:16]


@dataclass(frozen=True, kw_only=True, slots=True)
class Study:
    """Scenarios × K × methods × seeds, evaluated in some weathers, with and without traffic.

    Raises:
        StudyError: a list is empty, something stands in it twice, or a value makes no sense.
    """

    controller: str
    scenarios: tuple[Scenario, ...]
    figures: tuple[int | str, ...]
    methods: tuple[MethodPlan, ...]
    seeds: tuple[int, ...] = (0,)
    weathers: tuple[Weather, ...] = (Weather.CLEAR_NOON,)
    traffic: TrafficPlan | None = None
    simulator: str = "town"

    def __post_init__(self) -> None:
        for field in ("scenarios", "figures", "methods", "seeds", "weathers"):
            if not getattr(self, field):
                raise StudyError(f"{field} is empty, expected at least one")
        for figures in self.figures:
            known = isinstance(figures, int) and not isinstance(figures, bool) and 1 <= figures <= MAX_FIGURES
            if figures != BLACK and not known:
                raise StudyError(
                    f"figures has {figures!r}, expected 1 to {MAX_FIGURES}, or {BLACK!r} for one black figure"
                )
        if self.simulator != "town" and not is_server(self.simulator):
            raise StudyError(f"simulator is {self.simulator!r}, expected {SPECS}")
        for seed in self.seeds:
            _within(seed, "seeds", 0, MAX_SEED)
        # What is asked for twice would be two jobs that write the same folder.
        named = {"scenarios": [scenario.name for scenario in self.scenarios], "method": [m.name for m in self.methods]}
        for field in ("figures", "seeds", "weathers"):
            named[field] = list(map(str, getattr(self, field)))
        for field, names in named.items():
            twice = [name for name in names if names.count(name) > 1]
            if twice:
                raise StudyError(f"{field} has {twice[0]} twice, expected each once")

    @property
    def jobs(self) -> tuple[Job, ...]:
        """Every combination, scenario by scenario."""
        weights = _digest(self.controller)
        return tuple(
            Job(
                controller=self.controller,
                scenario=scenario,
                figures=figures,
                method=method,
                seed=seed,
                weathers=self.weathers,
                traffic=self.traffic,
                simulator=self.simulator,
                weights=weights,
            )
            for scenario, figures, method, seed in product(self.scenarios, self.figures, self.methods, self.seeds)
        )


def load_study(path: Path, *, trust: bool = False) -> Study:
    """Read a study; see the head of this module.

    Args:
        path: of the TOML file.
        trust: follow it also where it runs code or calls another machine: a plan may come from anyone.

    Raises:
        StudyError: the file is missing or damaged, a key is unknown, a value makes no sense, or it is not trusted with
            what it asks for; says which.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise StudyError(f"cannot read {path}: {error.strerror or error}; check the path") from None
    except (ValueError, RecursionError) as error:
        raise StudyError(f"{path} is not valid TOML ({error})") from None
    try:
        study = _study(content, path.parent)
        if not trust:
            _check_harmless(study)
    except StudyError as error:
        raise StudyError(f"{path}: {error}") from None
    return study


def _check_harmless(study: Study) -> None:
    if runs_code(study.controller):
        raise StudyError(
            f"controller {study.controller!r} runs what its author wrote; look at it, then give --trust (trust=True)"
        )
    if is_elsewhere(study.simulator):
        raise StudyError(f"simulator {study.simulator!r} is another machine; give --trust (trust=True) to call it")


def _study(content: dict[str, Any], folder: Path) -> Study:
    if content.pop("format", None) != FORMAT or content.pop("version", None) != FORMAT_VERSION:
        raise StudyError(f'expected format = "{FORMAT}" and version = {FORMAT_VERSION}')
    listed = content.pop("scenario_file", None)
    own = folder / str(listed) if listed is not None else BUILTIN_FILE
    if listed is not None and not own.resolve().is_relative_to(folder.resolve()):
        raise StudyError(f"scenario_file {listed!r} leaves the study's folder; put it beside the study")
    stated = {"methods" if key == "method" else key: value for key, value in content.items()}
    _known(stated, Study, "the study")
    for key in ("controller", "scenarios", "figures", "methods"):
        if key not in stated:
            raise StudyError(f"{'method' if key == 'methods' else key} is missing")
    traffic = stated.get("traffic")
    return Study(
        controller=str(stated["controller"]),
        scenarios=_chosen(_list(stated, "scenarios"), load_scenarios(own)),
        figures=tuple(_list(stated, "figures")),
        methods=tuple(_build(MethodPlan, method, "method") for method in _list(stated, "methods")),
        seeds=tuple(_seed(value) for value in _list(stated, "seeds", (0,))),
        weathers=tuple(_weather(name) for name in _list(stated, "weathers", (Weather.CLEAR_NOON,))),
        traffic=None if traffic is None else _build(TrafficPlan, traffic, "traffic"),
        simulator=str(stated.get("simulator", "town")),
    )


def _chosen(patterns: Iterable[object], scenarios: tuple[Scenario, ...]) -> tuple[Scenario, ...]:
    """Scenarios by name or pattern of names, each once, in the order first named."""
    chosen: dict[str, Scenario] = {}
    for pattern in map(str, patterns):
        found = [scenario for scenario in scenarios if fnmatch.fnmatchcase(scenario.name, pattern)]
        chosen |= {scenario.name: scenario for scenario in found or [find_scenario(pattern, scenarios)]}
    return tuple(chosen.values())


def _build(noun: type[Any], stated: object, what: str) -> Any:  # noqa: ANN401  # the noun that was asked for
    if not isinstance(stated, dict):
        raise StudyError(f"{what} is {stated!r}, expected a table")
    values = cast("dict[str, Any]", stated)
    _known(values, noun, what)
    for field in fields(noun):
        value = values.get(field.name)
        wanted = str if field.type == "str" else int
        if value is not None and (not isinstance(value, wanted) or isinstance(value, bool)):
            raise StudyError(f"{what}: {field.name} is {value!r}, expected {'a text' if wanted is str else 'a number'}")
    try:
        return noun(**values)
    except TypeError:
        missing = [name for name in ("name", "search") if name not in values]
        raise StudyError(f"{what} lacks {missing[0]}") from None


def _known(stated: Mapping[str, Any], noun: type[Any], what: str) -> None:
    names = [field.name for field in fields(noun)]
    for key in stated:
        if key not in names:
            nearest = difflib.get_close_matches(key, names, n=1, cutoff=0.0)
            raise StudyError(f"{what} has an unknown key {key!r}; did you mean {nearest[0]!r}?")


def _list(stated: Mapping[str, Any], key: str, otherwise: tuple[Any, ...] = ()) -> tuple[Any, ...]:
    value = stated.get(key, otherwise)
    if not isinstance(value, list | tuple):
        raise StudyError(f"{key} is {value!r}, expected a list")
    return tuple(cast("list[Any]", value))


def _digest(controller: str) -> str:
    """Of the file that a spec names, as `cil:FILE.safetensors` does; empty where it names none."""
    path = Path(controller.partition(":")[2] or controller)
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.suffix and path.is_file() else ""


def _seed(value: object) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise StudyError(f"seeds has {value!r}, expected whole numbers")
    return value


def _weather(name: object) -> Weather:
    _one_of(str(name), "weathers", tuple(Weather))
    return Weather(str(name))


def _one_of(value: str, name: str, choices: Iterable[str]) -> None:
    if value not in choices:
        raise StudyError(f"{name} is {value!r}, expected one of {', '.join(choices)}")


def _within(value: int, name: str, least: int, most: int) -> None:
    if not least <= value <= most:
        raise StudyError(f"{name} is {value}, expected {least} to {most}")
