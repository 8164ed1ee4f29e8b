"""Names from files: what may name a folder, and that nothing gets out of the folder it is in."""

import dataclasses

import pytest
import torch

import roadproof
from roadproof.coverage import Shape
from roadproof.errors import RecordingError, RoadproofError, ScenarioError
from roadproof.io.files import as_path, inside, is_plain_name
from roadproof.patterns import Pattern
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
