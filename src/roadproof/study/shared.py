"""What several jobs of a study need is made once: recorded drives, calibrated, and drives over the bare road.

    work/shared/KEY/record, calibration, recordings   as a run has them, and run.json, which says what they took
    work/shared/KEY/episodes                          drives over the bare road, as evaluations keep them

A key is a hash of all that the drives depend on. Jobs get links to the files, which nobody writes to again.
"""

from __future__ import annotations

import os
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from roadproof.calibration import Calibrated
from roadproof.controllers import Controller
from roadproof.drives import Drives
from roadproof.driving.drive_store import EPISODES, Episodes
from roadproof.driving.episode import Episode
from roadproof.driving.evaluation import Evaluation
from roadproof.errors import OutputError, RoadproofError
from roadproof.io.files import write_atomically, write_folder_atomically
from roadproof.io.identity import digest, stated
from roadproof.pipeline.budget import Budget
from roadproof.pipeline.stage_costs import FILE, StageCost, read_cost
from roadproof.simulators.protocol import Simulator
from roadproof.study.plan import Job

STAGES = ("record", "calibrate")
"""Stages of a run whose folders jobs share, and what those took."""

_PARTS = ("record", "calibration", "recordings")
_CLEAN = "[!.]*-clean-*.npz"


def recorded_by(budget: Budget) -> str:
    """What of a budget its recordings depend on."""
    return repr((budget.trajectories, budget.window, budget.calibration, budget.recorded_in))


@dataclass(frozen=True, slots=True)
class SharedRecordings:
    """The calibrated drives of a study for runs of one budget.

    Args:
        folder: their folder; it is there once a run has made them.
        weathers: weathers that are recorded, the first in the run's folder and each other in one of its name.
    """

    folder: Path
    weathers: tuple[str, ...]

    @staticmethod
    def of(job: Job, world: Simulator, controller: Controller, budget: Budget, work: Path) -> SharedRecordings:
        """Those of a job that searches with a budget."""
        folder = _folder(job, world, controller, work, recorded_by(budget))
        return SharedRecordings(folder, tuple(map(str, budget.recorded_in)))

    @property
    def cost(self) -> dict[str, StageCost]:
        """What they took, by the name of the stage; empty before they are made, and where nobody can say any more."""
        with suppress(RoadproofError):
            return {stage: cost for stage, cost in read_cost(self.folder).items() if stage in STAGES}
        return {}

    def bring(self, run: Path) -> None:
        """Give a run what it has not begun to record; what is damaged is removed, for the next run to make again.

        Raises:
            OutputError: the run's folder cannot be written.
        """
        wanted = [place for place in self._places if not (run / place / "record").exists()]
        if not wanted or not self.folder.is_dir():
            return
        if not self._is_whole():
            shutil.rmtree(self.folder, ignore_errors=True)
            return
        for place in wanted:
            # Drives last: a run that has drives has begun, and calibrates them itself.
            for part in (place / name for name in reversed(_PARTS)):
                if not (run / part).exists():
                    write_folder_atomically(run / part, lambda target, part=part: _link(self.folder / part, target))

    def keep(self, run: Path) -> None:
        """Keep what a finished run made, where nobody has yet.

        Raises:
            OutputError: the folder cannot be written.
        """

        def fill(place: Path) -> None:
            for part in (each / name for each in self._places for name in _PARTS):
                _link(run / part, place / part)
            shutil.copy(run / FILE, place / FILE)

        if self.folder.exists():
            return
        try:
            write_folder_atomically(self.folder, fill)
        except OutputError:
            if not self.folder.exists():  # else another job was quicker
                raise

    @property
    def _places(self) -> tuple[Path, ...]:
        return Path(), *map(Path, self.weathers[1:])

    def _is_whole(self) -> bool:
        try:
            for place in self._places:
                Drives.load(self.folder / place / "record")
                Calibrated.load(self.folder / place)
        except RoadproofError:
            return False
        return bool(self.cost)


def bring_bare_drives(shared: Path, evaluation: Path) -> None:
    """Give an evaluation the drives over the bare road that others have made, but none that is damaged."""
    for file in shared.glob(_CLEAN):
        if not (place := evaluation / EPISODES / file.name).exists():
            try:
                Episode.load(file)
            except RoadproofError:
                file.unlink(missing_ok=True)
            else:
                _link_file(file, place)


def keep_bare_drives(shared: Path, evaluation: Path, told: Evaluation) -> None:
    """Keep the drives over the bare road that an evaluation made, and leave it those that it tells of."""
    _link(evaluation / EPISODES, shared, _CLEAN)
    kept = {trial.clean for trial in told.trials}
    for file in list((evaluation / EPISODES).glob(_CLEAN)):
        if file.name not in kept:
            file.unlink()


def bare_drives(job: Job, world: Simulator, controller: Controller, work: Path) -> Path:
    """The folder of the drives over the bare road with which a job's patterns are compared."""
    return _folder(job, world, controller, work, "bare") / EPISODES


def _folder(job: Job, world: Simulator, controller: Controller, work: Path, asked: str) -> Path:
    # What a drive depends on is for the store of drives to say.
    parts = Episodes.of(world, controller, job.scenario, {}, work).parts
    told = {"drives": parts, "simulator": job.simulator, "controller": job.controller, "seed": job.seed, "asked": asked}
    return work / "shared" / digest(stated(told))[:16]


def _link(source: Path, target: Path, pattern: str = "**/*") -> None:
    """Link to the files of a folder from another."""
    for file in source.glob(pattern):
        place = target / file.relative_to(source)
        if file.is_file() and not place.exists():
            _link_file(file, place)


def _link_file(file: Path, place: Path) -> None:
    """Link to a file from another place, or copy it where links cannot be made."""
    place.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(file, place)
    except FileExistsError:
        pass
    except OSError:
        write_atomically(place, lambda part: shutil.copy2(file, part))
