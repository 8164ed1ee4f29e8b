"""A camera's focal length and lens, fitted to where its pictures show the corners of a chessboard.

    symbol   meaning                                                                             shape
    s        shared by all pictures: log of the focal length in px, the lens's coefficients,     (s,)
             and where the lens's middle lies beside the picture's, px right and down
    p        of each picture, where the board is: its turn as a rotation vector, and its         (n, 6)
             middle in camera axes, in squares of the board
    e        where corners are shown less where they are seen, px                                (n, m, 2)
    J        derivative of a picture's e by its own p, and by s                                  (n, 2m, 6 + s)

The squares of e are made least over s and p. Of each picture's J = Q R, the rows of R below the first six, which p
takes, are what it says of s alone: A (k, s), and y (k,) are these rows of Qᵀ e. Leaving out picture i would change s by
δ = (Σ A_jᵀ A_j)⁻¹ A_iᵀ y_i, the sum over all others, to first order; the covariance of s is that of the jackknife,
(n − 1) / n Σ δ δᵀ. It holds where the corners of a picture err together, too, as those of a board that is not flat do:
of real pictures the errors are some three times those of corners that would err each by itself.

References:
    Zhang, A flexible new technique for camera calibration, 2000. Triggs et al., Bundle adjustment, a modern synthesis,
    1999. Efron, The jackknife, the bootstrap and other resampling plans, 1982.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy import optimize
from scipy.spatial.transform import Rotation

from roadproof.errors import GeometryError, RecordingError
from roadproof.homographies import homography_from_points
from roadproof.lens import COEFFICIENTS, MOST_COEFFICIENT, Lens, LensModel

_MOST_STEPS = 40
_LEAST_NOISE_PX = 0.02  # no corner is found better; without noise nothing would seem open
_STEP = 1e-6

_optimize: Any = optimize
_rotation: Any = Rotation


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A camera and boards that were fitted to the corners seen.

    Args:
        shared: s, what all pictures share.
        poses: p, where the board is in each picture.
        missed_px: e, by how much each corner is missed.
        covariance: covariance of s, with zeros for what was held.
    """

    shared: Float[np.ndarray, " s"]
    poses: Float[np.ndarray, "n 6"]
    missed_px: Float[np.ndarray, "n m 2"]
    covariance: Float[np.ndarray, "s s"]


class Bundle:
    """The corners that all pictures show, and what a camera makes of them.

    Args:
        model: kind of the lens.
        seen_px: where each picture shows the corners, px, (N, M, 2).
        grid: where the corners are on the board, in squares from its middle, (M, 2).
        centre_px: middle of the picture, px.
    """

    def __init__(
        self,
        model: LensModel,
        seen_px: Float[np.ndarray, "n m 2"],
        grid: Float[np.ndarray, "m 2"],
        centre_px: Float[np.ndarray, " 2"],
    ) -> None:
        self.model: LensModel = model
        self.seen_px, self.grid, self.centre_px = seen_px, grid, centre_px
        self.coefficients = slice(1, 1 + len(COEFFICIENTS[model]))
        self.middle = slice(1 + len(COEFFICIENTS[model]), 3 + len(COEFFICIENTS[model]))

    def lens(self, shared: Float[np.ndarray, " s"]) -> Lens:
        """The lens that s holds, its coefficients within what a lens may have: a search may leave it on its way."""
        coefficients = shared[self.coefficients].clip(-MOST_COEFFICIENT, MOST_COEFFICIENT)
        return Lens(model=self.model, coefficients=tuple(coefficients.tolist()))

    def shown(
        self, shared: Float[np.ndarray, " s"], directions: Float[np.ndarray, "*n 3"]
    ) -> Float[np.ndarray, "*n 2"]:
        """Where a camera shows directions in its axes, px."""
        x, y, z = np.moveaxis(directions, -1, 0)
        middle_px = self.centre_px + shared[self.middle]
        return np.stack(self.lens(shared).distort(x, y, z), -1) * math.exp(shared[0]) + middle_px

    def missed(self, shared: Float[np.ndarray, " s"], poses: Float[np.ndarray, "n 6"]) -> Float[np.ndarray, "n m 2"]:
        """By how much a camera and boards miss the corners seen, px."""
        turns = _rotation.from_rotvec(poses[:, :3]).as_matrix()
        corners = self.grid @ turns[:, :, :2].swapaxes(1, 2) + poses[:, None, 3:]
        return self.shown(shared, corners) - self.seen_px

    def begun(self, focals_px: Iterable[float]) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "n 6"]]:
        """The camera without distortion, of those with some focal lengths, and the boards, that miss least.

        Raises:
            RecordingError: none of the cameras can show the boards.
        """
        tried: list[tuple[float, Float[np.ndarray, " s"], Float[np.ndarray, "n 6"]]] = []
        for focal_px in focals_px:
            shared = np.zeros(self.middle.stop)
            shared[0] = math.log(focal_px)
            straight = self.lens(shared)
            try:
                seen = [straight.undistort((each - self.centre_px) / focal_px)[0] for each in self.seen_px]
                poses = np.stack([_pose(each, self.grid) for each in seen])
            except GeometryError:
                continue  # the field is too wide for a board like this
            tried.append((float(np.square(self.missed(shared, poses)).sum()), shared, poses))
        if not tried:
            raise RecordingError("no camera shows chessboards as these are seen; check corners of [chessboard]")
        _, shared, poses = min(tried, key=lambda each: each[0])
        return shared, poses

    def fitted(
        self, free: Bool[np.ndarray, " s"], shared: Float[np.ndarray, " s"], poses: Float[np.ndarray, "n 6"]
    ) -> Fit:
        """The camera and the boards that miss least.

        Args:
            free: which numbers of the camera are fitted; the others are held.
            shared: camera from which the fit begins.
            poses: boards from which the fit begins.
        """
        pictures, count = len(poses), int(free.sum())

        def parts(numbers: Float[np.ndarray, " p"]) -> tuple[Float[np.ndarray, " s"], Float[np.ndarray, "n 6"]]:
            now = shared.copy()
            now[free] = numbers[:count]
            return now, numbers[count:].reshape(-1, 6)

        def missed(numbers: Float[np.ndarray, " p"]) -> Float[np.ndarray, " e"]:
            return self.missed(*parts(numbers)).ravel()

        def slopes(numbers: Float[np.ndarray, " p"]) -> Float[np.ndarray, "e p"]:
            by_own, by_shared = np.split(self._slopes(free, *parts(numbers)), [6], axis=-1)
            own = np.einsum("nep,nk->nekp", by_own, np.eye(pictures)).reshape(-1, 6 * pictures)
            return np.hstack([by_shared.reshape(-1, count), own])

        begin = np.concatenate([shared[free], poses.ravel()])
        found = _optimize.least_squares(missed, begin, slopes, x_scale="jac", max_nfev=_MOST_STEPS)
        now = parts(found.x)
        covariance = np.zeros((len(shared), len(shared)))
        covariance[np.ix_(free, free)] = _jackknife(self._slopes(free, *now), found.fun.reshape(pictures, -1))
        return Fit(*now, found.fun.reshape(self.seen_px.shape), covariance)

    def variance(self, fit: Fit, directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Variance of where the camera of a fit shows directions in its axes, of both coordinates together, px²."""
        steps = np.eye(len(fit.shared)) * _STEP
        there, back = ([self.shown(fit.shared + way * step, directions) for step in steps] for way in (1, -1))
        slopes = (np.stack(there) - np.stack(back)) / (2 * _STEP)
        return np.einsum("snx,st,tnx->n", slopes, fit.covariance, slopes)

    def _slopes(
        self, free: Bool[np.ndarray, " s"], shared: Float[np.ndarray, " s"], poses: Float[np.ndarray, "n 6"]
    ) -> Float[np.ndarray, "n e k"]:
        """J of every picture, without what is held: the difference between a small step there and one back."""
        still = np.zeros_like(shared), np.zeros(6)
        steps = [(still[0], step) for step in np.eye(6) * _STEP]
        steps += [(step, still[1]) for step in np.eye(len(shared))[free] * _STEP]
        there, back = (
            np.stack([self.missed(shared + way * one, poses + way * other) for one, other in steps], -1)
            for way in (1, -1)
        )
        return (there - back).reshape(len(poses), -1, len(steps)) / (2 * _STEP)


def _jackknife(slopes: Float[np.ndarray, "n e k"], missed_px: Float[np.ndarray, "n e"]) -> Float[np.ndarray, "s s"]:
    """Covariance of s, from what leaving each picture out would change."""
    turned, rows = np.linalg.qr(slopes)
    of_shared: Float[np.ndarray, "n k s"] = rows[:, 6:, 6:]
    left: Float[np.ndarray, "n k"] = np.einsum("nek,ne->nk", turned, missed_px)[:, 6:]
    count = len(slopes)
    others = [np.delete(of_shared, k, axis=0).reshape(-1, of_shared.shape[-1]) for k in range(count)]
    moved = np.stack([_inverse_square(others[k]) @ of_shared[k].T @ left[k] for k in range(count)])
    least = _LEAST_NOISE_PX**2 * _inverse_square(of_shared.reshape(-1, of_shared.shape[-1]))
    return (count - 1) / count * moved.T @ moved + least


def _inverse_square(rows: Float[np.ndarray, "r s"]) -> Float[np.ndarray, "s s"]:
    """(Aᵀ A)⁻¹, very large where A leaves a direction open."""
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-12)
    _, spread, turn = np.linalg.svd(rows / scale, full_matrices=False)
    half = turn.T / np.maximum(spread, 1e-12) / scale[:, None]
    return half @ half.T


def _pose(directions: Float[np.ndarray, "m 3"], grid: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, " 6"]:
    """Where a board is whose corners are seen in some directions, p; a `GeometryError` where none is seen so."""
    # Towards the board, where no direction is at right angles to the view: a fisheye sees such ones.
    aim = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).mean(0)
    aside = np.cross(aim, np.eye(3)[np.abs(aim).argmin()])
    turned = np.stack([each / np.linalg.norm(each) for each in (aside, np.cross(aim, aside), aim)])
    seen = directions @ turned.T
    if (seen[:, 2] <= 0).any():
        raise GeometryError("a board is seen all around")
    first, second, place = homography_from_points(grid, seen[:, :2] / seen[:, 2:]).T
    size = math.sqrt(np.linalg.norm(first) * np.linalg.norm(second))
    left, _, right = np.linalg.svd(np.stack([first, second, np.cross(first, second) / size], 1) / size)
    turn = _rotation.from_matrix(turned.T @ left @ right).as_rotvec()
    return np.concatenate([turn, turned.T @ place / size])
