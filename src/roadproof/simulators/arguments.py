"""What every simulator refuses."""

from __future__ import annotations

import numpy as np

from roadproof.errors import SimulatorError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CropResize
from roadproof.simulators.protocol import PatternImage


def check_crop(camera: CameraModel, view: CropResize) -> None:
    """Refuse a controller's view that leaves the camera picture.

    Raises:
        SimulatorError: it does.
    """
    if view.right_px > camera.width_px or view.bottom_px > camera.height_px:
        raise SimulatorError(
            f"the crop ends at ({view.right_px}, {view.bottom_px}), expected it inside the camera picture of "
            f"{camera.width_px}×{camera.height_px} pixels"
        )


def check_pattern(pattern: PatternImage | None) -> None:
    """Refuse what cannot be painted on the canvas.

    Raises:
        SimulatorError: it is of another shape or type.
    """
    expected = (CANVAS_SIZE_PX, CANVAS_SIZE_PX, 4)
    if pattern is not None and (pattern.shape != expected or pattern.dtype != np.uint8):
        raise SimulatorError(
            f"the pattern is {pattern.dtype} of shape {pattern.shape}, expected uint8 of shape {expected} (RGBA)"
        )
