"""How the same paint looks from one day to the next: camera, placement and wear, drawn from explicit seeds.

Searches take the mean over some looks. A look is one draw of all that varies; the looks of one draw cover every range
evenly (a Latin hypercube), and are the same for all patterns, so that patterns are compared under equal conditions.

    seen = clip( blur_β( g ⊙ picture ) + noise ),   g = 2^(e / 2.2) · (1 + w, 1, 1 − w)

on sRGB levels, which go with about the 2.2th root of light; e is the exposure in stops, w the white balance, and blur_β
mixes a share β = 2 σ² of the picture blurred by (1, 2, 1) / 4, which has the variance σ² of a Gaussian blur. Paint is
moved and turned about the middle of the canvas as a whole. Wear takes paint in patches of some decimetres: a sum of
plane waves, above the level which a standard normal number exceeds with the share's probability.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import conv2d, pad

from roadproof.errors import RoadproofError
from roadproof.geometry import CANVAS_SIZE_PX, CanvasPlacement
from roadproof.limits import is_whole
from roadproof.patterns import Pattern

_WAVES, _WAVELENGTH_PX, _SOFT = 12, (12.0, 60.0), 0.15
_LEAST_WEAR = 1e-4


@dataclass(frozen=True, kw_only=True, slots=True)
class Variation:
    """The ranges of looks over which a search takes its mean; 0 leaves a range out.

    Args:
        noise: standard deviation of the noise of every pixel, as a share of full scale, 0 to 0.2.
        exposure_stops: largest change of exposure either way, in stops, 0 to 2.
        white_balance: largest share by which red gains while blue loses, or the other way round, 0 to 0.3.
        blur_px: largest standard deviation of the blur, in pixels of the controller's input, 0 to 0.7.
        shift_m: largest shift of the paint from its place, across and along the road each, metres, 0 to 1.
        turn_deg: largest turn of the paint either way, degrees, 0 to 20.
        wear: largest share of the paint that is gone, 0 to 0.9.
        draws: number of looks in which every pattern is shown at every step, 1 to 64.

    Raises:
        RoadproofError: a value is out of its range.
    """

    noise: float = 0.01
    exposure_stops: float = 0.3
    white_balance: float = 0.05
    blur_px: float = 0.5
    shift_m: float = 0.1
    turn_deg: float = 2.0
    wear: float = 0.3
    draws: int = 4

    def __post_init__(self) -> None:
        for field, (least, most) in zip(fields(self), _RANGES, strict=True):
            if not least <= (value := getattr(self, field.name)) <= most:
                raise RoadproofError(f"variation: {field.name} is {value}, expected {least:g} to {most:g}")
        if not is_whole(self.draws):
            raise RoadproofError(f"variation: draws is {self.draws}, expected a whole number")

    def draw(self, seed: int, device: torch.device | str = "cpu", count: int | None = None) -> Looks:
        """Looks drawn from a seed, the same on every device.

        Args:
            seed: seed of the draw.
            device: torch device of the looks' tensors.
            count: number of looks; `draws` by default.
        """
        count = count or self.draws
        generator = torch.Generator().manual_seed(seed)
        order = torch.rand(8, count, generator=generator).argsort(1)
        even = (order + torch.rand(8, count, generator=generator)) / count
        exposure, white, blur, x, y, turn, wear, _ = even
        stops, balance = self.exposure_stops * (2 * exposure - 1), self.white_balance * (2 * white - 1)
        gain = 2 ** (stops[:, None] / 2.2) * torch.stack([1 + balance, torch.ones_like(balance), 1 - balance], 1)
        low, high = _WAVELENGTH_PX
        length = low * (high / low) ** torch.rand(count, _WAVES, generator=generator)
        angle = 2 * math.pi * torch.rand(count, _WAVES, generator=generator)
        wave = 2 * math.pi / length[..., None] * torch.stack([angle.cos(), angle.sin()], -1)
        parts = (
            gain,
            2 * (self.blur_px * blur).square(),
            self.shift_m * (2 * torch.stack([x, y], 1) - 1),
            self.turn_deg * (2 * turn - 1),
            self.wear * wear,
            wave,
            2 * math.pi * torch.rand(count, _WAVES, generator=generator),
        )
        return Looks(*(part.to(device) for part in parts), noise=self.noise, seed=seed)


_RANGES = ((0, 0.2), (0, 2), (0, 0.3), (0, 0.7), (0, 1), (0, 20), (0, 0.9), (1, 64))


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """D looks of paint and camera; the rows of a batch have them in turn.

    Args:
        gain: gain g of red, green and blue, (D, 3).
        blur: share β of the blurred picture, (D,).
        shift_m: shift of the paint to the right and towards the car, metres, (D, 2).
        turn_deg: turn of the paint about the canvas' middle, degrees, clockwise on the picture, (D,).
        wear: share of the paint that is gone, (D,).
        wave: wave vectors of the pattern of wear, radians per canvas px, (D, W, 2).
        phase: phases of the waves of wear, radians, (D, W).
        noise: standard deviation of the noise of every pixel, as a share of full scale.
        seed: seed of the noise.
    """

    gain: Float[Tensor, "d 3"]
    blur: Float[Tensor, " d"]
    shift_m: Float[Tensor, "d 2"]
    turn_deg: Float[Tensor, " d"]
    wear: Float[Tensor, " d"]
    wave: Float[Tensor, "d w 2"]
    phase: Float[Tensor, "d w"]
    noise: float
    seed: int

    def __len__(self) -> int:
        """How many looks there are."""
        return len(self.gain)

    def rows(self, count: int) -> Int[Tensor, " r"]:
        """Index of the look that each of `count` rows has, in turn."""
        return torch.arange(count, device=self.gain.device) % len(self)

    def placed(self, pattern: Pattern, canvas: CanvasPlacement | None) -> Pattern:
        """R patterns, each shifted and turned as its look says; if no canvas is known, on one of the paper's size.

        In metres figures keep their area, and their length its direction in the whole; as canvas px are not square, the
        angle between their edges changes a little.
        """
        canvas = canvas or CanvasPlacement(x_m=0.0, y_m=0.0)
        which = self.rows(len(pattern.boxes))
        scale = pattern.boxes.new_tensor([canvas.width_m, canvas.length_m]) / CANVAS_SIZE_PX
        middle = (CANVAS_SIZE_PX - 1) / 2
        at = (pattern.boxes[..., :2] - middle) * scale
        turn = self.turn_deg.to(at)[which][:, None]
        moved = (_turned(at, turn) + self.shift_m.to(at)[which][:, None]) / scale + middle
        width, length, rotation_deg = pattern.boxes[..., 2:].unbind(-1)
        along = _turned(at.new_tensor([0.0, 1.0]).expand_as(at), rotation_deg)
        now = _turned(along * scale, turn) / scale
        across = along[..., 0] * now[..., 1] - along[..., 1] * now[..., 0]
        turned_deg = torch.rad2deg(torch.atan2(across, (along * now).sum(-1)))
        longer = now.square().sum(-1).sqrt()
        rest = torch.stack([width / longer, length * longer, rotation_deg + turned_deg], -1)
        return Pattern(pattern.shapes, torch.cat([moved, rest], -1), pattern.colours)

    def left(self, centre: Float[Tensor, "#r p 2"], count: int) -> Float[Tensor, "r p"]:
        """The share of the paint that wear leaves at the footprints of R rows."""
        which = self.rows(count)
        field = torch.zeros(count, centre.shape[-2], device=centre.device)
        for k in range(self.wave.shape[1]):
            wave, phase = self.wave[which, k], self.phase[which, k]
            field = field + torch.cos((centre * wave[:, None]).sum(-1) + phase[:, None])
        level = cast("Tensor", torch.special.ndtri(1 - self.wear.clamp_min(_LEAST_WEAR)))[which, None]
        worn = torch.sigmoid((field * math.sqrt(2 / self.wave.shape[1]) - level) / _SOFT)
        return torch.where((self.wear > 0)[which, None], 1 - worn, 1.0)

    def seen(self, frames: Float[Tensor, "n 3 h w"], rows: int, step: int = 0) -> Float[Tensor, "n 3 h w"]:
        """The pictures as the camera of each look takes them: gain, blur and noise.

        Args:
            frames: pictures in [0, 1]: R rows of N / R pictures, row after row.
            rows: number R of rows.
            step: number of the step in the drive, which seeds its noise, so that every step has noise of its own.
        """
        which = self.rows(rows).repeat_interleave(len(frames) // rows)
        shown = frames * self.gain.to(frames)[which][:, :, None, None]
        if bool((self.blur > 0).any()):
            kernel = frames.new_tensor([0.25, 0.5, 0.25])
            soft = pad(shown, (1, 1, 1, 1), mode="replicate")
            soft = conv2d(soft, kernel.view(1, 1, 1, 3).expand(3, 1, 1, 3), groups=3)
            soft = conv2d(soft, kernel.view(1, 1, 3, 1).expand(3, 1, 3, 1), groups=3)
            shown = torch.lerp(shown, soft, self.blur.to(frames)[which][:, None, None, None])
        if self.noise:
            # Of one seed on every device; rows of one look have the same noise, and each of their pictures its own.
            generator = torch.Generator().manual_seed((self.seed * 1_000_003 + step) % 2**63)
            each = torch.randn(len(self), len(frames) // rows, *frames.shape[1:], generator=generator).to(frames)
            shown = shown + self.noise * each[self.rows(rows)].flatten(0, 1)
        return shown.clamp(0.0, 1.0)


def _turned(points: Float[Tensor, "r k 2"], turn_deg: Float[Tensor, "r _"]) -> Float[Tensor, "r k 2"]:
    """Points turned about the origin, clockwise on the picture."""
    c, s = torch.cos(torch.deg2rad(turn_deg)), torch.sin(torch.deg2rad(turn_deg))
    x, y = points.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y], -1)
