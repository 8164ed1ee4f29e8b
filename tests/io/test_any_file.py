"""Whatever stands in a file, it is read or refused in one line, in little time. `make fuzz` tries far more."""

import json
import math
import shutil
import warnings

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fuzzing import ANYTHING, CUTS, cut, tries
from killable import STUDY
from mutations import places_in
from paint_shy import along_a_street
from recorded_drives import drivable_set
from roadproof.controllers import load_controller
from roadproof.controllers.shipped import shipped_weights
from roadproof.datatypes import Weather
from roadproof.driving.episode import Episode
from roadproof.errors import RoadproofError
from roadproof.gate.plan import load_check
from roadproof.gate.result import CHECK_FILE, Case, CheckResult
from roadproof.gate.verdict import Kind, Status
from roadproof.patterns import load_pattern, save_pattern
from roadproof.recordings import load_recordings, save_recordings
from roadproof.scenarios import find_scenario, load_scenarios, save_scenarios
from roadproof.study.folder import read_rows
from roadproof.study.history import History, read_history
from roadproof.study.plan import load_study
from runs import driven
from team_folder import BAR, write_team


def opens(read, path):
    """Read it; whether it was taken. Anything but one line fails."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read(path)
    except RoadproofError as error:
        assert "\n" not in str(error)
        assert len(str(error)) < 5000
        return False
    return True


def _case():
    return Case(
        scenario="street",
        weather=Weather.CLEAR_NOON,
        kind=Kind.STORED,
        name="bar",
        conditions="0" * 16,
        measures={},
        status=Status.PASSED,
        reasons=(),
        command="roadproof drive",
        drives=(),
    )


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A file of every kind, by name, with what reads it."""
    place = tmp_path_factory.mktemp("whole")
    save_scenarios([along_a_street(place, 2.0)], place / "scenarios.toml")
    save_pattern(BAR, place / "pattern.json")
    (place / "study.toml").write_text(STUDY)
    check = write_team(place / "team")
    save_recordings(drivable_set(), place / "set")
    (job, *_) = load_study(place / "study.toml").jobs
    rows = place / "jobs" / job.key / "rows.json"
    rows.parent.mkdir(parents=True)
    row = {"scenario": "street", "figures": 1, "method": "chance", "seed": 0, "deviation_m": 0.5, "error": None}
    rows.write_text(json.dumps({"format": "roadproof-study-rows", "version": 1, "rows": [row]}))
    (place / "history.json").write_bytes(
        History(kind="surrogate", calls=(1, 2), seconds=(0.1, 0.2), best=(0.3, 0.4)).to_json()
    )
    result = CheckResult(
        roadproof="0.1.0", controller="cil", architecture="CIL", budget="smoke", compared=False, cases=(_case(),)
    )
    result.save(place / "check.json")
    shutil.copyfile(shipped_weights("pilotnet"), place / "weights.safetensors")
    driven(find_scenario("left-03")).save(place / "episode.npz")
    doors = {
        "pattern.json": load_pattern,
        "scenarios.toml": load_scenarios,
        "study.toml": load_study,
        check.relative_to(place).as_posix(): lambda path: load_check(path, trust=True),
        "set/recordings.json": lambda path: load_recordings(path.parent),
        "set/clean/drive.npz": lambda path: load_recordings(path.parents[1]),
        "rows.json": lambda path: read_rows(job, place),
        "history.json": read_history,
        "check.json": CHECK_FILE.read,
        "weights.safetensors": lambda path: load_controller(str(path)),
        "episode.npz": Episode.load,
    }
    made = {name: (rows if name == "rows.json" else place / name, read) for name, read in doors.items()}
    for name, (path, read) in made.items():
        assert opens(read, path), name
    return made


NAMES = (
    "pattern.json", "scenarios.toml", "study.toml", "team/check.toml", "set/recordings.json", "set/clean/drive.npz",
    "rows.json", "history.json", "check.json", "weights.safetensors", "episode.npz",
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_file_with_any_change_is_read_or_refused(whole, name):
    path, read = whole[name]
    kept = path.read_bytes()

    @tries(30)
    @given(CUTS, st.booleans())
    def changed(change, near_the_beginning):
        # What says how a file lies is at its beginning.
        at, gone, new = change
        path.write_bytes(cut(kept, (at % 400 if near_the_beginning else at, gone, new)))
        opens(read, path)

    try:
        changed()
    finally:
        path.write_bytes(kept)


@pytest.mark.parametrize("name", [name for name in NAMES if name.endswith((".json", ".toml"))])
def test_any_value_in_any_place_is_read_or_refused(whole, name):
    path, read = whole[name]
    kept = path.read_bytes()

    @tries(60)
    @given(st.integers(0, 10**4), ANYTHING)
    def put(number, value):
        text = kept.decode()
        path.write_bytes(_in_json(text, number, value) if name.endswith(".json") else _in_toml(text, number, value))
        opens(read, path)

    try:
        put()
    finally:
        path.write_bytes(kept)


def _in_json(text, number, value):
    content = json.loads(text)
    places = list(places_in(content))
    box, key = places[number % len(places)]
    box[key] = value
    return json.dumps(content).encode("utf-8", "surrogatepass")


def _in_toml(text, number, value):
    lines = text.splitlines()
    stated = [k for k, line in enumerate(lines) if "=" in line]
    k = stated[number % len(stated)]
    lines[k] = f"{lines[k].partition('=')[0]}= {toml(value)}"
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def toml(value):
    """A value as TOML has it; JSON's text and lists are TOML's."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {toml(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return '""' if value is None else json.dumps(value)
