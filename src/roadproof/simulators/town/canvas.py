"""The canvas: a patch of road on which a pattern is painted.

The pattern is mixed with the road below in numpy and the patch is drawn opaque: blending in the renderer would count
pixels on the edges of triangles twice. The patch is there even when nothing is painted, so that a bare road and a fully
transparent pattern look the same.

Convention:
    seen = road · (1 − α) + α · (paint · light · (1 − water) + sky · water), per channel and pixel: linear in the paint.
    Row 0 of the patch is the far edge. Coarser copies are averaged along and across the road separately, as the road is
    foreshortened; copy k is meant for the distance at which one rendered pixel covers one of its pixels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from roadproof.datatypes import VehicleState
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CanvasPlacement, CropResize
from roadproof.homographies import Homography
from roadproof.simulators.town.ground import COARSE_M, FINE_M, LitGround, paved_damp, turned_square
from roadproof.simulators.town.meshes import Mesh
from roadproof.simulators.town.textures import GRAIN_MEAN

PATCH_PX = 512
GRAIN_TILE_M = 3.0
COARSEST = 7
NEAREST_M = 0.5

Levels = Float[np.ndarray, "p p 3"]


@dataclass(frozen=True, slots=True, eq=False)
class RoadPatch:
    """The road under a canvas in one weather, in levels.

    Args:
        bare: levels of the road with its lane marks.
        gain: factor on a painted level: light, damp, a third of the stones' roughness, and what water leaves of it.
        offset: levels of the sky that is mirrored on the paint.
    """

    bare: Levels
    gain: Levels
    offset: Levels

    def painted(self, pattern: UInt8[np.ndarray, "400 400 4"] | None) -> UInt8[np.ndarray, "p p 3"]:
        """The patch with a pattern on it."""
        if pattern is None:
            return (self.bare + 0.5).astype(np.uint8)
        alpha = pattern[..., 3:].astype(np.float32) / 255
        premultiplied = np.concatenate([pattern[..., :3] * alpha, alpha], axis=2)
        # Copies of the outermost pixels stand for the paint beyond the outermost pixel centres.
        large = _magnified(_magnified(premultiplied.astype(np.float32)).transpose(1, 0, 2)).transpose(1, 0, 2)
        cover = large[..., 3:]
        seen = self.bare * (1 - cover) + large[..., :3] * self.gain + cover * self.offset
        return np.clip(seen + 0.5, 0, 255).astype(np.uint8)


def _magnified(plane: Float[np.ndarray, "h w c"]) -> Float[np.ndarray, "p w c"]:
    """Linear interpolation down the rows to the patch's size."""
    at = np.clip((np.arange(PATCH_PX) + 0.5) * (len(plane) / PATCH_PX) - 0.5, 0, len(plane) - 1)
    below = np.minimum(at.astype(int), len(plane) - 2)
    t = (at - below).astype(np.float32)[:, None, None]
    return plane[below] * (1 - t) + plane[below + 1] * t


def road_patch(lit: LitGround, placement: CanvasPlacement, grain: UInt8[np.ndarray, "g g 3"], paint: Mesh) -> RoadPatch:
    """Bake the road under a canvas.

    Args:
        lit: the ground in one weather.
        placement: where the canvas lies.
        grain: the asphalt's grain, one repeat of `GRAIN_TILE_M`.
        paint: mesh of the streets' painted lines.
    """
    step = CANVAS_SIZE_PX / PATCH_PX
    to_world = placement.world_from_canvas[:2]
    corner = to_world @ np.array([-0.5, -0.5, 1.0])
    columns, rows = to_world[:, 0] * step, to_world[:, 1] * step

    def seen(plane: Image.Image, pixel_m: float) -> Float[np.ndarray, "p p c"]:
        return turned_square(plane, pixel_m, corner - np.array(lit.ground.low_m), columns, rows, PATCH_PX)

    light = seen(lit.light, COARSE_M) / 255
    water = seen(lit.water, COARSE_M) / 255
    mirrored = np.array(lit.mirrored, np.float32)
    texture = _turned_grain(grain, corner, columns, rows)
    road = seen(lit.colour, FINE_M) * light * (1 - water) + water * mirrored
    # Paint lies on the stones: it shows a third of their roughness, and soaks up less water than they do.
    damp = (1 + 2 * paved_damp(lit.sky.wetness)) / 3
    gain = np.minimum(light * damp * (1 + (texture - 1) / 3), 1.0) * (1 - water)
    offset = water * mirrored
    lines, cover = _lane_marks(placement, paint)
    bare = road * texture * (1 - cover) + cover * (lines * gain + offset)
    return RoadPatch(np.clip(bare, 0, 255), gain, offset)


def _turned_grain(
    grain: UInt8[np.ndarray, "g g 3"],
    corner: Float[np.ndarray, "2"],
    columns: Float[np.ndarray, "2"],
    rows: Float[np.ndarray, "2"],
) -> Float[np.ndarray, "p p 1"]:
    """The asphalt's grain, 1 on average, over a turned square of pixels."""
    fine = np.ascontiguousarray(grain[::-1, :, 0])
    pixel_m = GRAIN_TILE_M / len(fine)
    outline = corner + np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) @ np.stack([columns, rows]) * PATCH_PX
    first = np.floor(outline.min(axis=0) / GRAIN_TILE_M) * GRAIN_TILE_M
    repeats = np.ceil((outline.max(axis=0) - first) / GRAIN_TILE_M).astype(int)
    mosaic = Image.fromarray(np.tile(fine, (repeats[1], repeats[0])))
    return turned_square(mosaic, pixel_m, corner - first, columns, rows, PATCH_PX) / GRAIN_MEAN


def _lane_marks(placement: CanvasPlacement, paint: Mesh) -> tuple[Levels, Float[np.ndarray, "p p 1"]]:
    """Colour and coverage of the streets' painted lines within the patch."""
    from_world = np.linalg.inv(placement.world_from_canvas[[0, 1, 3]])
    flat = np.column_stack([paint.points[:, :2], np.ones(len(paint.points))])
    scale = 2 * PATCH_PX / CANVAS_SIZE_PX
    at = ((flat @ from_world.T)[:, :2] + 0.5) * scale - 0.5
    corners = at[paint.triangles]
    near = ((corners.max(axis=1) > 0) & (corners.min(axis=1) < 2 * PATCH_PX)).all(axis=1)
    colour = Image.new("RGB", (2 * PATCH_PX, 2 * PATCH_PX), (255, 255, 255))
    cover = Image.new("L", colour.size, 0)
    pens = ImageDraw.Draw(colour), ImageDraw.Draw(cover)
    for triangle, vertices in zip(corners[near], paint.triangles[near], strict=True):
        outline = [(float(x), float(y)) for x, y in triangle]
        red, green, blue = (int(v) for v in 255 * paint.albedo[vertices].mean(axis=0) + 0.5)
        pens[0].polygon(outline, fill=(red, green, blue))
        pens[1].polygon(outline, fill=255)
    share = np.asarray(cover.reduce(2), np.float32)[..., None] / 255
    return np.asarray(colour.reduce(2), np.float32), share


def copies(
    patch: UInt8[np.ndarray, "p p 3"], reductions: Sequence[tuple[int, int]]
) -> list[UInt8[np.ndarray, "h w 3"]]:
    """A patch averaged along and across the road by powers of two."""
    image = Image.fromarray(patch)
    return [np.asarray(image.reduce((2**across, 2**along))) for across, along in reductions]


@dataclass(frozen=True, slots=True)
class Raster:
    """The pixels that one screen renders, and which copy of a patch suits which of its rows.

    Args:
        raster_from_camera: homography of scale and crop, pixel centres at integers on both sides.
        width_px: how many columns are rendered.
        height_px: how many rows are rendered.
        first_rows: for each copy but the coarsest, the first row that shows it or a finer one; decreasing.
    """

    raster_from_camera: Homography
    width_px: int
    height_px: int
    first_rows: tuple[float, ...]

    @classmethod
    def of(cls, camera: CameraModel, crop: CropResize, magnified: int, texel_m: float, copies_made: int) -> Raster:
        """The raster of a crop, `magnified` times as fine as the crop's output.

        Args:
            camera: the pinhole camera whose picture is cropped.
            crop: the part of the camera's picture that is seen.
            magnified: pixels rendered per pixel of the output, along each side.
            texel_m: length of the patch's finest pixel along the road.
            copies_made: how many copies there are, each twice as coarse along the road.
        """
        scale = np.diag([float(magnified), float(magnified), 1.0])
        scale[:2, 2] = (magnified - 1) / 2
        raster = scale @ crop.input_from_camera
        height = max(camera.up_m, 0.3)
        view = raster @ camera.image_from_world(VehicleState(0.0, 0.0, 0.0, 0.0, 0.0))
        rows: list[float] = []
        for along in range(copies_made - 1):
            # Rather too fine than too coarse: interpolation blurs as well. Against exact area averages, changing to the
            # next copy where a row covers 2^(along + 1.5) pixels of the patch halves the error of 2^(along + 0.5).
            distance = math.sqrt(texel_m * 2 ** (along + 1.5) * height * camera.focal_px * raster[1, 1])
            seen = view @ np.array([camera.forward_m + distance, 0.0, 0.0, 1.0])
            rows.append(float(round(seen[1] / seen[2])))
        return cls(raster, crop.width_px * magnified, crop.height_px * magnified, tuple(rows))

    def pieces(self, image_from_canvas: Homography) -> list[Piece]:
        """What is seen of the canvas, cut into rows that show the same copy.

        The renderer moves every vertex to the middle of its pixel. So vertices are put there to begin with, and are
        given the canvas point that is really seen there: the paint then lies exactly where the homography says.
        """
        raster = self.raster_from_camera @ image_from_canvas
        low, high = -0.5, CANVAS_SIZE_PX - 0.5
        outline = np.array([(low, high, 1), (high, high, 1), (high, low, 1), (low, low, 1)]) @ raster.T
        polygon = [(float(x), float(y), float(w)) for x, y, w in outline]
        for plane in (
            (0.0, 0.0, 1.0, -NEAREST_M), (1.0, 0.0, 0.0, 0.0), (-1.0, 0.0, float(self.width_px), 0.0),
            (0.0, 1.0, 0.0, 0.0), (0.0, -1.0, float(self.height_px), 0.0),
        ):  # fmt: skip
            polygon = _cut(polygon, plane)
        pieces: list[Piece] = []
        canvas_from_raster: Homography | None = None
        bounds = (math.inf, *self.first_rows, -math.inf)
        for copy, (below, above) in enumerate(itertools.pairwise(bounds)):
            part = polygon
            if math.isfinite(below):
                part = _cut(part, (0.0, -1.0, below, 0.0))
            if math.isfinite(above):
                part = _cut(part, (0.0, 1.0, -above, 0.0))
            if len(part) >= 3:
                canvas_from_raster = np.linalg.inv(raster) if canvas_from_raster is None else canvas_from_raster
                pixels = np.array([(round(x / w), round(y / w), 1.0) for x, y, w in part])
                canvas = pixels @ canvas_from_raster.T
                pieces.append(Piece(copy, canvas[:, :2] / canvas[:, 2:]))
        return pieces


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """A convex part of the canvas, (n, 2) in canvas px, and the copy it shows."""

    copy: int
    outline: Float[np.ndarray, "n 2"]


Corner = tuple[float, float, float]


def _cut(polygon: list[Corner], plane: tuple[float, float, float, float]) -> list[Corner]:
    """The part of a convex polygon of homogeneous points on the positive side of a plane (Sutherland and Hodgman)."""
    a, b, c, d = plane
    side = [a * x + b * y + c * w + d for x, y, w in polygon]
    if not polygon or min(side) >= 0:
        return polygon
    if max(side) < 0:
        return []
    kept: list[Corner] = []
    for i, (here, s) in enumerate(zip(polygon, side, strict=True)):
        before, t = polygon[i - 1], side[i - 1]
        if (s < 0) != (t < 0):
            k = t / (t - s)
            kept.append(
                (
                    before[0] + k * (here[0] - before[0]),
                    before[1] + k * (here[1] - before[1]),
                    before[2] + k * (here[2] - before[2]),
                )
            )
        if s >= 0:
            kept.append(here)
    return kept


def reductions_for(
    placement: CanvasPlacement, camera: CameraModel, focal_px: tuple[float, float]
) -> list[tuple[int, int]]:
    """The copies worth having: powers of two across and along, for a camera height and focal lengths in x and y."""
    texel_x, texel_y = placement.width_m / PATCH_PX, placement.length_m / PATCH_PX
    made: list[tuple[int, int]] = []
    for along in range(COARSEST + 1):
        distance = math.sqrt(texel_y * 2**along * max(camera.up_m, 0.3) * focal_px[1])
        across = round(math.log2(max(distance / focal_px[0] / texel_x, 1.0)))
        made.append((min(across, along), along))
    return made
