"""The colour transform, seen = gain(pixel) ⊙ response(painted) + offset(pixel), and its smooth shading.

The form is separable on purpose: the response is computed once a colour, gain and offset once a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.errors import ColourError
from roadproof.photometry.responses import AffineResponse, FilmResponse, Response

_FORMAT, _VERSION = "roadproof-colour", 1

Pair = tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b 3"]]


@dataclass(frozen=True, kw_only=True, slots=True)
class RadialShading:
    """What a lens takes from the corners: gain 1 + g r² and offset o r², the same in every channel.

    r is the distance from the middle of the camera picture in half widths. Two numbers, so that a fit to the part of
    the picture where the canvas happened to lie holds in the rest of it.

    Args:
        width_px: number of columns of the camera picture.
        height_px: number of rows of the camera picture.
        gain: coefficient g of the gain.
        offset: coefficient o of the offset.
    """

    width_px: int
    height_px: int
    gain: float
    offset: float

    def __call__(self, pixel: Float[Tensor, "*b 2"]) -> Pair:
        """Gain and offset at camera pixels (x right, y down, centres at integers)."""
        squared = squared_radius(pixel, self.width_px, self.height_px)[..., None].expand(*pixel.shape[:-1], 3)
        return 1 + self.gain * squared, self.offset * squared


def squared_radius(pixel: Float[Tensor, "*b 2"], width_px: int, height_px: int) -> Float[Tensor, "*b"]:
    """Squared distance from the middle of the picture in half widths."""
    middle = pixel.new_tensor([(width_px - 1) / 2, (height_px - 1) / 2])
    return ((pixel - middle) / (width_px / 2)).square().sum(-1)


@dataclass(frozen=True, slots=True)
class ColourTransform:
    """The transform from painted colour to seen colour at a camera pixel.

    Args:
        response: response, which gives the flat seen colour of a painted colour.
        shading: shading, which gives gain and offset at a camera pixel; None means 1 and 0.
    """

    response: Response
    shading: RadialShading | None = None

    def __call__(self, painted: Float[Tensor, "*b 3"], pixel: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 3"]:
        """The seen colour in [0, 1], differentiable in the painted one."""
        gain, offset = self.gain_and_offset(pixel)
        return (gain * self.response(painted) + offset).clamp(0.0, 1.0)

    def gain_and_offset(self, pixel: Float[Tensor, "*b 2"]) -> Pair:
        """Gain and offset of the shading at camera pixels (x right, y down, centres at integers)."""
        if self.shading is not None:
            return self.shading(pixel)
        one = torch.ones(*pixel.shape[:-1], 3, dtype=pixel.dtype, device=pixel.device)
        return one, torch.zeros_like(one)

    def to_dict(self) -> dict[str, Any]:
        """A JSON-able description.

        Raises:
            ColourError: the response is not one of roadproof's.
        """
        shading = self.shading
        return {
            "format": _FORMAT,
            "version": _VERSION,
            "response": _response_to_dict(self.response),
            "shading": None
            if shading is None
            else {"kind": "radial"} | {name: getattr(shading, name) for name in RadialShading.__slots__},
        }

    @classmethod
    def from_dict(cls, description: dict[str, Any]) -> ColourTransform:
        """The transform of a description made by `to_dict`.

        Raises:
            ColourError: a field is missing, of the wrong shape, not finite, or of a newer version.
        """
        if description.get("format") != _FORMAT or description.get("version") != _VERSION:
            found = f"{description.get('format')!r} version {description.get('version')!r}"
            raise ColourError(f"colour transform is {found}, expected {_FORMAT!r} version {_VERSION}")
        try:
            response = _response_from_dict(dict(description["response"]))
            shading = description["shading"]
            return cls(response, None if shading is None else _shading_from_dict(shading))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            if isinstance(error, ColourError):
                raise
            raise ColourError(f"colour transform is damaged ({error!r}); fit it again") from None


def _response_to_dict(response: Response) -> dict[str, Any]:
    if isinstance(response, AffineResponse):
        return {"kind": "affine", "matrix": response.matrix.tolist(), "offset": response.offset.tolist()}
    if isinstance(response, FilmResponse):
        return {
            "kind": "film",
            "exposure": response.exposure.tolist(),
            "contrast": float(response.contrast),
            "encoding": float(response.encoding),
        }
    raise ColourError(f"{type(response).__name__} cannot be saved, expected an AffineResponse or a FilmResponse")


def _response_from_dict(fields: dict[str, Any]) -> Response:
    if fields["kind"] == "affine":
        return AffineResponse(_numbers(fields, "matrix", 3, 3), _numbers(fields, "offset", 3))
    if fields["kind"] == "film":
        parts = _numbers(fields, "exposure", 3), _numbers(fields, "contrast"), _numbers(fields, "encoding")
        if any(bool((part <= 0).any()) for part in parts):
            raise ColourError("film response has an exposure, contrast or encoding that is not above 0; fit it again")
        return FilmResponse(*parts)
    raise ColourError(f"colour response is of kind {fields['kind']!r}, expected 'affine' or 'film'")


def _shading_from_dict(fields: dict[str, Any]) -> RadialShading:
    if fields["kind"] != "radial":
        raise ColourError(f"shading is of kind {fields['kind']!r}, expected 'radial'")
    size = [int(fields[name]) for name in ("width_px", "height_px")]
    gain, offset = float(_numbers(fields, "gain")), float(_numbers(fields, "offset"))
    if min(size) < 1 or not math.isfinite(gain + offset):
        raise ColourError(f"shading is for a {size[0]}×{size[1]} picture, expected at least 1×1 pixels")
    return RadialShading(width_px=size[0], height_px=size[1], gain=gain, offset=offset)


def _numbers(fields: dict[str, Any], name: str, *shape: int) -> Tensor:
    value = torch.tensor(fields[name], dtype=torch.float64)
    # Pictures are computed in single precision, in which the largest of double are infinite.
    if tuple(value.shape) != shape or not bool(value.float().isfinite().all()):
        raise ColourError(f"{name} of a colour transform is {fields[name]}, expected finite numbers of shape {shape}")
    return value
