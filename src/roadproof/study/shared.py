"""What several jobs of a study need is made once: recorded drives, calibrated, and drives over the bare road.

    work/shared/KEY/record, calibration, recordings   as a run has them, and run.json, which says what they took
    work/shared/KEY/episodes                          drives over the bare road, as evaluations keep them

A key is a hash of all that the drives depend on. Jobs get links to the files, which nobody writes to again.
"""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import roadproof
from roadproof.controllers import Controller
from roadproof.controllers.identity import parts_of
from roadproof.driving.evaluation import Evaluation
from roadproof.errors import OutputError
from roadproof.io.files import write_folder_atomically
from roadproof.io.identity import digest, stated
from roadproof.pipeline.budget import Budget
from roadproof.pipeline.stage_costs import FILE, StageCost, read_cost
from roadproof.scenarios import identity
from roadproof.simulators.protocol import Simulator, world_of
from roadproof.study.plan import Job

STAGES = ("record", "calibrate")
"""Stages of a run whose folders jobs share, and what those took."""

_PARTS = ("record", "calibration", "recordings")
_CLEAN = "*-clean-*.npz"


def recorded_by(budget: Budget) -> tuple[object, ...]:
    """What of a budget its recordings depend on."""
    return budget.trajectories, budget.window, budget.calibration, budget.recorded_in


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
        folder = _folder(job, world, controller, work, repr(recorded_by(budget)))
        return SharedRecordings(folder, tuple(map(str, budget.recorded_in)))

    @property
    def cost(self) -> dict[str, StageCost]:
        """What they took, by the name of the stage; empty before they are made."""
        return {stage: read_cost(self.folder)[stage] for stage in STAGES} if self.folder.is_dir() else {}

    def bring(self, run: Path) -> None:
        """Give a run what it has not begun to make.

        Raises:
            OutputError: the run's folder cannot be written.
        """
        for part in self._parts:
            if (self.folder / part).is_dir() and not (run / part).exists():
                write_folder_atomically(run / part, lambda place, part=part: _link(self.folder / part, place))

    def keep(self, run: Path) -> None:
        """Keep what a finished run made, where nobody has yet.

        Raises:
            OutputError: the folder cannot be written.
        """

        def fill(place: Path) -> None:
            for part in self._parts:
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
    def _parts(self) -> tuple[Path, ...]:
        places = (Path(), *map(Path, self.weathers[1:]))
        return tuple(place / name for place in places for name in _PARTS)


def bring_bare_drives(shared: Path, evaluation: Path) -> None:
    """Give an evaluation the drives over the bare road that others have made."""
    _link(shared, evaluation / "episodes")


def keep_bare_drives(shared: Path, evaluation: Path, told: Evaluation) -> None:
    """Keep the drives over the bare road that an evaluation made, and leave it those that it tells of."""
    _link(evaluation / "episodes", shared, _CLEAN)
    kept = {trial.clean for trial in told.trials}
    for file in list((evaluation / "episodes").glob(_CLEAN)):
        if file.name not in kept:
            file.unlink()


def bare_drives(job: Job, world: Simulator, controller: Controller, work: Path) -> Path:
    """The folder of the drives over the bare road with which a job's patterns are compared."""
    return _folder(job, world, controller, work, "bare") / "episodes"


def _folder(job: Job, world: Simulator, controller: Controller, work: Path, asked: str) -> Path:
    size = world.input.height_px, world.input.width_px
    parts: dict[str, Any] = {
        "version": roadproof.__version__,
        "scenario": identity(job.scenario),
        "controller": [job.controller, parts_of(controller, size)],
        "world": [job.simulator, world.paint, world_of(world)],
        "seed": job.seed,
        "asked": asked,
    }
    return work / "shared" / digest(stated(parts))[:16]


def _link(source: Path, target: Path, pattern: str = "**/*") -> None:
    """Link to the files of a folder from another, or copy them where links cannot be made."""
    for file in source.glob(pattern):
        place = target / file.relative_to(source)
        if file.is_file() and not place.exists():
            place.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(file, place)
            except FileExistsError:
                pass
            except OSError:
                shutil.copy2(file, place)
