"""Slow, plain references and synthetic drives that the tests hold the product to."""

import numpy as np
import torch

from roadproof.coverage import Shape, polygon_vertices
from roadproof.datatypes import VehicleState
from roadproof.errors import PatternError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CanvasPlacement, homography_from_pose
from roadproof.homographies import apply_homography
from roadproof.patterns import Pattern, boxes_from_published


def homography_jacobian(b_from_a, points):
    """Derivative of the mapped points: entry [n, i, j] is ∂b_i/∂a_j at point n."""
    w = points @ b_from_a[2, :2] + b_from_a[2, 2]
    mapped = apply_homography(b_from_a, points)
    return (b_from_a[:2, :2] - mapped[:, :, None] * b_from_a[2, :2]) / w[:, None, None]


def approach(count=8, first_m=14.0, last_m=4.0, lateral_m=0.0):
    """Homographies of a straight drive towards a canvas at the origin."""
    canvas = CanvasPlacement(x_m=0.0, y_m=0.0)
    poses = [
        VehicleState(x_m=-distance - 2.0, y_m=lateral_m, z_m=0.0, yaw_rad=0.02 * i, speed_mps=6.0)
        for i, distance in enumerate(np.linspace(first_m, last_m, count))
    ]
    return np.stack([homography_from_pose(CIL_CAMERA, pose, canvas) for pose in poses])


def rectangles_from_published(values):
    """A pattern from K rows of published parameters: rotation, position, width, length and, if not black, r, g, b."""
    lengths = {len(row) for row in values}
    if len(lengths) != 1 or not lengths <= {4, 7}:
        raise PatternError(f"published rectangles have rows of {sorted(lengths)} values, expected 4 (black) or 7 each")
    rows = torch.tensor(values, dtype=torch.float32)
    colours = rows[:, 4:] / 255 if rows.shape[1] == 7 else torch.zeros(len(rows), 3)
    return Pattern((Shape.RECTANGLE,) * len(rows), boxes_from_published(rows[:, :4]), colours)


def inside(shape: Shape, box: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Which points lie inside the figure, by the side of every edge they are on."""
    corners = polygon_vertices(shape, torch.as_tensor(box)).numpy()
    result = np.ones(points.shape[:-1], bool)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        edge, offset = end - start, points - start
        result &= edge[0] * offset[..., 1] - edge[1] * offset[..., 0] >= 0
    return result


def supersampled(shape, box, image_from_canvas, pixels, resampling, samples=16):
    """Coverage of pixels of the CIL input by samples² rays a pixel through the exact homography.

    An area filter takes its rays evenly from one pixel, antialiased bilinear from a tent over two. The rays lie on a
    rotated lattice, so that no edge runs along a row of them.
    """
    count = np.arange(samples**2)
    even = np.stack([(count + 0.5) / samples**2, (count * 0.6180339887498949 + 0.25) % 1.0], -1)
    if resampling == "area":
        offsets = even - 0.5
    else:
        offsets = np.where(even < 0.5, np.sqrt(2 * even) - 1, 1 - np.sqrt(2 * (1 - even)))
    canvas_from_input = np.linalg.inv(CIL_INPUT.input_from_camera @ image_from_canvas)
    rays = pixels[:, None] + offsets
    hit = inside(shape, box, apply_homography(canvas_from_input, rays.reshape(-1, 2)))
    return hit.reshape(len(pixels), -1).mean(1)
