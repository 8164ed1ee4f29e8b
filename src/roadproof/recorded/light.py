"""The light on the canvas in recorded frames, read where another picture looks into them."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from roadproof.compositing.view import camera_points, canvas_pixels
from roadproof.coverage import Footprints, canvas_share, footprint_variance
from roadproof.geometry import CameraModel, CropResize
from roadproof.homographies import Homographies
from roadproof.photometry import PixelMaps
from roadproof.recordings import RecordingSet

_SEEN = 0.02
_MOSTLY_ROAD = 0.05


class Light:
    """Gain and offset of the paint, and how much of the canvas nothing hides, in every pixel of every frame.

    Args:
        recordings: recordings calibrated with maps of every pixel, or with one colour transform for all.
        device: torch device of the light's tensors.

    Attributes:
        values: gain, offset and unoccluded share of every pixel of every frame, or of one frame for all, (M, 7).
        of_frames: whether every frame has pixels of its own.
    """

    def __init__(self, recordings: RecordingSet, device: torch.device) -> None:
        self._view = recordings.view
        maps = _maps(recordings)
        self.of_frames = maps is not None
        self.values = (_everywhere(recordings) if maps is None else maps).to(device)

    def at(
        self,
        pixel: Int[Tensor, "r p"],
        source: Float[Tensor, "r p 2"],
        frame: Int[Tensor, " r"],
        footprints: Footprints,
    ) -> tuple[Float[Tensor, "r p 3"], Float[Tensor, "r p 3"], Float[Tensor, "r p"]]:
        """Gain and offset of pixels of R pictures, and the share of each through which the canvas is seen.

        Args:
            pixel: index of each pixel in its flattened picture, (R, P).
            source: place of each pixel in the recorded frame, in half widths and heights from its middle, (R, P, 2).
            frame: index of the recorded frame of each picture, (R,).
            footprints: footprints of the pixels on the canvas, (R, 1, P, ...).
        """
        share = canvas_share(footprints)[:, 0]
        if not self.of_frames:
            light = self.values[pixel]
            return light[..., :3], light[..., 3:6], share
        height, width = self._view.height_px, self._view.width_px
        # Light changes slowly across a frame: the nearest pixel's will do.
        x, y = source.unbind(-1)
        column = ((x + 1) * (width / 2) - 0.5).round_().clamp_(0, width - 1).long()
        row = ((y + 1) * (height / 2) - 0.5).round_().clamp_(0, height - 1).long()
        index = (frame * (height * width))[:, None] + row * width + column
        light = self.values.index_select(0, index.flatten()).view(*index.shape, -1)
        return light[..., :3], light[..., 3:6], share * light[..., 6]


def _everywhere(recordings: RecordingSet) -> Float[Tensor, "p 7"]:
    """Gain and offset of one colour transform in every pixel, of which nothing is hidden."""
    view = recordings.view
    pixels = camera_points(torch.arange(view.height_px * view.width_px), view).float()
    return torch.cat([*recordings.colour.gain_and_offset(pixels), torch.ones(len(pixels), 1)], -1)


def _maps(recordings: RecordingSet) -> Float[Tensor, "n 7"] | None:
    """Gain, offset and unoccluded share of every pixel of every frame; None where the set has one colour for all.

    Where the canvas is not seen, the mean of the frame stands: a moved picture looks a little beyond its edge.
    """
    maps = PixelMaps.joined([drive.maps for drive in recordings.recordings])
    if maps is None:
        return None
    homographies = np.concatenate([drive.image_from_canvas for drive in recordings.recordings])
    expected = _expected_share(homographies, recordings.view, recordings.camera)
    values = torch.cat([maps.gain, maps.offset], -1).float()
    known = (maps.visible > _SEEN)[..., None]
    mean = (values * known).sum((1, 2)) / known.sum((1, 2)).clamp_min(1)
    values = torch.where(known, values, mean[:, None, None])
    free = torch.where(expected > _MOSTLY_ROAD, maps.visible / expected.clamp_min(_MOSTLY_ROAD), 1.0).clamp(0.0, 1.0)
    return torch.cat([values, free[..., None]], -1).flatten(0, 2)


def _expected_share(homographies: Homographies, view: CropResize, camera: CameraModel) -> Float[Tensor, "f h w"]:
    """Share of every pixel that would lie on the canvas if nothing stood in its way."""
    index, centre, jacobian = canvas_pixels(homographies, view, camera)
    footprints = Footprints.of(centre, jacobian, footprint_variance(view))
    share = torch.zeros(len(homographies) * view.height_px * view.width_px)
    share[torch.as_tensor(index)] = canvas_share(footprints)
    return share.view(-1, view.height_px, view.width_px)
