"""The recorded world's word against a real drive of the town."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from paint_shy import along_a_street
from roadproof.calibration import CalibrationMethod, calibrate
from roadproof.controllers import load_controller
from roadproof.drives import Swerve, Trajectories, Window, record
from roadproof.driving.rollout import rollout
from roadproof.errors import EpisodeError
from roadproof.pipeline.prediction import Prediction, predict
from roadproof.recordings import pooled
from roadproof.search_space import SearchSpace


def test_a_prediction_with_some_of_the_four_speeds_is_none():
    path, numbers = np.zeros((3, 2)), dict.fromkeys(("predicted_m", "least_m", "most_m", "driven_m"), 0.5)
    numbers |= dict.fromkeys(("path_error_m", "gap_m", "gap_rad"), 0.1)
    paths = {"clean_xy": path, "predicted_xy": path, "driven_xy": path}
    with pytest.raises(EpisodeError, match="some of the four speeds, expected all or none"):
        Prediction(**numbers, **paths, driven_mps=0.5)


@pytest.fixture(scope="module")
def run(town, tmp_path_factory):
    """Drives of the town past a bare canvas, calibrated."""
    scenario, controller = along_a_street(tmp_path_factory.mktemp("street")), load_controller("pilotnet")
    drives = record(
        town,
        controller,
        scenario,
        trajectories=Trajectories(count=3, perturbation=Swerve((0.5,))),
        window=Window(frames=30),
    )
    return controller, scenario, drives, calibrate(town, drives, CalibrationMethod.POSE).recordings


@pytest.mark.slow
def test_what_is_predicted_of_a_pattern_is_close_to_what_the_town_drives(town, run, tmp_path, monkeypatch):
    controller, scenario, drives, recordings = run
    assert recordings.is_placed
    space = SearchSpace(figures=5)
    pattern = space.pattern(space.random((), torch.Generator().manual_seed(4)))
    painted = rollout(town, controller, scenario, pattern=pattern)
    clean = drives.drives[0].episode
    found = predict(recordings, controller, pattern, clean, painted)
    assert found.error_m == pytest.approx(0.0, abs=0.1)
    assert found.path_error_m < 0.4
    # The car is where it is; so is its recorded way.
    assert np.allclose(found.clean_xy[0], found.predicted_xy[0], atol=0.05)
    dim = tuple(replace(drive, frames=drive.frames // 2, weather="clear-sunset") for drive in recordings.recordings)
    both = pooled({"clear-noon": recordings, "clear-sunset": replace(recordings, recordings=dim)})
    assert predict(both, controller, pattern, clean, painted).predicted_m == found.predicted_m
    found.save(tmp_path / "prediction.npz")
    loaded = Prediction.load(tmp_path / "prediction.npz")
    assert loaded.predicted_m == found.predicted_m
    assert np.array_equal(loaded.driven_xy, found.driven_xy)
    # One that crashed before the canvas was seen has no path to compare.
    late = len(painted.time_s) - 3
    whole = {each.name: getattr(painted, each.name) for each in fields(painted)}
    short = replace(painted, **{name: part[:-late] for name, part in whole.items() if isinstance(part, np.ndarray)})
    monkeypatch.setattr("roadproof.pipeline.prediction.passage", lambda *_: slice(10, 10 + len(found.clean_xy)))
    ended = predict(recordings, controller, pattern, clean, short)
    assert (len(ended.driven_xy), ended.path_error_m) == (0, None)
    ended.save(tmp_path / "ended.npz")
    assert Prediction.load(tmp_path / "ended.npz").path_error_m is None


@pytest.mark.slow
def test_perturbed_drives_show_how_fast_the_wheels_turn(run):
    from roadproof.recorded import Vehicle
    from roadproof.simulators.town.physics import MAX_STEER_RAD, STEER_RATE_RAD_S

    _, _, drives, recordings = run
    vehicle = Vehicle.identified([drive.track for drive in recordings.recordings])
    assert vehicle.steer_rate_per_s == pytest.approx(STEER_RATE_RAD_S / MAX_STEER_RAD, rel=0.05)
    assert vehicle.r2 > 0.97
    last = drives.drives[1]
    tested = last.episode.steer[int(last.frame_number[-1]) :]
    assert {-1.0, 1.0} <= set(tested.tolist())


def test_a_damaged_prediction_is_one_clear_line(tmp_path):
    (tmp_path / "prediction.npz").write_bytes(b"no archive")
    with pytest.raises(EpisodeError, match="is damaged"):
        Prediction.load(tmp_path / "prediction.npz")
