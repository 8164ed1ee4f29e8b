"""Lenses that bend straight lines: from where a point lies to where the picture shows it, and back.

    symbol     meaning                                                               shape
    X, Y, Z    direction to a point in camera axes: right, down, forward             (…)
    u          (X, Y) / ‖X, Y‖                                                       (…, 2)
    m          how far off the axis it is: ‖X, Y‖ / Z, in a fisheye the angle, rad   (…)
    d          where the picture shows it, in focal lengths from its middle          (…, 2)

With q = m u = (x, y), both lenses are a radial part and a part t that only Brown–Conrady has,

    d = R(m) u + t(q),    R(m) = m (1 + k1 m² + k2 m⁴ + k3 m⁶ + k4 m⁸)
    t = (2 p1 x y + p2 (m² + 2 x²),  p1 (m² + 2 y²) + 2 p2 x y),

    ∂d/∂q = R′ u uᵀ + (R / m) (1 − u uᵀ) + ∂t/∂q,    ‖∂t/∂q‖ ≤ 6 ‖p‖ m,    ‖t‖ ≤ 3 ‖p‖ m².

∂d/∂q is symmetric. As long as 12 ‖p‖ m is less than R′ and R / m it is positive definite, so that no two points are
shown in one place, and q ← R⁻¹(d − t(q)) comes at least twice as near with every step. The least m at which that ends
is the lens's `limit`; beyond, R goes on with slope 1 and t stays, so that what is outside the picture stays there.

References:
    Brown, Close-range camera calibration, 1971. Kannala and Brandt, A generic camera model and calibration method for
    conventional, wide-angle, and fish-eye lenses, 2006. The coefficients are those of OpenCV's calib3d and fisheye.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from roadproof.errors import GeometryError

LensModel = Literal["brown-conrady", "fisheye"]

COEFFICIENTS: dict[LensModel, tuple[str, ...]] = {
    "brown-conrady": ("k1", "k2", "p1", "p2", "k3"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
_FARTHEST: dict[LensModel, float] = {"brown-conrady": 100.0, "fisheye": math.pi}
MOST_COEFFICIENT = 1e3
_STEPS = 80
_SAME = 1e-15
_TINY = 1e-30


@dataclass(frozen=True, kw_only=True, slots=True)
class Lens:
    """The distortion of a lens, which depends on its coefficients alone.

    Args:
        model: "brown-conrady" for a lens that nearly shows straight lines straight, "fisheye" (Kannala–Brandt) for one
            with a wide field, which may be more than 180°.
        coefficients: k1, k2, p1, p2, k3 of a Brown–Conrady lens, or k1, k2, k3, k4 of a fisheye, without unit: the
            order and values of OpenCV.

    Raises:
        GeometryError: the model is another word, the coefficients are no tuple or more or fewer than the model has, or
            one is not within ±1000.
    """

    model: LensModel
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in COEFFICIENTS:
            raise GeometryError(f"lens model is {self.model!r:.40}, expected {' or '.join(COEFFICIENTS)}")
        names = COEFFICIENTS[self.model]
        if type(self.coefficients) is not tuple:
            raise GeometryError(
                f"{self.model} lens has the coefficients {self.coefficients!r:.80}, "
                f"expected a tuple: {', '.join(names)}"
            )
        if len(self.coefficients) != len(names):
            raise GeometryError(
                f"{self.model} lens has {len(self.coefficients)} coefficients, "
                f"expected {len(names)}: {', '.join(names)}"
            )
        for name, value in zip(names, self.coefficients, strict=True):
            if not abs(value) <= MOST_COEFFICIENT:
                raise GeometryError(
                    f"{self.model} lens has {name} {value:g}, expected −{MOST_COEFFICIENT:g} to {MOST_COEFFICIENT:g}"
                )

    @property
    def radial(self) -> tuple[float, ...]:
        """The coefficients k1, k2, … of the radial part."""
        return self._named("k")

    @property
    def tangential(self) -> tuple[float, ...]:
        """The coefficients p1 and p2; empty for a fisheye, which has none."""
        return self._named("p")

    def _named(self, letter: str) -> tuple[float, ...]:
        found = dict(zip(COEFFICIENTS[self.model], self.coefficients, strict=True))
        return tuple(found[name] for name in sorted(found) if name.startswith(letter))

    @property
    def limit(self) -> float:
        """The m up to which no two points are shown in one place, at most 100 (Brown–Conrady) or π (fisheye)."""
        return _limit_of(self)

    @property
    def reach(self) -> float:
        """How far from its middle a picture may extend, in focal lengths: what lies nearer is shown once."""
        limit = self.limit
        return float(_scale(self.radial, limit)) * limit - 3 * math.hypot(*self.tangential) * limit**2

    def distort(
        self,
        x: Float[Any, "*n"],
        y: Float[Any, "*n"],
        z: Float[Any, "*n"],
        xp: Any = np,  # noqa: ANN401
    ) -> tuple[Float[Any, "*n"], Float[Any, "*n"]]:
        """Where the picture shows points.

        Args:
            x: X of the directions to the points, in any unit that X, Y and Z share.
            y: Y of the directions.
            z: Z of the directions; points behind a Brown–Conrady camera are shown far outside its picture.
            xp: module of the arrays, `numpy` or `torch`.

        Returns:
            Both coordinates of d.
        """
        limit = self.limit
        across = xp.hypot(x, y)
        # What is behind a Brown–Conrady camera is as far aside as anything can be.
        m = xp.arctan2(across, z) if self.model == "fisheye" else across / xp.clip(z, 1e-3 * across + _TINY, None)
        u, v = x / (across + _TINY), y / (across + _TINY)
        within = xp.clip(m, 0.0, limit)
        radius = within * _scale(self.radial, within) + (m - within)
        tx, ty = self._shift(within * u, within * v)
        return radius * u + tx, radius * v + ty

    def undistort(
        self, points: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 2"]]:
        """What the picture shows at some places: the inverse of `distort`, to rounding.

        Args:
            points: places d in the picture, focal lengths from its middle.

        Returns:
            The directions X, Y, Z, of any positive length, and their derivatives by d, exact within `reach`.
        """
        m, unit = self._polar(points)
        within = np.minimum(m, self.limit)
        across = unit[..., :, None] * unit[..., None, :]
        rest = np.eye(2) - across
        scale: Float[np.ndarray, " n"] = _scale(self.radial, within)
        slope = np.where(m <= self.limit, _slope(self.radial, m), 1.0)
        radial = slope[..., None, None] * across + scale[..., None, None] * rest
        by_q = np.linalg.inv(radial + self._shift_slope(within[..., None] * unit))
        if self.model == "brown-conrady":
            direction = np.concatenate([m[..., None] * unit, np.ones_like(m)[..., None]], -1)
            return direction, np.concatenate([by_q, np.zeros_like(by_q[..., :1, :])], -2)
        m = np.minimum(m, math.pi)
        sine, cosine = np.sin(m)[..., None] * unit, np.cos(m)[..., None]
        turned = cosine[..., None] * across + np.sinc(m / math.pi)[..., None, None] * rest
        return np.concatenate([sine, cosine], -1), np.concatenate([turned, -sine[..., None, :]], -2) @ by_q

    def _polar(self, points: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
        """The m and u that the picture shows at some places."""
        m, unit, aim = np.zeros_like(points[..., 0]), np.zeros_like(points), points
        for _ in range(_STEPS):
            far = np.linalg.norm(aim, axis=-1)
            m, unit = self._inverse(far), aim / (far + _TINY)[..., None]
            q = np.minimum(m, self.limit)[..., None] * unit
            before, aim = aim, points - np.stack(self._shift(q[..., 0], q[..., 1]), -1)
            if (np.abs(aim - before) <= _SAME * (1 + far[..., None])).all():
                break
        return m, unit

    def _inverse(self, far: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """R⁻¹, by Newton's method between bounds that close in."""
        limit = self.limit
        beyond = np.maximum(far - limit * _scale(self.radial, limit), 0.0)
        low, high = np.zeros_like(far), np.full_like(far, limit)
        m = np.minimum(far, limit)
        for _ in range(_STEPS):
            off = m * _scale(self.radial, m) - (far - beyond)
            low, high = np.where(off < 0, m, low), np.where(off < 0, high, m)
            step = m - off / np.maximum(_slope(self.radial, m), _TINY)
            step = np.where((step >= low) & (step <= high), step, (low + high) / 2)
            before, m = m, step
            if (np.abs(m - before) <= _SAME * (1 + m)).all():
                break
        return m + beyond

    def _shift(self, x: Any, y: Any) -> tuple[Any, Any]:  # noqa: ANN401
        """Both coordinates of t."""
        if not self.tangential:
            return 0.0 * x, 0.0 * y
        p1, p2 = self.tangential
        square = x * x + y * y
        return 2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y

    def _shift_slope(self, q: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2 2"]:
        """∂t/∂q."""
        p1, p2 = self.tangential or (0.0, 0.0)
        x, y = q[..., 0], q[..., 1]
        mixed = 2 * (p1 * x + p2 * y)
        rows = [[2 * p1 * y + 6 * p2 * x, mixed], [mixed, 6 * p1 * y + 2 * p2 * x]]
        return np.stack([np.stack(row, -1) for row in rows], -2)


def _scale(radial: tuple[float, ...], m: Any) -> Any:  # noqa: ANN401
    """R(m) / m within the limit."""
    square: Any = m * m
    scale: Any = 0.0
    for k in reversed(radial):
        scale = (scale + k) * square
    return 1.0 + scale


def _slope(radial: tuple[float, ...], m: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """R′(m) within the limit: every power of m brings its exponent down."""
    return _scale(tuple((2 * order + 1) * k for order, k in enumerate(radial, 1)), m)


@lru_cache(maxsize=64)
def _limit_of(lens: Lens) -> float:
    """The least m at which 12 |p| m is no longer less than R′ and R / m."""
    low, high = 0.0, _FARTHEST[lens.model]
    for _ in range(2):
        tried = np.linspace(low, high, 20_001)
        least = np.minimum(_slope(lens.radial, tried), _scale(lens.radial, tried))
        bad = np.flatnonzero(least <= 12 * math.hypot(*lens.tangential) * tried)
        if not bad.size:
            return high
        low, high = float(tried[bad[0] - 1]), float(tried[bad[0]])
    return low
