"""What a colour fit learns from: painted colours, what was seen of them, and where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from roadproof.errors import ColourError


@dataclass(frozen=True, slots=True, eq=False)
class ColourSamples:
    """N samples of painted road: painted colour and seen colour.

    Args:
        painted: painted colours, RGB in [0, 1], (N, 3).
        seen: mean colour seen of each, RGB in [0, 1], (N, 3).
        group: colours that cross-validation leaves out together, such as the shades of one hue, (N,); by default each
            painted colour is a group of its own.
        pixel: camera pixel (column, row) at which each was seen, (N, 2); needed for shading.
        size_px: columns and rows of the camera picture; needed with `pixel`.

    Raises:
        ColourError: lengths differ, a value is NaN, infinite or outside [0, 1], or there are pixels without a picture
            size.
    """

    painted: Float[Tensor, "n 3"]
    seen: Float[Tensor, "m 3"]
    group: Int[Tensor, " g"] | None = None
    pixel: Float[Tensor, "q 2"] | None = None
    size_px: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        count = len(self.painted)
        for name, value in (("seen", self.seen), ("group", self.group), ("pixel", self.pixel)):
            if value is not None and len(value) != count:
                raise ColourError(
                    f"{count} painted colours but {len(value)} values of {name}, expected as many of both"
                )
        for name, value in (("painted", self.painted), ("seen", self.seen)):
            if not bool(value.isfinite().all()):
                raise ColourError(f"a {name} colour is NaN or infinite; drop colours that were not observed")
            if count and not (float(value.min()) >= 0 and float(value.max()) <= 1):
                raise ColourError(
                    f"{name} colours span {float(value.min()):g}…{float(value.max()):g}, expected 0…1; divide 8-bit "
                    "levels by 255"
                )
        if (self.pixel is None) != (self.size_px is None):
            raise ColourError("pixels of colour samples need the size of their picture, and the other way round")
        if self.pixel is not None and not bool(self.pixel.isfinite().all()):
            raise ColourError("a pixel of the colour samples is NaN or infinite")

    def __len__(self) -> int:
        return len(self.painted)

    @property
    def groups(self) -> Int[Tensor, " n"]:
        """The group of each sample, counted from 0."""
        key = self.painted if self.group is None else self.group[:, None]
        return distinct(key)[1]

    def at(self, rows: Bool[Tensor, " n"]) -> ColourSamples:
        """The samples of some rows."""
        group = None if self.group is None else self.group[rows]
        pixel = None if self.pixel is None else self.pixel[rows]
        return ColourSamples(self.painted[rows], self.seen[rows], group, pixel, self.size_px)


def distinct(rows: Float[Tensor, "n c"] | Int[Tensor, "n c"]) -> tuple[Tensor, Int[Tensor, " n"]]:
    """The different rows, sorted, and for each row the index of its own among them."""
    return cast("tuple[Tensor, Tensor]", torch.unique(rows, dim=0, return_inverse=True))


def samples_from_pictures(
    painted: Float[Tensor, "n 3"],
    pictures: UInt8[Tensor, "m h w 3"],
    mask: Bool[Tensor, "i j"],
    *,
    group: Int[Tensor, " g"] | None = None,
    patch_px: int = 16,
) -> ColourSamples:
    """Samples from camera pictures of the canvas, each painted all over with one colour.

    Pictures are averaged in square patches that lie wholly inside the mask: that takes out the renderer's dither and
    keeps what is smooth.

    Args:
        painted: painted colour of each picture, RGB in [0, 1], (N, 3).
        pictures: camera pictures of the canvas, one for each colour, (N, H, W, 3).
        mask: which camera pixels show the canvas, (H, W).
        group: group of each picture for cross-validation, (N,); by default every colour is a group of its own.
        patch_px: side of a square patch, px; 16 by default.

    Raises:
        ColourError: as many pictures as colours are not given, or no patch lies inside the mask.
    """
    count, height, width = pictures.shape[:3]
    if len(painted) != count or (group is not None and len(group) != count):
        raise ColourError(
            f"{len(painted)} painted colours for {count} pictures, expected one (and one group) a picture"
        )
    if mask.shape != (height, width):
        raise ColourError(f"mask is {mask.shape[1]}×{mask.shape[0]}, the pictures are {width}×{height}; give one mask")
    rows, columns = height // patch_px, width // patch_px
    cut = (slice(rows * patch_px), slice(columns * patch_px))
    whole = mask[cut].reshape(rows, patch_px, columns, patch_px).all(3).all(1)
    if not bool(whole.any()):
        raise ColourError(
            f"no patch of {patch_px}×{patch_px} px lies inside the mask; give a larger mask or less patch_px"
        )
    patches = pictures[:, cut[0], cut[1]].reshape(count, rows, patch_px, columns, patch_px, 3).double()
    seen = patches.mean((2, 4))[:, whole] / 255
    row, column = whole.nonzero(as_tuple=True)
    centre = torch.stack([column, row], 1).double() * patch_px + (patch_px - 1) / 2
    each = len(centre)
    return ColourSamples(
        painted.double().repeat_interleave(each, 0),
        seen.reshape(-1, 3),
        None if group is None else group.repeat_interleave(each),
        centre.repeat(count, 1),
        (width, height),
    )
