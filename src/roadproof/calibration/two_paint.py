"""Two replays a drive, the canvas all white and all black: how paint looks in every pixel, and where it ends."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from roadproof.calibration.replays import Replays, uniform
from roadproof.drives import Drive
from roadproof.errors import CalibrationError, ColourError
from roadproof.photometry import PixelMaps, pixel_maps_from_two_paints

LEAST_PX = 20


@dataclass(frozen=True, slots=True, eq=False)
class Paints:
    """What two paints show of one drive.

    Args:
        maps: gain, offset and visibility.
        dropped: which frames show too little of the canvas, and why.
    """

    maps: PixelMaps
    dropped: dict[int, str]

    @property
    def visible(self) -> Float[np.ndarray, "f h w"]:
        """Share of each pixel through which the canvas is seen."""
        return self.maps.visible.double().numpy()


def look_at_paints(replays: Replays, drive: Drive) -> Paints:
    """Replay a drive over a white and a black canvas.

    Raises:
        CalibrationError: the two look alike, saturate, or a replay goes astray.
    """
    light = replays.frames(drive, "white", uniform(255, 255, 255))
    dark = replays.frames(drive, "black", uniform(0, 0, 0))
    try:
        maps = pixel_maps_from_two_paints(torch.tensor(light), torch.tensor(dark))
    except ColourError as error:
        raise CalibrationError(f"drive {drive.name}: {error}") from None
    seen_px = maps.visible.sum((1, 2))
    dropped = {
        k: f"{float(seen_px[k]):.0f} pixels of the canvas are visible, {LEAST_PX} needed"
        for k in range(len(seen_px))
        if seen_px[k] < LEAST_PX
    }
    return Paints(maps, dropped)


def at_frames(maps: PixelMaps, kept: list[int]) -> PixelMaps:
    """The maps of some frames."""
    return PixelMaps(maps.gain[kept], maps.offset[kept], maps.visible[kept], maps.response)
