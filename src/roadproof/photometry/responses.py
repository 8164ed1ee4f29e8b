"""The flat seen colour of a painted colour: one answer for the whole canvas, before shading.

Convention:
    Colours are RGB in [0, 1] as files store them (sRGB-encoded). A response may leave [0, 1]; whoever puts its answer
    into a picture clips. Parameters are float64; calls compute in the precision and on the device of the painted colour
    and are differentiable in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, cast, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from roadproof.constants import placed
from roadproof.errors import ColourError

SATURATED = 1.5 / 255
"""A seen value this near to 0 or 1 says only that the true one lies there or beyond."""

_AP1_FROM_SRGB = (
    (0.6130974, 0.3395231, 0.0473795),
    (0.0701937, 0.9163539, 0.0134524),
    (0.0206156, 0.1095698, 0.8698146),
)
"""Linear sRGB to the wide primaries (ACEScg, AP1) in which renderers apply their film curve."""
_AP1_LUMINANCE = (0.2722287, 0.6740818, 0.0536895)
# Unreal's film curve mixes in a little grey before and after it, as the reference rendering transform of ACES does.
_SATURATION_BEFORE = 0.96
_SATURATION_AFTER = 0.93
_SOFT_CLIP = 1e-5
_DARKEST = 1e-8


@runtime_checkable
class Response(Protocol):
    """Painted colour → flat seen colour, differentiable."""

    def __call__(self, painted: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """The seen colour of each painted colour."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class AffineResponse:
    """The paper's seen = C · painted + b.

    Args:
        matrix: the matrix C, one row per seen channel, (3, 3).
        offset: the offset b, (3,).

    References:
        The paper, section on colour (C, b).
    """

    matrix: Float[Tensor, "3 3"]
    offset: Float[Tensor, " 3"]

    def __call__(self, painted: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """The seen colour of each painted colour."""
        return painted @ self.matrix.to(painted).mT + self.offset.to(painted)

    @classmethod
    def identity(cls) -> AffineResponse:
        """Seen as painted: what per-pixel maps stand on where a renderer multiplies paint by light."""
        return cls(torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))

    @classmethod
    def from_parameters(cls, parameters: Float[Tensor, " 12"]) -> AffineResponse:
        """The response from twelve parameters: C row by row, then b."""
        return cls(parameters[:9].reshape(3, 3), parameters[9:])


@dataclass(frozen=True, slots=True, eq=False)
class FilmResponse:
    """What a renderer with a film curve makes of paint.

    With E the sRGB encoding, P the wide primaries and S_a a mix of 1 − a of grey into a colour,

        t = S_0.96 P (exposure ⊙ E⁻¹(painted)),   y = P⁻¹ S_0.93 (tⁿ / (1 + tⁿ)),   seen = E(E(y)ᵏ)

    Five numbers instead of twelve. Primaries that lie outside those of the display are what turns a channel fully
    black beside a strong other one; y is clipped at 0 there, softly, so that a gradient always remains.

    Args:
        exposure: light that falls on the road times the camera's exposure, one number per channel, above 0, (3,).
        contrast: exponent n, the contrast of the curve in its middle, above 0.
        encoding: exponent k; 1 for pictures that were encoded twice on their way (CARLA 0.8), about 2.4 for once.

    References:
        The Academy Color Encoding System's reference rendering transform, as real-time renderers approximate it;
        Hill's equation for the curve.
    """

    exposure: Float[Tensor, " 3"]
    contrast: Float[Tensor, ""]
    encoding: Float[Tensor, ""]

    def __call__(self, painted: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        """The seen colour of each painted colour."""
        return self.curve()(painted)

    def curve(self) -> _Curve:
        """The response with the matrices before and after its curve worked out."""
        to_wide = torch.tensor(_AP1_FROM_SRGB, dtype=torch.float64)
        before = _saturation(_SATURATION_BEFORE) @ to_wide @ torch.diag(self.exposure.double())
        after = cast("Tensor", torch.linalg.inv(to_wide)) @ _saturation(_SATURATION_AFTER)
        return _Curve(before, after, self.contrast, self.encoding)

    @classmethod
    def from_parameters(cls, parameters: Float[Tensor, " 5"]) -> FilmResponse:
        """The response from five parameters: the logarithms of the three exposures, the contrast and the encoding."""
        positive = parameters.exp()
        return cls(positive[:3], positive[3], positive[4])


@dataclass(frozen=True, slots=True, eq=False)
class _Curve:
    """A film response with the matrices before and after its curve worked out."""

    before: Float[Tensor, "3 3"]
    after: Float[Tensor, "3 3"]
    contrast: Float[Tensor, ""]
    encoding: Float[Tensor, ""]

    def __call__(self, painted: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 3"]:
        contrast, encoding = self.contrast.to(painted), self.encoding.to(painted)
        light = (decode_srgb(painted) @ self.before.to(painted).mT).clamp_min(0.0) + _DARKEST
        curve = torch.sigmoid(contrast * light.log())
        return encode_srgb(encode_srgb(_clip_softly(curve @ self.after.to(painted).mT)) ** encoding)


def response_on(response: Response, device: torch.device | str, dtype: torch.dtype) -> Response:
    """A response with its numbers on a device and in a precision; one of the user's own is left as it is."""
    ready = response.curve() if isinstance(response, FilmResponse) else response
    return placed(ready, device, dtype) if isinstance(ready, AffineResponse | _Curve) else ready


def fit_affine(
    painted: Float[Tensor, "n 3"], seen: Float[Tensor, "n 3"], *, keep_saturated: bool = False
) -> AffineResponse:
    """The paper's C and b by least squares, one seen channel at a time.

    Args:
        painted: painted colours in [0, 1], (N, 3).
        seen: colour seen of each, in [0, 1], (N, 3).
        keep_saturated: whether to use values near 0 or 1 too, as the paper's code does.

    Raises:
        ColourError: a channel has fewer than four usable colours, or they do not span the colour space.
    """
    design = torch.cat([painted, torch.ones_like(painted[:, :1])], 1).double()
    rows: list[Tensor] = []
    for channel, name in enumerate(("red", "green", "blue")):
        value = seen[:, channel].double()
        usable = torch.ones_like(value, dtype=torch.bool) if keep_saturated else ~saturated(value)
        if int(cast("Tensor", torch.linalg.matrix_rank(design[usable], rtol=1e-6))) < 4:
            raise ColourError(
                f"{int(usable.sum())} of {len(value)} seen {name} values are usable (not at 0 or 255) and they do not "
                "determine an affine map; paint at least four colours that differ in every channel"
            )
        rows.append(cast("Tensor", torch.linalg.lstsq(design[usable], value[usable]).solution))
    fitted = torch.stack(rows)
    return AffineResponse(fitted[:, :3].contiguous(), fitted[:, 3].contiguous())


def saturated(seen: Float[Tensor, "*n"]) -> Bool[Tensor, "*n"]:
    """Which seen values lie at the end of the scale."""
    return (seen <= SATURATED) | (seen >= 1 - SATURATED)


def decode_srgb(encoded: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """Linear light from sRGB-encoded values."""
    bright = ((encoded.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(encoded <= 0.04045, encoded / 12.92, bright)


def encode_srgb(linear: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """sRGB-encoded values from linear light."""
    bright = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, bright)


def _saturation(amount: float) -> Float[Tensor, "3 3"]:
    grey = torch.tensor(_AP1_LUMINANCE, dtype=torch.float64).expand(3, 3)
    return amount * torch.eye(3, dtype=torch.float64) + (1 - amount) * grey


def _clip_softly(value: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """max(value, 0), rounded off so that neither the result nor its slope is ever 0."""
    root = (value.square() + 4 * _SOFT_CLIP**2).sqrt()
    return value.clamp_min(0.0) + 2 * _SOFT_CLIP**2 / (root + value.abs())
