"""Pictures of drives over the town's bare roads, each with a canvas laid somewhere on the road ahead.

So any frame of any drive is a street to learn on, without recordings or calibration of its own. What light does to
paint there is not measured, as it is in calibrated recordings: paint is taken to be as bright as the road is.
"""

from __future__ import annotations

import math
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.compositing.view import OwnViews, picked_pixels
from roadproof.coverage import Footprints, canvas_share, footprint_variance
from roadproof.geometry import CameraModel, CanvasPlacement, CropResize
from roadproof.hardening.views import Views
from roadproof.photometry.responses import AffineResponse
from roadproof.training.dataset import Dataset
from roadproof.training.pasting import ground_from_input, ground_seen, light_on_paint

AHEAD_M, ASIDE_M, TURNED_RAD = (-1.0, 22.0), 1.5, math.radians(20.0)
"""Where the middle of a canvas lies, from the car, and how far it may be turned."""

CANVAS = CanvasPlacement(x_m=0.0, y_m=0.0)


class Town:
    """Frames of clean drives, drawn so that each command comes in its share.

    Args:
        drives: the drives.
        camera: the pinhole camera that took the frames.
        view: how the frames were cut from its pictures.
        device: the torch device on which pictures are made.
    """

    def __init__(
        self, drives: Dataset, camera: CameraModel, view: CropResize, *, device: torch.device | str = "cpu"
    ) -> None:
        self._drives, self._view, self._device = drives, view, torch.device(device)
        self._weights = drives.weights()
        self._ground_from_input = torch.tensor(ground_from_input(camera, view), device=self._device)
        self._inside = ground_seen(camera, view)[0].to(self._device)
        rows, columns = torch.div(self._inside, view.width_px, rounding_mode="floor"), self._inside % view.width_px
        self._pixels = torch.stack([columns, rows, torch.ones_like(rows)]).double()

    def draw(self, count: int, generator: torch.Generator, *, to_paint: bool = True) -> Views:
        """Draw so many pictures, and a place for a canvas in each.

        Args:
            count: how many pictures to draw, at least 1.
            generator: where the randomness comes from, on the CPU.
            to_paint: False for pictures without a canvas.
        """
        chosen = torch.multinomial(self._weights, count, replacement=True, generator=generator)
        seen = self._drives.batch(chosen, self._device)
        canvas = None
        if to_paint:
            canvas_from_input = _canvas_from_ground(count, generator).to(self._device)
            canvas = self._laid(seen.frames, canvas_from_input @ self._ground_from_input)
        return Views(seen.frames, seen.speed_mps, seen.command, None, canvas)

    def _laid(self, frames: Float[Tensor, "b 3 h w"], canvas_from_input: Float[Tensor, "b 3 3"]) -> OwnViews:
        """The pixels of the ground, with all that painting a canvas there needs."""
        mapped = canvas_from_input @ self._pixels
        at, depth = mapped[:, :2] / mapped[:, 2:], mapped[:, 2]
        by = canvas_from_input[:, :, :2, None]
        jacobian = (by[:, :2] - at[:, :, None] * by[:, 2:]) / depth[:, None, None]
        footprints = Footprints.made(
            at.mT[:, None].float(), jacobian.permute(0, 3, 1, 2)[:, None].float(), footprint_variance(self._view)
        )
        share, pixel = canvas_share(footprints)[:, 0, :, None], self._inside.expand(len(frames), -1)
        light = (share * light_on_paint(picked_pixels(frames.flatten(2), pixel)).mT, share, 0.0)
        valid = torch.ones_like(pixel, dtype=torch.bool)
        return OwnViews.lit(frames, pixel, valid, footprints, light, AffineResponse.identity())


def _canvas_from_ground(count: int, generator: torch.Generator) -> Float[Tensor, "b 3 3"]:
    """Canvas px from metres ahead and left of the car, for canvases at drawn places."""
    unit = torch.rand(count, 3, dtype=torch.float64, generator=generator)
    ahead = AHEAD_M[0] + (AHEAD_M[1] - AHEAD_M[0]) * unit[:, 0]
    left, turned = ASIDE_M * (2 * unit[:, 1] - 1), TURNED_RAD * (2 * unit[:, 2] - 1)
    c, s, o = torch.cos(turned), torch.sin(turned), torch.zeros_like(turned)
    placed = torch.stack([c, -s, ahead, s, c, left, o, o, o + 1], -1).view(-1, 3, 3)
    return cast("Tensor", torch.linalg.inv(placed @ torch.tensor(CANVAS.world_from_canvas[[0, 1, 3]])))
