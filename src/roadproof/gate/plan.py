"""What a check drives and what it lets pass, as a TOML file says it.

format = "roadproof-check"
version = 1
controller = "pilotnet"
scenarios = ["left-03", "straight-*"]     # names or patterns of names
scenario_file = "own.toml"                # beside the plan; left out, the built-in scenarios
budget = "smoke"                          # or "full"; --budget wins
patterns = "patterns"                     # *.json for all scenarios, SCENARIO/*.json for one
random = 5                                # random patterns a seed
figures = 5                               # of random patterns and fresh attacks
seeds = [0, 1]                            # each has starts, random patterns and a fresh attack of its own

[starts]                                  # of every seed, as in a study; these are the defaults
count = 5
right_m = 0.3
turned_rad = 0.05
faster_mps = 2.0

[smoke]                                   # the recorded world
recordings = ["recordings"]               # folders with runs that are named after their scenarios
weathers = ["clear-noon"]

[full]                                    # a simulator, and a fresh attack for every scenario and seed
simulator = "town"                        # or carla://HOST:PORT
weathers = ["clear-noon", "rainy-noon"]   # attacks are found in the first

[limits]                                  # the greatest values that pass
bare = { failed = 0.0 }                   # share of the drives on the bare road that fail; this is the default
stored = { deviation_m = 0.5, left_lane = 0.0 }
random = { deviation_m = 0.3, left_lane = 0.0 }
fresh = { deviation_m = 1.5 }

[change]                                  # against a stored reference; both must be exceeded to fail
reference = "reference"                   # REFERENCE/BUDGET/check.json, beside the plan
deviation_m = { absolute = 0.1, relative = 0.2 }
left_lane = { absolute = 0.1, relative = 0.2 }
"""

from __future__ import annotations

import fnmatch
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from roadproof.controllers.loading import runs_code
from roadproof.datatypes import Weather
from roadproof.driving.starts import StartRange
from roadproof.errors import CheckError, RoadproofError
from roadproof.gate.inputs import Stored, each_once, recordings_of, stored_patterns
from roadproof.gate.verdict import Change, Kind, least_drives
from roadproof.limits import MAX_FIGURES, MAX_SEED
from roadproof.scenarios import BUILTIN_FILE, Scenario, find_scenario, load_scenarios
from roadproof.simulators.loading import SPECS, is_elsewhere, is_server
from roadproof.study.plan import StartPlan
from roadproof.study.reading import build, one_of, within

FORMAT = "roadproof-check"
FORMAT_VERSION = 1
BudgetName = Literal["smoke", "full"]
BUDGETS: tuple[BudgetName, ...] = get_args(BudgetName)


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckPlan:
    """What one check drives, and what it lets pass; `load_check` reads it.

    Args:
        controller: its spec.
        scenarios: where.
        scenario_file: they are from, where that is the user's own.
        budget: "smoke" in recordings, "full" in a simulator with fresh attacks.
        weathers: of that budget; a fresh attack is found in the first.
        seeds: each has starts, random patterns and a fresh attack of its own.
        starts: drives of each seed in each case.
        random: patterns drawn for each seed, each driven once.
        figures: of random patterns and fresh attacks.
        stored: patterns by name of the scenario that they are driven in.
        recordings: run of each scenario and weather; of a smoke check.
        simulator: its spec; of a full check.
        limits: greatest values that pass, by kind of paint and measure.
        change: how much worse than the reference each measure may be.
        reference: where the check.json to compare with lies; None where nothing is compared.
    """

    controller: str
    scenarios: tuple[Scenario, ...]
    scenario_file: Path | None
    budget: BudgetName
    weathers: tuple[Weather, ...]
    seeds: tuple[int, ...]
    starts: StartPlan
    random: int
    figures: int
    stored: Mapping[str, tuple[Stored, ...]]
    recordings: Mapping[tuple[str, Weather], Path]
    simulator: str
    limits: Mapping[Kind, Mapping[str, float]]
    change: Mapping[str, Change]
    reference: Path | None

    @property
    def start_range(self) -> StartRange:
        """What starts are drawn from."""
        return StartRange(
            right_m=self.starts.right_m, turned_rad=self.starts.turned_rad, faster_mps=self.starts.faster_mps
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Bare:
    failed: float = 0.0

    def __post_init__(self) -> None:
        within(self.failed, "failed", 0.0, 1.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Painted:
    deviation_m: float | None = None
    left_lane: float | None = None

    def __post_init__(self) -> None:
        if self.deviation_m is not None:
            within(self.deviation_m, "deviation_m", 0.01, 100.0)
        if self.left_lane is not None:
            within(self.left_lane, "left_lane", 0.0, 1.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Limits:
    bare: _Bare = _Bare()
    stored: _Painted = _Painted()
    random: _Painted = _Painted()
    fresh: _Painted = _Painted()


@dataclass(frozen=True, kw_only=True, slots=True)
class _Change:
    reference: str
    deviation_m: Change | None = None
    left_lane: Change | None = None
    failed: Change | None = None

    def __post_init__(self) -> None:
        if not self.measures:
            raise CheckError("change has no measure, expected deviation_m, left_lane or failed")
        for name, change in self.measures.items():
            within(change.absolute, f"{name}.absolute", 0.0, 100.0)
            within(change.relative, f"{name}.relative", 0.0, 100.0)

    @property
    def measures(self) -> dict[str, Change]:
        named = {"deviation_m": self.deviation_m, "left_lane": self.left_lane, "failed": self.failed}
        return {name: change for name, change in named.items() if change is not None}


@dataclass(frozen=True, kw_only=True, slots=True)
class _Smoke:
    recordings: tuple[str, ...]
    weathers: tuple[Weather, ...] = (Weather.CLEAR_NOON,)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Full:
    simulator: str = "town"
    weathers: tuple[Weather, ...] = (Weather.CLEAR_NOON,)

    def __post_init__(self) -> None:
        if self.simulator != "town" and not is_server(self.simulator):
            raise CheckError(f"simulator is {self.simulator!r}, expected {SPECS}")


@dataclass(frozen=True, kw_only=True, slots=True)
class _Stated:
    """A plan as its file says it."""

    controller: str
    scenarios: tuple[str, ...]
    limits: dict[str, Any]
    scenario_file: str | None = None
    budget: str = "smoke"
    patterns: str | None = None
    random: int = 5
    figures: int = 5
    seeds: tuple[int, ...] = (0, 1)
    starts: dict[str, Any] = field(default_factory=dict[str, Any])
    smoke: dict[str, Any] | None = None
    full: dict[str, Any] = field(default_factory=dict[str, Any])
    change: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        one_of(self.budget, "budget", BUDGETS)
        within(self.random, "random", 0, 1000)
        within(self.figures, "figures", 1, MAX_FIGURES)
        each_once(self.seeds, "seeds")
        each_once(self.scenarios, "scenarios")
        for seed in self.seeds:
            within(seed, "seeds", 0, MAX_SEED)


def load_check(path: Path, *, budget: str | None = None, trust: bool = False) -> CheckPlan:
    """Read a plan for one budget, with everything that it names; see the head of this module.

    Args:
        path: of the TOML file; what it names lies beside it.
        budget: "smoke" or "full"; None for the plan's own.
        trust: follow it also where it runs code or calls another machine: a plan may come from anyone.

    Raises:
        CheckError: the file or something that it names is missing, damaged or unknown, a number is out of its range,
            the drives are too few for the limits, or it is not trusted with what it asks for; the message says which.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CheckError(f"cannot read {path}: {error.strerror or error}; check the path") from None
    except (ValueError, RecursionError) as error:
        raise CheckError(f"{path} is not valid TOML ({error})") from None
    try:
        if content.pop("format", None) != FORMAT:
            raise CheckError(f'expected format = "{FORMAT}"')
        if (version := content.pop("version", None)) != FORMAT_VERSION:
            raise CheckError(f"version is {version!r}, expected {FORMAT_VERSION}")
        plan = _plan(build(_Stated, content, "the check"), path.parent, budget)
        if not trust:
            _check_harmless(plan)
    except RoadproofError as error:
        raise CheckError(f"{path}: {error}") from None
    return plan


def _plan(stated: _Stated, folder: Path, budget: str | None) -> CheckPlan:
    chosen: BudgetName = "full" if (budget or stated.budget) == "full" else "smoke"
    listed = stated.scenario_file
    own = None if listed is None else _beside(folder, listed, "scenario_file")
    known = load_scenarios(own or BUILTIN_FILE)
    scenarios = _chosen(stated.scenarios, known)
    smoke = None if stated.smoke is None else build(_Smoke, stated.smoke, "smoke")
    full = build(_Full, stated.full, "full")
    if chosen == "smoke" and smoke is None:
        raise CheckError('a smoke check drives in recordings; add [smoke] with recordings = ["FOLDER"]')
    weathers = full.weathers if chosen == "full" or smoke is None else smoke.weathers
    each_once(weathers, "weathers")
    change = None if stated.change is None else build(_Change, stated.change, "change")
    limits = asdict(build(_Limits, stated.limits, "limits"))
    plan = CheckPlan(
        controller=stated.controller,
        scenarios=scenarios,
        scenario_file=own,
        budget=chosen,
        weathers=weathers,
        seeds=stated.seeds,
        starts=build(StartPlan, stated.starts, "starts"),
        random=stated.random,
        figures=stated.figures,
        stored=stored_patterns(stated.patterns, folder, scenarios, known),
        recordings=recordings_of(folder, smoke.recordings, scenarios, weathers, stated.controller)
        if smoke is not None and chosen == "smoke"
        else {},
        simulator=full.simulator,
        limits={kind: {k: v for k, v in limits[kind].items() if v is not None} for kind in Kind},
        change={} if change is None else change.measures,
        reference=None if change is None else _beside(folder, change.reference, "reference") / chosen / "check.json",
    )
    _check_drives(plan)
    return plan


def _check_drives(plan: CheckPlan) -> None:
    """See that every kind of paint is judged, by enough drives for what is asked of it."""
    starts = plan.starts
    if not any((starts.right_m, starts.turned_rad, starts.faster_mps)):
        raise CheckError("starts are all the same, with right_m, turned_rad and faster_mps 0; then one is as many")
    each = starts.count * len(plan.seeds)
    drives = {Kind.BARE: each}
    if any(plan.stored.values()):
        drives[Kind.STORED] = each
    if plan.random:
        drives[Kind.RANDOM] = plan.random * len(plan.seeds)
    if plan.budget == "full":
        drives[Kind.FRESH] = each
    if len(drives) == 1:
        raise CheckError("random is 0 and there are no stored patterns, so nothing would be painted")
    for kind, count in drives.items():
        limits = plan.limits[kind]
        if kind is not Kind.BARE and not limits and not plan.change:
            raise CheckError(f"limits has nothing for {kind} patterns, which are driven over; add {kind} = {{ ... }}")
        asked = dict(limits) | ({"deviation_m": 0.0} if "deviation_m" in plan.change and kind is not Kind.BARE else {})
        for name, limit in asked.items():
            if count < (least := least_drives(name, limit)):
                what = "random × seeds" if kind is Kind.RANDOM else "starts × seeds"
                above = f" at most {limit:g}" if name != "deviation_m" else ""
                raise CheckError(
                    f"too few drives: {count} a case ({what}) can never show {name}{above} for {kind} with its 95 % "
                    f"interval, expected {least} or more"
                )


def _check_harmless(plan: CheckPlan) -> None:
    if runs_code(plan.controller):
        raise CheckError(
            f"controller {plan.controller!r} runs what its author wrote; look at it, then give --trust (trust=True)"
        )
    if plan.budget == "full" and is_elsewhere(plan.simulator):
        raise CheckError(f"simulator {plan.simulator!r} is another machine; give --trust (trust=True) to call it")


def _beside(folder: Path, listed: str, what: str) -> Path:
    path = folder / listed
    if not path.resolve().is_relative_to(folder.resolve()):
        raise CheckError(f"{what} {listed!r} leaves the plan's folder; put it beside the plan")
    return path


def _chosen(names: tuple[str, ...], known: tuple[Scenario, ...]) -> tuple[Scenario, ...]:
    """Scenarios by name or pattern of names, each once, in the order first named."""
    chosen: dict[str, Scenario] = {}
    for name in names:
        found = [each for each in known if fnmatch.fnmatchcase(each.name, name)] or [find_scenario(name, known)]
        chosen |= {each.name: each for each in found}
    return tuple(chosen.values())
