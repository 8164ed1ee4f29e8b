"""The stages of a stress test, each of which goes on from what its folder holds (`pipeline.stress_test`)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

from roadproof.attacks import AttackResult, Candidate, Cheapest, kept_attack, kept_cheapest, parse_groups
from roadproof.attacks.cheapest import MOST_LEVELS
from roadproof.attacks.groups import Group
from roadproof.attacks.objective import own_objective, variation_of
from roadproof.calibration import Calibrated, calibrate, replays_needed
from roadproof.controllers import Controller
from roadproof.controllers.identity import identity_of, parts_of
from roadproof.drives import Drives, record
from roadproof.driving.evaluate import evaluate
from roadproof.driving.evaluation import Evaluation
from roadproof.driving.starts import require_on_road
from roadproof.io.identity import digest, stated
from roadproof.io.known import known_by, without_addresses
from roadproof.patterns import Pattern, raster
from roadproof.pipeline.budget import Budget
from roadproof.pipeline.fidelity import Fidelity, measure_fidelity
from roadproof.pipeline.film import film_drives
from roadproof.pipeline.limit_costs import LIMIT_COSTS, LimitCosts, search_without
from roadproof.pipeline.prediction import Prediction, predict
from roadproof.pipeline.rerecording import Rounds, best_of, round_folder, search_on
from roadproof.pipeline.selection import UNITS, Selection, chosen_by, select_by_driving
from roadproof.processes import Pool
from roadproof.recordings import RecordingSet, load_recordings, pooled
from roadproof.roads.marks import marks_of, site_at
from roadproof.scenarios import Scenario, identity
from roadproof.search_space import SearchSpace
from roadproof.simulators.protocol import Simulator, world_of

CHEAPEST = "cheapest"
"""The folder of a run with the least paint for a deviation."""


OnProgress: TypeAlias = Callable[[str, int, int, str], object]
"""Called with the name of a stage, how many of its steps are done, how many there are, and a word on the last one."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Stages:
    """The stages of one run; its fields are the arguments of `stress_test`."""

    simulator: Simulator
    controller: Controller
    scenario: Scenario
    folder: Path
    budget: Budget
    space: SearchSpace
    seed: int
    controller_name: str
    device: str
    pool: Pool[Simulator]
    on_progress: OnProgress

    @property
    def made_of(self) -> dict[str, object]:
        """What identifies this run, by name."""
        size = self.simulator.input.height_px, self.simulator.input.width_px
        # Runs in the town are older than the content of maps.
        scenario = {name: value for name, value in identity(self.scenario).items() if name != "map" or value}
        return {
            "scenario": scenario,
            "budget": without_addresses(repr(self.budget)),
            "objective": own_objective(self.budget.objective),
            "space": self.space.stated,
            "variation": variation_of(self.budget.objective),
            "seed": self.seed,
            "controller": self.controller_name,
            **parts_of(self.controller, size),
            "paint": self.simulator.paint,
            "world": world_of(self.simulator),
        }

    def record(self, number: int) -> Drives:
        """Record the drives past the bare canvas in the weather of this number."""
        budget, wanted = self.budget, self.budget.trajectories
        total = wanted.count * len(budget.recorded_in)
        return record(
            self.simulator,
            self.controller,
            self.scenario,
            weather=budget.recorded_in[number],
            trajectories=wanted,
            window=budget.window,
            seed=self.seed,
            driver_name=self.controller_name,
            folder=self._folder_of(number) / "record",
            pool=self.pool,
            on_drive=lambda done: self.on_progress("Recording", number * wanted.count + done, total, ""),
        )

    def calibrate(self, number: int, drives: Drives) -> RecordingSet:
        """Calibrate the drives of the weather of this number."""
        place, each = self._folder_of(number), replays_needed(len(drives.drives), self.budget.calibration)
        done, total = Calibrated.kept(place, drives, self.budget.calibration), each * len(self.budget.recorded_in)
        if done is None:
            done = calibrate(
                self.simulator,
                drives,
                self.budget.calibration,
                folder=place / "calibration",
                pool=self.pool,
                on_call=lambda made: self.on_progress("Calibrating", number * each + made, total, ""),
            )
            done.save(place)
        if done.recordings.marks is None:
            # Of a calibration that is older than marks, or by a simulator without a map.
            return replace(done.recordings, marks=marks_of(self.simulator, self.scenario))
        return done.recordings

    def groups(self, recordings: RecordingSet) -> tuple[Group, ...]:
        """The groups to attack: the method's own, or all drives pooled if the budget says so."""
        budget = self.budget
        return parse_groups("all", recordings) if budget.pooled else budget.method.groups(recordings, budget.objective)

    def attack(self, recordings: RecordingSet) -> AttackResult:
        """Search for patterns on the recordings."""
        budget = self.budget
        steps = budget.method.steps(budget.objective)
        return kept_attack(
            self.folder / "attack",
            recordings,
            self.controller,
            self.space,
            objective=budget.objective,
            method=budget.method,
            groups=self.groups(recordings),
            seed=self.seed,
            device=self.device,
            pool=self.pool,
            on_step=lambda step, best: self.on_progress("Searching", step, steps, f"{best:.2f}"),
        )

    def select(self, found: AttackResult, drives: Drives) -> Selection:
        """Drive over the strongest candidates once each, and choose one."""
        total, unit = 1 + min(self.budget.select, len(found.candidates)), UNITS[chosen_by(found.candidates)]
        return self._drive_over(
            found.candidates,
            self.budget.select,
            self.folder,
            drives,
            lambda done, best: self.on_progress("Verifying by driving", done, total, f"{best:.2f} {unit}"),
        )

    def search_on(self, drives: Drives, recordings: RecordingSet, found: AttackResult, selection: Selection) -> Rounds:
        """Run the re-recording rounds that the budget asks for."""
        return search_on(
            self.simulator,
            self.controller,
            drives,
            recordings,
            self.groups(recordings),
            found,
            selection,
            objective=self.budget.objective,
            rounds=self.budget.rounds,
            best=self.budget.select,
            method=self.budget.calibration,
            folder=self.folder,
            device=self.device,
            pool=self.pool,
            on_step=lambda done, total, word: self.on_progress("Searching on", done, total, word),
        )

    def cheapest(
        self, recordings: RecordingSet, found: AttackResult, wanted_m: float, drives: Drives
    ) -> tuple[Cheapest, Selection] | None:
        """The least paint for a deviation, and the drive over it; None if nothing found reaches that deviation."""
        folder, total = self.folder / CHEAPEST, MOST_LEVELS + 1
        less = kept_cheapest(
            folder,
            recordings,
            self.controller,
            found,
            wanted_m,
            groups=self.groups(recordings),
            objective=self.budget.objective,
            device=self.device,
            on_level=lambda level, area: self.on_progress("Looking for less paint", level, total, f"{area:.2f} m²"),
        )
        if less is None:
            return None
        driven = self._drive_over(
            [less.candidate],
            1,
            folder,
            drives,
            lambda _done, _best: self.on_progress("Looking for less paint", total, total, ""),
        )
        return less, driven

    def limit_costs(self, recordings: RecordingSet, found: AttackResult, drives: Drives) -> tuple[LimitCosts, int]:
        """What each limit on paint costs, predicted and driven once each; and the number of drives made for it."""
        file, title = self.folder / LIMIT_COSTS, "Searching without limits"
        searched = search_without(
            file.parent,
            recordings,
            self.controller,
            found,
            objective=self.budget.objective,
            groups=self.groups(recordings),
            device=self.device,
            pool=self.pool,
            on_step=lambda done, total, word: self.on_progress(title, done, total, word),
        )
        patterns = [found.candidates[0], *(each.candidates[0] for each in searched.values())]
        driven = self._drive_over(patterns, len(patterns), file.parent, drives)
        costs = LimitCosts.of(found, searched).driven(driven)
        costs.save(file)
        return costs, driven.simulator_calls

    def predict(
        self, recordings: RecordingSet, pattern: Pattern, selection: Selection | None, rounds: Rounds | None
    ) -> Prediction | None:
        """Predict the path of the chosen pattern, beside the one driven over it; the run folder keeps the result."""
        chosen = best_of(selection, rounds)
        if chosen is None or not self.budget.is_predicted:
            return None
        path = self.folder / "prediction.npz"
        size = self.simulator.input.height_px, self.simulator.input.width_px
        driven = [chosen.driven[chosen.chosen].trial.clean, chosen.driven[chosen.chosen].trial.painted]
        told = [known_by(pattern), driven, recordings.digest(), identity_of(self.controller, size)]
        made_of = digest(stated(told))[:16]
        if path.exists() and (kept := Prediction.load(path)).made_of == made_of:
            return kept
        done = enumerate(() if rounds is None else rounds.done, 1)
        number = next((k for k, each in done if each.selection is chosen), 0)
        clean, painted = chosen.episodes(round_folder(self.folder, number) / "selection")
        prediction = predict(recordings, self.controller, pattern, clean, painted, device=self.device)
        prediction = replace(prediction, made_of=made_of)
        prediction.save(path)
        return prediction

    def evaluate(self, pattern: Pattern) -> Evaluation:
        """Drive over the chosen pattern in many conditions, to measure how bad it is."""
        return evaluate(
            self.simulator,
            self.controller,
            self.scenario,
            pattern,
            folder=self.folder / "evaluation",
            driver_name=self.controller_name,
            weathers=self.budget.weathers,
            starts=self.budget.starts,
            start_range=self.budget.start_range,
            runs=self.budget.runs,
            seed=self.seed,
            pool=self.pool,
            on_drive=lambda done, total: self.on_progress("Evaluating", done, total, ""),
        )

    def film(
        self, evaluation: Evaluation, pattern: Pattern, drives: Drives, recordings: RecordingSet
    ) -> Fidelity | None:
        """Film two drives and compare composites with renders, for the report."""
        folder, shown = self.folder / "evaluation", evaluation.shown()
        start = shown.start.of(evaluation.scenario)
        film_drives(self.simulator, start, (shown.clean, shown.painted), raster(pattern), folder, pool=self.pool)
        return measure_fidelity(
            self.simulator,
            self.controller,
            self.scenario,
            pattern,
            recordings,
            folder,
            weather=drives.settings.weather,
            clean=drives.drives[0].episode,
            device=self.device,
            pool=self.pool,
        )

    def _drive_over(
        self,
        candidates: Sequence[Candidate],
        best: int,
        place: Path,
        drives: Drives,
        on_drive: Callable[[int, float], object] = lambda _done, _effect: None,
    ) -> Selection:
        """Drive over the strongest candidates once each (`select_by_driving`); a folder keeps it as its selection."""
        return select_by_driving(
            self.simulator,
            self.controller,
            self.scenario,
            candidates,
            best=best,
            weather=self.budget.recorded_in[0],
            folder=place / "selection",
            # The simulator repeats itself, so the recorded clean drive is the one to compare with.
            clean=drives.drives[0].episode,
            pool=self.pool,
            on_drive=on_drive,
        )

    def _folder_of(self, number: int) -> Path:
        """The folder of the drives in the weather of this number."""
        return _folder_of(self.folder, self.budget, number)


def recordings_of(run: Path, budget: Budget) -> RecordingSet:
    """The recordings that a run of this budget was searched on, in all of its weathers.

    Raises:
        RecordingError: some are missing or damaged.
    """
    places = [_folder_of(run, budget, k) / "recordings" for k in range(len(budget.recorded_in))]
    if len(places) == 1:
        return load_recordings(places[0])
    return pooled({str(each): load_recordings(place) for each, place in zip(budget.recorded_in, places, strict=True)})


def _folder_of(run: Path, budget: Budget, number: int) -> Path:
    return run / budget.recorded_in[number] if number else run


def check_street(simulator: Simulator, scenario: Scenario, space: SearchSpace, budget: Budget) -> None:
    """Check, before anything is driven, that limits leave patterns on a street, and that drives start on its road.

    Raises:
        PatternError: the limits leave none.
        EpisodeError: the range of starts reaches off the road.
    """
    if space.limits is not None:
        space.require_paint(site_at(simulator, scenario))
    if budget.starts:
        require_on_road(budget.start_range, scenario, simulator)
