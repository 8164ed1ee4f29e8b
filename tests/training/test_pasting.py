"""Pasted paint lies on the road where the camera sees it, in its share of the pictures, and nowhere else."""

import numpy as np
import torch

from roadproof.datatypes import VehicleState
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CanvasPlacement, homography_from_pose
from roadproof.homographies import apply_homography
from roadproof.training.pasting import FARTHEST_M, PastedPaint, _covered, ground_seen


def grey(count):
    return torch.full((count, 3, 88, 200), 0.45)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def test_its_share_of_the_pictures_gets_paint_and_the_input_is_left_alone():
    given = grey(300)
    painted = PastedPaint(0.3)(given, seeded())
    assert torch.equal(given, grey(300))
    share = float((painted != given).flatten(1).any(dim=1).float().mean())
    assert 0.15 < share < 0.4  # some rectangles lie outside the picture
    assert painted.min() >= 0.0
    assert painted.max() <= 1.0
    assert PastedPaint(0.0)(given, seeded()) is given


def test_no_paint_in_the_sky():
    painted = PastedPaint(1.0)(grey(100), seeded(1))
    horizon_px = 300 - CIL_CAMERA.focal_px * np.tan(np.radians(15))
    sky = int((horizon_px - CIL_INPUT.top_px) * 88 / 395)
    assert sky > 5
    assert torch.equal(painted[:, :, :sky], grey(100)[:, :, :sky])


def test_the_ground_is_where_the_homography_of_a_canvas_puts_it():
    inside, ground = ground_seen(CIL_CAMERA, CIL_INPUT)
    canvas = CanvasPlacement(x_m=10.0, y_m=0.5)
    image_from_canvas = homography_from_pose(CIL_CAMERA, VehicleState(0.0, 0.0, 0.0, 0.0, 0.0), canvas)
    spots = np.array([[50.0, 60.0], [200.0, 200.0], [300.0, 390.0]])
    world = canvas.world_from_canvas @ np.column_stack([spots, np.ones(3)]).T
    seen = apply_homography(CIL_INPUT.input_from_camera @ image_from_canvas, spots)
    pixels = np.column_stack([inside.numpy() % 200, inside.numpy() // 200])
    for place, (x, y) in zip(world.T[:, :2], seen, strict=True):
        nearest = np.abs(pixels - (x, y)).sum(axis=1).argmin()
        np.testing.assert_allclose(ground[nearest], place, atol=0.6)
    assert ground[:, 0].max() < FARTHEST_M


def test_a_rectangle_covers_what_lies_in_its_own_axes():
    ground = torch.tensor([[10.0, 0.0], [13.0, 0.0], [10.0, 1.2], [12.0, 2.0]])
    box = torch.tensor([[10.0, 0.0, 1.0, 6.5, 0.0], [10.0, 0.0, 1.0, 6.5, np.pi / 4]], dtype=torch.float32)
    covered = _covered(ground, box)[:, 0]
    assert covered.tolist() == [[1, 1, 0, 0], [1, 0, 0, 1]]


def test_the_same_seed_pastes_alike():
    paste = PastedPaint(0.7)
    assert torch.equal(paste(grey(8), seeded(4)), paste(grey(8), seeded(4)))
    assert not torch.equal(paste(grey(8), seeded(4)), paste(grey(8), seeded(5)))
