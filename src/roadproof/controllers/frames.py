"""Frames on their way into a network: size, rows, colour, scale; all of it differentiable.

Convention:
    Frames are RGB in [0, 1], pixel centres at integers. Sizes are (height, width).
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from itertools import chain

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn

from roadproof.constants import constant, kept
from roadproof.controllers.protocol import PedalController
from roadproof.datatypes import Control
from roadproof.errors import ControllerError


@dataclass(frozen=True, kw_only=True, slots=True)
class FramePreparation:
    """How a network's input is made from the frames of a recording.

    In this order: keep some rows, resize by area, change the colour space, subtract the mean, divide by the deviation.

    Args:
        frame_size: (height, width) of the frames; None for any size.
        rows: first row kept and one past the last; None for all rows.
        network_size: (height, width) of the network's input; None for the size of the kept rows.
        colour: "rgb", or "yuv" as OpenCV's COLOR_RGB2YUV gives it on 8-bit pictures, divided by 255.
        mean: mean that is subtracted from each channel in [0, 1].
        std: deviation by which each channel is then divided; 0.5 with a mean of 0.5 is the usual x / 127.5 − 1.

    Raises:
        ControllerError: a size is not positive, rows lie outside the frame, or a deviation is 0.
    """

    frame_size: tuple[int, int] | None = None
    rows: tuple[int, int] | None = None
    network_size: tuple[int, int] | None = None
    colour: str = "rgb"
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("frame_size", "network_size"):
            size: tuple[int, int] | None = getattr(self, name)
            if size is not None and min(size) < 1:
                raise ControllerError(f"{name} is {size[0]}×{size[1]}, expected (height, width) of at least 1×1")
        height = None if self.frame_size is None else self.frame_size[0]
        if self.rows is not None and not 0 <= self.rows[0] < self.rows[1] <= (height or self.rows[1]):
            limit = "the frame" if height is None else f"the frame's {height} rows"
            raise ControllerError(f"rows are {self.rows}, expected (first, one past the last) inside {limit}")
        if self.colour not in ("rgb", "yuv"):
            raise ControllerError(f"colour is {self.colour!r}, expected 'rgb' or 'yuv'")
        if 0.0 in self.std:
            raise ControllerError(f"std is {self.std}, expected three numbers other than 0")

    def __call__(self, frames: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 hn wn"]:
        """The network's input made from the frames.

        Raises:
            ControllerError: the frames have another size than `frame_size`, or fewer rows than are to be kept.
        """
        require_frame_size(frames, self.frame_size)
        if self.rows is not None:
            if frames.shape[2] < self.rows[1]:
                raise ControllerError(
                    f"frames have {frames.shape[2]} rows, this controller keeps rows up to {self.rows[1]}"
                )
            frames = frames[:, :, self.rows[0] : self.rows[1]]
        if self.network_size is not None:
            frames = resize_by_area(frames, self.network_size)
        if self.colour == "yuv":
            frames = yuv_from_rgb(frames)
        if self.mean == (0.0, 0.0, 0.0) and self.std == (1.0, 1.0, 1.0):
            return frames
        mean, std = constant(self.mean, frames), constant(self.std, frames)
        return (frames - mean[:, None, None]) / std[:, None, None]


def require_frame_size(frames: Float[Tensor, "b 3 h w"], expected: tuple[int, int] | None) -> None:
    """Refuse frames of a size that a controller was not made for.

    Raises:
        ControllerError: the frames have another size than `expected`, (height, width); None accepts any.
    """
    height, width = frames.shape[-2:]
    if expected is not None and (height, width) != expected:
        raise ControllerError(
            f"frames are {width}×{height}, this controller takes {expected[1]}×{expected[0]} (width×height); "
            "record frames at its input size or choose another controller"
        )


def one_frame_batch(
    network: object, frame: UInt8[np.ndarray, "h w 3"], speed_mps: float, command: int
) -> tuple[Float[Tensor, "1 3 h w"], Float[Tensor, " 1"], Int[Tensor, " 1"]]:
    """One camera frame, speed and command as a batch of one on the network's device; the CPU's if it is no module."""
    tensors = chain(network.parameters(), network.buffers()) if isinstance(network, nn.Module) else iter(())
    first = next(tensors, None)
    device = None if first is None else first.device
    picture = torch.tensor(frame, device=device).permute(2, 0, 1)[None]
    return (
        picture.float() / 255,
        torch.tensor([speed_mps], dtype=torch.float32, device=device),
        torch.tensor([int(command)], device=device),
    )


def control_of(
    controller: PedalController, frame: UInt8[np.ndarray, "h w 3"], speed_mps: float, command: int
) -> Control:
    """The control that a controller's `controls` gives for one camera frame."""
    with torch.no_grad():
        return Control(*map(float, controller.controls(*one_frame_batch(controller, frame, speed_mps, command))[0]))


_LUMA = (0.299, 0.587, 0.114)
_YUV_FROM_RGB = (
    _LUMA,
    (-0.492 * _LUMA[0], -0.492 * _LUMA[1], 0.492 * (1 - _LUMA[2])),
    (0.877 * (1 - _LUMA[0]), -0.877 * _LUMA[1], -0.877 * _LUMA[2]),
)
_YUV_OF_BLACK = (0.0, 128 / 255, 128 / 255)


def yuv_from_rgb(frames: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"]:
    """OpenCV's COLOR_RGB2YUV in [0, 1], without its rounding to 8 bits but with its saturation.

    Convention:
        Y = 0.299 R + 0.587 G + 0.114 B, U = 0.492 (B − Y) + 128/255, V = 0.877 (R − Y) + 128/255. Saturated red or
        cyan leaves [0, 1] in V and is clipped there, as on 8-bit pictures.
    """
    matrix, middle = constant(_YUV_FROM_RGB, frames), constant(_YUV_OF_BLACK, frames)
    # One product reads and writes a picture once; with few digits U and V would be differences of rounded numbers.
    device = frames.device.type
    with torch.autocast(device, enabled=False) if torch.amp.is_autocast_available(device) else nullcontext():
        yuv = torch.baddbmm(middle[:, None], matrix.expand(len(frames), 3, 3), frames.flatten(2))
    return yuv.view_as(frames).clamp(0.0, 1.0)


def resize_by_area(frames: Float[Tensor, "b 3 h w"], size: tuple[int, int]) -> Float[Tensor, "b 3 hn wn"]:
    """Average each output pixel over exactly its footprint, as OpenCV's INTER_AREA does when it makes pictures smaller.

    Args:
        frames: pictures with any values, (B, 3, H, W).
        size: (height, width) of the result, px.
    """
    height, width = frames.shape[-2:]
    if size[0] != height:
        frames = kept(_area_weights, (height, size[0]), frames) @ frames
    if size[1] != width:
        frames = frames @ kept(_area_weights, (width, size[1]), frames).T
    return frames


def _area_weights(inputs: int, outputs: int) -> Float[Tensor, "outputs inputs"]:
    edges = torch.arange(outputs + 1, dtype=torch.float64) * (inputs / outputs)
    pixel = torch.arange(inputs, dtype=torch.float64)
    overlap = torch.minimum(edges[1:, None], pixel + 1) - torch.maximum(edges[:-1, None], pixel)
    return overlap.clamp(min=0) * (outputs / inputs)
