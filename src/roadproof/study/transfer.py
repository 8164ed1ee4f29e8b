"""Patterns found against one controller, tried on others: does a weakness belong to one network or to many?

FOLDER/transfer/CONTROLLER/SCENARIO/   the drives of every controller, kept, so that the same call goes on
FOLDER/transfer.parquet                a row for each pattern and drive of a controller (`rows.TransferRow`)

Every pattern is driven over alone, in the weather it was found in.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from roadproof.controllers import Controller, load_controller
from roadproof.driving.evaluate import evaluate
from roadproof.driving.evaluation import Evaluation
from roadproof.errors import RoadproofError, ScenarioError, StudyError
from roadproof.io.files import inside, write_atomically
from roadproof.io.locks import working_in
from roadproof.patterns import load_pattern
from roadproof.simulators.loading import open_simulator
from roadproof.simulators.protocol import Simulator
from roadproof.study.folder import TRANSFERRED, is_done, named, pandas, read_transfers
from roadproof.study.plan import Job, Study
from roadproof.study.rows import Frame, TransferRow, drive_columns, job_columns


@dataclass(frozen=True, slots=True, eq=False)
class Transfer:
    """What came of the patterns of a study under other controllers.

    Args:
        rows: a row for each pattern and drive of a controller, also of those that were tried before.
        failures: a line for each pattern that a controller could not be judged on, or not from all starts, with the
            controller and the reason.
    """

    rows: Frame
    failures: tuple[str, ...]


def transfer(
    study: Study,
    folder: Path,
    controllers: Sequence[str],
    *,
    on_pattern: Callable[[int, int], object] = lambda _done, _total: None,
) -> Transfer:
    """Drive every controller over the patterns of a study.

    A controller that fails on a pattern, as one that never comes to its canvas, is told, and the others go on.

    Args:
        study: the study whose patterns are driven over.
        folder: the folder with the study's results; jobs that are not done are left out.
        controllers: specs of the controllers; the one the patterns were found against may be among them.
        on_pattern: told how many patterns have been driven over, and of how many, all controllers counted.

    Raises:
        StudyError: no controller is named, no job of the study is done, or every pattern failed.
        ControllerError: there is no such controller.
        OutputError: the folder cannot be written.
    """
    if not controllers:
        raise StudyError("no controller to try the patterns on; name one or more")
    found = [job for job in study.jobs if is_done(job, folder)]
    if not found:
        raise StudyError(f"{folder} has no results of this study yet; run the study first")
    drivers = {spec: load_controller(spec) for spec in controllers}
    # What reads and writes the table, and what is wrong with it, is missed now, not after the last drive.
    pandas()
    before = read_transfers(folder)
    if before is not None and not {"job", "controller"} <= set(before):
        raise StudyError(f"{folder / TRANSFERRED} does not say of which jobs it is; remove it and give this again")
    rows, failures, done = list[TransferRow](), list[str](), 0
    with working_in(folder), open_simulator(study.simulator) as world:
        for spec, driver in drivers.items():
            for job in found:
                try:
                    evaluation = _evaluated(job, folder, world, spec, driver)
                except RoadproofError as error:
                    failures.append(f"{spec}: {named(job)}: {error}")
                else:
                    rows += _rows(job, spec, evaluation)
                    if lost := evaluation.left_out:
                        failures.append(
                            f"{spec}: {named(job)}: {lost} of {lost + len(evaluation.trials)} drives left out, since "
                            "without paint the car never came to the canvas"
                        )
                done += 1
                on_pattern(done, len(drivers) * len(found))
    if not rows:
        raise StudyError(f"no pattern could be driven over; the first of {len(failures)}: {failures[0]}")
    frame = pandas().DataFrame(rows)
    if before is not None:
        others = before["job"].isin([job.key for job in found]) & ~before["controller"].isin(list(drivers))
        frame = pandas().concat([before[others], frame], ignore_index=True) if others.any() else frame
    write_atomically(folder / TRANSFERRED, lambda part: frame.to_parquet(part, index=False))
    return Transfer(frame, tuple(failures))


def _evaluated(job: Job, folder: Path, world: Simulator, spec: str, driver: Controller) -> Evaluation:
    place = inside(folder / "transfer" / re.sub(r"[^\w.-]", "_", spec), job.scenario.name, "scenario", ScenarioError)
    return evaluate(
        world,
        driver,
        job.scenario,
        load_pattern(folder / "jobs" / job.key / "pattern.json"),
        folder=place,
        driver_name=spec,
        weathers=job.weathers[:1],
        starts=job.starts.count,
        start_range=job.starts.range,
        runs=0,
        seed=job.seed,
    )


def _rows(job: Job, spec: str, evaluation: Evaluation) -> list[TransferRow]:
    return [
        TransferRow(**job_columns(job), found_on=job.controller, controller=spec, **drive_columns(trial))
        for trial in evaluation.trials
    ]
