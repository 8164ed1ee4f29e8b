"""Did it help? Both controllers are attacked afresh, by several kinds of search, on held-out streets.

    judged/SCENARIO/               the attack of the kind that training used, with fresh seeds (`pipeline.stress_test`)
    judged/SCENARIO/kind-1/ …      attacks of kinds that training did not use: a black box, another shape
    judged/SCENARIO/old/           what was found against the controller before, driven over by the one after
    clean/SCENARIO/episodes/*.npz  drives over the bare road

All numbers are driven. Each kind's pattern is driven over from the same starts before and after; none of them chose it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path

import numpy as np

from roadproof.attacks import kept_attack
from roadproof.controllers import Controller
from roadproof.datatypes import Ending, Weather
from roadproof.driving.drive_store import CLEAN, DriveConditions, Episodes, load_episodes
from roadproof.driving.evaluate import evaluate
from roadproof.driving.evaluation import ATTACK, Evaluation
from roadproof.driving.infractions import counted
from roadproof.driving.intervals import Estimate, mean_95
from roadproof.driving.starts import StartOffset
from roadproof.hardening.plan import HardeningPlan
from roadproof.patterns import Pattern, load_pattern
from roadproof.pipeline.stages import OnProgress, recordings_of
from roadproof.scenarios import Scenario
from roadproof.simulators.protocol import Simulator

OLD = "found against the controller before"


@dataclass(frozen=True, kw_only=True, slots=True)
class JudgedAttack:
    """One kind of attack on one street against one controller.

    Args:
        scenario: the name of the street's scenario.
        kind: the kind of attack, in words.
        after: whether the controller is the hardened one, not the one before hardening.
        deviation_m: deviation of each drive over the pattern, metres.
        left_lane: whether each drive over the pattern left its lane.
        starts: where each drive began; of drives in several weathers the same again.
        simulator_calls: number of simulator drives that the attack and these drives took.
        left_out: number of drives that were not made, since without paint the car never came to the canvas.
    """

    scenario: str
    kind: str
    after: bool
    deviation_m: tuple[float, ...]
    left_lane: tuple[bool, ...]
    starts: tuple[StartOffset, ...]
    simulator_calls: int
    left_out: int = 0

    @property
    def mean_m(self) -> float:
        """The mean deviation over the drives, metres."""
        return float(np.mean(self.deviation_m))

    def by_start(self) -> dict[StartOffset, float]:
        """The deviation from each start, metres: drives in several weathers are not independent, and are averaged."""
        runs: dict[StartOffset, list[float]] = {}
        for start, metres in zip(self.starts, self.deviation_m, strict=True):
            runs.setdefault(start, []).append(metres)
        return {start: float(np.mean(each)) for start, each in runs.items()}


@dataclass(frozen=True, slots=True)
class BareDrives:
    """Drives over the bare road.

    Args:
        drives: how many drives there were.
        clean: how many drives arrived in time with nothing having happened.
        failed: scenario and weather of each drive that was not clean.
    """

    drives: int
    clean: int
    failed: tuple[str, ...]


@dataclass(frozen=True, kw_only=True, slots=True)
class BeforeAfter:
    """Both controllers over the strongest attack on each scenario; of one street, scenarios are averaged.

    Args:
        change_m: deviation after less before, metres: mean with 95 % interval.
        over: what the interval is over: "streets", or with one street alone the "starts" of its drives.
        before_m: median over scenarios of the mean deviation before hardening, metres.
        after_m: median over scenarios of the mean deviation after hardening, metres.
        left_lane_before: share of drives that leave the lane before hardening, 0 to 1, over the attack on each scenario
            that leads most of them out of it: not always the one of the largest deviation.
        left_lane_after: the same after hardening.
    """

    change_m: Estimate
    over: str
    before_m: float
    after_m: float
    left_lane_before: float
    left_lane_after: float

    @property
    def better(self) -> bool:
        """Whether all of the interval lies below no change."""
        return self.change_m.high is not None and self.change_m.high < 0

    @property
    def worse(self) -> bool:
        """Whether all of the interval lies above no change."""
        return self.change_m.low is not None and self.change_m.low > 0

    @property
    def leaves_more(self) -> bool:
        """Whether more drives than before leave the lane, by however few metres."""
        return self.left_lane_after > self.left_lane_before

    @property
    def sentence(self) -> str:
        """The comparison in words."""
        c = self.change_m
        counted = f"{c.count} {self.over}" if self.over == "streets" else f"{c.count} starts on one street"
        between = f" ({c.low:+.2f} to {c.high:+.2f} m, 95 % over {counted})" if c.low is not None else ""
        return (
            f"over the strongest attack on held-out streets it deviates by {self.after_m:.2f} m instead of "
            f"{self.before_m:.2f} m in the median, {c.value:+.2f} m on average{between}; over the one that leads it "
            f"out of its lane most often it leaves it in {self.left_lane_after:.0%} of the drives instead of "
            f"{self.left_lane_before:.0%}"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class HardeningVerdict:
    """Whether hardening helped.

    Args:
        outcome: "helped", "did not help" or "not shown".
        compared: both controllers on the streets that could be judged after hardening; None where none could.
        clean_worse: whether fewer drives over the bare road are clean after hardening.
        lost: how many more drives than before could not be judged, since the car never came to the canvas.
        unjudged: names of the streets that could not be judged after hardening.
    """

    outcome: str
    compared: BeforeAfter | None
    clean_worse: bool
    lost: int = 0
    unjudged: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """The verdict as a sentence for people."""
        outcome = {"helped": "It helped", "did not help": "It did not help", "not shown": "That it helped is not shown"}
        paint_alone = self.clean_worse and self.compared is not None and self.compared.better
        begin = "It helped against paint but not on the whole" if paint_alone else outcome[self.outcome]
        told = "no held-out street could be judged after it" if self.compared is None else self.compared.sentence
        told += "; fewer drives over the bare road are clean" if self.clean_worse else ""
        told += f"; in {self.lost} more drives it never came to the canvas" if self.lost else ""
        if self.compared is not None and self.unjudged:
            told += f"; {', '.join(self.unjudged)} could not be judged after it"
        return f"{begin}: {told}."


@dataclass(frozen=True, slots=True)
class Judgement:
    """All that was driven to judge a hardening, before and after it.

    Args:
        judged: every kind of attack on every street, before and after.
        clean: drives over the bare road, before and after.
        unjudged: why the hardened controller could not be attacked or compared on a street, by the street's name, such
            as that it no longer drives there.
        streets: names of the scenarios, those together that lie on one street, which counts once; empty where each has
            a street of its own.
    """

    judged: tuple[JudgedAttack, ...]
    clean: tuple[BareDrives, BareDrives]
    unjudged: dict[str, str] = field(default_factory=dict[str, str])
    streets: tuple[tuple[str, ...], ...] = ()

    def verdict(self) -> HardeningVerdict:
        """The verdict on each street's strongest attack: attackers choose the kind; a mean over kinds would flatter."""
        names = [name for name in dict.fromkeys(each.scenario for each in self.judged) if name not in self.unjudged]
        strongest = [(self._strongest(name, after=False), self._strongest(name, after=True)) for name in names]
        compared = self._compared(strongest) if strongest else None
        worse = self.clean[1].clean < self.clean[0].clean
        lost = sum(two.left_out - one.left_out for one, two in strongest)
        if worse or (compared is not None and compared.worse):
            outcome = "did not help"
        else:
            better = compared is not None and compared.better and not compared.leaves_more
            shown = better and lost <= 0 and not self.unjudged
            outcome = "helped" if shown else "not shown"
        return HardeningVerdict(
            outcome=outcome,
            compared=compared,
            clean_worse=worse,
            lost=max(lost, 0),
            unjudged=tuple(self.unjudged),
        )

    def _compared(self, strongest: Sequence[tuple[JudgedAttack, JudgedAttack]]) -> BeforeAfter:
        """Both controllers over the strongest attack on each scenario, before and after."""
        scenarios = [one.scenario for one, _ in strongest]
        pairs = {one.scenario: _from_common_starts(one, two) for one, two in strongest}
        means = {name: np.mean(list(each.values()), 0) for name, each in pairs.items()}
        known = self.streets or [[name] for name in scenarios]
        streets = [found for names in known if (found := [name for name in names if name in pairs])]
        # The scenarios of one street are driven from the same starts, of which some may have left one out.
        alone = [pairs[name] for name in streets[0]] if len(streets) == 1 else []
        common = [start for start in alone[0] if all(start in each for each in alone)] if alone else []
        if common:
            changes, over = [np.mean([np.diff(each[start]) for each in alone]) for start in common], "starts"
        else:
            changes, over = [np.mean([np.diff(means[name]) for name in street]) for street in streets], "streets"
        before_m, after_m = np.median(list(means.values()), 0)
        return BeforeAfter(
            change_m=mean_95([float(each) for each in changes]),
            over=over,
            before_m=float(before_m),
            after_m=float(after_m),
            left_lane_before=self._left_lane(scenarios, after=False),
            left_lane_after=self._left_lane(scenarios, after=True),
        )

    def _strongest(self, scenario: str, *, after: bool) -> JudgedAttack:
        return strongest_of(self._tried(scenario, after=after))

    def _left_lane(self, scenarios: Sequence[str], *, after: bool) -> float:
        """The share of drives that leave the lane, over the attack on each street that leads most of them out of it."""
        return float(np.mean([left for name in scenarios for left in most_out_of(self._tried(name, after=after))]))

    def _tried(self, scenario: str, *, after: bool) -> list[JudgedAttack]:
        return [each for each in self.judged if (each.scenario, each.after) == (scenario, after)]


def strongest_of(tried: Sequence[JudgedAttack]) -> JudgedAttack:
    """Of the attacks on one street the one over which a controller deviates most."""
    return max(tried, key=lambda each: each.mean_m)


def most_out_of(tried: Sequence[JudgedAttack]) -> tuple[bool, ...]:
    """Whether each drive left its lane over the attack on one street that leads most drives out of it."""
    return max((each.left_lane for each in tried), key=np.mean)


@dataclass(frozen=True, slots=True, eq=False)
class StreetJudge:
    """Attacks a round's controller on one street by every kind of search, and drives over what each found.

    Args:
        plan: the hardening.
        simulator: an open simulator.
        number: the number of the round whose controller is judged; 0 judges the one before hardening.
        scenario: the scenario of the street.
        on_progress: called at every step with the stage's name, the steps done, their number, and a word on them.
    """

    plan: HardeningPlan
    simulator: Simulator
    number: int
    scenario: Scenario
    on_progress: OnProgress

    def judge(self) -> list[JudgedAttack]:
        """Attack with every kind of search, and drive over what was found against the controller before.

        Raises:
            RoadproofError: a stage refuses; the message says why.
        """
        plan, folder = self.plan, self.plan.judged(self.number, self.scenario)
        tested = plan.attack(self.simulator, self.number, self.scenario, self.on_progress, judging=True)
        calls = sum(cost.simulator_calls for cost in tested.cost.values())
        judged = [self._judged(tested.evaluation, plan.budget.searched, calls)]
        controller, recordings = plan.controller(self.number), recordings_of(folder, plan.budget.judge)
        for place, (kind, (method, space)) in zip(self._places(), plan.budget.kinds(plan.space).items(), strict=True):
            title, steps = f"Searching, {kind}", method.steps(plan.budget.judge.objective)
            found = kept_attack(
                place / "attack",
                recordings,
                controller,
                space,
                objective=plan.budget.judge.objective,
                method=method,
                seed=plan.judging_seed,
                device=plan.device,
                on_step=lambda step, best, title=title, steps=steps: self.on_progress(
                    title, step, steps, f"{best:.2f}"
                ),
            )
            judged.append(self._driven(controller, found.pattern, place / "evaluation", kind))
        if self.number:
            old = load_pattern(plan.judged(0, self.scenario) / "pattern.json")
            judged.append(self._driven(controller, old, folder / "old", OLD))
        return judged

    def judge_in(self, weathers: Sequence[Weather]) -> list[JudgedAttack]:
        """Drive over what `judge` found, the strongest of each kind, in other weathers and from the same starts.

        Raises:
            RoadproofError: `judge` has not been here, or a drive fails.
        """
        plan, folders = self.plan, [self.plan.judged(self.number, self.scenario)]
        folders += [place / "attack" for place in self._places()]
        controller, kinds = plan.controller(self.number), (plan.budget.searched, *plan.budget.kinds(plan.space))
        return [
            self._driven(controller, load_pattern(place / "pattern.json"), place / "elsewhere", kind, weathers)
            for kind, place in zip(kinds, folders, strict=True)
        ]

    def _places(self) -> list[Path]:
        """The folders of the kinds of attack that training did not use."""
        folder = self.plan.judged(self.number, self.scenario)
        return [folder / f"kind-{number}" for number in range(1, 1 + len(self.plan.budget.kinds(self.plan.space)))]

    def _driven(
        self, controller: Controller, pattern: Pattern, place: Path, kind: str, weathers: Sequence[Weather] = ()
    ) -> JudgedAttack:
        asked = self.plan.budget.judge
        evaluation = evaluate(
            self.simulator,
            controller,
            self.scenario,
            pattern,
            folder=place,
            driver_name=self.plan.name(self.number),
            weathers=weathers or asked.weathers,
            starts=asked.starts,
            start_range=asked.start_range,
            runs=asked.runs,
            seed=self.plan.judging_seed,
            on_drive=lambda done, total: self.on_progress(f"Driving, {kind}", done, total, ""),
        )
        return self._judged(evaluation, kind, evaluation.simulator_calls)

    def _judged(self, evaluation: Evaluation, kind: str, calls: int) -> JudgedAttack:
        trials = evaluation.of(ATTACK, traffic=False)
        return JudgedAttack(
            scenario=self.scenario.name,
            kind=kind,
            after=self.number > 0,
            deviation_m=tuple(trial.deviation_m for trial in trials),
            left_lane=tuple(trial.leaves_lane for trial in trials),
            starts=tuple(trial.start for trial in trials),
            simulator_calls=calls,
            left_out=evaluation.left_out,
        )


def _from_common_starts(before: JudgedAttack, after: JudgedAttack) -> dict[StartOffset | None, tuple[float, float]]:
    """Both deviations from each start that both have, metres; where they have none in common, of all drives."""
    first, then = before.by_start(), after.by_start()
    common = {start: (metres, then[start]) for start, metres in first.items() if start in then}
    return {**common} or {None: (before.mean_m, after.mean_m)}


def clean_drives(
    simulator: Simulator,
    controller: Controller,
    scenarios: Sequence[Scenario],
    weathers: Sequence[Weather],
    folder: Path,
    *,
    on_drive: Callable[[int, int], object] = lambda _done, _total: None,
) -> BareDrives:
    """Drive scenarios over the bare road in several weathers, and count those in which nothing happened.

    Raises:
        ControllerError, SimulatorError: as `rollout` does.
        OutputError: the folder cannot be written.
    """
    failed: list[str] = []
    asked = list(dict.fromkeys(product(scenarios, weathers)))
    for done, (scenario, weather) in enumerate(asked, 1):
        episodes = Episodes.of(simulator, controller, scenario, {}, folder / scenario.name)
        drive = DriveConditions(paint=CLEAN, weather=weather)
        episodes.make(simulator, drive)
        (episode,) = load_episodes(episodes.folder, [episodes.file(drive)])
        if episode.ending is not Ending.GOAL_REACHED or counted(episode.events):
            failed.append(f"{scenario.name}, {weather}")
        on_drive(done, len(asked))
    return BareDrives(len(asked), len(asked) - len(failed), tuple(failed))
