"""Calibrating short real drives in the town, against the homographies the town itself states."""

import dataclasses

import numpy as np
import pytest
import torch

import needs
from paint_shy import along_a_street
from roadproof.calibration import Calibrated, CalibrationMethod, CalibrationReport, calibrate, replays_needed
from roadproof.compositing import composite, view_canvas
from roadproof.coverage import Shape
from roadproof.drives import Swerve, Trajectories, Window, record
from roadproof.driving.rollout import drive_again, replay, rollout
from roadproof.errors import CalibrationError
from roadproof.patterns import Pattern, raster
from roadproof.processes import Pool
from roadproof.recordings import load_recordings, save_recordings
from roadproof.training.expert import expert

needs.town()
from roadproof.simulators.town.simulator import TownSimulator


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return along_a_street(tmp_path_factory.mktemp("street"), 2.5)


@pytest.fixture(scope="module")
def drives(town, scene):
    asked = Trajectories(perturbation=Swerve((0.5,)))
    return record(town, expert, scene, trajectories=asked, window=Window(frames=8))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("calibration")


@pytest.fixture(scope="module")
def two_paint(town, drives, folder):
    return calibrate(town, drives, folder=folder)


def test_two_paints_find_the_canvas_within_half_a_pixel_for_nine_calls(two_paint):
    report = two_paint.report
    assert report.calls == 9
    assert report.method == "two-paint"
    for drive in report.drives:
        assert drive.stated_px.mean < 0.5
        assert drive.residual_px.mean < 1.0


def test_what_is_composited_is_what_is_seen_of_real_paint(two_paint, town, scene, drives):
    pattern = Pattern(
        (Shape.RECTANGLE,), torch.tensor([[180.0, 200.0, 120.0, 320.0, 20.0]]), torch.tensor([[0.8, 0.3, 0.1]])
    )
    recordings = two_paint.recordings
    clean = recordings.recordings[0]
    painted = []
    rollout(
        town, replay(drives.drives[0].episode), scene, pattern=raster(pattern),
        on_step=lambda seen, _: painted.append(seen.frame),
    )  # fmt: skip
    truth = np.stack([painted[k] for k in clean.frame_number]).astype(float)
    view = view_canvas(clean.frames, clean.image_from_canvas, recordings.view, recordings.colour, maps=clean.maps)
    made = 255 * composite(pattern, view).permute(0, 2, 3, 1).numpy()
    paint = np.abs(truth - clean.frames).max(-1) > 12
    assert paint.sum() > 500
    assert np.abs(made - truth)[paint].mean() < 3.5
    assert np.abs(made - truth)[~paint].mean() < 0.5


@pytest.mark.slow
def test_the_published_way_takes_61_calls_and_finds_the_canvas_within_pixels(town, scene, drives, tmp_path):
    assert drives.calls + replays_needed(len(drives.drives), CalibrationMethod.PUBLISHED) == 61
    # Full pictures take long: one drive only, which begins 13 m before the middle of the canvas.
    near = dataclasses.replace(scene, start=dataclasses.replace(scene.start, x_m=scene.canvas.x_m - 13.0))
    one = record(town, expert, near, trajectories=Trajectories(count=1), window=Window(frames=3))
    shown = []
    with Pool(TownSimulator, 2) as pool:
        found = calibrate(town, one, CalibrationMethod.PUBLISHED, folder=tmp_path, pool=pool, on_call=shown.append)
    assert shown == list(range(12 + 22 + 1))
    assert found.report.calls == 1 + 12 + 22
    assert found.report.drives[0].stated_px.mean < 3.0
    assert found.report.colour_residual < 12.0
    assert found.recordings.recordings[0].maps is None


def test_two_processes_find_what_one_does(town, drives, two_paint, folder):
    with Pool(TownSimulator, 2) as pool:
        found = calibrate(town, drives, folder=folder, pool=pool)
    assert found.recordings.digest() == two_paint.recordings.digest()
    assert found.report.drives == two_paint.report.drives


def test_poses_alone_are_exact_in_the_town_and_take_no_calls_of_their_own(town, drives, two_paint, folder):
    driven = len(list(folder.iterdir()))
    found = calibrate(town, drives, CalibrationMethod.POSE, folder=folder)
    assert len(list(folder.iterdir())) == driven, "light and dark are those of the two-paint calibration"
    assert max(drive.stated_px.p95 for drive in found.report.drives) < 0.01


def test_replays_that_are_kept_are_not_driven_again_and_damaged_ones_are(town, drives, two_paint, folder):
    (folder / "clean-light.npz").write_bytes(b"cut")
    shown = []
    steps = []
    step = town.step

    class Counted(TownSimulator):
        __module__ = TownSimulator.__module__  # one of a user's own would be another simulator

        def __getattribute__(self, name):
            if name in ("_open", "step", "__class__"):
                steps.append(name)
            return getattr(town, name)

    again = calibrate(Counted(), drives, folder=folder, on_call=shown.append)
    assert shown == list(range(7))
    # One replay, and what the type checks of the tests look at.
    assert 0 < steps.count("step") < 2 * int(drives.drives[0].frame_number[-1])
    for one, two in zip(two_paint.recordings.recordings, again.recordings.recordings, strict=True):
        np.testing.assert_array_equal(one.image_from_canvas, two.image_from_canvas)
        assert torch.equal(one.maps.gain, two.maps.gain)
    assert step.__self__ is town


def test_drives_of_another_simulator_are_not_calibrated_here(town, drives, tmp_path):
    settings = dataclasses.replace(drives.settings, world="egl")
    with pytest.raises(CalibrationError, match="recorded in another simulator: egl and the town as software draws it"):
        calibrate(town, dataclasses.replace(drives, settings=settings), folder=tmp_path / "calibration")
    assert not (tmp_path / "calibration").exists()


def test_the_set_and_its_report_survive_their_files(two_paint, tmp_path):
    two_paint.report.save(tmp_path / "report.json")
    assert CalibrationReport.load(tmp_path / "report.json") == two_paint.report
    save_recordings(two_paint.recordings, tmp_path / "recordings")
    loaded = load_recordings(tmp_path / "recordings")
    assert [drive.name for drive in loaded.recordings] == ["clean", "right", "left"]
    (tmp_path / "report.json").write_text("{")
    with pytest.raises(CalibrationError, match="not valid JSON"):
        CalibrationReport.load(tmp_path / "report.json")


def test_a_calibration_is_kept_for_its_own_drives_and_method(two_paint, drives, tmp_path):
    assert Calibrated.kept(tmp_path, drives, CalibrationMethod.TWO_PAINT) is None
    two_paint.save(tmp_path)
    assert Calibrated.kept(tmp_path, drives, CalibrationMethod.TWO_PAINT).report == two_paint.report
    loaded = Calibrated.load(tmp_path)
    assert (loaded.report, loaded.made_of) == (two_paint.report, two_paint.made_of)
    assert [drive.name for drive in loaded.recordings.recordings] == ["clean", "right", "left"]
    assert loaded._repr_html_() == two_paint._repr_html_()
    assert loaded._repr_html_().count("<tr>") == 1 + 3
    with pytest.raises(CalibrationError, match="holds a calibration with method 'two-paint', now it is 'pose'"):
        Calibrated.kept(tmp_path, drives, CalibrationMethod.POSE)
    clean, *others = drives.drives
    steered = dataclasses.replace(clean, episode=dataclasses.replace(clean.episode, steer=clean.episode.steer + 0.01))
    again = dataclasses.replace(drives, drives=(steered, *others))
    with pytest.raises(CalibrationError, match=r"holds a calibration with drives\.clean '"):
        Calibrated.kept(tmp_path, again, CalibrationMethod.TWO_PAINT)
    settings = drives.settings
    canvas = dataclasses.replace(settings.scenario.canvas, length_m=settings.scenario.canvas.length_m + 1.0)
    longer = dataclasses.replace(settings, scenario=dataclasses.replace(settings.scenario, canvas=canvas))
    with pytest.raises(CalibrationError, match="holds a calibration with canvas"):
        Calibrated.kept(tmp_path, dataclasses.replace(drives, settings=longer), CalibrationMethod.TWO_PAINT)
    two_paint.report.save(tmp_path / "calibration" / "report.json")  # alone, it does not say of which drives it is
    with pytest.raises(CalibrationError, match="holds a calibration that does not say what it was made of; choose ano"):
        Calibrated.kept(tmp_path, drives, CalibrationMethod.TWO_PAINT)


def test_recordings_that_were_put_in_another_runs_place_are_refused(two_paint, drives, tmp_path):
    first, *others = two_paint.recordings.recordings
    turned = dataclasses.replace(first, frames=255 - first.frames)
    elsewhere = dataclasses.replace(two_paint.recordings, recordings=(turned, *others))
    dataclasses.replace(two_paint, recordings=elsewhere).save(tmp_path)
    with pytest.raises(CalibrationError, match="drive clean has other frames than were recorded in this run"):
        Calibrated.kept(tmp_path, drives, CalibrationMethod.TWO_PAINT)


def test_a_replay_that_goes_another_way_is_refused(town, drives):
    clean = drives.drives[0]
    elsewhere = dataclasses.replace(clean.episode, x_m=clean.episode.x_m + 0.5)
    wrong = dataclasses.replace(drives, drives=(dataclasses.replace(clean, episode=elsewhere),))
    with pytest.raises(CalibrationError, match=r"a replay of drive clean is 0\.50 m and 0\.0° astray at step"):
        calibrate(town, wrong)


def test_another_camera_is_refused(drives):
    with pytest.raises(CalibrationError, match="another camera, crop or time step"):
        calibrate(TownSimulator(dt_s=0.1), drives)


def test_a_canvas_that_is_not_where_the_scenario_says_is_refused(town, scene, drives, monkeypatch):
    """As if the simulator painted elsewhere: its outline misses the poses by metres."""
    canvas = dataclasses.replace(scene.canvas, x_m=scene.canvas.x_m + 1.5, y_m=scene.canvas.y_m + 1.0)
    scenario = dataclasses.replace(scene, canvas=canvas)
    monkeypatch.setattr(
        "roadproof.calibration.replays.drive_again", lambda sim, drive, _, **how: drive_again(sim, drive, scene, **how)
    )
    moved = dataclasses.replace(drives, settings=dataclasses.replace(drives.settings, scenario=scenario))
    with pytest.raises(CalibrationError, match=r"miss what was seen by .* px on average"):
        calibrate(town, moved, CalibrationMethod.POSE)


def test_a_canvas_that_never_shows_is_refused(town, drives, monkeypatch):
    """As if something stood before all of it: light and dark look alike."""
    monkeypatch.setattr(
        "roadproof.calibration.replays.drive_again",
        lambda sim, drive, scenario, **how: drive_again(sim, drive, scenario, **how | {"pattern": None}),
    )
    with pytest.raises(CalibrationError, match="drive clean: light and dark frames do not differ anywhere"):
        calibrate(town, drives)
