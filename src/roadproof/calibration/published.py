"""The paper's calibration: coloured points for homographies, painted colours for one affine colour transform.

Twelve replays of every drive over a black canvas with five coloured discs give 60 correspondences a frame; 22 replays
of the clean drive with the canvas in one colour give colours.

References:
    The paper's supplement, calibration; adversary/color_map.txt and the detection of the released code. Its detection
    asks for channels of exactly 0, which a wet road never shows: here they are low beside the others. It calls no
    RANSAC; here wrong detections, which other renderers than the authors' may cause, are left out.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, UInt8

from roadproof.calibration.replays import Replays, Target
from roadproof.calibration.report import Geometry
from roadproof.datatypes import Observation
from roadproof.drives import Drive, Drives
from roadproof.errors import CalibrationError, ColourError, GeometryError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CropResize, sight
from roadproof.homographies import Homography, check_image_from_canvas, homography_from_points, reprojection_errors_px
from roadproof.photometry import ColourTransform, fit_affine
from roadproof.simulators.protocol import PatternImage, uniform

POINTS, RUNS = 60, 12
RADIUS_PX = 4
COLOURS = ((255, 0, 0), (0, 255, 0), (0, 0, 255), (0, 255, 255), (255, 0, 255))
PAINTS = (
    (204, 81, 81), (127, 51, 51), (81, 204, 204), (51, 127, 127), (142, 204, 81), (89, 127, 51), (142, 81, 204),
    (89, 51, 127), (204, 173, 81), (127, 108, 51), (81, 204, 112), (51, 127, 70), (81, 112, 204), (51, 70, 127),
    (204, 81, 173), (127, 51, 108), (204, 127, 81), (127, 79, 51), (188, 204, 81), (117, 127, 51), (96, 204, 81),
    (60, 127, 51),
)  # fmt: skip
_FROM_PX, _TO_PX, _APART_PX = 10, 389, 44.0
_BRIGHT, _LOW = 60.0, 0.35
_OUTLIER_PX = 5.0
_LEAST_POINTS = 8
_INNER_PX = (40, 359)
_SEED = 1


def calibration_points() -> Float[np.ndarray, "60 2"]:
    """The 60 calibration points on the canvas, px, at least 44 px apart, always the same."""
    rng = np.random.default_rng(_SEED)
    while True:
        points = np.empty((0, 2))
        for drawn in rng.uniform(_FROM_PX, _TO_PX, (20_000, 2)):
            if not len(points) or float(np.square(points - drawn).sum(1).min()) >= _APART_PX**2:
                points = np.vstack([points, drawn])
            if len(points) == POINTS:
                return points


def points_target(points: Float[np.ndarray, "5 2"]) -> PatternImage:
    """A black canvas with a disc of each of the five colours at its point."""
    target = uniform(0, 0, 0)
    rows, columns = np.mgrid[0:CANVAS_SIZE_PX, 0:CANVAS_SIZE_PX]
    for (x, y), colour in zip(points, COLOURS, strict=True):
        target[np.hypot(columns - x, rows - y) <= RADIUS_PX, :3] = colour
    return target


def detect_points(picture: UInt8[np.ndarray, "h w 3"]) -> Float[np.ndarray, "5 2"]:
    """The pixel at which each colour is seen brightest, (5, 2), in whole px; NaN for a colour that is not seen."""
    levels = picture.astype(np.float32)
    found = np.full((len(COLOURS), 2), np.nan)
    for k, colour in enumerate(COLOURS):
        on = np.array(colour) > 0
        lit, dark = levels[..., on].min(-1), levels[..., ~on].max(-1)
        score = np.where((lit > _BRIGHT) & (dark < _LOW * lit), lit - dark, 0.0)
        row, column = divmod(int(score.argmax()), picture.shape[1])
        if score[row, column] > 0:
            found[k] = column, row
    return found


def point_targets() -> list[Target]:
    """What every drive is replayed over for its homographies: the canvas with five points at a time."""
    runs = calibration_points().reshape(RUNS, len(COLOURS), 2)
    return [
        Target(f"points-{k:02d}", points_target(five), _points_seen, full_pictures=True)
        for k, five in enumerate(runs, 1)
    ]


def colour_targets() -> list[Target]:
    """What the clean drive is replayed over for its colours: the canvas in one colour at a time."""
    return [Target(f"colour-{k:02d}", uniform(*paint)) for k, paint in enumerate(PAINTS, 1)]


def _points_seen(seen: Observation) -> Float[np.ndarray, "5 2"]:
    assert seen.picture is not None
    return detect_points(seen.picture)


def homographies_from_points(replays: Replays, drive: Drive, camera: CameraModel) -> Geometry:
    """Where the frames of a drive see the canvas, from the points seen on it.

    Args:
        replays: replays of the recorded drives.
        drive: the drive to replay, one of the drives.
        camera: camera on the car, through whose lens the points are seen.

    Raises:
        CalibrationError: a replay goes astray.
    """
    points = calibration_points()
    seen = np.concatenate([replays.look(drive, target) for target in point_targets()], axis=1)
    found: dict[int, Homography] = {}
    dropped: dict[int, str] = {}
    residuals: list[Float[np.ndarray, " n"]] = []
    for k, image in enumerate(seen):
        straight = np.full_like(image, np.nan)
        seen_there = np.isfinite(image).all(1)
        straight[seen_there] = camera.straightened(image[seen_there])
        there = np.isfinite(straight).all(1)
        if there.sum() < _LEAST_POINTS:
            dropped[k] = f"{int(there.sum())} of {POINTS} points found, {_LEAST_POINTS} needed"
            continue
        try:
            homography = homography_from_points(points[there], straight[there], outlier_px=_OUTLIER_PX)
            check_image_from_canvas(homography)
        except GeometryError as error:
            dropped[k] = str(error)
            continue
        errors = reprojection_errors_px(homography, points[there], straight[there])
        found[k] = homography
        residuals.append(errors[errors < _OUTLIER_PX])
    return Geometry(found, dropped, np.concatenate([np.empty(0), *residuals]))


def colours_from_paints(
    replays: Replays, drives: Drives, clean: Drive, homographies: dict[int, Homography]
) -> tuple[ColourTransform, float]:
    """One affine colour transform from 22 colours painted all over, and its mean error in 8-bit levels.

    Raises:
        CalibrationError: the canvas is not seen, or the colours do not determine the transform.
    """
    settings = drives.settings
    inner = {k: _inner(homography, settings.view, settings.camera) for k, homography in homographies.items()}
    inner = {k: mask for k, mask in inner.items() if mask.any()}
    if not inner:
        raise CalibrationError("no frame of the clean drive shows the inside of the canvas; record nearer to it")
    looks = [replays.look(clean, target) for target in colour_targets()]
    seen = [[look[k][mask].mean(0) for k, mask in inner.items()] for look in looks]
    painted = torch.tensor(PAINTS, dtype=torch.float64).repeat_interleave(len(inner), 0) / 255
    measured = torch.tensor(np.array(seen).reshape(-1, 3)) / 255
    try:
        response = fit_affine(painted, measured)
    except ColourError as error:
        raise CalibrationError(f"the colours of the clean drive cannot be fitted: {error}") from None
    residual = 255 * float((response(painted).clamp(0, 1) - measured).abs().mean())
    return ColourTransform(response), residual


def _inner(homography: Homography, view: CropResize, camera: CameraModel) -> np.ndarray:
    """The pixels of the controller's input that lie well inside the canvas."""
    at, ahead = sight(view, camera).on(np.linalg.inv(view.input_from_camera @ homography))
    with np.errstate(invalid="ignore"):
        inside = ((at >= _INNER_PX[0]) & (at <= _INNER_PX[1])).all(1) & ahead
    return inside.reshape(view.height_px, view.width_px)
