"""The camera that pictures of a chessboard tell: its field of view and its lens, and how well they are known.

What is fitted (`own.bundle`) is `CameraModel` with its `Lens`, whose middle is the picture's. Coefficients that the
pictures do not tell from 0, by two standard errors, stay 0, beginning with the last in OpenCV's order: fitted all the
same, they bend the corners of the picture, where no board was, by many pixels. A second fit, in which the lens's middle
is free, says how far beside the picture's it is, and what that changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from roadproof.drives.own.boards import LEAST_PICTURES, Boards
from roadproof.drives.own.bundle import Bundle, Fit
from roadproof.errors import GeometryError, RecordingError
from roadproof.geometry import CameraModel
from roadproof.lens import LensModel

MOST_MISSED_PX = 2.0
"""Chessboards whose corners the camera found misses by more, root mean square, are refused."""
MOST_UNKNOWN = 0.01
"""Chessboards that leave open by more of the picture's width where the camera shows things are refused."""

_ODD, _WELL_PX = 3.0, 0.1  # times what is missed in the median picture, which is taken to be this much or more
_TOLD = 2.0  # standard errors from 0
_BESIDE = 3.0  # standard errors that the lens's middle is from the picture's
_STARTS = np.geomspace(1 / 3, 3.0, 13)
_FAR = 0.01  # of the picture's width, from where on it is said


@dataclass(frozen=True, kw_only=True, slots=True)
class Calibration:
    """What pictures of a chessboard tell of a camera; as a text, in words.

    Args:
        camera: camera with the field of view and the lens that were found; a pinhole where no coefficient was told.
        pictures: number of pictures that count.
        missed_px: distance from where corners are seen to where the camera shows them, root mean square, px.
        fov_error_deg: half the 95 % interval of the field of view, with what the lens's middle changes in it, degrees.
        unknown_px: half the 95 % interval of where the camera shows things, root mean square over the picture, px.
        middle_px: how far right and down the lens's middle is of the picture's, px; 0 where it is not told from it.
        left_out: which pictures are left out and why, in words.
    """

    camera: CameraModel
    pictures: int
    missed_px: float
    fov_error_deg: float
    unknown_px: float
    middle_px: tuple[float, float]
    left_out: str

    def __str__(self) -> str:
        lens = "no distortion" if self.camera.lens is None else "lens"
        fits = (
            f"field of view {self.camera.fov_deg:.2f}° ± {self.fov_error_deg:.2f}° (95 %) and {lens} from "
            f"{self.pictures} pictures of a chessboard, whose corners are missed by {self.missed_px:.2f} px (rms)"
        )
        known = f"where the camera shows things is known to ± {self.unknown_px:.1f} px"
        far = _is_far(self.middle_px, self.camera)
        return "; ".join(filter(None, [fits, known, _beside(self.middle_px) if far else "", self.left_out]))


def calibrated(camera: CameraModel, boards: Boards, model: LensModel) -> Calibration:
    """The camera whose field of view and lens show the corners of a chessboard where they are seen.

    Args:
        camera: camera that took the pictures; its focal length, where the search begins, may be off by a factor of 3.
        boards: where its pictures show the corners.
        model: kind of the lens.

    Raises:
        RecordingError: the camera found misses the corners by more than 2 px, the boards leave open by more than 1 % of
            the picture's width where it shows things, or the lens's middle is so far beside the picture's that it moves
            the picture's edges by more than that.
    """
    while True:
        bundle = Bundle(model, boards.seen_px, boards.grid, camera.intrinsics[:2, 2])
        fit, found = _told(bundle, camera)
        each_px = np.sqrt(np.square(fit.missed_px).sum(-1).mean(-1))
        # One corner that OpenCV mistakes for another spoils a fit.
        odd = each_px > _ODD * max(float(np.median(each_px)), _WELL_PX)
        if not odd.any() or len(odd) - odd.sum() < LEAST_PICTURES:
            break
        boards = boards.without(odd, "the corners do not fit those of the other pictures in")
    missed_px = _checked_px(each_px, boards, model)
    # Of the logarithm of the focal length, and what it makes of the field of view.
    error, to_deg = 2 * math.sqrt(fit.covariance[0, 0]), math.degrees(math.sin(math.radians(found.fov_deg)))
    unknown_px, most_px = _unknown_px(found, bundle, fit), MOST_UNKNOWN * camera.width_px
    middle_px, moved = _middle(bundle, fit)
    well = unknown_px <= most_px
    if _is_far(middle_px, camera) and not (well and abs(moved) * camera.width_px / 2 <= most_px):
        raise RecordingError(
            f"the chessboards fit no lens that is centred on the picture, as here all are: {_beside(middle_px)}"
        )
    if not well:
        raise RecordingError(
            f"the chessboards leave open by ± {unknown_px:.1f} px where the camera shows things, expected at most "
            f"{most_px:.1f}, and the field of view by ± {min(error * to_deg, 90.0):.1f}°: tilt the board by 20 "
            "to 40 degrees, each time another way, come nearer, and show it near all four corners of the picture"
        )
    return Calibration(
        camera=found,
        pictures=len(boards.names),
        missed_px=missed_px,
        fov_error_deg=math.hypot(error, moved) * to_deg,
        unknown_px=unknown_px,
        middle_px=middle_px,
        left_out=boards.left_out,
    )


def _told(bundle: Bundle, camera: CameraModel) -> tuple[Fit, CameraModel]:
    """The fit with the coefficients that the pictures tell from 0 and that fold none, and its camera."""
    shared, poses = bundle.begun(camera.focal_px * _STARTS)
    free = np.ones(len(shared), bool)
    free[bundle.middle] = False
    fit = bundle.fitted(free, shared, poses)
    found = _seen_through(camera, bundle, fit)
    for k in reversed(range(bundle.coefficients.start, bundle.coefficients.stop)):
        if found is not None and abs(fit.shared[k]) > _TOLD * math.sqrt(fit.covariance[k, k]):
            break
        free[k] = False
        fit = bundle.fitted(free, np.where(free, fit.shared, 0.0), fit.poses)
        found = _seen_through(camera, bundle, fit)
    if found is None:
        raise RecordingError(
            f"a {bundle.model} lens that shows the chessboards so would fold the picture before its corners; cut the "
            "pictures to what the lens draws"
        )
    return fit, found


def _checked_px(each_px: Float[np.ndarray, " n"], boards: Boards, model: LensModel) -> float:
    """By how much the corners of all pictures are missed, root mean square, where that is not too much."""
    missed_px, worst = math.sqrt(np.square(each_px).mean()), int(each_px.argmax())
    if not missed_px <= MOST_MISSED_PX:
        raise RecordingError(
            f"the chessboards' corners are missed by {missed_px:.1f} px (rms; most in {boards.names[worst]}, "
            f"{each_px[worst]:.1f} px), expected at most {MOST_MISSED_PX:g}: the board must be flat and the pictures "
            f"sharp, and a wide lens may be none of the kind {model}"
        )
    return missed_px


def _seen_through(camera: CameraModel, bundle: Bundle, fit: Fit) -> CameraModel | None:
    """The camera with the focal length and the lens of a fit; None where it would fold the picture."""
    fov_deg = math.degrees(2 * math.atan(camera.width_px / 2 / math.exp(fit.shared[0])))
    lens = bundle.lens(fit.shared) if fit.shared[bundle.coefficients].any() or bundle.model == "fisheye" else None
    try:
        return replace(camera, fov_deg=fov_deg, lens=lens)
    except GeometryError:
        return None


def _unknown_px(camera: CameraModel, bundle: Bundle, fit: Fit) -> float:
    """Twice the standard error of where the camera shows things, root mean square over the picture, px."""
    columns, rows = (np.linspace(-0.5, size - 0.5, 21) for size in (camera.width_px, camera.height_px))
    through, _ = camera.undistorted(np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2))
    return 2 * math.sqrt(bundle.variance(fit, through @ np.linalg.inv(camera.intrinsics).T).mean())


def _middle(bundle: Bundle, fit: Fit) -> tuple[tuple[float, float], float]:
    """The lens's middle beside the picture's, px, and by how much the logarithm of the focal length hangs on it.

    Both are 0 where the pictures do not tell the two middles apart.
    """
    free = fit.covariance.diagonal() > 0
    free[bundle.middle] = True
    moved = bundle.fitted(free, fit.shared, fit.poses)
    off, covariance = moved.shared[bundle.middle], moved.covariance[bundle.middle, bundle.middle]
    if off @ np.linalg.solve(covariance, off) < _BESIDE**2:
        return (0.0, 0.0), 0.0
    return (float(off[0]), float(off[1])), float(moved.shared[0] - fit.shared[0])


def _is_far(middle_px: tuple[float, float], camera: CameraModel) -> bool:
    """Whether the lens's middle is so far from the picture's that it is said."""
    return math.hypot(*middle_px) > _FAR * camera.width_px


def _beside(middle_px: tuple[float, float]) -> str:
    """How far the lens's middle is from the picture's, and what to cut, in words."""
    right, down = (round(each) for each in middle_px)
    sides = [
        (right, "right of" if right > 0 else "left of", f"columns from the {'left' if right > 0 else 'right'}"),
        (down, "below" if down > 0 else "above", f"rows from the {'top' if down > 0 else 'bottom'}"),
    ]
    where = " and ".join(f"{abs(px)} px {side}" for px, side, _ in sides if px)
    cut = " and ".join(f"{2 * abs(px)} {lines}" for px, _, lines in sides if px)
    return f"the lens's middle is {where} the picture's: cut {cut} of all pictures, so that it is theirs"
