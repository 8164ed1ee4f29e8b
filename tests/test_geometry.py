"""Geometry against closed forms, hand-made cameras and the real CARLA homographies."""

import dataclasses
import math

import numpy as np
import pytest
from PIL import Image

from roadproof.datatypes import VehicleState
from roadproof.errors import GeometryError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CameraModel, CanvasPlacement, CropResize, homography_from_pose
from roadproof.homographies import apply_homography

ORIGIN = VehicleState(x_m=0.0, y_m=0.0, z_m=0.0, yaw_rad=0.0, speed_mps=0.0)
CORNERS = np.array([[0.0, 0.0], [399.0, 0.0], [399.0, 399.0], [0.0, 399.0]])


def ahead(distance_m: float = 12.0, **kwargs: float) -> np.ndarray:
    return homography_from_pose(CIL_CAMERA, ORIGIN, CanvasPlacement(x_m=distance_m, y_m=0.0, **kwargs))


def test_focal_length_is_that_of_carlas_agent():
    assert CIL_CAMERA.focal_px == pytest.approx(335.64, abs=0.005)


def test_a_point_on_the_optical_axis_is_in_the_middle_of_the_picture():
    reach = CIL_CAMERA.up_m / math.tan(math.radians(15.0))
    point = np.array([CIL_CAMERA.forward_m + reach, 0.0, 0.0, 1.0])
    u, v, depth = CIL_CAMERA.image_from_world(ORIGIN) @ point
    assert (u / depth, v / depth) == pytest.approx((399.5, 299.5))
    assert depth == pytest.approx(math.hypot(reach, CIL_CAMERA.up_m))


def test_left_in_the_world_is_left_in_the_picture_and_near_is_low():
    far_left, far_right, near_right, near_left = apply_homography(ahead(), CORNERS)
    assert far_left[0] < far_right[0]
    assert near_left[0] < far_left[0]
    assert near_right[1] > far_right[1]


def test_the_view_does_not_change_when_car_and_canvas_move_together():
    yaw = 0.7
    state = VehicleState(x_m=5.0, y_m=-3.0, z_m=0.2, yaw_rad=yaw, speed_mps=0.0)
    moved = CanvasPlacement(x_m=5 + 12 * math.cos(yaw), y_m=-3 + 12 * math.sin(yaw), z_m=0.2, yaw_rad=yaw)
    np.testing.assert_allclose(homography_from_pose(CIL_CAMERA, state, moved), ahead(), atol=1e-9)


def test_canvas_centre_is_at_its_placement():
    world = CanvasPlacement(x_m=3.0, y_m=4.0, z_m=0.5, yaw_rad=1.0).world_from_canvas @ [199.5, 199.5, 1.0]
    np.testing.assert_allclose(world, [3.0, 4.0, 0.5, 1.0])


def test_input_pixel_centres_are_the_centres_of_their_footprints():
    # Input pixel 0 covers camera columns 0…3, whose centre is 1.5; row 0 covers 395/88 rows from 114.5.
    camera_from_input = np.linalg.inv(CIL_INPUT.input_from_camera)
    u, v, _ = camera_from_input @ [0.0, 0.0, 1.0]
    assert (u, v) == pytest.approx((1.5, 395 / 88 / 2 + 114.5))


@pytest.mark.parametrize("resampling", ["antialiased-bilinear", "area"])
def test_resizing_a_ramp_agrees_with_the_affine_map(resampling):
    crop = CropResize(
        left_px=20, top_px=40, right_px=220, bottom_px=216, width_px=50, height_px=44, resampling=resampling
    )
    ramp = np.broadcast_to(np.arange(256, dtype=np.uint8)[None, :, None], (256, 256, 3))
    columns = crop(np.ascontiguousarray(ramp))[5, 1:-1, 0].astype(float)
    camera_from_input = np.linalg.inv(crop.input_from_camera)
    expected = camera_from_input[0, 0] * np.arange(1, 49) + camera_from_input[0, 2]
    np.testing.assert_allclose(columns, expected, atol=0.51)


def test_resizing_is_pillows_antialiased_bilinear():
    picture = np.random.default_rng(0).integers(0, 256, (600, 800, 3), dtype=np.uint8)
    expected = Image.fromarray(picture[115:510]).resize((200, 88), Image.Resampling.BILINEAR)
    np.testing.assert_array_equal(CIL_INPUT(picture), np.asarray(expected))


@pytest.mark.parametrize(
    "kwargs",
    [
        {"width_px": 0},
        {"width_px": 10**6},
        {"fov_deg": 180.0},
        {"fov_deg": 179.999},
        {"fov_deg": 5e-324},
        {"fov_deg": float("nan")},
        {"up_m": 1e300},
        {"pitch_deg": 1e300},
        {"left_m": float("inf")},
    ],
    ids=lambda kwargs: next(iter(kwargs)),
)
def test_impossible_cameras_are_refused(kwargs):
    with pytest.raises(GeometryError, match=f"camera ({next(iter(kwargs))}|picture)"):
        CameraModel(**({"width_px": 800, "height_px": 600, "fov_deg": 100.0} | kwargs))


def test_an_input_that_fills_the_memory_is_refused():
    with pytest.raises(GeometryError, match="at most 40,000,000 in all"):
        dataclasses.replace(CIL_INPUT, width_px=10**9)


def test_a_picture_smaller_than_the_crop_is_refused():
    with pytest.raises(GeometryError, match="at least 800×510"):
        CIL_INPUT(np.zeros((100, 100, 3), np.uint8))


def test_a_word_that_names_no_resampling_is_refused():
    unchecked = CropResize.__init__.__wrapped__  # as it is without the tests' checks of types
    box = {"left_px": 0, "top_px": 0, "right_px": 8, "bottom_px": 8, "width_px": 4, "height_px": 4}
    with pytest.raises(GeometryError, match="resampling is 'bilinear', expected antialiased-bilinear or area"):
        unchecked(object.__new__(CropResize), **box, resampling="bilinear")
