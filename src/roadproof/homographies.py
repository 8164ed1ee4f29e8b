"""Homographies: how points of one plane or picture map to another, and their fit to corresponding points.

Convention:
    A homography named `b_from_a` maps column vectors (x, y, 1) of a to b; `image_from_canvas` has a positive third
    coordinate for what is in front of the camera, and maps to the picture that the camera would take without its lens.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Bool, Float

from roadproof.errors import GeometryError

_MOST_SCALE = 1e9

Points = Float[np.ndarray, "*n 2"]
Homography = Float[np.ndarray, "3 3"]
Homographies = Float[np.ndarray, "f 3 3"]


def homogeneous(
    b_from_a: Float[np.ndarray, "*b 3 3"], points: Float[np.ndarray, "*b n 2"]
) -> Float[np.ndarray, "*b n 3"]:
    """Map points of a to homogeneous points of b."""
    return points @ np.swapaxes(b_from_a[..., :2], -1, -2) + b_from_a[..., None, :, 2]


def apply_homography(b_from_a: Float[np.ndarray, "*b 3 3"], points: Float[np.ndarray, "*b n 2"]) -> Points:
    """Map points of a to b. Points at infinity come out as inf or NaN, without a warning."""
    mapped = homogeneous(b_from_a, points)
    with np.errstate(divide="ignore", invalid="ignore"):
        return mapped[..., :2] / mapped[..., 2:]


def homography_from_points(
    canvas: Float[np.ndarray, "n 2"], image: Float[np.ndarray, "m 2"], *, outlier_px: float | None = None
) -> Homography:
    """`image_from_canvas` from corresponding points, by the normalised direct linear transform.

    Args:
        canvas: points on the canvas, px, (N, 2).
        image: camera px at which each was seen, (N, 2), behind a lens those that `CameraModel.straightened` gives; all
            points lie in front of the camera.
        outlier_px: where given, correspondences further than this from the best of 500 seeded four-point fits are
            left out (RANSAC); otherwise all count, as in the paper.

    Returns:
        The homography, scaled to unit Frobenius norm, with a positive third coordinate at the points.

    Raises:
        GeometryError: fewer than four points, values that are not finite, points (nearly) on a line, points that lie
            on both sides of the camera, or no four points that agree with a fourth of the rest.

    References:
        Hartley and Zisserman, Multiple View Geometry, algorithms 4.2 and 4.6; the paper's supplement, calibration.
    """
    if len(canvas) != len(image):
        raise GeometryError(f"{len(canvas)} canvas points but {len(image)} image points, expected as many of both")
    if len(canvas) < 4:
        raise GeometryError(f"{len(canvas)} correspondences, expected at least 4 to fit a homography")
    if not (np.isfinite(canvas).all() and np.isfinite(image).all()):
        raise GeometryError("a correspondence is NaN or infinite; drop points that were not detected before the fit")
    if outlier_px is not None:
        keep = _ransac_inliers(canvas, image, outlier_px, np.random.default_rng(0))
        canvas, image = canvas[keep], image[keep]
    fitted, well_posed = _direct_linear_transform(canvas[None], image[None])
    if not well_posed[0]:
        raise GeometryError(
            f"the {len(canvas)} correspondences lie (nearly) on a line; spread them over the canvas in both directions"
        )
    homography = fitted[0]
    depth = canvas @ homography[2, :2] + homography[2, 2]
    if depth.mean() < 0:
        homography, depth = -homography, -depth
    if (depth <= 0).any():
        raise GeometryError(
            f"{int((depth <= 0).sum())} of {len(canvas)} points would lie behind the camera; "
            "give visible points only, or reject outliers"
        )
    return homography


def _direct_linear_transform(
    canvas: Float[np.ndarray, "b n 2"], image: Float[np.ndarray, "b n 2"]
) -> tuple[Float[np.ndarray, "b 3 3"], Bool[np.ndarray, " b"]]:
    """Batched DLT of unknown sign, unit norm, and whether the points determined it."""
    to_canvas, canvas_n = _normalised(canvas)
    to_image, image_n = _normalised(image)
    x, y = image_n[..., 0:1], image_n[..., 1:2]
    one = np.concatenate([canvas_n, np.ones_like(x)], axis=-1)
    zero = np.zeros_like(one)
    rows = np.concatenate(
        [np.concatenate([one, zero, -x * one], axis=-1), np.concatenate([zero, one, -y * one], axis=-1)], axis=-2
    )
    padded = rows if rows.shape[-2] >= 9 else np.concatenate([rows, np.zeros_like(rows[:, :1])], axis=-2)
    _, spread, vt = np.linalg.svd(padded, full_matrices=False)
    normalised = vt[:, -1].reshape(-1, 3, 3)
    # A line of points leaves a second null vector or a map that squashes the plane onto a line.
    shape = np.linalg.svd(normalised, compute_uv=False)
    well_posed = (spread[:, 7] > 1e-6 * spread[:, 0]) & (shape[:, 2] > 1e-6 * shape[:, 0])
    fitted = np.linalg.inv(to_image) @ normalised @ to_canvas
    return fitted / np.linalg.norm(fitted, axis=(-2, -1), keepdims=True), well_posed


def _normalised(points: Float[np.ndarray, "b n 2"]) -> tuple[Float[np.ndarray, "b 3 3"], Float[np.ndarray, "b n 2"]]:
    """Hartley's normalisation: mean zero, mean distance √2; and the similarity that does it."""
    centre = points.mean(axis=1)
    distance = np.linalg.norm(points - centre[:, None], axis=-1).mean(axis=1)
    scale = math.sqrt(2) / np.maximum(distance, 1e-12)
    similarity = np.zeros((len(points), 3, 3))
    similarity[:, 0, 0] = similarity[:, 1, 1] = scale
    similarity[:, :2, 2] = -scale[:, None] * centre
    similarity[:, 2, 2] = 1.0
    return similarity, (points - centre[:, None]) * scale[:, None, None]


def _ransac_inliers(
    canvas: Float[np.ndarray, "n 2"], image: Float[np.ndarray, "n 2"], outlier_px: float, rng: np.random.Generator
) -> Bool[np.ndarray, " n"]:
    draws = rng.random((500, len(canvas))).argsort(axis=1)[:, :4]
    fitted, well_posed = _direct_linear_transform(canvas[draws], image[draws])
    every = np.broadcast_to(canvas, (len(fitted), *canvas.shape))
    error = np.linalg.norm(apply_homography(fitted, every) - image, axis=-1)
    inlier = (error < outlier_px) & well_posed[:, None]
    best = inlier[inlier.sum(axis=1).argmax()]
    if best.sum() < max(4, len(canvas) / 4):
        raise GeometryError(
            f"no homography agrees with more than {int(best.sum())} of {len(canvas)} correspondences "
            f"within {outlier_px} px; check the detections"
        )
    return best


def reprojection_errors_px(
    image_from_canvas: Homography, canvas: Float[np.ndarray, "n 2"], image: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, " n"]:
    """Distance in camera px between where each canvas point is seen and where the homography puts it."""
    return np.linalg.norm(apply_homography(image_from_canvas, canvas) - image, axis=-1)


def check_image_from_canvas(image_from_canvas: Homography) -> None:
    """Refuse a matrix that cannot be the view of a canvas from above.

    A road seen from above is never mirrored, so the determinant of a homography of the right sign is positive.

    Raises:
        GeometryError: values that are not finite, rank below three, or the wrong sign.
    """
    if not np.isfinite(image_from_canvas).all():
        raise GeometryError("homography has NaN or infinite entries")
    largest = float(np.abs(image_from_canvas).max())
    if not 1 / _MOST_SCALE < largest < _MOST_SCALE:
        raise GeometryError(f"homography's largest entry is {largest:g}, no camera's; scale it to about 1")
    # Balanced first: pixels and the third row differ by orders of magnitude without any fault.
    scaled = image_from_canvas / np.maximum(np.abs(image_from_canvas).max(axis=1, keepdims=True), 1e-300)
    determinant = np.linalg.det(scaled / np.maximum(np.abs(scaled).max(axis=0, keepdims=True), 1e-300))
    if abs(determinant) < 1e-9:
        raise GeometryError("homography has rank below 3: the canvas would be seen as a line or a point")
    if determinant < 0:
        raise GeometryError(
            "homography has the wrong sign (negative determinant): multiply it by −1 so that the third coordinate is "
            "positive in front of the camera, and check that the canvas is not mirrored"
        )
