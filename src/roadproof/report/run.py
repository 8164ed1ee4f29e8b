"""A run folder, as far as it has come: what each stage left (`pipeline.stress_test`), read for the report.

RUN/commands.txt has the commands that made it, one a line; each stage's folder may have its own.
"""

from __future__ import annotations

import shlex
from dataclasses import asdict, dataclass
from itertools import chain, count, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from roadproof.attacks import AttackResult, Cheapest
from roadproof.calibration.report import CalibrationReport
from roadproof.datatypes import Weather
from roadproof.drives import Drives
from roadproof.driving.drive_store import load_episodes
from roadproof.driving.episode import Episode
from roadproof.driving.evaluation import Evaluation, load_paint
from roadproof.driving.trial import Trial
from roadproof.errors import RoadproofError
from roadproof.io.commands import read_commands
from roadproof.io.files import bytes_of, check_closed
from roadproof.patterns import Pattern, load_pattern
from roadproof.pipeline.fidelity import FIDELITY, Fidelity
from roadproof.pipeline.film import FILM, POSTER, STRIP, Strip
from roadproof.pipeline.limit_costs import LIMIT_COSTS, LimitCosts
from roadproof.pipeline.prediction import Prediction
from roadproof.pipeline.rerecording import round_folder
from roadproof.pipeline.selection import Selection
from roadproof.pipeline.stage_costs import StageCost, read_cost
from roadproof.pipeline.stages import CHEAPEST
from roadproof.recordings import RecordingSet, load_recordings
from roadproof.simulators.protocol import PatternImage

_STAGES = ("record", "calibration", "attack", "selection", "evaluation")


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ShownEvaluation:
    """An evaluation with what is shown of it.

    Args:
        evaluation: the drives that were judged.
        paint: the canvas as it was painted.
        shown: the trial that is shown in pictures.
        clean: the shown drive without paint.
        painted: the shown drive over the paint of the canvas.
        by_weather: the drives without others on the road, each with its weather, without and with paint.
        fidelity: composites against renders, where they were compared.
        film: the film of both shown drives side by side, as MP4; None where there is none.
        poster: one image of the film, as JPEG; None where there is none.
        strip: pictures of both shown drives passing the canvas; None where there are none.
    """

    evaluation: Evaluation
    paint: PatternImage
    shown: Trial
    clean: Episode
    painted: Episode
    by_weather: tuple[tuple[Weather, Episode, Episode], ...]
    fidelity: Fidelity | None
    film: bytes | None
    poster: bytes | None
    strip: Strip | None

    @property
    def steps(self) -> Int[np.ndarray, " n"]:
        """The steps of the shown drives that the strip has pictures of."""
        moments = np.zeros(0) if self.strip is None else self.strip.time_s
        return np.abs(self.painted.time_s - moments[:, None]).argmin(1)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Run:
    """What a run folder holds; None for a stage that is not there.

    Args:
        folder: the run folder that was read.
        drives: the drives as they were recorded, before calibration.
        recordings: the calibrated set of recordings.
        calibration: the report of the calibration.
        attack: the result of the attack.
        selections: the candidates that were driven, of the search and of each round, in that order.
        judged: the evaluation, with what is shown of it.
        prediction: the path that the recorded world predicted for the chosen pattern, beside the path that was driven.
        pattern: the pattern that was chosen in the end; the attack's own where the run says nothing else.
        cost: what each stage took since the run began; empty where the run keeps no account of it.
        commands: the commands that made the run, as they were given; none where it was made in Python.
        cheapest: the least paint for a deviation, where it was looked for.
        cheapest_driven: the drive over the least paint, where it was driven over.
        limit_costs: what each limit on paint costs, where that was asked for.
    """

    folder: Path
    drives: Drives | None
    recordings: RecordingSet | None
    calibration: CalibrationReport | None
    attack: AttackResult | None
    selections: tuple[Selection, ...]
    judged: ShownEvaluation | None
    prediction: Prediction | None
    pattern: Pattern | None
    cost: dict[str, StageCost]
    commands: tuple[str, ...]
    cheapest: Cheapest | None
    cheapest_driven: Selection | None
    limit_costs: LimitCosts | None

    @property
    def name(self) -> str:
        """The name of the scenario; of the folder where no stage names one."""
        if self.judged is not None:
            return self.judged.evaluation.scenario.name
        return self.drives.settings.scenario.name if self.drives else self.folder.resolve().name

    @property
    def costs(self) -> list[dict[str, Any]]:
        """Simulator calls, seconds and the controller's frames of each stage; None where they were not noted."""
        frames = {} if self.attack is None else {"attack": self.attack.cost.controller_frames}
        if self.cost:
            spent = {stage: asdict(cost) for stage, cost in self.cost.items() if cost != StageCost()}
        else:
            spent = self._noted()
        return [{"stage": stage} | cost | {"frames": frames.get(stage)} for stage, cost in spent.items()]

    def _noted(self) -> dict[str, dict[str, Any]]:
        """What the stages themselves say they took, where the run keeps no account of it."""
        spent: dict[str, dict[str, Any]] = {}
        recorded = 0
        if self.drives is not None:
            recorded = self.drives.calls
            spent["record"] = {"simulator_calls": recorded, "seconds": None}
        if self.calibration is not None:
            # Its own count includes recording.
            calls = self.calibration.calls - recorded
            spent["calibrate"] = {"simulator_calls": calls, "seconds": self.calibration.seconds}
        if self.attack is not None:
            cost = self.attack.cost
            spent["attack"] = {"simulator_calls": cost.simulator_calls, "seconds": cost.seconds}
        if self.judged is not None:
            judged = self.judged.evaluation
            spent["evaluate"] = {"simulator_calls": judged.simulator_calls, "seconds": judged.seconds}
        return spent


def read_run(folder: Path) -> Run:
    """Read a run folder. A stage that was not done is left out; one that is damaged is refused.

    Raises:
        RoadproofError: there is no such folder, no stage in it, or a stage is damaged; the message names it.
    """
    if not folder.is_dir():
        raise RoadproofError(f"no folder {folder}; expected a run with record, recordings, attack or evaluation in it")
    check_closed(folder, RoadproofError)
    attack = AttackResult.load(folder / "attack") if (folder / "attack" / "result.json").exists() else None
    chosen = load_pattern(path) if (path := folder / "pattern.json").exists() else attack and attack.pattern
    report = folder / "calibration" / "report.json"
    run = Run(
        folder=folder,
        drives=Drives.load(folder / "record") if (folder / "record" / "record.json").exists() else None,
        recordings=load_recordings(folder / "recordings") if (folder / "recordings").is_dir() else None,
        calibration=CalibrationReport.load(report) if report.exists() else None,
        attack=attack,
        selections=_selections(folder),
        judged=_judged(folder / "evaluation") if (folder / "evaluation" / "evaluation.json").exists() else None,
        prediction=Prediction.load(path) if (path := folder / "prediction.npz").exists() else None,
        pattern=chosen,
        cost=read_cost(folder),
        commands=_commands(folder),
        cheapest=Cheapest.load(path.parent) if (path := _searched(folder, f"{CHEAPEST}/cheapest.json")) else None,
        cheapest_driven=Selection.load(path)
        if ((path := folder / CHEAPEST / "selection") / "selection.json").exists()
        else None,
        limit_costs=LimitCosts.load(path) if (path := _searched(folder, LIMIT_COSTS)) else None,
    )
    if run.drives is None and run.recordings is None and run.attack is None and run.judged is None:
        raise RoadproofError(
            f"{folder} has neither record, recordings, attack nor evaluation in it; nothing to report yet"
        )
    return run


def _selections(folder: Path) -> tuple[Selection, ...]:
    places = (round_folder(folder, number) / "selection" for number in count())
    return tuple(map(Selection.load, takewhile(lambda place: (place / "selection.json").exists(), places)))


def _searched(folder: Path, file: str) -> Path | None:
    """A file of a run that a search alone leaves beside its own result; None where it is in neither place."""
    return next((path for path in (folder / file, folder / "attack" / file) if path.exists()), None)


def _commands(folder: Path) -> tuple[str, ...]:
    """The commands kept in a run, or else those kept in the folders of its stages."""
    if whole := read_commands(folder):
        return whole
    # What a stage made for several runs at once stands in each of them.
    stages = tuple(chain.from_iterable(read_commands(folder / stage) for stage in _STAGES))
    return (*stages, shlex.join(["roadproof", "report", str(folder)])) if stages else ()


def _judged(folder: Path) -> ShownEvaluation:
    evaluation = Evaluation.load(folder)
    shown = evaluation.shown()
    alone = evaluation.of(traffic=False)
    pairs = tuple(_driven(folder, trial) for trial in alone)
    fidelity = folder / FIDELITY
    return ShownEvaluation(
        evaluation=evaluation,
        paint=load_paint(folder),
        shown=shown,
        clean=pairs[0][1],
        painted=pairs[0][2],
        by_weather=pairs,
        fidelity=Fidelity.load(fidelity) if fidelity.exists() else None,
        film=bytes_of(folder / FILM),
        poster=bytes_of(folder / POSTER),
        strip=Strip.load(path) if (path := folder / STRIP).exists() else None,
    )


def _driven(folder: Path, trial: Trial) -> tuple[Weather, Episode, Episode]:
    clean, painted = load_episodes(folder, (trial.clean, trial.painted))
    return trial.weather, clean, painted
