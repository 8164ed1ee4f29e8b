"""Patterns as they would lie on the road."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from PIL import Image

ASPHALT = (92, 94, 98)


def on_asphalt(paint: UInt8[np.ndarray, "s s 4"], width_px: int, size: tuple[float, float]) -> Image.Image:
    """A canvas on asphalt in its true proportions.

    Args:
        paint: on the canvas, RGBA.
        width_px: of the picture.
        size: width and length of the canvas, in any unit.
    """
    road = Image.new("RGB", (paint.shape[1], paint.shape[0]), ASPHALT)
    road.paste(Image.fromarray(paint[..., :3]), (0, 0), Image.fromarray(paint[..., 3]))
    width, length = size
    return road.resize((width_px, max(round(width_px * length / width), 1)), Image.Resampling.LANCZOS)
