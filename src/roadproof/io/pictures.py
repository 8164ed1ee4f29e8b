"""Pictures from files that may come from anyone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from PIL.ExifTags import Base

from roadproof.errors import RoadproofError
from roadproof.io.arrays import DAMAGE
from roadproof.io.files import open_file

MOST_PIXELS = 40_000_000
"""A picture, or a controller's input, has no more pixels; one that claims more is not unpacked."""


def read_picture(
    path: Path,
    error: type[RoadproofError],
    remedy: str,
    *,
    mode: str = "RGB",
    size: tuple[int, int] | None = None,
) -> UInt8[np.ndarray, "h w c"]:
    """Read a picture's pixels.

    Args:
        path: the picture's file, a PNG or JPEG.
        error: the type of error to raise.
        remedy: what the user can do where the picture is missing or damaged.
        mode: the channels to return, "RGB" or "RGBA".
        size: (width, height) that the picture must have, looked at before it is unpacked; None for any.

    Raises:
        error: the picture is missing, damaged, of another kind or size, larger than any picture here, has more than 8
            bits a channel, is animated or stored turned; or it is transparent where RGB is wanted.
    """
    try:
        # Pillow leaves a file open whose first bytes cannot be read.
        with open_file(path) as file, Image.open(file, formats=("PNG", "JPEG")) as picture:
            deep = picture.format == "PNG" and _png_depth(path) > 8
            if picture.width * picture.height > MOST_PIXELS:
                raise ValueError(f"{picture.width}×{picture.height} pixels, expected at most {MOST_PIXELS}")
            if size is not None and picture.size != size:
                expected = "×".join(map(str, size))
                raise ValueError(f"it has {picture.width}×{picture.height} pixels, expected {expected}")
            if (frames := getattr(picture, "n_frames", 1)) > 1:
                raise ValueError(f"it is an animation of {frames} pictures, expected one")
            if (orientation := picture.getexif().get(Base.Orientation)) in range(2, 9):
                # Viewers would show it turned, Pillow reads it as it lies in the file.
                raise ValueError(f"it is stored turned (EXIF orientation {orientation}), expected one that is upright")
            if picture.mode[0] in "IF" or deep:
                # Pillow would clip grey ones to 8 bits, nearly all white, and drop the lower half of colours unsaid.
                raise ValueError(f"its channels have more than 8 bits (mode {picture.mode}), expected 8")
            if (
                mode == "RGB"
                and picture.has_transparency_data
                and np.array(picture.convert("RGBA"))[..., 3].min() < 255
            ):
                raise ValueError("parts of it are transparent, expected a picture that is not")
            return np.array(picture.convert(mode))
    except FileNotFoundError:
        raise error(f"{path} is missing; {remedy}") from None
    except (*DAMAGE, Image.DecompressionBombError) as reason:
        raise error(f"{path} cannot be read ({reason}); {remedy}") from None


def _png_depth(path: Path) -> int:
    """Bits of a channel, which Pillow does not tell of colours."""
    with open_file(path) as file:
        return file.read(25)[24]
