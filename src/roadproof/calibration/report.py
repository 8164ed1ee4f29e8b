"""How good a calibration is, and what it cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from roadproof.errors import CalibrationError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel
from roadproof.homographies import Homographies, Homography, homogeneous
from roadproof.io.records import RecordFile, Saved

_GRID = 9


class Geometry(NamedTuple):
    """Where the frames of one drive see the canvas, and how well that fits what they show.

    Args:
        found: homography of each frame that has one, canvas px to camera px, by the frame's index.
        dropped: index of each other frame, and why it has none.
        residuals_px: by how much the homographies miss points or outline, camera px, (N,).
    """

    found: dict[int, Homography]
    dropped: dict[int, str]
    residuals_px: Float[np.ndarray, " n"]


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean and 95th percentile of errors, in px of the camera picture."""

    mean: float
    p95: float

    @staticmethod
    def of(errors: Float[np.ndarray, " n"]) -> Spread | None:
        """Mean and 95th percentile of some errors; None if there are none."""
        return Spread(float(errors.mean()), float(np.percentile(errors, 95))) if errors.size else None


@dataclass(frozen=True, kw_only=True, slots=True)
class DriveReport:
    """How the calibration of one drive went.

    Args:
        name: name of the drive.
        frames: number of frames that are kept.
        dropped: frame number of each frame that was dropped, and why.
        residual_px: mean and 95th percentile by which homographies miss their points or outline, camera px.
        stated_px: distance between points mapped by the homographies and by those that the simulator states, over a
            grid on the visible canvas, camera px; None if no replay stated any.
    """

    name: str
    frames: int
    dropped: tuple[tuple[int, str], ...]
    residual_px: Spread | None
    stated_px: Spread | None


@dataclass(frozen=True, kw_only=True, slots=True)
class CalibrationReport(Saved):
    """How good a calibration is, and what it cost.

    Args:
        method: calibration method.
        drives: report on each drive.
        colour_residual: mean error of the fitted colours, 8-bit levels; None for two-paint methods, which fit two
            unknowns to two paints.
        calls: number of drives the simulator made, recording included.
        seconds: wall time in seconds of replays and fits, without recording.
    """

    method: str
    drives: tuple[DriveReport, ...]
    colour_residual: float | None
    calls: int
    seconds: float


CalibrationReport.FILE = RecordFile(
    kind=CalibrationReport, name="roadproof-calibration", error=CalibrationError, remedy="calibrate again"
)


def stated_errors_px(
    image_from_canvas: Homographies, stated: Float[np.ndarray, "g 3 3"], camera: CameraModel
) -> Float[np.ndarray, " n"]:
    """Distances in the picture between two views of a 9×9 grid of canvas points, corners included, where it shows them.

    Args:
        image_from_canvas: fitted homographies, canvas px to px of the camera without its lens, (F, 3, 3).
        stated: homographies that the simulator states, (F, 3, 3).
        camera: camera on the car.
    """
    side = np.linspace(-0.5, CANVAS_SIZE_PX - 0.5, _GRID)
    grid = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    points = np.broadcast_to(grid, (len(stated), *grid.shape))
    mapped = homogeneous(stated, points)
    there, depth = camera.distorted(mapped), mapped[..., 2]
    inside = (there > -0.5) & (there < np.array([camera.width_px, camera.height_px]) - 0.5)
    seen = inside.all(-1) & (depth > 0)
    return np.linalg.norm(camera.distorted(homogeneous(image_from_canvas, points)) - there, axis=-1)[seen]
