"""What a check drives and what it lets pass, as a TOML file says it; docs/check.md has one with every key."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast, get_args

from roadproof.attacks.objective import varied
from roadproof.compositing import Variation
from roadproof.datatypes import Weather
from roadproof.driving.starts import StartPlan
from roadproof.errors import CheckError, RoadproofError
from roadproof.gate.inputs import Stored, recordings_of, stored_patterns
from roadproof.gate.verdict import Change, Kind, least_drives
from roadproof.io.files import AnyPath, as_path
from roadproof.io.tables import build, each_once
from roadproof.io.text import read_toml
from roadproof.limits import MAX_FIGURES, check_range, check_seed
from roadproof.paint import PaintLimits
from roadproof.pipeline.budget import QUICK, Budget
from roadproof.plans import beside, chosen_scenarios, refuse_untrusted, take_head
from roadproof.scenarios import BUILTIN_FILE, Scenario, load_scenarios
from roadproof.simulators.loading import check_spec

Key: TypeAlias = tuple[str, Weather, Kind, str]
"""What tells a case from the others: scenario, weather, and kind and name of the paint."""

BARE, RANDOM = "bare road", "random patterns"
FILE = "check.json"
FORMAT = "roadproof-check"
FORMAT_VERSION = 1
BudgetName = Literal["smoke", "full"]
BUDGETS: tuple[BudgetName, ...] = get_args(BudgetName)
RANGES = {"deviation_m": (0.01, 100.0), "left_lane": (0.0, 1.0), "failed": (0.0, 1.0)}
MEASURES = {kind: ("failed",) if kind is Kind.BARE else ("deviation_m", "left_lane") for kind in Kind}


def fresh(seed: int) -> str:
    """The name of the case of a fresh attack.

    Each is one of its own: drives over one pattern say nothing of what attacks with other seeds find.
    """
    return f"fresh attack, seed {seed}"


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckPlan:
    """What one check drives, and what it lets pass; `load_check` reads it.

    Args:
        controller: the spec of the controller that is checked.
        scenarios: the scenarios that it is driven in.
        scenario_file: the file of these scenarios, where it is the user's own.
        budget: "smoke" drives in recordings; "full" drives in a simulator, with fresh attacks.
        weathers: the weathers that this budget drives in; a fresh attack is found in the first.
        seeds: the seeds; each has starts, random patterns and a fresh attack of its own.
        starts: how many starts each seed has in each case, and the range that they are drawn from.
        random: how many random patterns are drawn for each seed; each is driven once in each weather.
        figures: how many figures a random pattern and a fresh attack's pattern have.
        paint: limits on the paint of random patterns and fresh attacks; None limits nothing.
        variation: what fresh attacks take the mean over; None for paint and camera as recorded.
        stored: the stored patterns, by the name of the scenario that they are driven in.
        recordings: the run folder of each (scenario's name, weather); empty in a full check.
        simulator: spec of the simulator that a full check drives in.
        limits: the greatest values that pass, by kind of paint and by measure.
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
    paint: PaintLimits | None
    variation: Variation | None
    stored: Mapping[str, tuple[Stored, ...]]
    recordings: Mapping[tuple[str, Weather], Path]
    simulator: str
    limits: Mapping[Kind, Mapping[str, float]]
    change: Mapping[str, Change]
    reference: Path | None

    @property
    def keys(self) -> tuple[Key, ...]:
        """The key of every case, scenario by scenario."""
        found: list[Key] = []
        for scenario in self.scenarios:
            painted = [(Kind.STORED, each.name) for each in self.stored.get(scenario.name, ())]
            painted += [(Kind.RANDOM, RANDOM)] if self.random else []
            painted += [(Kind.FRESH, fresh(seed)) for seed in self.seeds] if self.budget == "full" else []
            found += [
                (scenario.name, weather, *each) for weather in self.weathers for each in ((Kind.BARE, BARE), *painted)
            ]
        return tuple(found)

    @property
    def attack(self) -> Budget:
        """What a fresh attack spends; its own evaluation is one drive, for the cases' drives judge it."""
        objective = varied(QUICK.objective, self.variation)
        return replace(QUICK, weathers=self.weathers[:1], starts=0, objective=objective)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Smoke:
    recordings: tuple[str, ...]
    weathers: tuple[Weather, ...] = (Weather.CLEAR_NOON,)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Full:
    simulator: str = "town"
    weathers: tuple[Weather, ...] = (Weather.CLEAR_NOON,)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Stated:
    """A plan as its file says it."""

    controller: str
    scenarios: tuple[str, ...]
    limits: dict[str, dict[str, float]]
    scenario_file: str | None = None
    budget: BudgetName = "smoke"
    patterns: str | None = None
    random: int = 5
    figures: int = 5
    seeds: tuple[int, ...] = (0, 1)
    starts: dict[str, Any] = field(default_factory=dict[str, Any])
    paint: dict[str, Any] | None = None
    variation: dict[str, Any] | None = None
    smoke: dict[str, Any] | None = None
    full: dict[str, Any] = field(default_factory=dict[str, Any])
    change: dict[str, str | dict[str, Any]] = field(default_factory=dict[str, str | dict[str, Any]])


def load_check(path: AnyPath, *, budget: str | None = None, trust: bool = False) -> CheckPlan:
    """Read a plan for one budget, with everything that it names.

    Args:
        path: the plan's TOML file; the files and folders that it names are looked for beside it.
        budget: "smoke" or "full"; None for the plan's own.
        trust: whether to follow a plan that runs code or calls another machine; a plan may come from anyone.

    Raises:
        CheckError: the file or something that it names is missing, damaged or unknown, a number is out of its range,
            the drives are too few for the limits, or the plan is not trusted with what it asks for; says which.
    """
    path = as_path(path)
    content = read_toml(path, CheckError)
    try:
        # What it names is told in files, by the paths beside it.
        if not _is_utf8(str(path)):
            raise CheckError("its path is not UTF-8, so no file could tell of what lies beside it; rename the folder")
        take_head(content, FORMAT, FORMAT_VERSION, CheckError)
        plan = _plan(build(_Stated, content, "the check", CheckError), path.parent, budget)
        if not trust:
            refuse_untrusted(plan.controller, plan.simulator if plan.budget == "full" else None, CheckError)
    except RoadproofError as error:
        raise CheckError(f"{path}: {error}") from None
    return plan


def references_of(path: AnyPath) -> Path | None:
    """The folder in which a plan keeps its references, whatever else is wrong with it; None where it names none.

    Raises:
        CheckError: the file is missing, or not TOML, so that nobody knows where its references are.
    """
    path = as_path(path)
    change = read_toml(path, CheckError).get("change")
    named = cast("dict[str, object]", change).get("reference") if isinstance(change, dict) else None
    return path.parent / named if isinstance(named, str) else None


def _plan(stated: _Stated, folder: Path, budget: str | None) -> CheckPlan:
    check_range(stated.random, "random", 0, 1000, CheckError)
    check_range(stated.figures, "figures", 1, MAX_FIGURES, CheckError)
    each_once(stated.scenarios, "scenarios", CheckError)
    each_once(stated.seeds, "seeds", CheckError)
    for seed in stated.seeds:
        check_seed(seed, "seeds", CheckError)
    if budget is not None:
        _one_of(budget, "budget", BUDGETS)
    chosen: BudgetName = "full" if (budget or stated.budget) == "full" else "smoke"
    listed = stated.scenario_file
    own = None if listed is None else beside(folder, listed, "scenario_file", "plan", CheckError)
    known = load_scenarios(own or BUILTIN_FILE)
    scenarios = chosen_scenarios(stated.scenarios, known)
    smoke = None if stated.smoke is None else build(_Smoke, stated.smoke, "smoke", CheckError)
    full = build(_Full, stated.full, "full", CheckError)
    check_spec(full.simulator)
    if chosen == "smoke" and smoke is None:
        raise CheckError('a smoke check drives in recordings; add [smoke] with recordings = ["FOLDER"]')
    weathers = full.weathers if chosen == "full" or smoke is None else smoke.weathers
    each_once(weathers, "weathers", CheckError)
    change, reference = _change(stated.change, folder)
    plan = CheckPlan(
        controller=stated.controller,
        scenarios=scenarios,
        scenario_file=own,
        budget=chosen,
        weathers=weathers,
        seeds=stated.seeds,
        starts=build(StartPlan, stated.starts, "starts", CheckError),
        random=stated.random,
        figures=stated.figures,
        paint=None if stated.paint is None else build(PaintLimits, stated.paint, "paint", CheckError),
        variation=None if stated.variation is None else build(Variation, stated.variation, "variation", CheckError),
        stored=stored_patterns(stated.patterns, folder, scenarios, known),
        recordings=recordings_of(folder, smoke.recordings, scenarios, weathers, stated.controller, own)
        if smoke is not None and chosen == "smoke"
        else {},
        simulator=full.simulator,
        limits=_limits(stated.limits),
        change=change,
        reference=reference and reference / chosen / FILE,
    )
    _check_drives(plan)
    _check_asphalt(plan)
    return plan


def _limits(stated: dict[str, dict[str, float]]) -> dict[Kind, dict[str, float]]:
    found: dict[Kind, dict[str, float]] = {kind: {} for kind in Kind}
    found[Kind.BARE] = {"failed": 0.0}
    for kind, limits in stated.items():
        _one_of(kind, "a key of limits", tuple(Kind))
        for name, limit in limits.items():
            _one_of(name, f"a key of limits.{kind}", MEASURES[Kind(kind)])
            check_range(limit, f"limits.{kind}.{name}", *RANGES[name], CheckError)
            found[Kind(kind)][name] = limit
    return found


def _change(stated: dict[str, str | dict[str, Any]], folder: Path) -> tuple[dict[str, Change], Path | None]:
    """How much worse each measure may be, and than what."""
    if not stated:
        return {}, None
    reference = stated.pop("reference", None)
    if not isinstance(reference, str) or not reference or not stated:
        raise CheckError(f"change needs reference, a folder beside the plan, and one of {', '.join(RANGES)}")
    found: dict[str, Change] = {}
    for name, table in stated.items():
        _one_of(name, "a key of change", tuple(RANGES))
        if isinstance(table, str):
            raise CheckError(f"change.{name} is {table!r}, expected {{ absolute = ..., relative = ... }}")
        found[name] = build(Change, table, f"change.{name}", CheckError)
        for each in ("absolute", "relative"):
            check_range(getattr(found[name], each), f"change.{name}.{each}", 0.0, 100.0, CheckError)
    return found, beside(folder, reference, "reference", "plan", CheckError)


def _check_drives(plan: CheckPlan) -> None:
    """See that every kind of paint is judged, by enough drives for what is asked of it."""
    plan.starts.check_drawn(plan.seeds)
    each = plan.starts.count * len(plan.seeds)
    drives = {Kind.BARE: each}
    if any(plan.stored.values()):
        drives[Kind.STORED] = each
    if plan.random:
        drives[Kind.RANDOM] = plan.random * len(plan.seeds)
    if plan.budget == "full":
        drives[Kind.FRESH] = each
    bare = [each.name for each in plan.scenarios if not plan.stored.get(each.name)]
    if bare and not drives.keys() & {Kind.RANDOM, Kind.FRESH}:
        raise CheckError(f"random is 0 and {bare[0]} has no stored patterns, so nothing would be painted there")
    for kind, count in drives.items():
        limits = plan.limits[kind]
        if not limits and not plan.change.keys() & set(MEASURES[kind]):
            raise CheckError(f"limits has nothing for {kind} patterns, which are driven over; add {kind} = {{ ... }}")
        asked = [
            (f"{name} at most {limit:g}" if name != "deviation_m" else name, least_drives(name, limit))
            for name, limit in limits.items()
        ]
        # A case that is compared takes as many as a median, whatever is compared.
        median = least_drives("deviation_m", 0.0)
        asked += [(f"a change of {name}", median) for name in MEASURES[kind] if name in plan.change]
        for shown, least in asked:
            if count < least:
                what = "random × seeds" if kind is Kind.RANDOM else "starts × seeds"
                raise CheckError(
                    f"too few drives: {count} a case ({what}) can never show {shown} for {kind} with its 95 % "
                    f"interval, expected {least} or more"
                )


def _check_asphalt(plan: CheckPlan) -> None:
    """See that random patterns in a simulator, where nothing is measured before they are driven, can keep to limits."""
    if plan.budget == "full" and plan.random and plan.paint and plan.paint.lacks_asphalt:
        raise CheckError(
            "paint.contrast needs the colour of the asphalt for random patterns in a full check, where none is "
            'measured; add asphalt, such as "#5a5a5b", to [paint], or random = 0'
        )


def _is_utf8(text: str) -> bool:
    try:
        text.encode()
    except UnicodeError:
        return False
    return True


def _one_of(value: str, name: str, choices: Iterable[str]) -> None:
    if value not in choices:
        raise CheckError(f"{name} is {value!r}, expected one of {', '.join(choices)}")
