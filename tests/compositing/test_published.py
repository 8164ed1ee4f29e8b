"""The published way: bit for bit the authors' masks, their local linearisation, and its kinship with ours."""

import numpy as np
import torch

from references import approach, rectangles_from_published
from roadproof.compositing import composite, view_canvas
from roadproof.compositing.published import (
    canvas_mask,
    nearest_canvas_pixels,
    pasted,
    view_canvas_published,
)
from roadproof.geometry import CANVAS_SIZE_PX, CIL_INPUT
from roadproof.patterns import visibilities
from scenes import PLAIN, road_frames

ROWS = [[70.5, 191.5, 56.7, 37.7, 143.2, 196.7, 112.2], [154.4, 176.0, 44.0, 0.8, 8.4, 150.4, 193.1]]


def test_masks_of_the_whole_canvas_are_the_authors_bit_for_bit(carla_data):
    for trajectory in ("t1", "t2", "t3"):
        stored = np.load(carla_data / trajectory / "homographies.npz", allow_pickle=False)
        masks = np.unpackbits(stored["mask_nearest"], axis=1).reshape(-1, 88, 200).astype(bool)
        ours = nearest_canvas_pixels(stored["H"], CIL_INPUT) < CANVAS_SIZE_PX**2
        np.testing.assert_array_equal(ours, masks)


def test_a_mask_covers_the_rectangles_area():
    box = rectangles_from_published(ROWS).boxes[1]
    assert abs(float(canvas_mask(box).sum()) / float(box[2] * box[3]) - 1) < 0.05


def test_published_frames_are_ours_without_antialiasing():
    frames, homographies = road_frames(3, 0), approach(3)
    pattern = rectangles_from_published(ROWS)
    view = view_canvas_published(frames, homographies, CIL_INPUT, PLAIN)
    published = pasted(view, view.pixels(visibilities(view.masks(pattern.boxes)), pattern.colours))
    ours = composite(pattern, view_canvas(frames, homographies, CIL_INPUT, PLAIN)).permute(0, 2, 3, 1)
    clean = torch.as_tensor(frames) / 255
    painted = (published != clean).any(-1)
    assert float((published - ours).abs()[painted].median()) < 0.01
    assert float((published - ours).abs().mean()) < 0.01
