"""Homographies from what two paints show of the canvas, starting from the pose.

    symbol   meaning                                                                      shape
    H        image_from_canvas; pixels are looked up through the lens (`geometry.sight`)    (F, 3, 3)
    K        camera intrinsics
    ω, τ     small rotation (rad) and translation (m) of the camera in its own axes       (F, 3) each
    D        difference of the light and the dark frame                                   (F, H, W)
    p        the contrast that a homography predicts: share of the canvas in a footprint, less what the squares take
    g        gain of the paint near a pixel, so that D = g p

The light frame shows the canvas all white, the dark one black with grey squares, a checkerboard: the squares give edges
inside the canvas, which are seen also where its outline has left the picture, and leave every pixel at least half of
its contrast. A pose gives H; H(ω, τ) = K (exp[ω]× K⁻¹H + τ e₃ᵀ) is the view of a camera moved a little. What is looked
for are the ω, τ for which D / g = p, in robust least squares, from coarse to fine: both sides are blurred at first, so
that edges that are off by several pixels are still felt. (ω, τ) of a frame is a correction common to the drive plus
little of its own, both with a prior: what some frames show carries over to the others.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial.transform import Rotation

from roadproof.calibration.compiled import canvas_shares
from roadproof.coverage import footprint_variance
from roadproof.geometry import CANVAS_CORNERS_PX, CameraModel, CropResize, sight
from roadproof.homographies import Homographies

Pictures = Float[np.ndarray, "f h w"]
"""A number of every pixel of F pictures."""

_BLURS_PX = (6, 3, 0)
_STEPS = (4, 4, 5)
# Of a pixel's share. Pixels along an edge err together, so this is more than one of them errs: measured in the town,
# 0.3 puts the canvas nearer to the truth than 0.05, which the pixels alone would suggest.
_NOISE = 0.3
_ROBUST = 3.0
_REACH_PX = 3
_GAIN_PX = 5
_SEEN = 6 / 255
_DELTA = 1e-5
_FILTER_PX = 16
"""Further than a footprint reaches, which far beside the road is some pixels wide."""
COMMON_DOUBT = (0.01, 0.01, 0.01, 0.1, 0.03, 0.1)
"""Standard deviations of (ω, τ) that is common to a drive, rad and m along the camera's axes (right, down, forward)."""
OWN_DOUBT = (0.001, 0.0005, 0.0005, 0.002, 0.002, 0.002)
"""The same of each frame by itself."""


def fit_outline(
    prior: Homographies, contrast: Pictures, camera: CameraModel, view: CropResize
) -> tuple[Homographies, Float[np.ndarray, " f"]]:
    """Move homographies until canvas and squares lie where they are seen.

    Args:
        prior: homographies from the pose, canvas px to camera px, (F, 3, 3).
        contrast: D: light minus dark frames, mean over channels, 1 for white minus black, (F, H, W).
        camera: camera of the frames.
        view: crop and resize that make the controller's input from the camera picture.

    Returns:
        The moved homographies, (F, 3, 3), and what `outline_errors_px` says of them, (F,).
    """
    common, own = (np.diag(1 / np.square(doubt)) for doubt in (COMMON_DOUBT, OWN_DOUBT))
    moves = np.zeros((len(prior), 6))
    for blur, steps in zip(_BLURS_PX, _STEPS, strict=True):
        problem = _Outline(prior, contrast, camera, view, blur, moves)
        for _ in range(steps):
            moves = problem.step(moves, common, own)
    finest = _Outline(prior, contrast, camera, view, 0, moves)
    return moved(prior, moves, camera), finest.outline_px(moves)


def outline_errors_px(
    image_from_canvas: Homographies, contrast: Pictures, camera: CameraModel, view: CropResize
) -> Float[np.ndarray, " f"]:
    """Mean distance of predicted from measured edges per frame, camera px; NaN if no edge is in view."""
    unmoved = np.zeros((len(contrast), 6))
    return _Outline(image_from_canvas, contrast, camera, view, 0, unmoved).outline_px(unmoved)


def predicted_contrast(
    image_from_canvas: Homographies, view: CropResize, camera: CameraModel
) -> tuple[Pictures, Pictures]:
    """Share of the canvas in every pixel's footprint, and the predicted contrast p, which the squares reduce."""
    input_from_canvas = view.input_from_camera @ image_from_canvas
    through, bend = sight(view, camera)
    shape = (len(image_from_canvas), view.height_px, view.width_px)
    canvas_from_input = np.linalg.inv(input_from_canvas)
    near = _may_see_canvas(input_from_canvas, canvas_from_input, through)
    # Behind a lens lines are curves, which corners do not bound.
    frame, pixel = np.nonzero(near if camera.lens is None else np.ones_like(near))
    variance = footprint_variance(view)
    whole = np.zeros((2, *shape))
    shares = canvas_shares(canvas_from_input, frame, through.T[pixel], bend[pixel], variance)
    whole.reshape(2, shape[0], -1)[:, frame, pixel] = shares
    return whole[0], whole[1]


def _may_see_canvas(
    input_from_canvas: Homographies, canvas_from_input: Homographies, through: Float[np.ndarray, "3 n"]
) -> Bool[np.ndarray, "f n"]:
    """The pixels near the box around the canvas' corners, or all where a corner is behind the camera.

    Beside them those near the horizon, where a footprint is as long as the road.
    """
    seen = input_from_canvas @ CANVAS_CORNERS_PX.T
    behind = seen[:, 2:] < 1e-6
    at = seen[:, :2] / np.where(behind, 1.0, seen[:, 2:])
    least, most = at.min(2)[..., None] - _FILTER_PX, at.max(2)[..., None] + _FILTER_PX
    inside = ((through[:2] >= least) & (through[:2] <= most)).all(1)
    depth, slope = canvas_from_input[:, 2] @ through, np.hypot(*canvas_from_input[:, 2, :2].T)
    return inside | behind.any(2) | (np.abs(depth) < _FILTER_PX * slope[:, None])


def moved(image_from_canvas: Homographies, moves: Float[np.ndarray, "f 6"], camera: CameraModel) -> Homographies:
    """Homographies of a camera turned by ω and shifted by τ in its own axes.

    Args:
        image_from_canvas: homographies whose third coordinate is the depth in metres, as a pose gives them, (F, 3, 3).
        moves: rotation ω in radians and translation τ in metres for each frame, (F, 6).
        camera: camera of the frames.
    """
    K = camera.intrinsics
    turned = Rotation.from_rotvec(moves[:, :3]).as_matrix() @ (np.linalg.inv(K) @ image_from_canvas)
    turned[..., 2] += moves[:, 3:]
    return K @ turned


class _Outline:
    """The pixels near the outline, at one blur; predictions for them and Gauss-Newton steps."""

    def __init__(
        self,
        prior: Homographies,
        contrast: Pictures,
        camera: CameraModel,
        view: CropResize,
        blur_px: int,
        moves: Float[np.ndarray, "f 6"],
    ) -> None:
        self._prior, self._camera, self._view = prior, camera, view
        self._variance = footprint_variance(view) + blur_px**2
        _, expected = predicted_contrast(moved(prior, moves, camera), view, camera)
        blurred, whole = _blurred(_over_gain(contrast, expected), blur_px)
        self._frame, row, column = np.nonzero(whole & _near_edge(blurred))
        through, bend = sight(view, camera)
        pixel = row * view.width_px + column
        self._pixel, self._bend = through.T[pixel], bend[pixel]
        self._measured = blurred[self._frame, row, column]
        self._first = np.searchsorted(self._frame, np.arange(len(prior) + 1))

    def step(
        self, moves: Float[np.ndarray, "f 6"], common: Float[np.ndarray, "6 6"], own: Float[np.ndarray, "6 6"]
    ) -> Float[np.ndarray, "f 6"]:
        """One damped Gauss-Newton step of all frames together."""
        here = self._predicted(moves)
        slopes = np.stack([(self._predicted(moves + _DELTA * axis) - here) / _DELTA for axis in np.eye(6)], -1)
        error = (here - self._measured) / _NOISE
        # Huber's weights: an occluder at the edge of the canvas is not the edge of the canvas.
        weight = np.minimum(1.0, _ROBUST / np.maximum(np.abs(error), 1e-9)) / _NOISE
        normal = self._of_frames((weight / _NOISE)[:, None, None] * slopes[:, :, None] * slopes[:, None, :])
        return _arrow_step(moves, normal, self._of_frames((weight * error)[:, None] * slopes), common, own)

    def outline_px(self, moves: Float[np.ndarray, "f 6"]) -> Float[np.ndarray, " f"]:
        """Mean distance of predicted from measured edges per frame, camera px: wrong shares over the edges' length."""
        frames = len(moves)
        wrong = np.bincount(self._frame, np.abs(self._predicted(moves) - self._measured), frames)
        canvas_from_input = np.linalg.inv(self._view.input_from_camera @ moved(self._prior, moves, self._camera))
        # The predicted share falls from 1 to 0 across the outline, so its gradients add up to the outline's length.
        steps = [self._shares(canvas_from_input, self._pixel + self._bend @ np.array(side)) for side in _SIDES]
        gradient = np.hypot(steps[0] - steps[1], steps[2] - steps[3])
        length = np.bincount(self._frame, gradient, frames)
        scale = math.sqrt(abs(np.linalg.det(self._view.input_from_camera[:2, :2])))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(length > 2.0, wrong / length, np.nan) / scale

    def _predicted(self, moves: Float[np.ndarray, "f 6"]) -> Float[np.ndarray, " p"]:
        image_from_canvas = moved(self._prior, moves, self._camera)
        return self._shares(np.linalg.inv(self._view.input_from_camera @ image_from_canvas), self._pixel)

    def _shares(self, canvas_from_input: Homographies, pixel: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
        return canvas_shares(canvas_from_input, self._frame, pixel, self._bend, self._variance)[1]

    def _of_frames(self, values: Float[np.ndarray, "p ..."]) -> Float[np.ndarray, "f ..."]:
        """The sum over the pixels of each frame, of which there may be none; they lie one frame after another."""
        padded = np.concatenate([values, np.zeros((1, *values.shape[1:]))])
        totals = np.add.reduceat(padded, self._first[:-1])
        totals[np.diff(self._first) == 0] = 0.0
        return totals


def _over_gain(contrast: Pictures, expected: Pictures) -> Pictures:
    """D / g with the g that suits a pixel's neighbourhood best; 0 where nothing is expected or seen."""
    fit, power = (_box_mean(values, _GAIN_PX) for values in (contrast * expected, expected**2))
    known = (power > 1e-3) & (fit > _SEEN * power)
    return np.where(known, np.clip(contrast / np.where(known, fit / np.maximum(power, 1e-9), 1.0), 0.0, 1.5), 0.0)


_SIDES = ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))


def _blurred(contrast: Pictures, blur_px: int) -> tuple[Pictures, Bool[np.ndarray, "f h w"]]:
    """Contrast averaged over a tent of this half-width, and where that did not need pixels beyond the picture."""
    if blur_px == 0:
        return contrast, np.ones(contrast.shape, bool)
    # Two boxes make a tent.
    shares = _box_mean(_box_mean(contrast, blur_px // 2), blur_px // 2)
    whole = np.zeros(contrast.shape, bool)
    whole[:, blur_px:-blur_px, blur_px:-blur_px] = True
    return shares, whole


def _box_mean(pictures: Pictures, reach_px: int) -> Pictures:
    """Means over squares around each pixel; beyond the pictures there is 0."""
    return cast("Any", ndimage).uniform_filter(pictures, 2 * reach_px + 1, mode="constant", axes=(1, 2))


def _near_edge(contrast: Pictures) -> Bool[np.ndarray, "f h w"]:
    """The pixels within reach of a place where the contrast changes."""
    size = 2 * _REACH_PX + 1
    return ndimage.morphological_gradient(contrast, (1, size, size)) > 0.25


def _arrow_step(
    moves: Float[np.ndarray, "f 6"],
    normal: Float[np.ndarray, "f 6 6"],
    slope: Float[np.ndarray, "f 6"],
    common: Float[np.ndarray, "6 6"],
    own: Float[np.ndarray, "6 6"],
) -> Float[np.ndarray, "f 6"]:
    """Gauss-Newton for moves x_f = c + y_f with priors on c and y_f, eliminating the y_f.

    For fixed c the best x_f solves (N_f + O) x_f = N_f x⁰_f − s_f + O c; what remains is quadratic in c.
    """
    target = np.einsum("fij,fj->fi", normal, moves) - slope
    inverse = np.linalg.inv(normal + own)
    # Of frame f: c costs ½ cᵀ(O − O (N+O)⁻¹ O) c − cᵀ O (N+O)⁻¹ target.
    curvature = common + (own - own @ inverse @ own).sum(0)
    pull = np.einsum("ij,fjk,fk->i", own, inverse, target)
    shared = np.asarray(np.linalg.solve(curvature, pull), np.float64)
    return np.einsum("fij,fj->fi", inverse, target + own @ shared)
