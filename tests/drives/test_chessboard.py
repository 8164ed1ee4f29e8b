"""The camera that chessboards tell, against the camera that drew them, OpenCV's projections and its calibration."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chessboards import CORNERS, inner, poses, shown, write_boards
from lenses import ACTION, BARREL, PINCUSHION
from roadproof.drives.own.boards import Boards, boards_in
from roadproof.drives.own.bundle import Bundle
from roadproof.drives.own.chessboard import calibrated
from roadproof.drives.own.plan import Chessboard
from roadproof.errors import RecordingError
from roadproof.geometry import CameraModel

cv2 = pytest.importorskip("cv2", reason="chessboards need the extra roadproof[chessboard]")

GRID = inner()[:, :2] - [4.0, 2.5]
CAMERA = CameraModel(width_px=480, height_px=360, fov_deg=62.0)
CAMERAS = {
    "pinhole": CAMERA,
    "barrel": replace(CAMERA, lens=BARREL),
    "pincushion": replace(CAMERA, fov_deg=45.0, lens=PINCUSHION),
    "fisheye": replace(CAMERA, fov_deg=100.0, lens=ACTION),
}


def kind(camera):
    return "brown-conrady" if camera.lens is None else camera.lens.model


def seen_by(camera, boards, noise_px=0.0, seed=0):
    """The corners that a camera shows, found to some px."""
    seen = np.stack([shown(camera, pose) for pose in boards])
    seen += np.random.default_rng(seed).normal(0.0, noise_px, seen.shape)
    return Boards(names=tuple(f"{k:02}.png" for k in range(len(boards))), seen_px=seen, grid=GRID, left_out="")


def aside_by(boards, right_px, down_px):
    """The same corners behind a lens whose middle is elsewhere in the picture."""
    return replace(boards, seen_px=boards.seen_px + np.array([right_px, down_px]))


def off_px(camera, true):
    """By how much a camera misses where another shows what lies all over its picture, px."""
    x, y = np.linspace(-0.5, true.width_px - 0.5, 41), np.linspace(-0.5, true.height_px - 0.5, 41)
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    directions = true.undistorted(places)[0] @ np.linalg.inv(true.intrinsics).T
    return np.linalg.norm(camera.distorted(directions @ camera.intrinsics.T) - places, axis=1)


@pytest.mark.parametrize("name", CAMERAS)
def test_pictures_tell_the_camera_that_drew_them(tmp_path, name):
    true = CAMERAS[name]
    write_boards(tmp_path / "boards", true, poses(true, 20, seed=1))
    stated = Chessboard(pictures="boards", corners=CORNERS, lens=kind(true))
    found = calibrated(replace(CAMERA, fov_deg=80.0), boards_in(tmp_path, CAMERA, stated), kind(true))
    assert found.camera.fov_deg == pytest.approx(true.fov_deg, abs=0.1)
    assert found.missed_px < 0.3
    assert off_px(found.camera, true).max() < 0.5
    assert (found.camera.lens is None) == (true.lens is None)
    assert found.middle_px == (0.0, 0.0)
    assert f"{len(list((tmp_path / 'boards').iterdir()))} pictures of a chessboard" in str(found)


def test_blur_and_noise_cost_little(tmp_path):
    true = CAMERAS["barrel"]
    write_boards(tmp_path / "boards", true, poses(true, 20, seed=1), blur_px=1.5, noise=6.0)
    found = calibrated(CAMERA, boards_in(tmp_path, CAMERA, Chessboard(pictures="boards", corners=CORNERS)), kind(true))
    assert found.camera.fov_deg == pytest.approx(true.fov_deg, abs=0.1)
    assert found.missed_px < 0.3
    assert math.sqrt(np.square(off_px(found.camera, true)).mean()) < 0.5


@pytest.mark.parametrize("name", ["barrel", "pincushion", "fisheye"])
def test_what_opencv_projects_is_fitted_with_opencvs_coefficients(name):
    true = CAMERAS[name]
    points = (inner() - [4.0, 2.5, 0.0])[None]
    project = cv2.fisheye.projectPoints if name == "fisheye" else cv2.projectPoints
    seen = []
    for turn, place in poses(true, 12):
        turned, middle = cv2.Rodrigues(turn)[0], place + turn @ [4.0, 2.5, 0.0]
        projected, _ = project(points, turned, middle, true.intrinsics, np.array(true.lens.coefficients))
        seen.append(projected.reshape(-1, 2))
    bundle = Bundle(kind(true), np.stack(seen), GRID, true.intrinsics[:2, 2])
    free = np.ones(bundle.middle.stop, bool)
    fit = bundle.fitted(free, *bundle.begun(CAMERA.focal_px * np.array([0.5, 1.0, 2.0])))
    assert np.abs(fit.missed_px).max() < 1e-6
    assert math.exp(fit.shared[0]) == pytest.approx(true.focal_px, rel=1e-8)
    np.testing.assert_allclose(fit.shared[bundle.coefficients], true.lens.coefficients, atol=1e-5)
    np.testing.assert_allclose(fit.shared[bundle.middle], 0.0, atol=1e-5)


def test_the_fit_is_that_of_opencvs_calibration_with_a_centred_lens():
    seen = seen_by(CAMERAS["barrel"], poses(CAMERAS["barrel"], 12), noise_px=0.2).seen_px
    bundle = Bundle("brown-conrady", seen, GRID, CAMERA.intrinsics[:2, 2])
    free = np.ones(bundle.middle.stop, bool)
    free[bundle.middle] = False
    fit = bundle.fitted(free, *bundle.begun([CAMERA.focal_px]))
    fixed = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_USE_INTRINSIC_GUESS
    missed_px, intrinsics, coefficients, *_ = cv2.calibrateCamera(
        [inner().astype(np.float32)] * len(seen),
        seen.astype(np.float32),
        (480, 360),
        CAMERA.intrinsics,
        None,
        flags=fixed,
        criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-12),
    )
    assert math.sqrt(np.square(fit.missed_px).sum(-1).mean()) == pytest.approx(missed_px, rel=1e-5)
    assert math.exp(fit.shared[0]) == pytest.approx(intrinsics[0, 0], rel=1e-4)
    np.testing.assert_allclose(fit.shared[bundle.coefficients], coefficients.ravel(), atol=2e-3)


def test_the_covariance_is_that_of_fits_without_each_picture_in_turn():
    true = CAMERAS["fisheye"]
    seen = seen_by(true, poses(true, 12), 0.1).seen_px
    seen[3] += 0.3 * GRID[:, :1] ** 2 / 4.0**2  # this one shows the board a little bent
    bundle = Bundle("fisheye", seen, GRID, true.intrinsics[:2, 2])
    free = np.ones(bundle.middle.stop, bool)
    fit = bundle.fitted(free, *bundle.begun([true.focal_px]))
    without = []
    for k in range(len(seen)):
        others = Bundle("fisheye", np.delete(seen, k, 0), GRID, bundle.centre_px)
        without.append(others.fitted(free, fit.shared, np.delete(fit.poses, k, 0)).shared)
    changed = np.stack(without) - fit.shared
    jackknife = (len(seen) - 1) / len(seen) * changed.T @ changed
    error, expected = (np.sqrt(each.diagonal()) for each in (fit.covariance, jackknife))
    np.testing.assert_allclose(error, expected, rtol=0.1)
    alike = np.corrcoef(
        (fit.covariance / np.outer(error, error)).ravel(), (jackknife / np.outer(expected, expected)).ravel()
    )
    assert alike[0, 1] > 0.99


@pytest.mark.slow
def test_the_stated_uncertainty_is_that_of_noise():
    true, boards = CAMERAS["barrel"], poses(CAMERAS["barrel"], 8, seed=4)
    found = [calibrated(CAMERA, seen_by(true, boards, 0.15, seed), "brown-conrady") for seed in range(25)]
    fov = [abs(each.camera.fov_deg - true.fov_deg) / each.fov_error_deg for each in found]
    places = [math.sqrt(np.square(off_px(each.camera, true)).mean()) / each.unknown_px for each in found]
    # 95 % lie within, by the binomial distribution at least 21 of 25; and they would not within half of it.
    for within in (fov, places):
        assert sum(each <= 1.0 for each in within) >= 21
        assert max(within) > 0.5


@pytest.mark.parametrize("fov_deg", [25.0, 130.0])
def test_the_field_of_view_that_is_stated_does_not_count(fov_deg):
    seen = seen_by(CAMERAS["barrel"], poses(CAMERAS["barrel"], 6, seed=3), 0.1)
    one, two = (calibrated(replace(CAMERA, fov_deg=fov), seen, "brown-conrady") for fov in (62.0, fov_deg))
    assert two.camera.fov_deg == pytest.approx(one.camera.fov_deg, abs=1e-3)


def test_a_lens_whose_middle_is_beside_the_pictures_is_told_with_what_to_cut():
    true = CAMERAS["barrel"]
    seen = seen_by(true, poses(true, 15, seed=3), 0.1)
    aside = calibrated(CAMERA, aside_by(seen, 8.0, -6.0), "brown-conrady")
    assert aside.middle_px == pytest.approx((8.0, -6.0), abs=3.0)
    right, down = (round(each) for each in aside.middle_px)
    told = (
        f"{right} px right of and {-down} px above the picture's: cut {2 * right} columns from the left and {-2 * down}"
    )
    assert f"the lens's middle is {told} rows from the bottom of all pictures" in str(aside)
    assert aside.fov_error_deg > abs(aside.camera.fov_deg - true.fov_deg)
    assert "cut" not in str(calibrated(CAMERA, seen, "brown-conrady"))


def test_a_lens_whose_middle_changes_the_field_of_view_much_is_refused():
    true = replace(CAMERAS["fisheye"], fov_deg=115.0)
    seen = seen_by(true, poses(true, 15, seed=3), 0.05)
    with pytest.raises(
        RecordingError, match=r"fit no lens that is centred .* cut 50 columns from the right and 40 rows"
    ):
        calibrated(CAMERA, aside_by(seen, -25.0, 20.0), "fisheye")


def facing(count, most_tilt_deg):
    """Boards all over a pinhole's picture that are, but for some degrees, parallel to it."""
    rng, found = np.random.default_rng(0), []
    for _ in range(count):
        tilts = rng.uniform(-1.0, 1.0, 3) * [most_tilt_deg, most_tilt_deg, 20.0]
        turn = Rotation.from_euler("xyz", tilts, degrees=True).as_matrix()
        far = rng.uniform(12.0, 25.0)
        place = np.array([rng.uniform(-0.25, 0.25) * far, rng.uniform(-0.2, 0.2) * far, far])
        found.append((turn, place - turn @ [4.0, 2.5, 0.0]))
    return found


@pytest.mark.parametrize(("most_tilt_deg", "noise_px"), [(0.0, 0.0), (0.0, 0.1), (3.0, 0.1)])
def test_boards_that_all_face_the_camera_are_refused(most_tilt_deg, noise_px):
    with pytest.raises(RecordingError, match=r"the field of view by ± [\d.]+°: tilt the board by 20 to 40 degrees"):
        calibrated(CAMERA, seen_by(CAMERA, facing(10, most_tilt_deg), noise_px), "brown-conrady")


def test_corners_that_no_such_lens_shows_are_refused_with_the_picture_that_shows_it_most():
    with pytest.raises(RecordingError, match=r"corners are missed by 5\.\d px \(rms; most in \d\d\.png, \d"):
        calibrated(CAMERA, seen_by(CAMERA, poses(CAMERA, 10), 4.0), "brown-conrady")
    wide = replace(CAMERAS["fisheye"], fov_deg=118.0)
    with pytest.raises(RecordingError, match="a wide lens may be none of the kind brown-conrady"):
        calibrated(CAMERA, seen_by(wide, poses(wide, 20, seed=1), 0.1), "brown-conrady")


def test_a_picture_whose_corners_are_mistaken_is_left_out_by_name():
    true = CAMERAS["barrel"]
    seen = seen_by(true, poses(true, 12), 0.1)
    seen.seen_px[7, 0] += 30.0
    found = calibrated(CAMERA, seen, "brown-conrady")
    assert found.left_out == "the corners do not fit those of the other pictures in 07.png"
    assert found.pictures == 11
    assert found.camera.fov_deg == pytest.approx(true.fov_deg, abs=2 * found.fov_error_deg)
    assert found.left_out in str(found)
