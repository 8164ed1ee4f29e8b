"""Pictures from files that may come from anyone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from roadproof.errors import RoadproofError

MOST_PIXELS = 40_000_000
"""A picture that claims more pixels is not unpacked."""


def read_picture(
    path: Path, error: type[RoadproofError], remedy: str, *, mode: str = "RGB"
) -> UInt8[np.ndarray, "h w c"]:
    """Read a picture's pixels.

    Args:
        path: the picture's file, a PNG or JPEG.
        error: the type of error to raise.
        remedy: what the user can do where the picture is missing or damaged.
        mode: the channels to return, "RGB" or "RGBA".

    Raises:
        error: the picture is missing, damaged, of another kind, or larger than any picture here.
    """
    try:
        # Pillow leaves a file open whose first bytes cannot be read.
        with path.open("rb") as file, Image.open(file, formats=("PNG", "JPEG")) as picture:
            if picture.width * picture.height > MOST_PIXELS:
                raise ValueError(f"{picture.width}×{picture.height} pixels, expected at most {MOST_PIXELS}")
            return np.array(picture.convert(mode))
    except FileNotFoundError:
        raise error(f"{path} is missing; {remedy}") from None
    except (
        EOFError,
        MemoryError,
        OSError,
        OverflowError,
        RuntimeError,
        SyntaxError,
        ValueError,
        Image.DecompressionBombError,
    ) as reason:
        raise error(f"{path} cannot be read ({reason}); {remedy}") from None
