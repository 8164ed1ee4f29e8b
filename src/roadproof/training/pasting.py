"""Coloured rectangles pasted on the road of recorded pictures, so that a controller learns not to follow paint.

Convention:
    Ground coordinates are metres in the frame of the car: x ahead, y to the left, on a flat road.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from roadproof.datatypes import VehicleState
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CameraModel, CropResize, sight
from roadproof.homographies import Homography
from roadproof.training.augmentation import some

FARTHEST_M = 40.0
MOST = 5
AHEAD_M, ASIDE_M = (3.0, 18.0), (-4.5, 4.5)
WIDTH_M, LENGTH_M = (0.12, 2.2), (0.5, 9.5)
ALONG_RAD = math.radians(25.0)


class PastedPaint:
    """Pastes one to five rectangles in a share of CARLA's agent's pictures; half of them lie nearly along the road.

    Args:
        share: share of the pictures that get rectangles, 0 to 1.
    """

    def __init__(self, share: float) -> None:
        self.share = share
        self._inside, self._ground = ground_seen(CIL_CAMERA, CIL_INPUT)

    def __call__(self, frames: Float[Tensor, "b 3 h w"], generator: torch.Generator) -> Float[Tensor, "b 3 h w"]:
        """Copies with paint in some of them; drawn on the CPU, whatever the frames are on.

        Args:
            frames: RGB in [0, 1].
            generator: the random generator that is drawn from.
        """
        chosen = some(self.share, len(frames), generator)
        if not len(chosen):
            return frames
        inside, ground = self._inside.to(frames.device), self._ground.to(frames)
        pixels = frames.contiguous().flatten(2).clone()
        seen = pixels[chosen][:, :, inside]
        light = light_on_paint(seen)
        count = torch.randint(1, MOST + 1, (len(chosen),), generator=generator)
        for k in range(MOST):
            box, colour, cover = _rectangles(len(chosen), generator)
            covered = _covered(ground, box.to(frames)) * (count > k).to(frames)[:, None, None]
            covered = covered * cover.to(frames)
            seen = torch.lerp(seen, colour.to(frames) * light, covered)
        pixels[chosen[:, None, None], torch.arange(3)[None, :, None], inside[None, None, :]] = seen.clamp(0.0, 1.0)
        return pixels.reshape(frames.shape)


def _rectangles(
    count: int, generator: torch.Generator
) -> tuple[Float[Tensor, "b 5"], Float[Tensor, "b 3 1"], Float[Tensor, "b 1 1"]]:
    """Boxes (x, y, width, length, angle from ahead), colours, and how opaque they are."""
    unit = torch.rand(count, 10, generator=generator)

    def between(column: int, limits: tuple[float, float]) -> Float[Tensor, " b"]:
        return limits[0] + (limits[1] - limits[0]) * unit[:, column]

    along, across = between(4, (-ALONG_RAD, ALONG_RAD)), between(4, (-math.pi / 2, math.pi / 2))
    angle = torch.where(unit[:, 5] < 0.5, along, across)
    box = torch.stack([between(0, AHEAD_M), between(1, ASIDE_M), between(2, WIDTH_M), between(3, LENGTH_M), angle], 1)
    return box, unit[:, 6:9, None], (0.75 + 0.25 * unit[:, 9])[:, None, None]


def _covered(ground: Float[Tensor, "p 2"], box: Float[Tensor, "b 5"]) -> Float[Tensor, "b 1 p"]:
    """1 inside a rectangle, 0 outside."""
    x, y, width, length, angle = (column[:, None] for column in box.unbind(1))
    dx, dy = ground[:, 0] - x, ground[:, 1] - y
    ahead, left = dx * angle.cos() + dy * angle.sin(), dy * angle.cos() - dx * angle.sin()
    return ((ahead.abs() <= length / 2) & (left.abs() <= width / 2)).to(ground)[:, None]


def light_on_paint(road: Float[Tensor, "b 3 p"]) -> Float[Tensor, "b 1 p"]:
    """What paint is multiplied with: it is lit as the road is, and some of the road's grain shows through."""
    grain = road.mean(dim=1, keepdim=True)
    bright = grain.mean(dim=2, keepdim=True)
    return (bright / 0.45).clamp(0.3, 1.2) * (0.8 + 0.2 * grain / bright.clamp_min(0.05))


def ground_from_input(camera: CameraModel, view: CropResize) -> Homography:
    """Ground (x, y, 1) in the frame of the car from the input's px."""
    camera_from_ground = camera.image_from_world(VehicleState(0.0, 0.0, 0.0, 0.0, 0.0))[:, [0, 1, 3]]
    return np.linalg.inv(view.input_from_camera @ camera_from_ground)


def ground_seen(camera: CameraModel, view: CropResize) -> tuple[Int[Tensor, " p"], Float[Tensor, "p 2"]]:
    """Which pixels of the input see the ground up to `FARTHEST_M`, as flat indices, and where."""
    ground, _ = sight(view, camera).on(ground_from_input(camera, view))
    seen = np.isfinite(ground).all(axis=1) & (ground[:, 0] > 0) & (ground[:, 0] < FARTHEST_M)
    return torch.from_numpy(np.flatnonzero(seen)), torch.from_numpy(ground[seen]).float()
