"""Coverage against supersampled polygons, closed forms and finite differences."""

import numpy as np
import pytest
import torch

from references import approach, supersampled
from roadproof.compositing.view import canvas_pixels
from roadproof.coverage import (
    FOOTPRINT_VARIANCE,
    Footprints,
    Shape,
    coverage,
    footprint_variance,
    polygon_vertices,
    tent_share,
)
from roadproof.geometry import CIL_INPUT, CropResize

BOX = torch.tensor([200.0, 200.0, 60.0, 300.0, 35.0], dtype=torch.float64)


def random_box(rng):
    return np.array(
        [rng.uniform(10, 390), rng.uniform(100, 300), rng.uniform(5, 105), rng.uniform(60, 390), rng.uniform(0, 180)]
    )


def view_of(homography, resampling, every=1):
    index, centre, jacobian = (part[::every] for part in canvas_pixels(homography[None], CIL_INPUT))
    pixels = np.stack([index % 200, index // 200], -1).astype(float)
    return pixels, Footprints.of(centre, jacobian, FOOTPRINT_VARIANCE[resampling], dtype=torch.float64)


def mean_error(homographies, shape, resampling, seed, count=16):
    rng = np.random.default_rng(seed)
    errors = []
    for _ in range(count):
        homography = homographies[rng.integers(len(homographies))]
        pixels, footprints = view_of(homography, resampling, every=13)
        box = random_box(rng)
        exact = supersampled(shape, box, homography, pixels, resampling)
        errors.append(np.abs(coverage(shape, torch.tensor(box), footprints).numpy() - exact).mean())
    return np.mean(errors)


@pytest.mark.parametrize("resampling", ["area", "antialiased-bilinear"])
@pytest.mark.parametrize("shape", list(Shape))
def test_coverage_is_that_of_a_supersampled_figure(shape, resampling):
    assert mean_error(approach(), shape, resampling, seed=0, count=4) < 0.005


@pytest.mark.parametrize("resampling", ["area", "antialiased-bilinear"])
def test_coverage_is_that_of_a_supersampled_rectangle_on_real_homographies(carla_data, resampling):
    stored = [np.load(carla_data / t / "homographies.npz", allow_pickle=False) for t in ("t1", "t2", "t3")]
    homographies = np.concatenate([part["H"][part["consistent"].astype(bool)] for part in stored])
    assert mean_error(homographies, Shape.RECTANGLE, resampling, seed=1) < 0.003


def flat(resampling="area", step=4.0):
    """Footprints seen straight from above, `step` canvas px a pixel."""
    grid = np.stack(np.meshgrid(np.arange(100), np.arange(100)), -1).reshape(-1, 2) * step + 1.5
    slope, variance = np.broadcast_to(np.eye(2) * step, (10_000, 2, 2)), FOOTPRINT_VARIANCE[resampling]
    return Footprints.of(grid, slope, variance, dtype=torch.float64)


@pytest.mark.parametrize("resampling", ["area", "antialiased-bilinear"])
@pytest.mark.parametrize("camera_px", [0.5, 1, 4])
def test_an_edge_is_as_sharp_as_the_input_has_it_larger_smaller_or_as_large_as_its_crop(resampling, camera_px):
    crop, edges = 120, np.linspace(60, 60 + camera_px, 9)
    side = round(crop / camera_px)
    box = {"left_px": 0, "top_px": 0, "right_px": crop, "bottom_px": crop}
    view = CropResize(**box, width_px=side, height_px=side, resampling=resampling)
    place = np.linalg.inv(view.input_from_camera) @ np.stack([np.arange(side), np.full(side, side // 2), np.ones(side)])
    slope = np.broadcast_to(np.eye(2) * camera_px, (side, 2, 2))
    footprints = Footprints.of(place[:2].T, slope, footprint_variance(view), dtype=torch.float64)
    worst = 0.0
    for edge in edges:
        # Straight from above, a canvas px is a pixel of the camera.
        seen = np.clip(edge - (np.arange(crop) - 0.5), 0, 1)
        picture = np.broadcast_to((255 * seen).round().astype(np.uint8)[None, :, None], (crop, crop, 3))
        painted = torch.tensor([edge - 500.0, 60.0, 1000.0, 1000.0, 0.0], dtype=torch.float64)
        made = coverage(Shape.RECTANGLE, painted, footprints).numpy()
        worst = max(worst, np.abs(made - view(picture)[side // 2, :, 0] / 255).max())
    # Boxes enlarged by boxes are steps, which no smooth edge follows.
    assert worst < (0.3 if (resampling, camera_px) == ("area", 0.5) else 0.08)


@pytest.mark.parametrize("shape", list(Shape))
def test_covered_pixels_add_up_to_the_area_of_the_figure(shape):
    corners = polygon_vertices(shape, BOX)
    x, y = corners.T
    area = 0.5 * (x * y.roll(-1) - x.roll(-1) * y).sum().abs()
    assert float(coverage(shape, BOX, flat()).sum() * 16) == pytest.approx(float(area), rel=0.002)


def test_a_sliver_thinner_than_a_pixel_still_counts():
    sliver = torch.tensor([200.0, 200.0, 0.5, 300.0, 20.0], dtype=torch.float64)
    for shape, fill in ((Shape.RECTANGLE, 1.0), (Shape.TRIANGLE, 0.5), (Shape.DIAMOND, 0.5)):
        assert float(coverage(shape, sliver, flat()).sum() * 16) == pytest.approx(150 * fill, rel=0.04)


def test_turning_half_way_round_changes_nothing():
    turned = BOX + torch.tensor([0, 0, 0, 0, 180.0])
    for shape in (Shape.RECTANGLE, Shape.ELLIPSE, Shape.DIAMOND):
        torch.testing.assert_close(coverage(shape, turned, flat()), coverage(shape, BOX, flat()))


def test_positive_rotation_moves_the_far_end_to_the_right():
    x, y = polygon_vertices(Shape.RECTANGLE, BOX)[:2].mean(0)
    assert x > 200
    assert y < 200


def test_the_share_of_a_tent_is_the_integral_of_its_density():
    t = torch.linspace(-1.5, 1.5, 301, dtype=torch.float64, requires_grad=True)
    (density,) = torch.autograd.grad(tent_share(t).sum(), t)
    torch.testing.assert_close(density, (1 - t.detach().abs()).clamp_min(0))


@pytest.mark.parametrize("shape", list(Shape))
def test_gradients_are_exact(shape):
    _, part = view_of(approach()[3], "antialiased-bilinear", every=37)
    box = BOX.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda b: coverage(shape, b, part), (box,), eps=1e-5, atol=1e-5)


@pytest.mark.parametrize("shape", [Shape.RECTANGLE, Shape.TRIANGLE])
def test_gradients_are_those_of_the_supersampled_figure(shape):
    homography = approach()[4]
    pixels, footprints = view_of(homography, "antialiased-bilinear")
    weight = torch.tensor(np.sin(pixels[:, 0] / 9.0) + pixels[:, 1] / 50)
    box = BOX.clone().requires_grad_()
    (gradient,) = torch.autograd.grad((coverage(shape, box, footprints) * weight).sum(), box)
    steps = np.diag([2.0, 2.0, 2.0, 4.0, 1.5])
    for axis, step in enumerate(steps):
        high = supersampled(shape, BOX.numpy() + step, homography, pixels, "antialiased-bilinear")
        low = supersampled(shape, BOX.numpy() - step, homography, pixels, "antialiased-bilinear")
        slope = float((high - low) @ weight.numpy()) / (2 * step[axis])
        assert float(gradient[axis]) == pytest.approx(slope, rel=0.1)
