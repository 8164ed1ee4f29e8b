"""Homographies from the outline of the canvas, starting from the pose.

    symbol   meaning                                                                      shape
    H        image_from_canvas                                                            (F, 3, 3)
    K        camera intrinsics
    ω, τ     small rotation (rad) and translation (m) of the camera in its own axes       (F, 3) each
    m        measured share of each pixel through which the canvas is seen                (F, H, W)
    M        the share that a homography predicts: coverage of the canvas by footprints

A pose gives H; H(ω, τ) = K (exp[ω]× K⁻¹H + τ e₃ᵀ) is the view of a camera moved a little. What is looked for are the
ω, τ whose predicted shares agree with the measured ones, in robust least squares, from coarse to fine: both are blurred
at first, so that an outline that is off by several pixels is still felt. The canvas' far edge alone, when the others
leave the picture, cannot tell where the car is; so (ω, τ) of a frame is a correction common to the drive plus little of
its own, both with a prior: what frames far from the canvas show carries over to the near ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch.nn.functional import avg_pool2d

from roadproof.coverage import FOOTPRINT_VARIANCE
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CropResize

_BLURS_PX = (6, 3, 0)
_STEPS = (4, 4, 5)
# Of a pixel's share. Pixels along an edge err together, so this is more than one of them errs: measured in the town,
# 0.3 puts the canvas nearer to the truth than 0.05, which the pixels alone would suggest.
_NOISE = 0.3
_ROBUST = 3.0
_REACH_PX = 3
_DELTA = 1e-5


@dataclass(frozen=True, kw_only=True, slots=True)
class PoseDoubt:
    """How far a pose may be off: standard deviations along the camera's axes (right, down, forward).

    Args:
        common_rad: rotation common to a drive, about each axis.
        common_m: translation common to a drive.
        own_rad: rotation of each frame by itself.
        own_m: translation of each frame by itself.
    """

    common_rad: tuple[float, float, float] = (0.01, 0.01, 0.01)
    common_m: tuple[float, float, float] = (0.1, 0.03, 0.1)
    own_rad: tuple[float, float, float] = (0.001, 0.0005, 0.0005)
    own_m: tuple[float, float, float] = (0.002, 0.002, 0.002)

    @property
    def precisions(self) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6 6"]]:
        """Of the common and the own corrections."""
        common, own = (*self.common_rad, *self.common_m), (*self.own_rad, *self.own_m)
        return np.diag(1 / np.square(common)), np.diag(1 / np.square(own))


@dataclass(frozen=True, slots=True, eq=False)
class OutlineFit:
    """Homographies fitted to the outline.

    Args:
        image_from_canvas: one a frame.
        outline_px: mean distance of the predicted from the measured outline, camera px, a frame; NaN where no outline
            is in view.
    """

    image_from_canvas: Float[np.ndarray, "f 3 3"]
    outline_px: Float[np.ndarray, " f"]


def fit_outline(
    prior: Float[np.ndarray, "f 3 3"],
    visible: Float[np.ndarray, "f h w"],
    camera: CameraModel,
    view: CropResize,
    *,
    doubt: PoseDoubt | None = None,
) -> OutlineFit:
    """Move homographies until the canvas covers what was seen of it.

    Args:
        prior: homographies from the pose.
        visible: share of each pixel of the controller's input through which the canvas is seen, in [0, 1].
        camera: the pinhole.
        view: how the input is made from its picture.
        doubt: how far the pose may be off.
    """
    common, own = (PoseDoubt() if doubt is None else doubt).precisions
    moves = np.zeros((len(prior), 6))
    for blur, steps in zip(_BLURS_PX, _STEPS, strict=True):
        problem = _Outline(prior, visible, camera, view, blur)
        for _ in range(steps):
            moves = problem.step(moves, common, own)
    finest = _Outline(prior, visible, camera, view, 0)
    return OutlineFit(moved(prior, moves, camera), finest.outline_px(moves))


def outline_errors_px(
    image_from_canvas: Float[np.ndarray, "f 3 3"],
    visible: Float[np.ndarray, "f h w"],
    camera: CameraModel,
    view: CropResize,
) -> Float[np.ndarray, " f"]:
    """Mean distance of predicted from measured outline, camera px, a frame; NaN where no outline is in view."""
    return _Outline(image_from_canvas, visible, camera, view, 0).outline_px(np.zeros((len(visible), 6)))


def moved(
    image_from_canvas: Float[np.ndarray, "f 3 3"], moves: Float[np.ndarray, "f 6"], camera: CameraModel
) -> Float[np.ndarray, "f 3 3"]:
    """Homographies of a camera turned by ω and shifted by τ in its own axes.

    Args:
        image_from_canvas: with a third coordinate that is the depth in metres, as a pose gives them.
        moves: ω and τ of each frame.
        camera: the pinhole.
    """
    K = camera.intrinsics
    turned = _rotation(moves[:, :3]) @ (np.linalg.inv(K) @ image_from_canvas)
    turned[..., 2] += moves[:, 3:]
    return K @ turned


def _rotation(vector: Float[np.ndarray, "f 3"]) -> Float[np.ndarray, "f 3 3"]:
    """Rodrigues' formula."""
    angle = np.linalg.norm(vector, axis=-1)[:, None, None]
    x, y, z = vector.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    safe = np.maximum(angle, 1e-12)
    return np.eye(3) + np.sin(angle) / safe * cross + (1 - np.cos(angle)) / safe**2 * cross @ cross


class _Outline:
    """The pixels near the outline, at one blur; predictions for them and Gauss-Newton steps."""

    def __init__(
        self,
        prior: Float[np.ndarray, "f 3 3"],
        visible: Float[np.ndarray, "f h w"],
        camera: CameraModel,
        view: CropResize,
        blur_px: int,
    ) -> None:
        self._prior, self._camera, self._view = prior, camera, view
        self._variance = FOOTPRINT_VARIANCE[view.resampling] + blur_px**2
        blurred, whole = _blurred(visible, blur_px)
        self._frame, row, column = np.nonzero(whole & _near_edge(blurred))
        self._pixel = np.stack([column, row, np.ones_like(row)], -1).astype(np.float64)
        self._measured = blurred[self._frame, row, column]

    def step(
        self, moves: Float[np.ndarray, "f 6"], common: Float[np.ndarray, "6 6"], own: Float[np.ndarray, "6 6"]
    ) -> Float[np.ndarray, "f 6"]:
        """One damped Gauss-Newton step of all frames together."""
        frames = len(moves)
        here = self._predicted(moves)
        slopes = np.stack([(self._predicted(moves + _DELTA * axis) - here) / _DELTA for axis in np.eye(6)], -1)
        error = (here - self._measured) / _NOISE
        # Huber's weights: an occluder at the edge of the canvas is not the edge of the canvas.
        weight = np.minimum(1.0, _ROBUST / np.maximum(np.abs(error), 1e-9)) / _NOISE
        normal, slope = np.zeros((frames, 6, 6)), np.zeros((frames, 6))
        np.add.at(normal, self._frame, (weight / _NOISE)[:, None, None] * slopes[:, :, None] * slopes[:, None, :])
        np.add.at(slope, self._frame, (weight * error)[:, None] * slopes)
        return _arrow_step(moves, normal, slope, common, own)

    def outline_px(self, moves: Float[np.ndarray, "f 6"]) -> Float[np.ndarray, " f"]:
        """Sum of wrong shares, over the length of the outline: its mean distance, in camera px."""
        frames = len(moves)
        wrong = np.bincount(self._frame, np.abs(self._predicted(moves) - self._measured), frames)
        canvas_from_input = np.linalg.inv(self._view.input_from_camera @ moved(self._prior, moves, self._camera))
        # The predicted share falls from 1 to 0 across the outline, so its gradients add up to the outline's length.
        steps = [self._shares(canvas_from_input, self._pixel + np.array([*side, 0.0])) for side in _SIDES]
        gradient = np.hypot(steps[0] - steps[1], steps[2] - steps[3])
        length = np.bincount(self._frame, gradient, frames)
        scale = math.sqrt(abs(np.linalg.det(self._view.input_from_camera[:2, :2])))
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(length > 2.0, wrong / length, np.nan) / scale

    def _predicted(self, moves: Float[np.ndarray, "f 6"]) -> Float[np.ndarray, " p"]:
        image_from_canvas = moved(self._prior, moves, self._camera)
        return self._shares(np.linalg.inv(self._view.input_from_camera @ image_from_canvas), self._pixel)

    def _shares(
        self, canvas_from_input: Float[np.ndarray, "f 3 3"], pixel: Float[np.ndarray, "p 3"]
    ) -> Float[np.ndarray, " p"]:
        """Share of each footprint that lies on the canvas (`coverage`, for one rectangle that is not turned)."""
        inverse = canvas_from_input[self._frame]
        mapped = np.einsum("pij,pj->pi", inverse, pixel)
        ahead = mapped[:, 2] > 1e-9
        depth = np.where(ahead, mapped[:, 2], 1.0)[:, None]
        at = mapped[:, :2] / depth
        jacobian = (inverse[:, :2, :2] - at[:, :, None] * inverse[:, 2:, :2]) / depth[..., None]
        reach = np.sqrt(self._variance * np.square(jacobian).sum(-1) + 1e-9)
        middle, half = (CANVAS_SIZE_PX - 1) / 2, CANVAS_SIZE_PX / 2
        shares = _tent((half - (at - middle)) / reach) + _tent((half + (at - middle)) / reach)
        return np.where(ahead, shares.prod(-1), 0.0)


_SIDES = ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5))


def _tent(t: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Share of a tent of half-width 1 between its middle and t."""
    t = np.clip(t, -1.0, 1.0)
    return t * (1.0 - 0.5 * np.abs(t))


def _blurred(
    visible: Float[np.ndarray, "f h w"], blur_px: int
) -> tuple[Float[np.ndarray, "f h w"], Bool[np.ndarray, "f h w"]]:
    """Shares averaged over a tent of this half-width, and where that did not need pixels beyond the picture."""
    if blur_px == 0:
        return visible, np.ones(visible.shape, bool)
    shares = torch.tensor(visible)[:, None]
    for _ in range(2):
        # Two boxes make a tent.
        shares = avg_pool2d(shares, 2 * (blur_px // 2) + 1, 1, blur_px // 2)
    whole = np.zeros(visible.shape, bool)
    whole[:, blur_px:-blur_px, blur_px:-blur_px] = True
    return shares[:, 0].numpy(), whole


def _near_edge(shares: Float[np.ndarray, "f h w"]) -> Bool[np.ndarray, "f h w"]:
    """Pixels within reach of a place where shares change."""
    shown = torch.tensor(shares)[:, None]
    size = 2 * _REACH_PX + 1
    mean = avg_pool2d(shown, size, 1, _REACH_PX, count_include_pad=False)[:, 0].numpy()
    return (mean > 0.01) & (mean < 0.99)


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
    shared: Float[np.ndarray, " 6"] = np.linalg.solve(curvature, pull)
    return np.einsum("fij,fj->fi", inverse, target + own @ shared)
