"""The vehicle's own motion, from how the flat ground moves from one picture to the next.

    symbol   meaning                                                                       shape
    p        point of the ground before the vehicle's origin, metres: ahead, left          (n, 2)
    a        arc that the origin drives from a picture to the next, metres                 ()
    w        angle by which the vehicle turns on it, radians, left positive                ()
    t        angle by which the camera nods between the two, degrees, up positive          ()
    I, J     the two pictures without what is coarse or fine in them: their grain          (h, w)

The origin does not slip sideways: it is the middle of the rear axle, and moves on an arc. The ground point that lay at
p then lies at

    q(p) = R(−w) (p − a sinc(w / 2) (cos(w / 2), sin(w / 2))),    R a rotation, sinc(x) = sin(x) / x,

and J shows at pixel(q(p), t) what I shows at pixel(p, 0): the camera's height is what makes pixels metres. The nod, by
bumps and brakes, is found with the arc and then left out: on the ground far ahead a tenth of a degree is as a metre.

A first pass looks at every arc up to `FASTEST_MPS`: the best of all small turns and nods, which shift the picture, is
the peak of the two pictures' correlation. Its height is smoothed over time, and the highest is taken. A second pass
refines a, w and t from there, and from those of the pictures before, by Gauss–Newton steps with Huber's weights, and
keeps what has the higher correlation of I and J.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from scipy import ndimage

from roadproof.datatypes import VehicleState
from roadproof.errors import RecordingError
from roadproof.geometry import CameraModel, CropResize

FASTEST_MPS = 45.0
"""A car in pictures is not looked for at higher speeds."""
LEAST_CORRELATION = 0.35
"""Two pictures whose ground agrees less do not tell how the car moved between them."""

_image: Any = ndimage
_linalg: Any = np.linalg
_ORIGIN = VehicleState(0.0, 0.0, 0.0, 0.0, 0.0)
_FINE_PX, _AROUND_PX, _NOISE = 1.0, 9, 2.0
_FINER = (2, 1)
_STEEPEST = 0.35  # metres of ground a metre high that one pixel of the farthest row used spans
_MOST_TURN, _MOST_NOD = 0.8, 0.12  # rad/s
_SMOOTH_S = 0.2
_LEAST_POINTS = 200
_STEPS = 10

Grain = Float[np.ndarray, "_ _"]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Motion:
    """How a vehicle moved, row by row of its table.

    Args:
        speed_mps: forward speed, m/s, (n,).
        yaw_rate_rad_s: yaw rate, rad/s, left positive, (n,).
        correlation: correlation of the ground in each picture and the next, in [−1, 1], (n − 1,).
    """

    speed_mps: Float[np.ndarray, " n"]
    yaw_rate_rad_s: Float[np.ndarray, " n"]
    correlation: Float[np.ndarray, " m"]


def motion_of(
    camera: CameraModel, view: CropResize, picture: Callable[[int], UInt8[np.ndarray, "h w 3"]], count: int, dt_s: float
) -> Motion:
    """Speed and yaw rate of a vehicle, from pictures that its camera took at equal times.

    Args:
        camera: camera that took them, with its height, pitch and field of view.
        view: crop of the pictures; ground outside its box does not count.
        picture: picture of each row, RGB, (H, W, 3).
        count: number of rows.
        dt_s: seconds from one picture to the next.

    Raises:
        RecordingError: there are fewer than three pictures, or they do not tell how the car moved.
    """
    if count < 3:
        raise RecordingError(f"{count} pictures, expected 3 or more to see the vehicle's motion in them")
    seen = _Ground(camera, view, dt_s)
    arcs, peaks, places = seen.arcs, np.zeros((count - 1, len(seen.arcs))), np.zeros((count - 1, len(seen.arcs), 2))
    after = seen.grain(picture(0), seen.step)
    for k in range(count - 1):
        before, after = after, seen.grain(picture(k + 1), seen.step)
        peaks[k], places[k] = seen.searched(before, after)
    best = _image.gaussian_filter1d(peaks, _SMOOTH_S / dt_s, axis=0, mode="nearest").argmax(1)
    found, agreed = np.zeros((count - 1, 3)), np.zeros(count - 1)
    last = [seen.grain(picture(0), by) for by in _FINER]
    for k, at in enumerate(best.tolist()):
        first, last = last, [seen.grain(picture(k + 1), by) for by in _FINER]
        begins = [np.array([arcs[at], *places[k, at]]), *found[max(k - 1, 0) : k]]
        found[k], agreed[k] = max((seen.refined(first, last, begin) for begin in begins), key=lambda each: each[1])
    told = agreed >= LEAST_CORRELATION
    if told.mean() < 0.5:
        raise RecordingError(
            f"pictures do not tell how the car moved: the ground agrees in {told.sum()} of {count - 1} pairs, with a "
            f"correlation of {np.median(agreed):.2f}, expected {LEAST_CORRELATION} or more in half of them; check the "
            "camera, or give speed_mps and yaw_rate_rad_s"
        )
    middle, rows = np.flatnonzero(told) + 0.5, np.arange(count)
    speed, rate = (np.interp(rows, middle, _smooth(found[told, k] / dt_s, dt_s)) for k in (0, 1))
    return Motion(speed_mps=speed, yaw_rate_rad_s=rate, correlation=agreed)


def _smooth(values: Float[np.ndarray, " n"], dt_s: float) -> Float[np.ndarray, " n"]:
    median = _image.median_filter(values, 2 * round(_SMOOTH_S / dt_s / 2) + 1, mode="nearest")
    return _image.gaussian_filter1d(median, _SMOOTH_S / dt_s / 2, mode="nearest")


class _Ground:
    """The ground that a camera sees in its pictures, and the arcs on which it may move."""

    def __init__(self, camera: CameraModel, view: CropResize, dt_s: float) -> None:
        self.camera, self.step = camera, math.ceil(camera.width_px / 150)
        columns = np.arange(view.left_px, min(view.right_px, camera.width_px), self.step)
        lines = np.arange(view.top_px, min(view.bottom_px, camera.height_px), self.step)
        x_px, y_px = np.meshgrid(columns, lines)
        pixels = np.stack([x_px.ravel(), y_px.ravel()], 1).astype(np.float64)
        through, _ = camera.undistorted(pixels)
        mapped = through @ np.linalg.inv(camera.image_from_world(_ORIGIN)[:, [0, 1, 3]]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            place = mapped[:, :2] / mapped[:, 2:]
        ahead = place[:, 0] - camera.forward_m
        far = math.sqrt(_STEEPEST * camera.focal_px * camera.up_m)
        on = (through[:, 2] > 0) & (mapped[:, 2] > 0) & (ahead > far / 5) & (ahead < far)
        on &= np.abs(place[:, 1] - camera.left_m) < max(5.0, far / 3)
        if on.sum() < _LEAST_POINTS:
            raise RecordingError(
                f"the camera sees {on.sum() * self.step**2} pixels of near ground in the box of [input], expected "
                f"{_LEAST_POINTS * self.step**2} or more to see the vehicle's motion; check pitch_deg, or the box"
            )
        self.shape, self.on = x_px.shape, on
        self.pixels, self.place = pixels[on], place[on]
        self.top = int(self.pixels[:, 1].min())
        near = float(ahead[on].min())
        fastest = min(FASTEST_MPS * dt_s, 0.6 * (far - near))
        self.arcs = np.arange(0.0, fastest, 0.75 * self.step * near**2 / (camera.focal_px * camera.up_m))
        self.warps = [self.shown(np.array([arc, 0.0, 0.0])) for arc in self.arcs]
        turn, nod = (math.ceil(most * dt_s * camera.focal_px / self.step) + 1 for most in (_MOST_TURN, _MOST_NOD))
        self.most = min(nod, self.shape[0] // 3), min(turn, self.shape[1] // 3)

    def shown(self, move: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "n 2"]:
        """Where the next picture shows the ground points, px, after an arc, a turn and a nod."""
        arc, turn, nod = move.tolist()
        half = turn / 2
        way = arc * np.sinc(half / np.pi) * np.array([math.cos(half), math.sin(half)])
        ahead, left = (self.place - way).T
        cos, sin = math.cos(turn), math.sin(turn)
        point = np.stack([cos * ahead + sin * left, cos * left - sin * ahead, np.ones_like(ahead)], 1)
        camera = replace(self.camera, pitch_deg=self.camera.pitch_deg + nod)
        return camera.distorted(point @ camera.image_from_world(_ORIGIN)[:, [0, 1, 3]].T)

    def grain(self, picture: UInt8[np.ndarray, "h w 3"], by: int) -> Grain:
        """The grain of a picture that is made smaller `by` some times, in units of the contrast around."""
        grey = picture[self.top :].mean(-1, dtype=np.float32)
        tall, wide = (size // by for size in grey.shape)
        grey = grey[: tall * by, : wide * by].reshape(tall, by, wide, by).mean((1, 3))
        fine = _image.gaussian_filter(grey, _FINE_PX)
        fine -= _image.uniform_filter(fine, _AROUND_PX)
        return fine / (np.sqrt(_image.uniform_filter(fine * fine, 2 * _AROUND_PX - 1).clip(0)) + _NOISE)

    def sampled(self, grain: Grain, by: int, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """The grain at places of the whole picture, px; NaN outside."""
        places = (pixels.T[::-1] + np.array([[0.5 - self.top], [0.5]])) / by - 0.5
        return _image.map_coordinates(grain, places, order=1, cval=np.nan)

    def searched(self, before: Grain, after: Grain) -> tuple[Float[np.ndarray, " a"], Float[np.ndarray, "a 2"]]:
        """For each arc the highest correlation, and the turn (rad) and nod (degrees) that have it."""
        canvas = np.zeros(self.shape)
        canvas[self.on.reshape(self.shape)] = np.nan_to_num(self.sampled(before, self.step, self.pixels))
        spectrum, energy = np.fft.rfft2(canvas), np.square(canvas).sum()
        heights, places = np.zeros(len(self.arcs)), np.zeros((len(self.arcs), 2))
        down, across = self.most
        for k, warp in enumerate(self.warps):
            moved = np.zeros(self.shape)
            moved[self.on.reshape(self.shape)] = np.nan_to_num(self.sampled(after, self.step, warp))
            product = np.fft.irfft2(np.fft.rfft2(moved) * spectrum.conj(), self.shape)
            window = np.roll(product, (down, across), (0, 1))[: 2 * down + 1, : 2 * across + 1]
            y, x = np.unravel_index(window.argmax(), window.shape)
            heights[k] = window[y, x] / math.sqrt(energy * np.square(moved).sum() + 1e-9)
            places[k] = (int(x) - across), (int(y) - down)
        scale = self.step / self.camera.focal_px
        return heights, places * (scale, math.degrees(scale))

    def refined(
        self, first: Sequence[Grain], last: Sequence[Grain], move: Float[np.ndarray, " 3"]
    ) -> tuple[Float[np.ndarray, " 3"], float]:
        """Arc, turn and nod from where the search left them, and the correlation of the finest grains there."""
        angle = 0.5 / self.camera.focal_px
        small = np.diag([0.01, angle, math.degrees(angle)])
        wanted = here = np.zeros(0)
        for by, before, after in zip(_FINER, first, last, strict=True):
            wanted = self.sampled(before, by, self.pixels)
            for _ in range(_STEPS):
                here, *sides = (
                    self.sampled(after, by, self.shown(each)) for each in (move, *(move + small), *(move - small))
                )
                slope = [(sides[k] - sides[k + 3]) / 2 for k in range(3)]
                design = np.stack([*slope, here, np.ones_like(here)], 1)
                known = np.isfinite(design).all(1) & np.isfinite(wanted)
                if known.sum() < _LEAST_POINTS:
                    return move, 0.0
                off = (wanted - here)[known]
                weight = np.sqrt(1 / np.maximum(1.0, np.abs(off) / (1.5 * np.median(np.abs(off)) + 1e-9)))
                change = _linalg.lstsq(design[known] * weight[:, None], off * weight)[0][:3]
                move = np.asarray(move + change * small.diagonal(), np.float64)
                if (np.abs(change) < 0.04).all():
                    break
            here = self.sampled(after, by, self.shown(move))
        return move, _correlation(wanted, here)


def _correlation(one: Float[np.ndarray, " n"], two: Float[np.ndarray, " n"]) -> float:
    known = np.isfinite(one) & np.isfinite(two)
    if known.sum() < _LEAST_POINTS:
        return 0.0
    one, two = one[known] - one[known].mean(), two[known] - two[known].mean()
    return float(one @ two / math.sqrt((one @ one) * (two @ two) + 1e-9))
