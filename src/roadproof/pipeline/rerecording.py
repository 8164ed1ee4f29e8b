"""Re-recording rounds: searching on where the attacked car really went.

Composited frames stand for drives near the recorded ones. Once a pattern bites, the car is elsewhere, so each round
drives where the last pattern took it, over the bare road, calibrates that drive as the others, adds it to them, and
searches on from the patterns that deviated most when driven. Rounds are not monotone: the best *driven* of all counts.

    RUN/round-1/round-1/       the drive over the bare road (`drives.record_along`)
    RUN/round-1/calibration/   how good its calibration is; its replays are in RUN/calibration/
    RUN/round-1/recordings/    it and the clean one, calibrated
    RUN/round-1/attack/        what was found with it (`attacks.attack`)
    RUN/round-1/selection/     which of that was strongest when driven (`pipeline.selection`)
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, takewhile
from pathlib import Path

import torch

from roadproof.attacks import AttackResult, Candidate, GradOpt, Method, Objective, kept_attack
from roadproof.attacks.groups import Direction, Group, parse_groups
from roadproof.calibration import Calibrated, CalibrationMethod, CalibrationReport, calibrate, replays_needed
from roadproof.controllers import Controller
from roadproof.drives import Drive, Drives, record_along
from roadproof.drives.folder import read_drive
from roadproof.driving.episode import Episode
from roadproof.errors import CalibrationError, RecordingError
from roadproof.pipeline.selection import Selection, select_by_driving
from roadproof.processes import Pool
from roadproof.recordings import Recording, RecordingSet
from roadproof.simulators.protocol import Simulator


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ReRecordingRound:
    """One re-recording round: its search and the drives over what it found.

    Args:
        attack: result of the search; its numbers are predictions of the surrogate.
        selection: outcome of the drives over its candidates, closed loop.
        simulator_calls: number of drives in this round: recording, calibration and selection.
    """

    attack: AttackResult
    selection: Selection
    simulator_calls: int


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Rounds:
    """The outcome of all re-recording rounds.

    Args:
        first: selection before the rounds.
        done: finished rounds, in order.
        stopped: why there are fewer rounds than asked for; empty if there are not.
    """

    first: Selection
    done: tuple[ReRecordingRound, ...]
    stopped: str = ""

    @property
    def best(self) -> Selection:
        """The selection with the largest deviation when driven, of all rounds and the one before."""
        return max((self.first, *(each.selection for each in self.done)), key=lambda chosen: chosen.deviation_m)

    @property
    def simulator_calls(self) -> int:
        """Number of simulator drives in all rounds."""
        return sum(each.simulator_calls for each in self.done)

    @staticmethod
    def kept(folder: Path, first: Selection) -> Rounds | None:
        """The finished rounds in the folder of a run, after the selection before them; None if there is none.

        Raises:
            RoadproofError: a round is damaged.
        """
        places = takewhile(
            lambda place: (place / "selection" / "selection.json").exists(),
            (round_folder(folder, number) for number in count(1)),
        )
        done = tuple(map(_read_round, places))
        return Rounds(first=first, done=done) if done else None


def round_folder(folder: Path, number: int) -> Path:
    """The folder of a round in the folder of its run; round 0 is what was done before, in the run itself."""
    return folder / f"round-{number}" if number else folder


def best_of(selection: Selection | None, rounds: Rounds | None) -> Selection | None:
    """The selection that a run goes by: the best of all rounds; None where nothing was driven to choose."""
    return selection if rounds is None else rounds.best


def search_on(
    simulator: Simulator,
    controller: Controller,
    drives: Drives,
    recordings: RecordingSet,
    groups: Sequence[Group],
    found: AttackResult,
    selection: Selection,
    *,
    objective: Objective,
    rounds: int,
    best: int,
    method: CalibrationMethod,
    folder: Path,
    device: torch.device | str = "cpu",
    pool: Pool[Simulator] | None = None,
    on_step: Callable[[int, int, str], object] = lambda _done, _total, _word: None,
) -> Rounds:
    """Search on for some rounds, each with the recording of one more drive.

    A round is the search before, but no starts compete: every start is a pattern that was found before. It ends the
    rounds when the drive cannot be calibrated, because it shows too little of the canvas.

    Args:
        simulator: an open simulator.
        controller: controller that is attacked; it computes on `device`.
        drives: drives recorded without paint; they give scenario and weather.
        recordings: calibrated recordings that the search before used.
        groups: groups of drives of the search before.
        found: result of the search before.
        selection: selection after the search before, whose drives are in `folder`/selection.
        objective: objective of the search before, which every round's search shares.
        rounds: number of rounds.
        best: number of candidates driven over in each round.
        method: calibration method for the recorded drives.
        folder: path of the run folder; what it holds is not done again.
        device: torch device on which the search computes.
        pool: processes that are open already and make the replays and the drives over candidates instead.
        on_step: called with the number of steps done, the number of all steps, and a word on the current one.

    Raises:
        RoadproofError: as recording, search and selection do; a failed calibration ends the rounds without an error.
    """
    clean = Drives(settings=drives.settings, drives=drives.drives[:1])
    steps = _gone_on(found.method).steps(objective)
    per_round = steps + best
    known, last, drives_of_last = _ranked(found, selection), selection, folder / "selection"
    done: list[ReRecordingRound] = []
    for number in range(1, rounds + 1):
        place = round_folder(folder, number)
        tell = partial(_tell, on_step, per_round * (number - 1), per_round * rounds)
        tell(0, "recording")
        bare, driven = last.episodes(drives_of_last)
        try:
            added, calls = _recorded(simulator, controller, clean, driven, method, place, pool)
        except _ShowsTooLittleError as error:
            return Rounds(first=selection, done=tuple(done), stopped=f"round {number}: {error}")
        recordings = replace(recordings, recordings=(*recordings.recordings, added))
        again = _search_again(
            place / "attack",
            recordings,
            controller,
            objective,
            groups,
            found,
            [candidate for _, candidate in known],
            device,
            pool,
            lambda step, best, tell=tell: tell(step, f"{best:.2f}"),
        )
        chosen = select_by_driving(
            simulator,
            controller,
            drives.settings.scenario,
            again.candidates,
            best=best,
            weather=drives.settings.weather,
            folder=place / "selection",
            clean=bare,
            pool=pool,
            on_drive=lambda n, far, tell=tell: tell(steps + n - 1, f"{far:.2f} m"),
        )
        done.append(ReRecordingRound(attack=again, selection=chosen, simulator_calls=calls + chosen.simulator_calls))
        known = sorted([*_ranked(again, chosen), *known], key=lambda each: -each[0])
        last, drives_of_last = chosen, place / "selection"
    return Rounds(first=selection, done=tuple(done))


def _tell(on_step: Callable[[int, int, str], object], before: int, whole: int, now: int, word: str) -> None:
    on_step(before + now, whole, word)


def _search_again(
    place: Path,
    recordings: RecordingSet,
    controller: Controller,
    objective: Objective,
    groups: Sequence[Group],
    found: AttackResult,
    starts: Sequence[Candidate],
    device: torch.device | str,
    pool: Pool[Simulator] | None,
    on_step: Callable[[int, float], object],
) -> AttackResult:
    """The search before, gone on with from what is known, on one more recorded drive."""
    if groups[0].direction is Direction.EITHER:
        groups = parse_groups("all", recordings)
    return kept_attack(
        place,
        recordings,
        controller,
        found.space,
        objective=objective,
        method=_gone_on(found.method),
        groups=groups,
        seed=found.seed,
        starts=starts,
        device=device,
        pool=pool,
        on_step=on_step,
    )


def _ranked(found: AttackResult, selection: Selection) -> list[tuple[float, Candidate]]:
    """The candidates found with their deviation when driven, metres: the largest first, then those not driven."""
    driven = {each.rank: each.trial.deviation_m for each in selection.driven}
    ranked = [(driven.get(rank, -1.0), candidate) for rank, candidate in enumerate(found.candidates, 1)]
    return sorted(ranked, key=lambda each: -each[0])


def _recorded(
    simulator: Simulator,
    controller: Controller,
    clean: Drives,
    last: Episode,
    method: CalibrationMethod,
    place: Path,
    pool: Pool[Simulator] | None,
) -> tuple[Recording, int]:
    """The recording of the last pattern's path, without paint and calibrated, and the number of drives it took."""
    read_drive(place.name, place)  # one that is damaged is told as such, and ends no round
    with _what_is_shown():
        drive = record_along(simulator, controller, clean, last, name=place.name, folder=place)
    both = replace(clean, drives=(*clean.drives, drive))
    calibrated = Calibrated.kept(place, both, method)
    if calibrated is None:
        # The clean drive's replays lie there already and are not driven again.
        with _what_is_shown():
            calibrated = calibrate(simulator, both, method, folder=place.parent / "calibration", pool=pool)
        calibrated.save(place)
    return calibrated.recordings.recordings[1], _calls_of(drive, method)


class _ShowsTooLittleError(Exception):
    """The road along a pattern's path cannot be recorded or calibrated."""


@contextmanager
def _what_is_shown() -> Generator[None]:
    try:
        yield
    except (CalibrationError, RecordingError) as error:
        raise _ShowsTooLittleError(str(error)) from error


def _calls_of(drive: Drive, method: CalibrationMethod) -> int:
    """Number of drives that recording a round's drive and calibrating it beside the clean one takes."""
    return drive.calls + replays_needed(2, method) - replays_needed(1, method)


def _read_round(place: Path) -> ReRecordingRound:
    """A finished round, from its folder."""
    attack, selection = AttackResult.load(place / "attack"), Selection.load(place / "selection")
    report = CalibrationReport.load(place / "calibration" / "report.json")
    drive = read_drive(place.name, place)
    if drive is None:
        raise RecordingError(f"{place} lacks the drive {place.name}; give the same call again to record it")
    calls = _calls_of(drive, CalibrationMethod(report.method)) + selection.simulator_calls
    return ReRecordingRound(attack=attack, selection=selection, simulator_calls=calls)


def _gone_on(method: Method) -> Method:
    """The method with as many starts as it ended with, none of which compete (no successive halving)."""
    return replace(method, halving=False) if isinstance(method, GradOpt) else method
