"""Patterns seen through lenses, against the picture of a far finer pinhole that is bent pixel by pixel."""

import dataclasses
from functools import cache

import numpy as np
import pytest
import torch

from lenses import LENSES, behind
from references import approach
from roadproof.compositing import composite, view_canvas
from roadproof.compositing.published import nearest_canvas_pixels
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CameraModel, CropResize
from roadproof.homographies import apply_homography
from roadproof.lens import Lens
from roadproof.search_space import SearchSpace
from scenes import PLAIN, road_frames

VIEW = dataclasses.replace(CIL_INPUT, resampling="area")
GREY = 110
FINE = CameraModel(width_px=2000, height_px=1500, fov_deg=140.0)
WHOLE = CropResize(left_px=0, top_px=0, right_px=2000, bottom_px=1500, width_px=2000, height_px=1500, resampling="area")
SAMPLES = 5


def pattern(dtype=torch.float32):
    space = SearchSpace(figures=3, family="free")
    return space.pattern(space.random((), torch.Generator().manual_seed(5)).to(dtype))


@cache
def fine_picture():
    """Levels of the pattern on a grey road, as a pinhole with a wide field and many pixels sees it."""
    image_from_canvas = FINE.intrinsics @ np.linalg.inv(CIL_CAMERA.intrinsics) @ approach(8)[6]
    bare = np.full((1, FINE.height_px, FINE.width_px, 3), GREY, np.uint8)
    view = view_canvas(bare, image_from_canvas[None], WHOLE, PLAIN)
    return composite(pattern(), view)[0].permute(1, 2, 0).numpy() * 255


def bent(camera):
    """The fine picture as the camera shows it, and which pixels of the input it fills: 25 points looked up for each."""
    sides = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    x, y = ((np.arange(count)[:, None] + sides).ravel() for count in (VIEW.width_px, VIEW.height_px))
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    there, _ = camera.undistorted(apply_homography(np.linalg.inv(VIEW.input_from_camera), points))
    fine = there @ (FINE.intrinsics @ np.linalg.inv(camera.intrinsics)).T
    ahead = fine[:, 2] > 1e-6
    at = fine[:, :2] / np.where(ahead, fine[:, 2], 1.0)[:, None]
    shown = ahead & ((at > 0) & (at < (FINE.width_px - 1, FINE.height_px - 1))).all(1)
    at = np.where(shown[:, None], at, 0.0)
    low = at.astype(int)
    (right, below), picture = (at - low).T[..., None], fine_picture()
    upper, lower = (
        picture[low[:, 1] + k, low[:, 0]] * (1 - right) + picture[low[:, 1] + k, low[:, 0] + 1] * right for k in (0, 1)
    )
    levels = np.where(shown[:, None], upper * (1 - below) + lower * below, GREY)
    shape = (VIEW.height_px, SAMPLES, VIEW.width_px, SAMPLES)
    return levels.reshape(*shape, 3).mean((1, 3)), shown.reshape(shape).all((1, 3))


def errors(lens):
    """Levels by which the composite is off, away from edges and near them."""
    camera = behind(lens)
    bare = np.full((1, VIEW.height_px, VIEW.width_px, 3), GREY, np.uint8)
    view = view_canvas(bare, approach(8)[6:7], VIEW, PLAIN, camera=camera)
    expected, shown = bent(camera)
    off = np.abs(composite(pattern(), view)[0].permute(1, 2, 0).numpy() * 255 - expected).max(-1)
    near = [np.roll(expected, (row, column), (0, 1)) for row in range(-2, 3) for column in range(-2, 3)]
    flat = np.ptp(near, axis=0).max(-1) < 2
    assert (flat & shown & (np.abs(expected - GREY).max(-1) > 5)).sum() > 200
    return off[flat & shown], off[~flat & shown]


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_a_composite_through_a_lens_is_as_good_as_that_of_a_pinhole(lens):
    away, near = errors(lens)
    _, near_straight = errors(None)
    assert away.max() < 2.0
    assert near.mean() < 1.1 * near_straight.mean() < 0.7


def test_a_lens_that_bends_nothing_is_a_pinhole():
    plain = Lens(model="brown-conrady", coefficients=(0.0,) * 5)
    frames, homographies = road_frames(3, 0), approach(3)
    straight, through = (
        composite(pattern(), view_canvas(frames, homographies, CIL_INPUT, PLAIN, camera=camera))
        for camera in (CIL_CAMERA, behind(plain))
    )
    torch.testing.assert_close(through, straight, rtol=0, atol=1e-5)


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_outside_the_canvas_frames_are_copied_bit_for_bit(lens):
    frames = road_frames(3, 0)
    view = view_canvas(frames, approach(3), CIL_INPUT, PLAIN, camera=behind(lens))
    painted = composite(pattern(), view).permute(0, 2, 3, 1).reshape(-1, 3)
    outside = torch.ones(len(painted), dtype=torch.bool)
    outside[view.index] = False
    assert torch.equal(painted[outside], view.frames.reshape(-1, 3)[outside])
    assert not torch.equal(painted[~outside], view.clean)


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_gradients_through_a_lens_are_exact(lens):
    view = view_canvas(road_frames(1, 0), approach(8)[6:7], CIL_INPUT, PLAIN, camera=behind(lens), dtype=torch.float64)
    space = SearchSpace(figures=2, family="free")
    unit = space.random((1,), torch.Generator().manual_seed(0)).double().requires_grad_()
    weight = torch.randn(1, 1, 3, 88, 200, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    function = lambda point: (composite(space.pattern(point), view) * weight).sum()  # noqa: E731
    assert torch.autograd.gradcheck(function, (unit,), eps=1e-6, atol=1e-4)
    (slope,) = torch.autograd.grad(function(unit), unit)
    assert (slope.abs().sum((0, 2)) > 0).all()


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_the_published_lookup_goes_through_the_lens(lens):
    camera, homography = behind(lens), approach(8)[6]
    lookup = nearest_canvas_pixels(homography[None], CIL_INPUT, camera)[0]
    row, column = 60, 80
    there, _ = camera.undistorted(np.array([[column * 4.0, 115 + row * 395 / 88]]))
    x, y, ahead = (there @ np.linalg.inv(homography).T)[0]
    assert ahead > 0
    assert lookup[row, column] == round(y / ahead) * 400 + round(x / ahead)
    assert (lookup != nearest_canvas_pixels(homography[None], CIL_INPUT)[0]).any()
