"""A run folder from anyone: whatever was changed in it, opening it ends well or in one line."""

from __future__ import annotations

import random
import warnings

import pytest

import needs
from mutations import files_of, mutated
from roadproof.drives import load_drives
from roadproof.errors import RoadproofError
from roadproof.recordings import load_recordings
from roadproof.report.page import write_report
from roadproof.report.run import read_run
from runs import write_run

DOORS = {
    "run": read_run,
    "recordings": lambda folder: load_recordings(folder / "recordings"),
    "record": lambda folder: load_drives(folder / "record"),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    needs.town()
    folder = tmp_path_factory.mktemp("mutations") / "run"
    write_run(folder)
    return folder


def try_changed(run, doors, count, seed):
    """How often a change was refused; a traceback fails the test by itself."""
    paths, rng, refused = files_of(run, ".json", ".npz", ".png", ".jpg", ".npy"), random.Random(seed), 0
    before = set(run.parent.rglob("*"))
    for _ in range(count):
        path = rng.choice(paths)
        kept = path.read_bytes()
        path.write_bytes(mutated(kept, path.suffix, rng))
        for name, open_it in doors.items():
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    open_it(run)
            except RoadproofError as error:
                refused += 1
                assert "\n" not in str(error), (name, path)
        path.write_bytes(kept)
    assert {path.name for path in set(run.parent.rglob("*")) - before} <= {"report.html", "result.json", "commands.txt"}
    return refused


@pytest.mark.parametrize("seed", range(3))
def test_every_door_ends_well_or_in_one_line(run, seed):
    assert try_changed(run, DOORS, 80, seed) > 20


def test_a_report_of_a_changed_run_is_made_or_refused(run):
    assert try_changed(run, {"report": write_report}, 40, 7) > 5
