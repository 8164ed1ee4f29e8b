"""Paint put into a camera's picture, with the depth and the kinds of things that the same camera sees.

A pixel shows the canvas where the scene's point is road and lies in the plane of the canvas, so whatever stands before
the canvas hides it. The pattern is averaged over the pixel. Its light is that of the bare road around the pixel: paint
of level p is seen as p · (road seen there) / (level of asphalt in full light).

    symbol   meaning                                    shape
    H        image_from_canvas, canvas px → camera px   (3, 3)
    P        pixels that may show the canvas            count
    S        places in each pixel that are looked up    count
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy import ndimage

from roadproof.geometry import CANVAS_SIZE_PX
from roadproof.homographies import Homography
from roadproof.simulators.protocol import PatternImage

ASPHALT_LEVEL = 0.42
"""Display level of asphalt in full light, as a share of white; that of the embedded town."""

# A road's footprint is long along the road, which is down the picture.
SAMPLES_ACROSS, SAMPLES_DOWN = 4, 12
LIGHT_RADIUS_PX = 6
PLANE_M = 0.12


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What one camera sees at one moment.

    Args:
        picture: (h, w, 3) RGB of the camera.
        height_m: (h, w) height of the point that each pixel shows above the plane of the canvas, metres.
        road: (h, w) whether each pixel shows asphalt or a line on it.
        asphalt: (h, w) whether each pixel shows asphalt alone.
    """

    picture: UInt8[np.ndarray, "h w 3"]
    height_m: Float[np.ndarray, "h w"]
    road: Bool[np.ndarray, "h w"]
    asphalt: Bool[np.ndarray, "h w"]


class Paint:
    """A pattern made ready to be put into one picture after another.

    Args:
        pattern: RGBA of the canvas.
    """

    def __init__(self, pattern: PatternImage) -> None:
        # A transparent frame stands for all that is outside. Colours in levels, multiplied with alpha; alpha in [0, 1].
        levels = np.pad(pattern, ((1, 1), (1, 1), (0, 0))).astype(np.float32)
        levels[..., 3] /= 255
        levels[..., :3] *= levels[..., 3:]
        self._levels = levels
        steps = np.zeros(levels.shape[:2], np.int32)
        steps[:-1] |= (levels[1:] != levels[:-1]).any(axis=-1)
        steps[:, :-1] |= (levels[:, 1:] != levels[:, :-1]).any(axis=-1)
        # Running sums: how many places within a box differ from the next one.
        self._steps = np.pad(steps.cumsum(0).cumsum(1), ((1, 0), (1, 0)))

    def on(self, scene: Scene, image_from_canvas: Homography) -> UInt8[np.ndarray, "h w 3"]:
        """The picture with the pattern on the road.

        Convention:
            Pixel centres at integers; `image_from_canvas` has a positive third coordinate in front of the camera.
        """
        free = scene.road & (np.abs(scene.height_m) < PLANE_M)
        rows, columns = np.nonzero(free & may_show(image_from_canvas, scene.road.shape))
        if not len(rows):
            return scene.picture
        paint = self._averaged(np.linalg.inv(image_from_canvas), rows, columns)
        # Only the neighbourhood of the paint tells its light.
        reach = LIGHT_RADIUS_PX
        top, left = max(int(rows.min()) - reach, 0), max(int(columns.min()) - reach, 0)
        near = np.s_[top : int(rows.max()) + reach + 1, left : int(columns.max()) + reach + 1]
        light = _light(scene.picture[near], scene.asphalt[near])[rows - top, columns - left]
        clean = scene.picture[rows, columns].astype(np.float64)
        seen = clean * (1.0 - paint[:, 3:]) + paint[:, :3] * light
        result = scene.picture.copy()
        result[rows, columns] = np.clip(seen + 0.5, 0, 255).astype(np.uint8)
        return result

    def _averaged(
        self, canvas_from_image: Homography, rows: Int[np.ndarray, " p"], columns: Int[np.ndarray, " p"]
    ) -> Float[np.ndarray, "p 4"]:
        """Mean levels of the pattern over each pixel."""
        paint, alike = self._looked_up(canvas_from_image, rows, columns)
        # Most pixels see one colour alone; only the others are worth the samples.
        mixed = np.flatnonzero(~alike)
        across = (np.arange(SAMPLES_ACROSS) + 0.5) / SAMPLES_ACROSS - 0.5
        down = (np.arange(SAMPLES_DOWN) + 0.5) / SAMPLES_DOWN - 0.5
        dx, dy = (axis.ravel() for axis in np.meshgrid(across, down))
        x, y, ahead = _mapped(canvas_from_image, columns[mixed, None] + dx, rows[mixed, None] + dy)
        seen = self._levels[_framed(y), _framed(x)] * (ahead > 0)[..., None]
        paint[mixed] = seen.mean(axis=1, dtype=np.float64)
        return paint

    def _looked_up(
        self, canvas_from_image: Homography, rows: Int[np.ndarray, " p"], columns: Int[np.ndarray, " p"]
    ) -> tuple[Float[np.ndarray, "p 4"], Bool[np.ndarray, " p"]]:
        """A level somewhere in each pixel, and whether all in it are the same."""
        across, down = np.array([[-0.5, 0.5, -0.5, 0.5], [-0.5, -0.5, 0.5, 0.5]])[..., None]
        x, y, ahead = _mapped(canvas_from_image, columns + across, rows + down)
        (left, right), (top, bottom) = ((_framed(v.min(axis=0)), _framed(v.max(axis=0))) for v in (x, y))
        sums = self._steps
        within = sums[bottom + 1, right + 1] - sums[top, right + 1] - sums[bottom + 1, left] + sums[top, left]
        return self._levels[top, left].astype(np.float64), (within == 0) & (ahead > 0).all(axis=0)


def may_show(image_from_canvas: Homography, shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    """Pixels of which some part lies on the canvas, and a few beside them."""
    rows, columns = np.mgrid[: shape[0] + 1, : shape[1] + 1] - 0.5
    x, y, ahead = _mapped(np.linalg.inv(image_from_canvas), columns, rows)
    low, high = -0.5, CANVAS_SIZE_PX - 0.5
    corner = (ahead > 0) & (x > low) & (x < high) & (y > low) & (y < high)
    touched = corner[1:] | corner[:-1]
    return touched[:, 1:] | touched[:, :-1]


def _mapped(
    canvas_from_image: Homography, columns: Float[np.ndarray, "..."], rows: Float[np.ndarray, "..."]
) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """Canvas x, y of picture points, and a number that is positive in front of the camera."""
    x, y, w = (a * columns + b * rows + c for a, b, c in canvas_from_image)
    with np.errstate(divide="ignore", invalid="ignore"):
        return x / w, y / w, w


def _framed(canvas_px: Float[np.ndarray, "..."]) -> Int[np.ndarray, "..."]:
    """Indices into the canvas with a frame around it, which takes all that is outside."""
    inside = np.nan_to_num(canvas_px, nan=-1.0).clip(-1, CANVAS_SIZE_PX)
    return np.rint(inside).astype(np.intp) + 1


def _light(picture: UInt8[np.ndarray, "h w 3"], asphalt: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """How bright white paint would be: the asphalt around each pixel over asphalt in full light, at most 1."""
    weight = asphalt[..., None].astype(np.float64)
    total: Float[np.ndarray, "h w 4"] = np.concatenate([picture * weight, weight], axis=-1)
    square = np.ones(2 * LIGHT_RADIUS_PX + 1)
    for axis in (0, 1):
        total = cast("Any", ndimage).correlate1d(total, square, axis=axis, mode="constant")
    everywhere = total[..., :3].sum((0, 1)) / max(float(total[..., 3].sum()), 1e-9)
    seen = np.where(total[..., 3:] > 1e-9, total[..., :3] / np.maximum(total[..., 3:], 1e-9), everywhere)
    return np.clip(seen / (255 * ASPHALT_LEVEL), 0.0, 1.0)
