"""Lenses against closed forms, plain arithmetic, central differences and their own inverses."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lenses import ACTION, BARREL, LENSES, PINCUSHION, behind
from references import approach
from roadproof.compositing.view import canvas_pixels
from roadproof.errors import GeometryError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CameraModel, sight
from roadproof.lens import Lens


def places(camera, count=41):
    """Places all over a picture, its corners included."""
    x, y = np.linspace(-0.5, camera.width_px - 0.5, count), np.linspace(-0.5, camera.height_px - 0.5, count)
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_what_is_straightened_and_bent_again_is_where_it_was(lens):
    camera = behind(lens)
    points = places(camera)
    there, _ = camera.undistorted(points)
    assert np.abs(camera.distorted(there) - points).max() < 1e-9


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_the_slope_is_the_derivative(lens):
    camera, step = behind(lens), 1e-3
    points = places(camera, 15)
    _, slope = camera.undistorted(points)
    for axis in (0, 1):
        moved = step * np.eye(2)[axis]
        measured = (camera.undistorted(points + moved)[0] - camera.undistorted(points - moved)[0]) / (2 * step)
        np.testing.assert_allclose(slope[..., axis], measured, atol=1e-6 * np.abs(slope).max())


def test_brown_conrady_is_opencvs_formula():
    k1, k2, p1, p2, k3 = BARREL.coefficients
    x, y = 0.4 / 1.3, -0.7 / 1.3
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )
    found = BARREL.distort(*np.array([[0.4], [-0.7], [1.3]]))
    np.testing.assert_allclose(np.ravel(found), expected, rtol=1e-14)


def test_fisheye_is_opencvs_formula():
    k1, k2, k3, k4 = ACTION.coefficients
    x, y = 0.4 / 1.3, -0.7 / 1.3
    r = math.hypot(x, y)
    theta = math.atan(r)
    bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    found = ACTION.distort(*np.array([[0.4], [-0.7], [1.3]]))
    np.testing.assert_allclose(np.ravel(found), (bent / r * x, bent / r * y), rtol=1e-14)


def test_a_fisheye_without_coefficients_shows_angles_and_sees_behind_itself():
    equidistant = Lens(model="fisheye", coefficients=(0.0,) * 4)
    x, y = equidistant.distort(np.array([0.0, 1.0, 1.0]), np.zeros(3), np.array([1.0, 0.0, -1.0]))
    np.testing.assert_allclose(x, [0.0, math.pi / 2, 3 * math.pi / 4], atol=1e-12)
    np.testing.assert_allclose(y, 0.0)
    directions, _ = equidistant.undistort(np.array([[0.0, 3 * math.pi / 4]]))
    np.testing.assert_allclose(directions, [[0.0, math.sqrt(0.5), -math.sqrt(0.5)]], atol=1e-12)


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_tensors_are_bent_as_arrays_are(lens):
    rays = np.random.default_rng(0).normal(size=(3, 500))
    exact = np.stack(lens.distort(*rays))
    np.testing.assert_allclose(
        torch.stack(lens.distort(*torch.tensor(rays), torch)).numpy(), exact, rtol=1e-12, atol=1e-12
    )


@given(
    st.sampled_from(["brown-conrady", "fisheye"]),
    st.lists(st.floats(-0.6, 0.6), min_size=5, max_size=5),
    st.floats(0.0, 1.0),
)
@settings(max_examples=80, deadline=None, derandomize=True)
def test_whatever_is_accepted_shows_every_point_once_and_nothing_from_outside(model, numbers, share):
    k1, k2, p1, p2, k3 = numbers
    brown = (k1, k2, p1 * share / 10, p2 * share / 10, k3)
    lens = Lens(model=model, coefficients=brown if model == "brown-conrady" else (k1, k2, k3, p1 * share))
    reach = min(lens.reach, 2.0)
    if reach <= 0.05:
        return
    turn = np.linspace(0, 2 * math.pi, 24, endpoint=False)
    circle = np.stack([np.cos(turn), np.sin(turn)], -1)
    points = (np.linspace(0.0, 1.0, 12)[:, None, None] * reach * circle).reshape(-1, 2)
    directions, _ = lens.undistort(points)
    assert np.abs(np.stack(lens.distort(*directions.T), -1) - points).max() < 1e-11
    # From the limit on, all that is further aside is shown further out.
    off = lens.limit + np.array([0.0, 1e-3, 0.1, 1.0, 10.0])
    off = off[off < math.pi] if model == "fisheye" else off
    ahead, aside = (np.cos(off), np.sin(off)) if model == "fisheye" else (np.ones_like(off), off)
    shown = np.stack(
        lens.distort(*(np.outer(aside, circle[:, k]) for k in (0, 1)), np.repeat(ahead[:, None], 24, 1)), -1
    )
    far = np.linalg.norm(shown, axis=-1) / lens.reach
    assert (far >= 1 - 1e-9).all()
    assert (np.diff(far, axis=0) > -1e-9).all()


def test_what_is_behind_a_brown_conrady_camera_is_outside_its_picture():
    rays = np.random.default_rng(1).normal(size=(3, 1000))
    rays[2] = -np.abs(rays[2])
    far = np.hypot(*BARREL.distort(*rays))
    assert np.isfinite(far).all()
    assert far.min() > BARREL.reach


def test_pinholes_see_as_they_did():
    points = np.random.default_rng(2).uniform(0, 600, (100, 2))
    there, slope = CIL_CAMERA.undistorted(points)
    np.testing.assert_array_equal(there, np.column_stack([points, np.ones(100)]))
    np.testing.assert_array_equal(slope, np.broadcast_to(np.eye(3, 2), (100, 3, 2)))
    assert "lens" not in CIL_CAMERA.stated
    # The formula of a pinhole, as it stood before there were lenses.
    inverse = np.linalg.inv(CIL_INPUT.input_from_camera @ approach(4))
    columns, rows = np.meshgrid(np.arange(200), np.arange(88))
    mapped = np.swapaxes(inverse @ np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)]), 1, 2)
    for camera in (None, CIL_CAMERA):
        index, centre, jacobian = canvas_pixels(approach(4), CIL_INPUT, camera)
        frame, pixel = np.divmod(index, 88 * 200)
        at, depth = mapped[frame, pixel], mapped[frame, pixel, 2:]
        np.testing.assert_array_equal(centre, at[:, :2] / depth)
        slope = inverse[frame][:, :2, :2] - centre[:, :, None] * inverse[frame][:, 2:, :2]
        np.testing.assert_array_equal(jacobian, slope / depth[:, None])


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_pixels_of_the_input_look_where_their_middles_and_sides_do(lens):
    camera = behind(lens)
    through, slope = sight(CIL_INPUT, camera)
    row, column = 60, 30
    camera_from_input = np.linalg.inv(CIL_INPUT.input_from_camera)

    def looks(x, y):
        there, _ = camera.undistorted((camera_from_input @ [x, y, 1.0])[None, :2])
        return CIL_INPUT.input_from_camera @ there[0]

    pixel = row * 200 + column
    np.testing.assert_allclose(through[:, pixel], looks(column, row), rtol=1e-12)
    by_column = (looks(column + 1e-4, row) - looks(column - 1e-4, row)) / 2e-4
    np.testing.assert_allclose(slope[pixel, :, 0], by_column, atol=1e-6)
    with pytest.raises(ValueError, match="read-only"):
        through[0, 0] = 1.0


@pytest.mark.parametrize(
    ("model", "coefficients", "says"),
    [
        ("brown-conrady", (0.1, 0.0, 0.0, 0.0), "has 4 coefficients, expected 5: k1, k2, p1, p2, k3"),
        ("fisheye", (0.1,) * 5, "has 5 coefficients, expected 4: k1, k2, k3, k4"),
        ("fisheye", (0.1, math.nan, 0.0, 0.0), "has k2 nan, expected −1000 to 1000"),
        ("brown-conrady", (0.1, 0.0, math.inf, 0.0, 0.0), "has p1 inf, expected −1000 to 1000"),
        ("brown-conrady", (-0.5, 0.0, 0.0, 0.0, 0.0), "folds the picture 183 px from its middle, before its corners"),
        ("brown-conrady", (0.0, 0.0, 0.2, 0.0, 0.0), "folds the picture"),
        ("fisheye", (-0.5, 0.0, 0.0, 0.0), "folds the picture"),
    ],
)
def test_lenses_that_make_no_sense_are_refused_in_one_line(model, coefficients, says):
    with pytest.raises(GeometryError, match=says) as refused:
        dataclasses.replace(CIL_CAMERA, lens=Lens(model=model, coefficients=coefficients))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("model", "coefficients", "says"),
    [
        ("pinhole", (0.0,) * 4, "lens model is 'pinhole', expected brown-conrady or fisheye"),
        ("fisheye", [0.0] * 4, r"coefficients \[0\.0, 0\.0, 0\.0, 0\.0\], expected a tuple: k1, k2, k3, k4"),
        ("fisheye", np.zeros(4), r"coefficients array\(.*, expected a tuple"),
    ],
)
def test_lenses_of_another_model_or_type_are_refused_in_one_line(model, coefficients, says):
    unchecked = Lens.__init__.__wrapped__  # as it is without the tests' checks of types
    with pytest.raises(GeometryError, match=says):
        unchecked(object.__new__(Lens), model=model, coefficients=coefficients)


def test_a_lens_that_folds_outside_the_picture_is_accepted():
    fold = Lens(model="brown-conrady", coefficients=(-0.3, 0.0, 0.0, 0.0, 0.0))
    assert fold.limit == pytest.approx(math.sqrt(1 / 0.9))
    assert fold.reach == pytest.approx(2 / 3 * fold.limit)
    narrow = CameraModel(width_px=640, height_px=480, fov_deg=56.0, lens=fold)
    assert narrow.least_focal_px == pytest.approx(400 / fold.reach)
    assert narrow.focal_px > narrow.least_focal_px
    with pytest.raises(GeometryError, match="folds the picture"):
        dataclasses.replace(narrow, fov_deg=60.0)
    assert PINCUSHION.limit == 100.0
