"""Edges of canvas and squares against a plain supersampled picture of them."""

import dataclasses
from contextlib import nullcontext

import numpy as np
import pytest

from references import approach
from roadproof.calibration import outline
from roadproof.calibration.calibrate import _check as require_good
from roadproof.calibration.compiled import GREY, SQUARES
from roadproof.calibration.outline import fit_outline, moved, outline_errors_px, predicted_contrast
from roadproof.calibration.replays import Replays
from roadproof.calibration.report import Spread, stated_errors_px
from roadproof.calibration.two_paint import look_at_paints
from roadproof.datatypes import VehicleState
from roadproof.drives.folder import read_drive
from roadproof.errors import CalibrationError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CanvasPlacement, homography_from_pose
from roadproof.lens import Lens
from team_folder import write_recorded

OFF = np.array([0.004, 0.008, 0.002, 0.08, -0.02, 0.1])
"""A camera that looks 0.2° lower, 0.5° aside, is turned by 0.1°, and 8, 2 and 10 cm away."""


def seen_canvas(image_from_canvas, times=6):
    """Contrast of light and dark paint in each input pixel, by counting points (an area filter)."""
    inverse = np.linalg.inv(CIL_INPUT.input_from_camera @ image_from_canvas)
    fine = (np.arange(times) + 0.5) / times - 0.5
    columns = (np.arange(200)[:, None] + fine).ravel()
    rows = (np.arange(88)[:, None] + fine).ravel()
    x, y = np.meshgrid(columns, rows)
    mapped = np.stack([x, y, np.ones_like(x)], -1) @ inverse.T
    at = mapped[..., :2] / mapped[..., 2:]
    inside = ((at > -0.5) & (at < 399.5)).all(-1) & (mapped[..., 2] > 0)
    with np.errstate(invalid="ignore"):
        which = np.floor((np.nan_to_num(at) + 0.5) * SQUARES / 400).sum(-1)
    contrast = inside * (1 - GREY * (which % 2 == 0))
    return contrast.reshape(88, times, 200, times).mean((1, 3))


@pytest.fixture(scope="module")
def scene():
    truth = approach(8)
    view = dataclasses.replace(CIL_INPUT, resampling="area")
    return truth, np.stack([seen_canvas(each) for each in truth]), view


def error_px(found, truth):
    return stated_errors_px(found, truth, CIL_CAMERA).mean()


def test_a_pose_that_is_off_is_mended_to_a_tenth_of_its_error_and_below_half_a_pixel(scene):
    truth, visible, view = scene
    prior = moved(truth, np.tile(OFF, (len(truth), 1)), CIL_CAMERA)
    fitted, outline_px = fit_outline(prior, visible, CIL_CAMERA, view)
    before, after = error_px(prior, truth), error_px(fitted, truth)
    assert before > 5.0
    assert after < 0.5
    assert np.nanmean(outline_px) < 0.5 * np.nanmean(outline_errors_px(prior, visible, CIL_CAMERA, view))


@pytest.mark.parametrize("refine", [True, False])
@pytest.mark.parametrize(
    ("ahead_m", "aside_m", "lower_deg", "accepted"),
    [(0.0, 0.3, 0.3, True), (0.0, 4.0, 0.0, False), (8.0, 0.0, 0.0, False), (0.0, 0.0, 20.0, False)],
)
def test_a_canvas_that_lies_elsewhere_is_refused_however_far(tmp_path, refine, ahead_m, aside_m, lower_deg, accepted):
    def poses(x_m, y_m, pitch_deg):
        camera = dataclasses.replace(CIL_CAMERA, pitch_deg=CIL_CAMERA.pitch_deg + pitch_deg)
        canvas = CanvasPlacement(x_m=x_m, y_m=y_m, width_m=3.5, length_m=6.0)
        states = [VehicleState(at_m, 0.0) for at_m in np.linspace(0.0, 8.0, 6).tolist()]
        return np.stack([homography_from_pose(camera, state, canvas) for state in states])

    share, contrast = predicted_contrast(poses(18.0 + ahead_m, aside_m, lower_deg), CIL_INPUT, CIL_CAMERA)
    light = 60.0 + 140.0 * share
    shown = {"light": light, "dark": np.clip(light - 170.0 * contrast, 0, 255)}
    if accepted:
        # Leaves that moved between the two replays.
        shown["light"] = light + 12.0 * (np.indices(light.shape)[1] < 10)
    frames = {name: np.repeat(values[..., None], 3, -1).round().astype(np.uint8) for name, values in shown.items()}

    class Seen(Replays):
        def __init__(self):
            """Nothing is driven."""

        def look(self, drive, target):
            return frames[target.name]

    write_recorded(tmp_path)
    drive = read_drive("clean", tmp_path / "record")
    drive = dataclasses.replace(
        drive, frames=frames["light"], frame_number=np.arange(6), steer=np.zeros(6), right_m=np.zeros(6)
    )
    geometry, _ = look_at_paints(Seen(), drive, poses(18.0, 0.0, 0.0), CIL_CAMERA, CIL_INPUT, refine=refine)
    said = "of what is seen of the canvas lies where the pose has none of it"
    with nullcontext() if accepted else pytest.raises(CalibrationError, match=said):
        require_good(drive, geometry)


def test_a_pose_that_is_right_stays_right(scene):
    truth, visible, view = scene
    assert error_px(fit_outline(truth, visible, CIL_CAMERA, view)[0], truth) < 0.3


def test_light_that_changes_over_the_canvas_does_not_move_it(scene):
    truth, visible, view = scene
    lit = visible * np.linspace(0.4, 0.9, 200) * np.linspace(0.7, 1.0, 88)[:, None]
    prior = moved(truth, np.tile(OFF, (len(truth), 1)), CIL_CAMERA)
    assert error_px(fit_outline(prior, lit, CIL_CAMERA, view)[0], truth) < 0.6


def test_what_stands_in_the_way_is_not_taken_for_the_edge_of_the_canvas(scene):
    truth, visible, view = scene
    hidden = visible.copy()
    hidden[:, :, 92:98] = 0.0
    assert visible[:, :, 92:98].sum() > 100
    prior = moved(truth, np.tile(OFF, (len(truth), 1)), CIL_CAMERA)
    assert error_px(fit_outline(prior, hidden, CIL_CAMERA, view)[0], truth) < 1.0


def test_what_some_frames_show_carries_over_to_frames_that_show_nothing(scene):
    truth, visible, view = scene
    blind = visible.copy()
    blind[-1] = 0.0
    prior = moved(truth, np.tile(OFF, (len(truth), 1)), CIL_CAMERA)
    fitted, _ = fit_outline(prior, blind, CIL_CAMERA, view)
    assert error_px(fitted[-1:], truth[-1:]) < 0.25 * error_px(prior[-1:], truth[-1:])
    assert np.isnan(outline_errors_px(truth, np.zeros_like(visible), CIL_CAMERA, view)).all()


def test_a_pose_without_doubt_is_not_moved(scene, monkeypatch):
    truth, visible, view = scene
    prior = moved(truth, np.tile(OFF, (len(truth), 1)), CIL_CAMERA)
    for doubt in ("COMMON_DOUBT", "OWN_DOUBT"):
        monkeypatch.setattr(f"roadproof.calibration.outline.{doubt}", (1e-7,) * 6)
    fitted, _ = fit_outline(prior, visible, CIL_CAMERA, view)
    np.testing.assert_allclose(fitted, prior, rtol=1e-3, atol=1e-2)


def test_a_move_turns_and_shifts_the_camera(scene):
    truth, _, _ = scene
    shifted = moved(truth, np.tile([0, 0, 0, 0, 0, 0.5], (len(truth), 1)), CIL_CAMERA)
    np.testing.assert_allclose(shifted[:, 2] - truth[:, 2], np.tile([0, 0, 0.5], (len(truth), 1)), atol=1e-9)
    # A turn about the camera's y axis by ω moves the middle of the picture by f tan ω.
    centre = np.array([399.5, 299.5, 1.0])
    turned = moved(truth, np.tile([0, 0.01, 0, 0, 0, 0], (len(truth), 1)), CIL_CAMERA)
    there = turned @ np.linalg.inv(truth) @ centre
    np.testing.assert_allclose(there[:, 0] / there[:, 2] - 399.5, CIL_CAMERA.focal_px * np.tan(0.01), rtol=1e-6)


def test_errors_count_only_points_in_view(scene):
    truth, _, _ = scene
    assert stated_errors_px(truth, truth, CIL_CAMERA).max() < 1e-6
    aside = moved(truth, np.tile([0, 0.01, 0, 0, 0, 0], (len(truth), 1)), CIL_CAMERA)
    errors = stated_errors_px(aside, truth, CIL_CAMERA)
    assert 0 < len(errors) <= len(truth) * 81
    assert errors.mean() == pytest.approx(CIL_CAMERA.focal_px * 0.01, rel=0.5)
    assert Spread.of(np.empty(0)) is None


FISHEYE = dataclasses.replace(CIL_CAMERA, lens=Lens(model="fisheye", coefficients=(0.0, 0.0, 0.0, 0.0)))


@pytest.mark.parametrize("camera", [CIL_CAMERA, FISHEYE], ids=["pinhole", "fisheye"])
def test_no_pixel_that_sees_the_canvas_is_left_out(camera, monkeypatch):
    canvas = CanvasPlacement(x_m=0.0, y_m=0.0, width_m=7.6, length_m=9.5)
    places = [
        (x, y, yaw) for x in (-25.0, -14.0, -7.0, -2.0, 3.0) for y in (-6.0, 0.0, 1.5) for yaw in (-0.3, 0.0, 0.1)
    ]
    states = [VehicleState(x_m=x, y_m=y, z_m=0.0, yaw_rad=yaw, speed_mps=5.0) for x, y, yaw in places]
    homographies = np.stack([homography_from_pose(camera, state, canvas) for state in states])
    found = predicted_contrast(homographies, CIL_INPUT, camera)
    assert found[0].max() > 0.99
    everywhere = lambda h, _, through: np.ones((len(h), through.shape[1]), bool)  # noqa: E731
    monkeypatch.setattr(outline, "_may_see_canvas", everywhere)
    for few, full in zip(found, predicted_contrast(homographies, CIL_INPUT, camera), strict=True):
        assert np.array_equal(few, full)


def test_the_predicted_contrast_is_what_points_counted_in_every_pixel_give(scene):
    truth, visible, view = scene
    share, contrast = predicted_contrast(truth, view, CIL_CAMERA)
    assert share.min() >= 0.0
    assert share.max() == pytest.approx(1.0)
    off = np.abs(contrast - visible)
    assert off[visible > 0].mean() < 0.02
    assert off.max() < 0.25
    assert not contrast[share == 0.0].any()
    canvas = CanvasPlacement(x_m=0.0, y_m=0.0, width_m=7.6, length_m=9.5)
    behind = homography_from_pose(CIL_CAMERA, VehicleState(x_m=40.0, y_m=0.0), canvas)
    assert predicted_contrast(behind[None], view, CIL_CAMERA)[0].max() < 0.01
