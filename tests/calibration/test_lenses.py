"""Calibration behind a lens: edges and points are looked up where the lens shows them."""

import dataclasses

import numpy as np
import pytest

from lenses import LENSES, behind
from references import approach
from roadproof.calibration.compiled import GREY, SQUARES
from roadproof.calibration.outline import fit_outline, moved, outline_errors_px
from roadproof.calibration.published import RUNS, calibration_points, homographies_from_points
from roadproof.calibration.replays import Replays
from roadproof.calibration.report import stated_errors_px
from roadproof.drives import Drive
from roadproof.geometry import CIL_CAMERA, CIL_INPUT
from roadproof.homographies import apply_homography, homogeneous

VIEW = dataclasses.replace(CIL_INPUT, resampling="area")
OFF = np.array([0.004, 0.008, 0.002, 0.08, -0.02, 0.1])
TRUTH = approach(4)


def seen_canvas(image_from_canvas, camera, times=4):
    """Contrast of light and dark paint in each input pixel, by counting points (an area filter)."""
    fine = (np.arange(times) + 0.5) / times - 0.5
    x, y = ((np.arange(count)[:, None] + fine).ravel() for count in (200, 88))
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    there, _ = camera.undistorted(apply_homography(np.linalg.inv(VIEW.input_from_camera), points))
    mapped = there @ np.linalg.inv(image_from_canvas).T
    at = mapped[:, :2] / mapped[:, 2:]
    inside = ((at > -0.5) & (at < 399.5)).all(-1) & (mapped[:, 2] > 0)
    which = np.floor((at + 0.5) * SQUARES / 400).sum(-1)
    contrast = inside * (1 - GREY * (which % 2 == 0))
    return contrast.reshape(88, times, 200, times).mean((1, 3))


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_a_pose_that_is_off_is_mended_behind_a_lens(lens):
    camera = behind(lens)
    visible = np.stack([seen_canvas(each, camera) for each in TRUTH])
    prior = moved(TRUTH, np.tile(OFF, (len(TRUTH), 1)), camera)
    fitted, _ = fit_outline(prior, visible, camera, VIEW)
    assert stated_errors_px(prior, TRUTH, camera).mean() > 4.0
    assert stated_errors_px(fitted, TRUTH, camera).mean() < 0.5
    errors = outline_errors_px(TRUTH, visible, camera, VIEW)
    assert np.nanmean(errors) < 0.25 * np.nanmean(outline_errors_px(TRUTH, visible, CIL_CAMERA, VIEW))


def test_errors_are_those_in_the_picture():
    camera = behind(LENSES[0])
    aside = moved(TRUTH, np.tile([0, 0.01, 0, 0, 0, 0], (len(TRUTH), 1)), camera)
    corner = np.array([[-0.5, -0.5]])
    expected = [
        float(np.linalg.norm(np.diff([camera.distorted(homogeneous(h, corner))[0] for h in pair], axis=0)))
        for pair in zip(TRUTH, aside, strict=True)
    ]
    found = stated_errors_px(aside, TRUTH, camera)
    assert all(np.isclose(found, each).any() for each in expected)


@pytest.mark.parametrize("lens", LENSES[::2], ids=str)
def test_points_are_straightened_before_the_homography_is_fitted(lens):
    camera = behind(lens)
    runs = calibration_points().reshape(RUNS, 5, 2)

    class AllSeen(Replays):
        """Replays that see every point where the lens shows it."""

        def __init__(self):
            pass

        def look(self, drive, target):
            five = runs[int(target.name[-2:]) - 1]
            return camera.distorted(homogeneous(TRUTH, np.broadcast_to(five, (len(TRUTH), 5, 2))))

    found, dropped, residuals = homographies_from_points(AllSeen(), Drive.__new__(Drive), camera)
    assert not dropped
    assert residuals.max() < 1e-6
    for homography, truth in zip(found.values(), TRUTH, strict=True):
        np.testing.assert_allclose(homography, truth / np.linalg.norm(truth), atol=1e-9)
