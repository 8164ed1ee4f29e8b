"""Recording in the town: what is kept, how far drives go astray, and going on after an interruption."""

import contextlib
import dataclasses
import json

import numpy as np
import pytest

import needs
from paint_shy import PaintShy
from roadproof.datatypes import Control, Event, EventKind, Weather
from roadproof.drives import Drives, Swerve, Trajectories, Window, record, record_along
from roadproof.drives.folder import read_settings, require_same_map, write_settings
from roadproof.errors import ControllerError, OutputError, RecordingError, RoadproofError, ScenarioError
from roadproof.geometry import CIL_CAMERA, homography_from_pose
from roadproof.homographies import apply_homography
from roadproof.recordings import Side
from roadproof.scenarios import find_scenario
from roadproof.training.expert import expert

needs.town()

LEFT = find_scenario("left-03")
WANTED = Trajectories(count=3, perturbation=Swerve((1.2,)))
ASKED = {"trajectories": WANTED, "window": Window(frames=5), "weather": Weather.CLOUDY_NOON, "seed": 4}


DRIVEN = []


def watched(world):
    DRIVEN.append(world)
    return expert(world)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("run") / "record"


@pytest.fixture(scope="module")
def drives(town, folder):
    return record(town, watched, LEFT, folder=folder, **ASKED)


def test_the_drives_go_as_far_astray_as_was_asked_and_to_their_side(drives):
    assert [drive.side for drive in drives.drives] == [Side.CLEAN, Side.RIGHT, Side.LEFT]
    clean, right, left = drives.drives
    assert clean.offset_m == 0.0
    assert 1.0 < right.offset_m < 1.3
    assert -1.3 < left.offset_m < -1.0
    assert right.right_m.min() > -0.05
    assert left.right_m.max() < 0.05
    # Measured without the recorder's own path: least distance to the clean positions.
    apart = np.hypot(*(getattr(right.episode, n)[:, None] - getattr(clean.episode, n) for n in ("x_m", "y_m")))
    assert 1.0 < apart.min(1).max() < 1.35


def test_a_recording_of_a_driver_that_answered_otherwise_is_not_taken(drives, folder):
    with pytest.raises(RecordingError, match="a recording of another controller, which answers otherwise"):
        write_settings(dataclasses.replace(drives.settings, answers="0123456789abcdef"), folder)
    write_settings(drives.settings, folder)


def test_a_recording_knows_a_map_by_what_is_in_it_wherever_it_lies(drives, tmp_path):
    own = tmp_path / "own.xodr"
    own.write_text("<OpenDRIVE/>")
    settings = dataclasses.replace(drives.settings, scenario=dataclasses.replace(LEFT, map_name=str(own)))
    with contextlib.chdir(tmp_path):
        near = dataclasses.replace(settings, scenario=dataclasses.replace(LEFT, map_name="own.xodr"))
        assert write_settings(near, tmp_path / "record")
    (tmp_path / "moved").mkdir()
    kept, own = own.rename(tmp_path / "moved" / "own.xodr"), tmp_path / "record" / "own.xodr"
    settings = dataclasses.replace(settings, scenario=dataclasses.replace(LEFT, map_name=str(kept)))
    assert not write_settings(settings, tmp_path / "record")
    kept.write_text("<OpenDRIVE />")
    with pytest.raises(RecordingError, match=r"holds a recording with scenario\.map "):
        write_settings(settings, tmp_path / "record")
    stored = read_settings(tmp_path / "record")
    assert stored.scenario.map_name == str(own), "found from everywhere"
    require_same_map(stored, tmp_path / "record")
    own.write_text("<OpenDRIVE />")
    with pytest.raises(RecordingError, match=r"own\.xodr has changed since the drives in .*record were recorded on it"):
        require_same_map(stored, tmp_path / "record")
    own.unlink()
    with pytest.raises(RecordingError, match=r"record lacks own\.xodr, the map of its scenario; give the same"):
        read_settings(tmp_path / "record")
    # Which copies it there again, also where an older recording names one that lies elsewhere.
    kept.write_text("<OpenDRIVE/>")
    file = tmp_path / "record" / "record.json"
    for stated in (file.read_text(), file.read_text().replace('"own.xodr"', json.dumps(str(kept)))):
        file.write_text(stated)
        assert not write_settings(settings, tmp_path / "record")
        assert read_settings(tmp_path / "record") == stored
        assert own.read_text() == "<OpenDRIVE/>"
        own.unlink()


def test_a_map_that_is_named_by_its_path_in_the_simulator_is_the_same_again(drives, tmp_path):
    settings = dataclasses.replace(drives.settings, scenario=dataclasses.replace(LEFT, map_name="Carla/Maps/Town01"))
    assert [write_settings(settings, tmp_path / "record") for _ in range(2)] == [True, False]


@pytest.mark.parametrize("name", ["../own.xodr", "/etc/own.xodr", "deep/own.xodr"])
def test_a_map_that_lies_elsewhere_is_no_recordings(drives, tmp_path, name):
    (tmp_path / "own.xodr").write_text("<OpenDRIVE/>")
    settings = dataclasses.replace(drives.settings, scenario=dataclasses.replace(LEFT, map_name="own.xodr"))
    with contextlib.chdir(tmp_path):
        write_settings(settings, tmp_path / "record")
    stated = tmp_path / "record" / "record.json"
    stated.write_text(stated.read_text().replace('"own.xodr"', json.dumps(name)))
    with pytest.raises(RecordingError, match=r"record\.json: map_name is '.*own\.xodr', expected the name of a"):
        read_settings(tmp_path / "record")


def test_the_kept_frames_show_the_canvas(drives):
    for drive in drives.drives:
        assert drive.frames.shape == (5, 88, 200, 3)
        assert (np.diff(drive.frame_number) > 0).all()
        for state in drive.states:
            canvas = LEFT.canvas
            assert np.hypot(state.x_m - canvas.x_m, state.y_m - canvas.y_m) < 25.0 + canvas.length_m / 2
            # Some point of the canvas lies inside the crop.
            grid = np.stack(np.meshgrid(np.linspace(0, 399, 21), np.linspace(0, 399, 21)), -1).reshape(-1, 2)
            view = homography_from_pose(CIL_CAMERA, state, canvas)
            x, y = apply_homography(view, grid)[(grid @ view[2, :2] + view[2, 2]) > 0].T
            assert ((x > 0) & (x < 800) & (y > 115) & (y < 510)).any()


def test_what_the_driver_answered_is_kept_not_what_was_done(drives):
    clean, right, _ = drives.drives
    np.testing.assert_array_equal(clean.steer, clean.episode.steer[clean.frame_number])
    done = right.episode.steer[right.frame_number]
    assert np.abs(right.steer - done).max() > 0.02
    # Perturbed to the right, the expert wants back to the left.
    assert right.steer[-1] < clean.steer[-1]


def test_finished_drives_are_not_driven_again(drives, folder, town):
    (folder / "left" / "drive.npz").unlink()
    (folder / "left" / "episode.npz").unlink()
    (folder / "left").rmdir()
    with pytest.raises(RecordingError, match="lacks the drive left; give the same `roadproof record` again"):
        Drives.load(folder)
    driven = DRIVEN
    driven.clear()
    again = record(town, watched, LEFT, folder=folder, **ASKED)
    assert len(driven) == 1
    loaded = Drives.load(folder)
    assert loaded.settings == again.settings == drives.settings
    for one, two, three in zip(drives.drives, again.drives, loaded.drives, strict=True):
        assert one.name == two.name == three.name
        for name in ("frames", "frame_number", "steer", "right_m"):
            np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
            np.testing.assert_array_equal(getattr(one, name), getattr(three, name))
        np.testing.assert_array_equal(one.episode.x_m, three.episode.x_m)
    assert sorted(path.name for path in folder.iterdir()) == ["clean", "left", "record.json", "right"]


def test_a_folder_with_other_settings_is_refused(drives, folder, town):
    with pytest.raises(RecordingError, match="holds a recording with weather 'cloudy-noon', now it is 'rainy-noon'"):
        record(town, expert, LEFT, folder=folder, **(ASKED | {"weather": Weather.RAINY_NOON}))


def test_a_recording_by_another_function_is_refused(drives, folder, town):
    with pytest.raises(RecordingError, match="a recording of another controller, whose weights, settings or source"):
        record(town, lambda world: watched(world), LEFT, folder=folder, **ASKED)


def test_damage_is_named(drives, folder, tmp_path):
    import shutil

    copy = shutil.copytree(folder, tmp_path / "record")
    path = copy / "clean" / "drive.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[:200])
    with pytest.raises(RecordingError, match=r"clean.drive\.npz is damaged"):
        Drives.load(copy)
    path.write_bytes(whole)
    (copy / "record.json").write_text((copy / "record.json").read_text().replace('"seed": 4', '"seed": "four"'))
    with pytest.raises(RecordingError, match=r"record\.json is incomplete or damaged"):
        Drives.load(copy)
    with pytest.raises(RecordingError, match=r"has no record\.json"):
        Drives.load(tmp_path)


def test_a_driver_that_never_sees_the_canvas_is_refused(town):
    short = dataclasses.replace(LEFT, time_limit_s=0.5)
    with pytest.raises(RecordingError, match="drive clean of left-03 never sees 60 pixels of the canvas within 2 m"):
        record(town, expert, short, window=Window(horizon_m=2.0))


def test_a_driver_that_answers_nan_is_refused(town):
    with pytest.raises(ControllerError, match=r"the driver failed at .*test_record\.py:\d+: control steer is nan"):
        record(town, lambda _: lambda _: Control(float("nan")), LEFT)


def test_a_seed_that_is_none_is_refused_and_writes_nothing(town, tmp_path):
    with pytest.raises(RecordingError, match="seed is -1, expected a whole number"):
        record(town, expert, LEFT, **ASKED | {"seed": -1}, folder=tmp_path / "record")
    assert not (tmp_path / "record").exists()


def test_a_folder_that_cannot_be_written_is_named(town, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write"):
        record(town, expert, LEFT, folder=tmp_path / "file" / "record")


def test_a_drive_made_before_is_recorded_over_the_bare_road(drives, town, tmp_path):
    right = drives.drives[1]
    along = record_along(town, PaintShy(), drives, right.episode, name="round-1", folder=tmp_path)
    assert along.side is Side.RIGHT
    assert along.offset_m == pytest.approx(right.offset_m, abs=0.02)
    np.testing.assert_array_equal(along.frames, right.frames)
    np.testing.assert_array_equal(along.frame_number, right.frame_number)
    np.testing.assert_array_equal(along.episode.x_m[along.frame_number], right.episode.x_m[right.frame_number])
    assert (along.steer == 0).all(), "asked of a controller that sees no paint, not given"
    kept = (tmp_path / "round-1" / "drive.npz").stat().st_mtime_ns
    again = record_along(town, PaintShy(), drives, right.episode, name="round-1", folder=tmp_path)
    assert (tmp_path / "round-1" / "drive.npz").stat().st_mtime_ns == kept
    with pytest.raises(RoadproofError, match="a drive along another one than was chosen; remove that folder") as other:
        record_along(town, PaintShy(), drives, drives.drives[2].episode, name="round-1", folder=tmp_path)
    assert not isinstance(other.value, RecordingError), "which would end the rounds in silence"
    np.testing.assert_array_equal(again.frames, along.frames)


def test_it_is_cut_where_the_drive_came_to_harm(drives, town):
    left = drives.drives[2]
    harm_s = float(left.episode.time_s[left.frame_number[2]])
    hit = dataclasses.replace(left.episode, events=(Event(EventKind.COLLISION_STATIC, harm_s, "tree"),))
    along = record_along(town, PaintShy(), drives, hit, name="round-1")
    assert along.episode.time_s[-1] == pytest.approx(harm_s)
    assert along.frame_number[-1] < left.frame_number[2]


def test_a_drive_that_ends_on_the_canvas_says_so(drives, town):
    clean, canvas = drives.drives[0].episode, LEFT.canvas
    ahead_m = np.array([canvas.ahead_m(x, y) for x, y in zip(clean.x_m.tolist(), clean.y_m.tolist(), strict=True)])
    until_s = float(clean.time_s[np.abs(ahead_m).argmin()])
    found = record(town, expert, dataclasses.replace(LEFT, time_limit_s=until_s), **ASKED)
    assert [each.note for each in drives.drives] == [""] * 3
    assert [each.note for each in found.drives] == ["ended before the canvas was passed: time limit"] * 3


def test_a_scenario_that_the_simulator_refuses_leaves_the_folder_to_the_mended_one(town, tmp_path):
    (tmp_path / "none.xodr").write_text("mine")
    for name in ("nope", str(tmp_path / "nope.xodr"), str(tmp_path / "none.xodr")):
        nowhere = dataclasses.replace(LEFT, map_name=name)
        with pytest.raises(ScenarioError, match=r"nope|none"):
            record(town, expert, nowhere, folder=tmp_path / "record", **ASKED)
        assert not (tmp_path / "record").exists()
    assert (tmp_path / "none.xodr").read_text() == "mine"
    own = tmp_path / "record" / "own.xodr"
    own.parent.mkdir()
    own.write_text("mine")
    with pytest.raises(ScenarioError, match="own"):
        record(town, expert, dataclasses.replace(LEFT, map_name=str(own)), folder=own.parent, **ASKED)
    assert [path.name for path in own.parent.iterdir()] == ["own.xodr"]
