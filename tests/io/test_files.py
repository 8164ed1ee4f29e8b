"""Names from files: what may name a folder, and that nothing gets out of the folder it is in."""

import dataclasses
import os

import pytest
import torch

import roadproof
from roadproof.coverage import Shape
from roadproof.drives.own.plan import OwnDrive
from roadproof.drives.own.table import read_table
from roadproof.errors import OutputError, RecordingError, RoadproofError, ScenarioError
from roadproof.io.commands import read_commands
from roadproof.io.files import (
    as_path,
    bytes_of,
    check_closed,
    inside,
    is_plain_name,
    write_atomically,
    write_folder_atomically,
    write_json,
)
from roadproof.io.locks import working_in
from roadproof.io.tables import first_twice
from roadproof.io.text import read_json, read_toml
from roadproof.patterns import Pattern
from roadproof.roads.opendrive import read_opendrive
from roadproof.scenarios import builtin_scenarios, load_scenarios, save_scenarios
from scenes import recording_set

PLAIN = (
    "left-03",
    "clean",
    "right-2",
    "clear-noon-clean",
    "kurve-süd",
    "7",
    "_own",
    "a b",
    "map v1.2+x (new) [2]",
    "x" * 100,
)
NOT_PLAIN = (
    "", ".", "..", "../x", "/etc/x", "a/b", "a/../..", "a\\b", "c:x", "x\0y", "a\nb", " a", "a ", "a.", ".hidden",
    "-rf", "~", "~root", "$HOME", "a*", "nul", "CON", "Com1.txt", "x" * 101, "a\u202eb", None, 3, ["a"],
)  # fmt: skip


@pytest.mark.parametrize("name", PLAIN)
def test_what_people_call_things_is_plain(name, tmp_path):
    assert is_plain_name(name)
    assert inside(tmp_path, name, "drive", RecordingError) == tmp_path / name
    (tmp_path / name).mkdir()


@pytest.mark.parametrize("name", NOT_PLAIN)
def test_a_name_that_could_lead_elsewhere_is_refused_in_a_line(name, tmp_path):
    assert not is_plain_name(name)
    with pytest.raises(RecordingError, match=r"drive .* is not a plain name") as refused:
        inside(tmp_path, name, "drive", RecordingError)
    assert "\n" not in str(refused.value)
    assert "\0" not in str(refused.value)


def test_a_link_out_of_the_folder_is_refused_and_one_within_is_not(tmp_path):
    runs, elsewhere = tmp_path / "runs", tmp_path / "elsewhere"
    (runs / "kept").mkdir(parents=True)
    elsewhere.mkdir()
    (runs / "out").symlink_to(elsewhere)
    (runs / "within").symlink_to(runs / "kept")
    with pytest.raises(RecordingError, match="is a link that leads out of"):
        inside(runs, "out", "drive", RecordingError)
    assert inside(runs, "within", "drive", RecordingError) == runs / "within"


@pytest.mark.parametrize("name", ["../../outside", "/tmp/outside", "..", "a\0b", "nul", "x/../../y"])
def test_a_scenario_is_called_by_a_plain_name_however_it_comes(name, tmp_path):
    scenario = builtin_scenarios()[0]
    with pytest.raises(ScenarioError, match="is not a plain name"):
        dataclasses.replace(scenario, name=name)
    path = tmp_path / "own.toml"
    save_scenarios([scenario], path)
    escaped = name.replace("\0", "\\u0000")
    path.write_text(path.read_text().replace(f'"{scenario.name}"', f'"{escaped}"'))
    with pytest.raises(ScenarioError, match=r"own.toml.*(is not a plain name|valid TOML|no NUL)"):
        load_scenarios(path)


def test_public_functions_take_paths_as_text(tmp_path):
    pattern = Pattern((Shape.ELLIPSE,), torch.tensor([[200.0, 200.0, 90.0, 60.0, 0.0]]), torch.ones(1, 3))
    roadproof.save_pattern(pattern, f"{tmp_path}/pattern.json")
    assert roadproof.load_pattern(f"{tmp_path}/pattern.json").shapes == pattern.shapes
    roadproof.save_recordings(recording_set(frames=3), f"{tmp_path}/run/recordings")
    assert len(roadproof.load_recordings(f"{tmp_path}/run/recordings").recordings) == 3
    with pytest.raises(RoadproofError, match="nothing to report yet"):
        roadproof.write_report(str(tmp_path))


@pytest.mark.parametrize("given", [None, 3, b"x", ""])
def test_what_is_no_path_is_one_line(given):
    with pytest.raises(RoadproofError, match=f"^{given!r} is no path, expected a text or a pathlib.Path$"):
        as_path(given)


def test_links_that_lead_out_of_a_folder_are_named_before_anything_is_read(tmp_path):
    inner, other = tmp_path / "run" / "attack", tmp_path / "other"
    inner.mkdir(parents=True)
    other.mkdir()
    (tmp_path / "run" / "own").symlink_to(inner)
    check_closed(tmp_path / "run", RoadproofError)
    for link, target in ((inner / "pattern.json", other / "x"), (tmp_path / "run" / "record", other)):
        link.symlink_to(target)
        with pytest.raises(RoadproofError, match=f"{link.name} is a link that leads out of"):
            check_closed(tmp_path / "run", RoadproofError)
        link.unlink()


def test_recordings_with_a_link_in_them_are_not_read(tmp_path):
    roadproof.save_recordings(recording_set(frames=2), tmp_path / "set")
    (tmp_path / "set" / "clean" / "drive.npz").rename(tmp_path / "drive.npz")
    (tmp_path / "set" / "clean" / "drive.npz").symlink_to(tmp_path / "drive.npz")
    with pytest.raises(RecordingError, match=r"drive\.npz is a link that leads out of"):
        roadproof.load_recordings(tmp_path / "set")


def test_what_is_written_to_a_folder_that_is_worked_in_stays_there(tmp_path):
    run, other = tmp_path / "run", tmp_path / "other"
    run.mkdir()
    other.mkdir()
    (run / "record").symlink_to(other)
    (run / "own").mkdir()
    with working_in(run):
        for path in (run / "record" / "record.json", run / "record" / "deep" / "x"):
            with pytest.raises(OutputError, match="reached by a link that leads out of"):
                write_atomically(path, lambda part: part.write_text("x"))
            with pytest.raises(OutputError, match="reached by a link that leads out of"):
                write_folder_atomically(path, lambda part: None)
        write_atomically(run / "own" / "x", lambda part: part.write_text("x"))
        write_atomically(tmp_path / "beside", lambda part: part.write_text("x"))
    assert not list(other.iterdir())


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_in_place_of_a_file_is_not_waited_for(tmp_path):
    os.mkfifo(path := tmp_path / "commands.txt")
    for read in (
        lambda: read_json(path, "x", 1, RoadproofError),
        lambda: read_toml(path, RoadproofError),
        lambda: bytes_of(path),
        lambda: read_commands(tmp_path),
        lambda: read_table(tmp_path, OwnDrive(name="clean", table=path.name)),
        lambda: read_opendrive(path),
    ):
        with pytest.raises(RoadproofError, match=r"commands\.txt.*it is a pipe or a device, expected a file"):
            read()


@pytest.mark.parametrize("text", [".".join("a" * 5000) + " = 1", f"[{'.'.join('a' * 5000)}]"])
def test_toml_that_is_too_deep_is_one_line(tmp_path, text):
    (tmp_path / "x.toml").write_text(text)
    with pytest.raises(RoadproofError, match=r"x\.toml is not valid TOML \(.*recursion") as refusal:
        read_toml(tmp_path / "x.toml", RoadproofError)
    assert "\n" not in str(refusal.value)


def test_a_text_file_that_is_too_large_is_not_read(tmp_path):
    (tmp_path / "x.json").write_text("{" + " " * 2000 + "}")
    with pytest.raises(RoadproofError, match="it is larger than 1,000 bytes"):
        read_json(tmp_path / "x.json", "x", 1, RoadproofError, most_bytes=1000)
    with (tmp_path / "x.toml").open("wb") as file:
        file.truncate(2**33)
    with pytest.raises(RoadproofError, match="it is larger than 33,554,432 bytes"):
        read_toml(tmp_path / "x.toml", RoadproofError)


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_a_number_that_nobody_could_read_is_not_written(number, tmp_path):
    path = tmp_path / "x.json"
    write_json(path, {"metres": 1.0})
    with pytest.raises(OutputError, match=r"x\.json is not written: Out of range float"):
        write_json(path, {"metres": number})
    assert path.read_text() == '{\n "metres": 1.0\n}\n'


def test_the_first_value_that_is_there_twice_is_found_at_once():
    assert first_twice(range(300_000)) is None
    assert first_twice(["a", "b", "c", "b", "a"]) == "b"
