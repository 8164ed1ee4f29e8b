"""Homographies: their fit to points, outliers, and what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from references import homography_jacobian
from roadproof.datatypes import VehicleState
from roadproof.errors import GeometryError
from roadproof.geometry import CIL_CAMERA, CanvasPlacement, homography_from_pose
from roadproof.homographies import (
    apply_homography,
    check_image_from_canvas,
    homography_from_points,
    reprojection_errors_px,
)

ORIGIN = VehicleState(x_m=0.0, y_m=0.0, z_m=0.0, yaw_rad=0.0, speed_mps=0.0)
CORNERS = np.array([[0.0, 0.0], [399.0, 0.0], [399.0, 399.0], [0.0, 399.0]])


def ahead(distance_m: float = 12.0) -> np.ndarray:
    return homography_from_pose(CIL_CAMERA, ORIGIN, CanvasPlacement(x_m=distance_m, y_m=0.0))


@given(st.integers(4, 60), st.integers(0, 10_000))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_a_homography_is_recovered_from_exact_points(count, seed):
    rng = np.random.default_rng(seed)
    # The far half of the canvas is in front of the camera from every one of these poses.
    truth = ahead(rng.uniform(11.0, 25.0))
    canvas = np.concatenate([CORNERS, rng.uniform(0, 399, (count - 4, 2))])
    fitted = homography_from_points(canvas, apply_homography(truth, canvas))
    assert reprojection_errors_px(fitted, canvas, apply_homography(truth, canvas)).max() < 1e-6
    np.testing.assert_allclose(fitted, truth / np.linalg.norm(truth), atol=1e-9)


def test_outliers_are_left_out_when_asked():
    rng = np.random.default_rng(1)
    canvas = rng.uniform(0, 399, (60, 2))
    image = apply_homography(ahead(), canvas) + rng.normal(0, 0.2, (60, 2))
    clean = apply_homography(ahead(), canvas)
    image[:12] += 80.0
    assert reprojection_errors_px(homography_from_points(canvas, image), canvas, clean).max() > 5
    fitted = homography_from_points(canvas, image, outlier_px=2.0)
    assert reprojection_errors_px(fitted, canvas, clean).max() < 0.6
    np.testing.assert_array_equal(fitted, homography_from_points(canvas, image, outlier_px=2.0))


def test_the_jacobian_is_the_derivative():
    points = np.random.default_rng(2).uniform(50, 350, (20, 2))
    jacobian = homography_jacobian(ahead(), points)
    for axis, step in enumerate(np.eye(2) * 1e-4):
        slope = (apply_homography(ahead(), points + step) - apply_homography(ahead(), points - step)) / 2e-4
        np.testing.assert_allclose(jacobian[:, :, axis], slope, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("canvas", "image", "message"),
    [
        (CORNERS[:3], CORNERS[:3], "at least 4"),
        (CORNERS, CORNERS[:3], "as many"),
        (np.linspace([0, 0], [399, 200], 10), np.linspace([100, 300], [400, 400], 10), "on a line"),
        (CORNERS, np.where(CORNERS > 0, np.nan, 0.0), "NaN"),
    ],
)
def test_degenerate_points_are_refused(canvas, image, message):
    with pytest.raises(GeometryError, match=message):
        homography_from_points(canvas, image)


def test_points_behind_the_camera_are_refused():
    under_the_car = homography_from_pose(CIL_CAMERA, ORIGIN, CanvasPlacement(x_m=1.0, y_m=0.0))
    canvas = np.random.default_rng(0).uniform(0, 399, (30, 2))
    with pytest.raises(GeometryError, match="behind the camera"):
        homography_from_points(canvas, apply_homography(under_the_car, canvas))


def test_homographies_of_wrong_sign_or_rank_are_refused():
    check_image_from_canvas(ahead())
    with pytest.raises(GeometryError, match="wrong sign"):
        check_image_from_canvas(-ahead())
    with pytest.raises(GeometryError, match="rank"):
        check_image_from_canvas(np.outer([1.0, 2.0, 3.0], [0.1, 0.2, 1.0]))
    with pytest.raises(GeometryError, match="NaN"):
        check_image_from_canvas(np.full((3, 3), np.nan))


def test_real_homographies_have_the_right_sign_and_look_at_the_road(carla_data):
    for trajectory in ("t1", "t2", "t3"):
        stored = np.load(carla_data / trajectory / "homographies.npz", allow_pickle=False)
        for homography in stored["H"][stored["consistent"].astype(bool)]:
            check_image_from_canvas(homography)
            depth = homography[2] @ [199.5, 100.0, 1.0]
            assert depth > 0
