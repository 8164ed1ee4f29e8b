"""What a study compares, as a TOML file says it (see docs/studies.md), and the independent jobs that come of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

from roadproof.attacks import BayesianOptimisation, GradOpt
from roadproof.compositing import Variation
from roadproof.controllers.loading import files_digest
from roadproof.datatypes import Weather
from roadproof.driving.starts import USUAL_PLAN, StartPlan, require_on_road
from roadproof.errors import PatternError, RoadproofError, StudyError
from roadproof.io.files import AnyPath, as_path
from roadproof.io.identity import digest, stated
from roadproof.io.tables import build, each_once
from roadproof.io.text import read_toml
from roadproof.limits import MAX_CROWD, MAX_FIGURES, check_range, check_seed
from roadproof.paint import PaintLimits
from roadproof.plans import beside, chosen_scenarios, refuse_untrusted, take_head
from roadproof.roads.maps import load_map
from roadproof.roads.marks import site_at
from roadproof.roads.roadmap import RoadMap
from roadproof.scenarios import BUILTIN_FILE, Scenario, identity, load_scenarios
from roadproof.search_space import Family, SearchSpace
from roadproof.simulators.loading import TOWNS, check_spec
from roadproof.study.methods import (
    BlackBoxPlan,
    MethodPlan,
    PublishedPlan,
    family_of,
    method_plan,
    tries_by_driving,
)

FORMAT = "roadproof-study"
FORMAT_VERSION = 2
JOB_VERSION = 3
JOB_VERSIONS = {BayesianOptimisation.word: 5, GradOpt.word: 4}
"""Raised when a job of the same settings is done differently: old results are then not taken for new ones.

Digits that are rounded otherwise are no such change, though a search that climbs ends elsewhere after it, by chance.
"""

BLACK = "1-b"


@dataclass(frozen=True, kw_only=True, slots=True)
class TrafficPlan:
    """Evaluation in traffic: seeded runs whose mean counts.

    Args:
        cars: how many other cars are on the road, 0 to 500.
        pedestrians: how many people are about, 0 to 500.
        runs: how many runs there are in each weather, 1 to 10,000.
        weathers: "all" has traffic in all of the study's weathers, "first" in the first alone.

    Raises:
        StudyError: a number is out of its range, or nobody is on the road.
    """

    cars: int = 20
    pedestrians: int = 20
    runs: int = 10
    weathers: Literal["all", "first"] = "all"

    def __post_init__(self) -> None:
        check_range(self.cars, "cars", 0, MAX_CROWD, StudyError)
        check_range(self.pedestrians, "pedestrians", 0, MAX_CROWD, StudyError)
        check_range(self.runs, "runs", 1, 10_000, StudyError)
        if not self.cars + self.pedestrians:
            raise StudyError("cars and pedestrians are 0; leave [traffic] out to drive alone")


@dataclass(frozen=True, kw_only=True, slots=True)
class Conditions:
    """Whom patterns are found against, and how they are judged.

    Args:
        controller: spec of the controller (`controllers.loading`).
        weathers: the weathers of the drives that judge a pattern; patterns are found in the first.
        traffic: cars and people in the evaluation; None for drives alone.
        starts: how many drives alone judge a pattern in each weather, and where they begin.
        simulator: spec of the simulator (`simulators.loading`).
        paint: limits on the paint of patterns; None limits nothing.
        variation: what searches in recordings take the mean over; None for paint and camera as recorded.
    """

    controller: str
    weathers: tuple[Weather, ...] = (Weather.CLEAR_NOON,)
    traffic: TrafficPlan | None = None
    starts: StartPlan = USUAL_PLAN
    simulator: str = "town"
    paint: PaintLimits | None = None
    variation: Variation | None = None

    @property
    def shared(self) -> dict[str, Any]:
        """The conditions of a job or a study without its other fields, by name."""
        return {each.name: getattr(self, each.name) for each in fields(Conditions)}


@dataclass(frozen=True, kw_only=True, slots=True)
class Job(Conditions):
    """One pattern to be found and evaluated; independent of every other.

    Args:
        scenario: the scenario on whose canvas the pattern is painted.
        figures: K, how many figures the pattern has, or "1-b" for one black figure.
        method: the method by which the pattern is found.
        seed: the seed of the recording and the search.
        weights: digest of the file that the controller's spec names, or of the source of a function of the user's;
            empty for a controller that comes with the package, with its first weights.
    """

    scenario: Scenario
    figures: int | str
    method: MethodPlan
    seed: int
    weights: str = ""

    @property
    def key(self) -> str:
        """What tells this job from every other: a hash of all it depends on."""
        version = JOB_VERSIONS.get(self.method.search, JOB_VERSION)
        told: dict[str, Any] = {"job_version": version, **asdict(self), "scenario": identity(self.scenario)}
        if isinstance(self.method, BlackBoxPlan) and self.method.start:
            told["begun_with"] = JOB_VERSIONS[GradOpt.word]
        if self.variation or self.paint:
            # Searches under a variation count from the bare road in the same look; limits know the asphalt better.
            told["under_limits"] = 2
        # Jobs are older than these words; a map of the user's is known by what is in it, not by where it lies.
        tables = (
            (told, ("weights", "paint", "variation")),
            (told["method"], ("attack_weathers",)),
            (told["scenario"], ("map",)),
        )
        for table, names in tables:
            for name in names:
                if not table.get(name):
                    table.pop(name, None)
        return digest(stated(told))[:16]


@dataclass(frozen=True, kw_only=True, slots=True)
class Study(Conditions):
    """Scenarios × K × methods × seeds, evaluated in some weathers, with and without traffic.

    Args:
        scenarios: the stretches of road on which every method finds its patterns.
        figures: the values of K, how many figures a pattern has, or "1-b" for one black figure.
        methods: the methods by which patterns are found.
        seeds: the seeds of recording and search.
        reference: name of the method that tables compare with the others; None for the first.

    Raises:
        StudyError: a list is empty, something stands in it twice, a value makes no sense, or limits leave no pattern.
        EpisodeError: the starts of a seed are not all different, one is a scenario's own, or their range reaches off a
            road of the town.
        ScenarioError: the town has no such map.
        SimulatorError: no simulator has this name.
    """

    scenarios: tuple[Scenario, ...]
    figures: tuple[int | str, ...]
    methods: tuple[MethodPlan, ...]
    seeds: tuple[int, ...] = (0,)
    reference: str | None = None

    def __post_init__(self) -> None:
        methods = [method.name for method in self.methods]
        # What is asked for twice would be two jobs that write the same folder.
        named = {"scenarios": [scenario.name for scenario in self.scenarios], "method": methods}
        named |= {what: list(map(str, getattr(self, what))) for what in ("figures", "seeds", "weathers")}
        for what, names in named.items():
            each_once(names, what, StudyError)
        if self.reference is not None and self.reference not in methods:
            raise StudyError(f"reference is {self.reference!r}, expected one of {', '.join(methods)}")
        for figures in self.figures:
            known = isinstance(figures, int) and not isinstance(figures, bool) and 1 <= figures <= MAX_FIGURES
            if figures != BLACK and not known:
                raise StudyError(
                    f"figures has {figures!r}, expected 1 to {MAX_FIGURES}, or {BLACK!r} for one black figure"
                )
        for seed in self.seeds:
            check_seed(seed, "seeds", StudyError)
            self.starts.check_drawn([seed])
        check_spec(self.simulator)
        if self._in_town:
            for scenario in self.scenarios:
                require_on_road(self.starts.range, scenario, _OwnMaps())
        self._check_paint()

    def _check_paint(self) -> None:
        """See that every method can keep to the limits on paint and the variation."""
        for method in self.methods:
            if isinstance(method, PublishedPlan) and (self.paint or self.variation):
                raise StudyError(f"method {method.name} is as published, without [paint] and [variation]; leave it out")
            if tries_by_driving(method) and self.variation:
                raise StudyError(f"method {method.name} drives in the simulator, which varies nothing; leave it out")
            if tries_by_driving(method) and self.paint and self.paint.lacks_asphalt:
                raise StudyError(
                    f"paint.contrast needs the colour of the asphalt for method {method.name}, which drives in the "
                    'simulator, where none is measured; add asphalt, such as "#5a5a5b", to [paint], or leave it out'
                )
        if self.paint is None:
            return
        families: dict[Family, None] = dict.fromkeys(family_of(method) for method in self.methods)
        colours = dict.fromkeys(figures != BLACK for figures in self.figures)
        spaces = [
            SearchSpace(figures=1, family=family, colour=colour, limits=self.paint)
            for family, colour in product(families, colours)
        ]
        for scenario in self.scenarios:
            # The marks of other maps are known when their simulator is open.
            known = site_at(_OwnMaps(), scenario) if self._in_town else replace(site_at(None, scenario), marks=())
            for space in spaces:
                try:
                    space.require_paint(known)
                except PatternError as error:
                    raise StudyError(f"[paint] on {scenario.name}: {error}") from None

    @property
    def _in_town(self) -> bool:
        """Whether the maps are known before any simulator is open."""
        return self.simulator in TOWNS

    @property
    def jobs(self) -> tuple[Job, ...]:
        """The job of every combination, scenario by scenario."""
        more: dict[str, Any] = {"weights": weights_digest(self.controller), **self.shared}
        combinations = product(self.scenarios, self.figures, self.methods, self.seeds)
        return tuple(
            Job(scenario=scenario, figures=figures, method=method, seed=seed, **more)
            for scenario, figures, method, seed in combinations
        )


def load_study(path: AnyPath, *, trust: bool = False) -> Study:
    """Read a study from its plan.

    Args:
        path: the plan's TOML file.
        trust: whether to follow a plan that runs code or calls another machine; a plan may come from anyone.

    Raises:
        StudyError: the file is missing or damaged, a key is unknown, a value makes no sense, or the plan is not trusted
            with what it asks for; says which.
    """
    path = as_path(path)
    content = read_toml(path, StudyError)
    try:
        study = _study(content, path.parent)
        if not trust:
            refuse_untrusted(study.controller, study.simulator, StudyError)
    except RoadproofError as error:
        raise StudyError(f"{path}: {error}") from None
    return study


class _OwnMaps:
    """The maps that the town drives on, without the town."""

    def road_map(self, name: str) -> RoadMap:
        """The map that a scenario names."""
        return load_map(name)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Stated(Conditions):
    """A plan as its file says it."""

    scenarios: tuple[str, ...]
    figures: tuple[int | str, ...]
    method: tuple[dict[str, Any], ...]
    scenario_file: str | None = None
    seeds: tuple[int, ...] = (0,)
    reference: str | None = None


def _study(content: dict[str, Any], folder: Path) -> Study:
    advice = "; version 1 had other keys, see docs/studies.md"
    take_head(content, FORMAT, FORMAT_VERSION, StudyError, advice=advice)
    tables = {"traffic": TrafficPlan, "starts": StartPlan, "paint": PaintLimits, "variation": Variation}
    built = {
        name: build(tables[name], content[name], name, StudyError)
        for name in tables
        if isinstance(content.get(name), dict)
    }
    plan = build(_Stated, content | built, "the study", StudyError)
    listed = plan.scenario_file
    own = BUILTIN_FILE if listed is None else beside(folder, listed, "scenario_file", "study", StudyError)
    return Study(
        scenarios=chosen_scenarios(plan.scenarios, load_scenarios(own)),
        figures=plan.figures,
        methods=tuple(map(method_plan, plan.method)),
        seeds=plan.seeds,
        reference=plan.reference,
        **plan.shared,
    )


_FIRST_WEIGHTS = {
    "cil": "bee9fbf17dd944f3",
    "cil-small": "cfae47e5bb9672bb",
    "pilotnet": "678d88488c9f5042",
    "pilotnet-b": "8ad93a3836078ca6",
    "temporal": "156d6ab596bb6299",
    "waypoint": "f20de22ec6cfb48f",
}
"""Digests of the shipped weights that keys of jobs are older than: those that the published rows were made with."""


def weights_digest(controller: str) -> str:
    """The digest of a controller's files; empty for one that comes with the package, with the weights it had first."""
    found = files_digest(controller)
    return "" if found == _FIRST_WEIGHTS.get(controller) else found
