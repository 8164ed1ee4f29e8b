"""Other light and another lens: what may change in a picture without changing how to drive."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional


@dataclass(frozen=True, kw_only=True, slots=True)
class Augmentation:
    """How strongly pictures are varied, and how many of them.

    Args:
        brightness: standard deviation of the logarithm of the factor on all channels.
        contrast: standard deviation of the logarithm of the factor on the distance from the picture's mean.
        tint: standard deviation of the logarithm of the factor on each channel.
        saturation: standard deviation of the logarithm of the factor on the distance from grey.
        noise: largest standard deviation of a pixel's noise, where levels are in [0, 1].
        noisy: share of the pictures with noise, 0 to 1.
        blurred: share of the pictures blurred over 3×3 pixels, 0 to 1.
    """

    brightness: float = 0.15
    contrast: float = 0.2
    tint: float = 0.05
    saturation: float = 0.25
    noise: float = 0.04
    noisy: float = 0.3
    blurred: float = 0.15

    def __call__(
        self, frames: Float[Tensor, "b 3 h w"], generator: torch.Generator, *, window: int = 1
    ) -> Float[Tensor, "b 3 h w"]:
        """Varied copies in [0, 1], each picture in its own way; drawn on the CPU, whatever the frames are on.

        Args:
            frames: RGB in [0, 1].
            generator: the random generator that is drawn from.
            window: number of pictures, one after the other, that are varied alike but for blur and noise.
        """
        count = len(frames) // window

        def factor(deviation: float, channels: int = 1) -> Float[Tensor, "b c 1"]:
            drawn = torch.randn(count, channels, 1, generator=generator).mul(deviation).exp()
            return drawn.repeat_interleave(window, 0).to(frames)

        contrast, saturation = factor(self.contrast), factor(self.saturation)
        gain = factor(self.brightness) * factor(self.tint, 3)
        # Towards or away from grey, then from the picture's mean, then the gains: one matrix and offset a picture.
        mean = frames.mean(dim=(1, 2, 3)).reshape(-1, 1, 1)
        mixing = saturation * torch.eye(3).to(frames) + (1.0 - saturation) / 3.0
        pixels = frames.contiguous().flatten(2)
        varied = torch.baddbmm(gain * mean * (1.0 - contrast), gain * contrast * mixing, pixels)
        varied = varied.reshape(frames.shape).clamp_(0.0, 1.0)
        if len(blurred := some(self.blurred, len(varied), generator)):
            varied[blurred] = functional.avg_pool2d(varied[blurred], 3, 1, 1, count_include_pad=False)
        if count := len(noisy := some(self.noisy, len(varied), generator)):
            strength = self.noise * torch.rand(count, 1, 1, 1, generator=generator)
            noise = torch.randn(count, *varied.shape[1:], generator=generator) * strength
            varied[noisy] += noise.to(varied)
        return varied.clamp_(0.0, 1.0)


def some(share: float, count: int, generator: torch.Generator) -> Int[Tensor, " c"]:
    """Numbers below a count, each of them chosen with a probability of `share`."""
    return (torch.rand(count, generator=generator) < share).nonzero()[:, 0]
