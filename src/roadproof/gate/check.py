"""A check: every case of a plan driven and judged.

    OUT/check.json      verdict, and every case with its drives (`gate.result`)
    OUT/junit.xml       a test case each, for a CI to read
    OUT/summary.md      for people, with worst.jpg: the worst drive of what does not pass
    OUT/drives/         every drive by scenario; what is there is not driven again
    OUT/patterns/       the random and the fresh patterns, by scenario
    OUT/fresh/          the attacks of a full check

None of the first four is there before all cases are judged.
"""

from __future__ import annotations

import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import roadproof
from roadproof.attacks import site_of
from roadproof.controllers import Controller
from roadproof.controllers.checks import require_usable
from roadproof.controllers.identity import architecture_of, identity_of
from roadproof.driving.drive_store import EPISODES, Episodes, load_episodes
from roadproof.driving.starts import NOMINAL, require_on_road
from roadproof.errors import CanvasNotReachedError, CheckError
from roadproof.gate.outputs import WORST, WORST_COLUMNS, write_junit, write_summary, write_worst
from roadproof.gate.places import Place, command_of, places_of
from roadproof.gate.plan import FILE, CheckPlan, Key, fresh
from roadproof.gate.result import AGAIN, Case, CheckResult, JudgedDrive, load_reference, worst_of
from roadproof.gate.stretch import Paint, Stretch, known_paints, measures_of
from roadproof.gate.verdict import Kind, Status, judge
from roadproof.io.files import AnyPath, as_path
from roadproof.io.identity import digest, stated
from roadproof.io.known import known_by
from roadproof.io.locks import working_in
from roadproof.patterns import raster, read_paint, require_visible, save_pattern
from roadproof.pipeline.film import STRIP, STRIP_SIZE, Strip, film_drives, forget_film, pictures_at
from roadproof.pipeline.stress_test import OnProgress, StressTest, stress_test
from roadproof.processes import require_picklable
from roadproof.recorded.simulator import RecordedSimulator
from roadproof.recordings import evenly
from roadproof.roads.marks import site_at
from roadproof.scenarios import Scenario, identity
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import Simulator, begun_in, world_of

JUNIT, SUMMARY = "junit.xml", "summary.md"
PATTERNS, DRIVES = "patterns", "drives"
OUTPUTS = (FILE, JUNIT, SUMMARY, WORST)


def run_check(
    plan: CheckPlan,
    controller: Controller,
    folder: AnyPath,
    *,
    compare: bool = True,
    device: str = "cpu",
    processes: int = 1,
    on_progress: OnProgress = lambda _stage, _done, _total, _word: None,
) -> CheckResult:
    """Drive every case of a plan, judge it by the plan's limits, and write what came of it.

    Args:
        plan: the cases to drive, and the limits that they are judged by.
        controller: the controller that is checked.
        folder: the folder for the results; an interrupted check goes on from what it holds.
        compare: whether to compare with the plan's reference.
        device: the torch device on which attacks and recorded worlds compute, such as "cpu" or "cuda".
        processes: how many drives are made at once, each in a process with a world of its own.
        on_progress: called in every stage with the stage's name, the steps done, their number, and a word on them.

    Raises:
        CheckError: the reference is missing, damaged, or was made under other conditions, or the folder is its own
            or the stored patterns'.
        PatternError: a pattern paints nothing, or the limits on paint leave none.
        ControllerError: the controller raises, answers wrongly, or cannot travel to several processes.
        SimulatorError: the simulator is not there or stopped answering.
        EpisodeError: the range of starts reaches off the road of a scenario.
        OutputError: the folder cannot be written, or another process works in it.
    """
    before: Mapping[Key, Case] = {}
    begun, folder = time.perf_counter(), as_path(folder)
    architecture = architecture_of(controller)
    if processes > 1:
        require_picklable(controller)
    with working_in(folder):
        clear(folder, None if plan.reference is None else plan.reference.parents[1])
        _keep_apart(folder, plan)
        _forget(folder)
        if compare and plan.reference is not None:
            before = load_reference(plan.reference, architecture, plan)
        run = _Check(plan, controller, folder, before, device, processes, on_progress)
        places = places_of(plan, device)
        for place in places:
            run.require(place)
        cases = tuple(case for place in places for case in run.cases(place))
        result = CheckResult(
            roadproof=roadproof.__version__,
            controller=plan.controller,
            architecture=architecture,
            budget=plan.budget,
            compared=bool(before),
            cases=cases,
        )
        pictured = run.film(places, cases)
        write_junit(result, time.perf_counter() - begun, folder / JUNIT)
        write_summary(result, pictured, folder / SUMMARY)
        result.save(folder / FILE)
    return result


def clear(folder: Path, references: Path | None) -> None:
    """Take away what an earlier check left for others, so that nobody takes it for this one's.

    Args:
        folder: the folder for the results of a check.
        references: the folder in which the plan keeps its references; None where it names none.

    Raises:
        CheckError: the folder is one for references, or holds a result, or files of such names, that no check left
            there.
    """
    named = references is not None and folder.resolve().parent == references.resolve()
    # A check leaves its result beside its summary; a result alone is one that somebody keeps, whatever a plan says.
    if named or ((folder / FILE).is_file() and not (folder / SUMMARY).is_file()):
        whose = "kept for a reference of the plan" if named else f"no check's own, without {SUMMARY} beside it"
        raise CheckError(f"{folder / FILE} is {whose}; choose another folder for the results")
    found = [folder / name for name in OUTPUTS if (folder / name).exists()]
    if found and not ((folder / FILE).is_file() or any((folder / DRIVES).glob(f"*/{EPISODES}"))):
        raise CheckError(
            f"{found[0]} is no check's, without {FILE} or a check's {DRIVES} beside it; choose another folder"
        )
    for path in found:
        path.unlink()


def _forget(folder: Path) -> None:
    """Take away the patterns and films that an earlier check left; one of fewer would leave some beside its own."""
    drawn = re.compile(r"(random-\d+-\d+|(fresh|not-searched)-\d+)\.(json|png)")
    for path in [each for each in (folder / PATTERNS).rglob("*") if drawn.fullmatch(each.name)]:
        path.unlink()
    for scenario in (folder / DRIVES).glob("*/"):
        forget_film(scenario)


def _keep_apart(folder: Path, plan: CheckPlan) -> None:
    """See that no pattern of the results would be a stored one of the next check."""
    out = folder.resolve()
    for place in {stored.path.resolve().parent for each in plan.stored.values() for stored in each}:
        if place.is_relative_to(out / PATTERNS) or out.is_relative_to(place):
            raise CheckError(f"the results would lie among the plan's patterns in {place}; choose another folder")


@dataclass(frozen=True, slots=True, eq=False)
class _Check:
    """A check that is under way: the arguments of `run_check`, and the cases of the reference by their keys."""

    plan: CheckPlan
    controller: Controller
    folder: Path
    before: Mapping[Key, Case]
    device: str
    processes: int
    on_progress: OnProgress

    def require(self, place: Place) -> None:
        """See that a place can be driven in, by this controller, and compared with what the reference has of it."""
        with place.factory() as world:
            size = (world.input.height_px, world.input.width_px)
            require_usable(self.controller, size=size, device=self.device, gradients=self._attacks)
            scenario = begun_in(world, place.scenario)
            require_on_road(self.plan.starts.range, scenario, world)
            stretch = self._stretch(place, world, scenario, self._known_paints(place, world, scenario))
            for key, (conditions, _) in self._told(place, stretch).items():
                stored = self.before.get(key)
                if stored is not None and stored.conditions != conditions:
                    raise CheckError(
                        f"the reference {self.plan.reference} has {stored} with other patterns, starts, seeds or "
                        f"recordings; {AGAIN}"
                    )

    def cases(self, place: Place) -> list[Case]:
        """Drive the cases of a place, and judge them."""
        plan = self.plan
        with place.factory() as world:
            scenario = begun_in(world, place.scenario)
            paints = self._known_paints(place, world, scenario)
            if self._attacks:
                bare = self._stretch(place, world, scenario, ())
                self._drive(place, bare)
                drives_well = any(not each.wrong for each in bare.bare(plan.weathers[0]))
                missing = f"on the bare road no drive went well in {plan.weathers[0]}"
                paints += tuple(
                    self._fresh(world, scenario, seed) if drives_well else self._unsearched(scenario, seed, missing)
                    for seed in plan.seeds
                )
            stretch = self._stretch(place, world, scenario, paints)
            self._drive(place, stretch)
            told = self._told(place, stretch)
            return [self._judged(place, stretch, key, *each) for key, each in told.items()]

    @property
    def _attacks(self) -> bool:
        return self.plan.budget == "full"

    def _known_paints(self, place: Place, world: Simulator, scenario: Scenario) -> tuple[Paint, ...]:
        site = site_of(world.recordings) if isinstance(world, RecordedSimulator) else site_at(world, scenario)
        patterns = self.folder / PATTERNS / scenario.name
        # Random ones keep to limits by the asphalt that is measured in each weather's recordings.
        patterns = patterns if self._attacks else patterns.joinpath(*place.weathers)
        return known_paints(self.plan, scenario, site, patterns)

    def _told(self, place: Place, stretch: Stretch) -> dict[Key, tuple[str, tuple[Paint, ...]]]:
        """What each case of a place depends on, and its patterns."""
        return {
            key: (stretch.conditions(key, painted), painted)
            for key in self.plan.keys
            if key[0] == place.scenario.name and key[1] in place.weathers
            for painted in [tuple(paint for paint in stretch.paints if (paint.kind, paint.case) == key[2:])]
        }

    def _drive(self, place: Place, stretch: Stretch) -> None:
        stage = f"Driving {place.scenario.name}, {', '.join(place.weathers)}"
        stretch.drive(place.factory, self.processes, lambda done, total: self.on_progress(stage, done, total, ""))

    def _stretch(self, place: Place, world: Simulator, scenario: Scenario, paints: tuple[Paint, ...]) -> Stretch:
        images = {paint.name: raster(paint.pattern) for paint in paints}
        for paint in paints:
            require_visible(images[paint.name], f"{scenario.name}, {paint.path.name}")
        episodes = Episodes.of(world, self.controller, scenario, images, self.folder / DRIVES / scenario.name)
        return Stretch(plan=self.plan, world=world, weathers=place.weathers, paints=paints, episodes=episodes)

    def _judged(self, place: Place, stretch: Stretch, key: Key, conditions: str, paints: tuple[Paint, ...]) -> Case:
        plan, (scenario, weather, kind, name) = self.plan, key
        drives = stretch.bare(weather) if kind is Kind.BARE else stretch.painted(weather, paints)
        measures = measures_of(kind, drives)
        stored = self.before.get(key)
        left_out = sum(len(paint.drives) for paint in paints) - len(drives) if paints else 0
        is_new = bool(self.before) and stored is None
        against = stored and stored.measures
        unjudged = next((paint.unsearched for paint in paints if paint.unsearched), "")
        status, reasons = judge(
            measures, plan.limits[kind], plan.change, against, left_out, is_new=is_new, unjudged=unjudged
        )
        # Where there is none over paint, the drives past the bare road are to be seen.
        shown = paints or stretch.paints
        first = next((seed for paint in shown for seed, _ in paint.drives), plan.seeds[0])
        worst = worst_of(drives) or JudgedDrive(seed=first, start=NOMINAL, wrong="", clean="")
        pattern = worst.paint or str(shown[0].path)
        return Case(
            scenario=scenario,
            weather=weather,
            kind=kind,
            name=name,
            conditions=conditions,
            measures=dict(measures),
            status=status,
            reasons=reasons,
            command=command_of(plan, place, weather, pattern, worst.seed, self.folder / "show"),
            drives=drives,
        )

    def _fresh(self, world: Simulator, scenario: Scenario, seed: int) -> Paint:
        """The pattern that a fresh attack finds in a scenario, where the car can be recorded there."""
        plan, name = self.plan, f"fresh-{seed}"
        try:
            found = self._attacked(world, scenario, seed)
        except CanvasNotReachedError as error:
            return self._unsearched(scenario, seed, str(error))
        path = self.folder / PATTERNS / scenario.name / f"{name}.json"
        save_pattern(found.pattern, path)
        drives = tuple((each, k) for each in plan.seeds for k in range(plan.starts.count))
        return Paint(name, Kind.FRESH, fresh(seed), found.pattern, path, drives)

    def _attacked(self, world: Simulator, scenario: Scenario, seed: int) -> StressTest:
        """A fresh attack; its folder is that of this very attack alone."""
        plan, space = self.plan, SearchSpace(figures=self.plan.figures, limits=self.plan.paint)
        who = identity_of(self.controller, (world.input.height_px, world.input.width_px))
        place = identity(scenario), world_of(world), world.paint
        asked = digest(stated(known_by([who, plan.controller, plan.attack, space, *place])))
        return stress_test(
            world,
            self.controller,
            scenario,
            self.folder / "fresh" / f"{scenario.name}-{seed}-{asked[:8]}",
            budget=plan.attack,
            space=space,
            seed=seed,
            controller_name=plan.controller,
            device=self.device,
            film=False,
            on_progress=lambda stage, done, total, word: self.on_progress(
                f"{scenario.name}, seed {seed}: {stage}", done, total, word
            ),
        )

    def _unsearched(self, scenario: Scenario, seed: int, why: str) -> Paint:
        """Any pattern, to see the bare road beside: no attack begins where the car does not arrive without paint."""
        path = self.folder / PATTERNS / scenario.name / f"not-searched-{seed}.json"
        pattern = SearchSpace(figures=self.plan.figures).drawn(1, seed)[0]
        save_pattern(pattern, path)
        return Paint(path.stem, Kind.FRESH, fresh(seed), pattern, path, (), f"no attack could be made: {why}")

    def film(self, places: Sequence[Place], cases: Sequence[Case]) -> Case | None:
        """Leave a picture, and say which case it shows.

        It is the one with the drive furthest astray of the painted cases that do not pass, or else one of the bare road
        that does not, or else of all painted ones.
        """
        painted = [(case, worst) for case in cases if case.kind is not Kind.BARE and (worst := worst_of(case.drives))]
        wrong = [each for each in painted if each[0].status is not Status.PASSED]
        not_clean = [case for case in cases if case.kind is Kind.BARE and case.status is not Status.PASSED]
        spoilt = [(case, drive) for case in not_clean for drive in case.drives if drive.wrong]
        if not painted and not spoilt:
            return None
        case, worst = spoilt[0] if spoilt and not wrong else max(wrong or painted, key=lambda each: each[1].deviation_m)
        place = next(p for p in places if p.scenario.name == case.scenario and case.weather in p.weathers)
        drives = self.folder / DRIVES / case.scenario
        with place.factory() as world:
            start = worst.start.of(begun_in(world, place.scenario))
            if case.kind is Kind.BARE:
                (episode,) = load_episodes(drives, [worst.clean])
                steps = evenly(len(episode), WORST_COLUMNS).tolist()
                pictures = [pictures_at(world, episode, start, steps, STRIP_SIZE)]
            else:
                film_drives(world, start, (worst.clean, worst.painted), read_paint(Path(worst.paint)), drives)
                strip = Strip.load(drives / STRIP)
                pictures = [strip.clean, strip.painted]
        write_worst(pictures, self.folder / WORST)
        return case
