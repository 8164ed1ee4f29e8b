"""What recordings say of the road that may be painted."""

from __future__ import annotations

from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.compositing.view import camera_points, canvas_pixels
from roadproof.errors import GeometryError
from roadproof.paint.site import Rgb, Site
from roadproof.photometry import Response
from roadproof.recordings import Recording, RecordingSet

_VISIBLE = 0.5
_GRID, _ZOOM, _LEVELS = 9, 0.4, 12


def site_of(recordings: RecordingSet) -> Site:
    """The canvas' size, its lane marks, and the paint that looks like its asphalt.

    The asphalt's colour is that of which the recorded colour transform makes the median of the canvas' pixels, in the
    frame of the clean drive that shows the canvas largest.
    """
    canvas = recordings.canvas
    return Site(
        size_m=None if canvas is None else (canvas.width_m, canvas.length_m),
        asphalt=_asphalt(recordings),
        marks=recordings.marks,
    )


def _asphalt(recordings: RecordingSet) -> Rgb | None:
    drive = recordings.clean or recordings.recordings[0]
    flats = (_flat(recordings, drive, k) for k in range(len(drive.frames)))
    largest = max((flat for flat in flats if flat is not None and len(flat)), key=len, default=None)
    if largest is None:
        return None
    painted = _painted(recordings.colour.response, largest.quantile(0.5, 0))
    red, green, blue = cast("list[float]", painted.tolist())
    return round(red, 4), round(green, 4), round(blue, 4)


def _flat(recordings: RecordingSet, drive: Recording, k: int) -> Float[Tensor, "p 3"] | None:
    """The bare canvas' pixels of one frame without gain and offset: what the response would have to be there."""
    try:
        index, _, _ = canvas_pixels(drive.image_from_canvas[k : k + 1], recordings.view, recordings.camera)
    except GeometryError:
        return None
    place = torch.as_tensor(index)
    clean = torch.tensor(drive.frames[k].reshape(-1, 3)[index]).double() / 255
    if drive.maps is None:
        gain, offset = recordings.colour.gain_and_offset(camera_points(place, recordings.view))
        seen = torch.ones(len(place), dtype=torch.bool)
    else:
        maps = drive.maps
        gain, offset = maps.gain[k].flatten(0, 1)[place], maps.offset[k].flatten(0, 1)[place]
        seen = maps.visible[k].flatten()[place] > _VISIBLE
    usable = seen & (gain.abs().amin(-1) > 1e-3)
    return ((clean - offset.double()) / gain.double())[usable]


def _painted(response: Response, seen: Float[Tensor, " 3"]) -> Float[Tensor, " 3"]:
    """The paint of which a response makes a flat colour, or the nearest to it: a grid, made finer about its best."""
    axis = torch.linspace(-0.5, 0.5, _GRID, dtype=torch.float64)
    grid = torch.cartesian_prod(axis, axis, axis)
    best, span = torch.full((3,), 0.5, dtype=torch.float64), 1.0
    for _ in range(_LEVELS):
        tried = (best + span * grid).clamp(0.0, 1.0)
        best, span = tried[(response(tried) - seen).square().sum(-1).argmin()], span * _ZOOM
    return best
