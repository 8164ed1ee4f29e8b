"""Two replays a drive, the canvas white, then black with grey squares: how paint looks in every pixel, and where."""

from __future__ import annotations

import numpy as np
import torch

from roadproof.calibration.compiled import GREY, SQUARES
from roadproof.calibration.outline import fit_outline, outline_errors_px, predicted_contrast
from roadproof.calibration.replays import Replays, Target
from roadproof.calibration.report import Geometry
from roadproof.drives import Drive
from roadproof.errors import CalibrationError, ColourError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CropResize
from roadproof.homographies import Homographies
from roadproof.photometry import PixelMaps, pixel_maps_from_two_paints
from roadproof.simulators.protocol import PatternImage, uniform

LEAST_PX = 20
MOST_ASTRAY = 0.5
"""A frame of whose canvas more is seen beside where its pose has it is another's: no edge is near to measure by."""


def dark_target() -> PatternImage:
    """The dark target: a black canvas with grey squares like the squares of one colour on a chessboard."""
    target = uniform(0, 0, 0)
    rows, columns = np.indices((CANVAS_SIZE_PX, CANVAS_SIZE_PX)) * SQUARES // CANVAS_SIZE_PX
    target[(rows + columns) % 2 == 0, :3] = round(255 * GREY)
    return target


TARGETS = Target("light", uniform(255, 255, 255)), Target("dark", dark_target())


def look_at_paints(
    replays: Replays,
    drive: Drive,
    prior: Homographies,
    camera: CameraModel,
    view: CropResize,
    *,
    refine: bool,
) -> tuple[Geometry, PixelMaps]:
    """Where the frames of a drive see the canvas, and how paint looks there, from a light and a dark canvas.

    Args:
        replays: replays of the recorded drives.
        drive: the drive to replay, one of the drives.
        prior: homographies from the drive's poses, canvas px to camera px, (F, 3, 3).
        camera: camera on the car.
        view: crop and resize that make the controller's input from the camera picture.
        refine: whether the homographies are corrected by what the frames show.

    Raises:
        CalibrationError: the two paints look alike or saturate, or a replay goes astray.
    """
    light, dark = (replays.look(drive, target) for target in TARGETS)
    difference = light.astype(np.float64) - dark
    contrast = difference.mean(-1) / 255
    if refine:
        homographies, errors = fit_outline(prior, contrast, camera, view)
    else:
        homographies, errors = prior, outline_errors_px(prior, contrast, camera, view)
    # What the dark frame would be without its squares: they took the known share 1 − p / s of the difference.
    share, expected = predicted_contrast(homographies, view, camera)
    whole = np.where(share > 0.01, share / np.maximum(expected, 1e-6), 1.0).clip(1.0, 1.0 / (1.0 - GREY))
    black = np.clip(np.round(light - difference * whole[..., None]), 0, 255).astype(np.uint8)
    try:
        maps = pixel_maps_from_two_paints(torch.tensor(light), torch.tensor(black))
    except ColourError as error:
        raise CalibrationError(f"drive {drive.name}: {error}") from None
    visible = maps.visible.numpy()
    seen_px, within_px = visible.sum((1, 2)), (visible * (share >= 0.01)).sum((1, 2))
    # Leaves that move, or cars, differ elsewhere too, and leave the canvas where it is.
    elsewhere = within_px < (1 - MOST_ASTRAY) * np.minimum(seen_px, share.sum((1, 2)))
    dropped = {
        k: f"{seen:.0f} pixels of the canvas are visible, {LEAST_PX} needed"
        if seen < LEAST_PX
        else f"{1 - within_px[k] / seen:.0%} of what is seen of the canvas lies where the pose has none of it"
        for k, seen in enumerate(seen_px.tolist())
        if seen < LEAST_PX or elsewhere[k]
    }
    found = {k: homography for k, homography in enumerate(homographies) if k not in dropped}
    kept = list(found)
    residuals_px = errors[kept]
    return Geometry(found, dropped, residuals_px[np.isfinite(residuals_px)]), maps.at(kept)
