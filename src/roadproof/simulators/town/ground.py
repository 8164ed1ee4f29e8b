"""The ground seen from above: what it is made of, which shadows fall on it, where water stands.

Convention:
    Planes are north-up pictures turned round: row 0 is the *lowest* y, column 0 the lowest x, and a sample lies in the
    middle of its square. `Ground` is the same in all weathers; `LitGround` is one weather.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageChops, ImageDraw, ImageFilter
from scipy.spatial import ConvexHull

from roadproof.roads.roadmap import RoadMap
from roadproof.simulators.town.scenery import Scenery, Tree
from roadproof.simulators.town.textures import fractal_noise
from roadproof.simulators.town.weather import Sky

SEED, CROWN_SEED = 50, 60
FINE_M = 0.125
COARSE_M = 0.25
BORDER_M = 30.0
NOISE_M = 64.0
UNIT = 190
WET_FROM = 0.3
EDGE_M = 0.4
TUFTS = 22

ASPHALT, SHOULDER, PAVEMENT, LAWN = (108, 107, 107), (114, 113, 111), (176, 172, 164), (90, 108, 60)
KINDS = (LAWN, PAVEMENT, SHOULDER, ASPHALT)

Plane = Float[np.ndarray, "_ _"]
Vector = Float[np.ndarray, "2"]


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """What the ground is made of.

    Args:
        low_m: world x, y of the planes' lower corner.
        size_m: extent of the planes in x and y.
        albedo: colour of the ground in display levels, RGB, `FINE_M` a pixel.
        hard: 255 where the ground is paved, 0 on lawn, `FINE_M` a pixel.
        hollows: how low the ground lies, 0 to 255: where water collects first, `COARSE_M` a pixel.
        open_sky: share of the sky that is seen, 0 to 255, `COARSE_M` a pixel.
    """

    low_m: tuple[float, float]
    size_m: tuple[float, float]
    albedo: Image.Image
    hard: Image.Image
    hollows: UInt8[np.ndarray, "h w"]
    open_sky: UInt8[np.ndarray, "h w"]


@lru_cache(maxsize=2)
def build_ground(roads: RoadMap, scenery: Scenery, cell_m: float) -> Ground:
    """Draw the ground of a map; its extent is a whole number of cells. Kept, so that the next call is free."""
    x0, y0, x1, y1 = roads.bounds_m
    low = (math.floor((x0 - BORDER_M) / cell_m) * cell_m, math.floor((y0 - BORDER_M) / cell_m) * cell_m)
    size = (
        math.ceil((x1 + BORDER_M - low[0]) / cell_m) * cell_m,
        math.ceil((y1 + BORDER_M - low[1]) / cell_m) * cell_m,
    )
    fine, coarse = _Raster(low, size, FINE_M), _Raster(low, size, COARSE_M)
    surface = _surfaces(fine, roads, scenery)
    driving = [lane for lane in roads.lanes if lane.kind == "driving"]
    wheels = [lane.left * (1 - share) + lane.right * share for lane in driving for share in (0.27, 0.73)]
    tracks = coarse.lines(wheels, 2, 0.22)
    edges = coarse.lines([lane.left for lane in roads.lanes if lane.kind == "sidewalk"], round(1.0 / COARSE_M), 0.3)
    hollows = _hollows(coarse, tracks, edges)
    albedo = _albedo(coarse, surface, tracks, edges)
    hard = surface.point([0] + [255] * 255)
    return Ground(low, size, albedo, hard, hollows, _open_sky(coarse, scenery))


class _Raster:
    """Draws world shapes into a plane of one byte a pixel."""

    def __init__(self, low: tuple[float, float], size: tuple[float, float], pixel_m: float) -> None:
        self.low, self.pixel_m = np.array(low), pixel_m
        self.shape = (round(size[1] / pixel_m), round(size[0] / pixel_m))

    def blank(self) -> Image.Image:
        return Image.new("L", (self.shape[1], self.shape[0]), 0)

    def points(self, world: np.ndarray) -> list[tuple[float, float]]:
        return [(x, y) for x, y in ((world[:, :2] - self.low) / self.pixel_m - 0.5).tolist()]

    def soft(self, image: Image.Image, blur_m: float) -> Plane:
        """A blurred plane, in [0, 1]."""
        return np.asarray(image.filter(ImageFilter.GaussianBlur(blur_m / self.pixel_m)), np.float32) / 255

    def lines(self, lines: Iterable[np.ndarray], width_px: int, blur_m: float) -> Plane:
        """Soft lines, in [0, 1]."""
        image = self.blank()
        pen = ImageDraw.Draw(image)
        for line in lines:
            pen.line(self.points(line), fill=255, width=width_px)
        return self.soft(image, blur_m)

    def noise(self, seed: int, cells: int, octaves: int) -> Plane:
        """Noise that repeats every `NOISE_M`."""
        n = round(NOISE_M / self.pixel_m)
        patch = fractal_noise(n, n, seed=seed, cells=cells, octaves=octaves)
        rows, columns = np.arange(self.shape[0]) % n, np.arange(self.shape[1]) % n
        return patch[rows][:, columns]


def _surfaces(raster: _Raster, roads: RoadMap, scenery: Scenery) -> Image.Image:
    """`Surface` of each sample: 0 lawn, 1 pavement, 2 shoulder, 3 road."""
    image = raster.blank()
    pen = ImageDraw.Draw(image)
    for outline in scenery.paved:
        pen.polygon(raster.points(outline), fill=1)
    for surface, outline in roads.paved():
        pen.polygon(raster.points(outline), fill=int(surface))
    # Sidewalks get an edge of stone, which also fills the chinks where strips meet at an angle.
    near = image.point([0, 255, 0, 0] + [0] * 252).filter(ImageFilter.BoxBlur(EDGE_M / raster.pixel_m))
    bare = image.point([255] + [0] * 255)
    image.paste(1, mask=ImageChops.multiply(near.point([0] + [255] * 255), bare))
    return image


def _hollows(raster: _Raster, tracks: Plane, edges: Plane) -> UInt8[np.ndarray, "h w"]:
    low = 0.7 * raster.noise(SEED, 14, 5) + 0.3 * raster.noise(SEED + 4, 48, 3) + 0.05 * tracks + 0.08 * edges
    return (np.clip((low - 0.35) / 0.40, 0, 1) * 255).astype(np.uint8)


def _albedo(raster: _Raster, surface: Image.Image, tracks: Plane, edges: Plane) -> Image.Image:
    """Colours: asphalt with tracks, dirt at the kerb and mended patches; slabs; lawn."""
    broad, lumps = raster.noise(SEED + 1, 8, 4), raster.noise(SEED + 2, 64, 4)
    road = 1 + 0.22 * (broad - 0.5) + 0.05 * (lumps - 0.5) - 0.11 * tracks - 0.16 * edges
    road *= 1 - 0.09 * _mended(raster)
    lawn = 0.72 + 0.36 * broad + 0.40 * (lumps - 0.3)
    # Factors up to 1.34 as bytes; the tables make up for it.
    factors = [
        Image.fromarray(np.clip(plane * UNIT + 0.5, 0, 255).astype(np.uint8)).resize(
            surface.size, Image.Resampling.BILINEAR
        )
        for plane in (lawn, 0.94 + 0.12 * broad, road)
    ]
    paved = Image.composite(factors[2], factors[1], surface.point([0, 0] + [255] * 254))
    factor = Image.composite(paved, factors[0], surface.point([0] + [255] * 255))
    channels = [
        ImageChops.multiply(surface.point([round(kind[k] * 255 / UNIT) for kind in KINDS] + [0] * 252), factor)
        for k in range(3)
    ]
    return Image.merge("RGB", channels).filter(ImageFilter.BoxBlur(0.6))


def _mended(raster: _Raster) -> Plane:
    """Rectangles of newer asphalt, 0 or 1."""
    rng = np.random.default_rng(SEED + 3)
    image = raster.blank()
    pen = ImageDraw.Draw(image)
    height, width = raster.shape
    for _ in range(round(height * width * raster.pixel_m**2 / 90)):
        x, y = rng.uniform(0, width), rng.uniform(0, height)
        w, h = rng.uniform(0.7, 3.0, 2) / raster.pixel_m
        pen.rectangle((x, y, x + w, y + h), fill=255)
    return np.asarray(image, np.float32) / 255


def _open_sky(raster: _Raster, scenery: Scenery) -> UInt8[np.ndarray, "h w"]:
    """How open the sky is: less beside walls, below trees and under parked cars."""
    walls, low = raster.blank(), raster.blank()
    tall, flat = ImageDraw.Draw(walls), ImageDraw.Draw(low)
    for solid in scenery.solids:
        if solid.name == "building":
            tall.polygon(raster.points(solid.corners), fill=255)
        elif solid.casts_shadow and solid.half_m[1] > 0.3:
            flat.polygon(raster.points(solid.corners), fill=255)
    for tree in scenery.trees:
        (x, y), r = raster.points(np.array([[tree.x_m, tree.y_m]]))[0], 0.34 * tree.height_m / raster.pixel_m
        flat.ellipse((x - r, y - r, x + r, y + r), fill=90)
    far = walls.reduce(4).filter(ImageFilter.GaussianBlur(1.5 / raster.pixel_m)).resize(walls.size)
    broad = np.asarray(far, np.float32) / 255
    near, under = raster.soft(walls, 1.5), raster.soft(low, 0.4)
    share = 1 - np.clip(0.36 * near + 0.40 * broad + 0.5 * under, 0, 0.7)
    return (share * 255).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class LitGround:
    """The ground in one weather.

    Args:
        ground: what the ground is made of.
        sky: the sky of the weather.
        sunlit: 255 in the sun, 0 in full shadow, `COARSE_M` a pixel.
        colour: colour of the dry or damp ground before light, RGB, `FINE_M` a pixel.
        light: what colours are multiplied with, 255 for 1, RGB, `COARSE_M` a pixel.
        water: share of mirrored sky in what is seen, 255 for 1, `COARSE_M` a pixel; on paved ground only.
        mirrored: the sky that is mirrored, RGB levels.
    """

    ground: Ground
    sky: Sky
    sunlit: UInt8[np.ndarray, "h w"]
    colour: Image.Image
    light: Image.Image
    water: Image.Image
    mirrored: tuple[int, int, int]

    def sunlit_at(self, points_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """1 in the sun, 0 in full shadow."""
        return self._at(self.sunlit, points_m)

    def open_sky_at(self, points_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Share of the sky that is seen."""
        return self._at(self.ground.open_sky, points_m)

    def water_at(self, points_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Share of mirrored sky."""
        return self._at(np.asarray(self.water), points_m)

    def _at(self, plane: UInt8[np.ndarray, "h w"], points_m: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        at = np.floor((np.asarray(points_m) - self.ground.low_m) / COARSE_M).astype(int)
        x, y = np.clip(at[:, 0], 0, plane.shape[1] - 1), np.clip(at[:, 1], 0, plane.shape[0] - 1)
        return plane[y, x] / 255

    def cell(self, column: int, row: int, cell_m: float, margin_m: float) -> Image.Image:
        """The lit colour of a square cell and a margin round it, `FINE_M` a pixel, row 0 the *highest* y."""
        n = round((cell_m + 2 * margin_m) / FINE_M)
        low = np.array([column, row]) * cell_m - margin_m
        box = self._box(low, n, FINE_M)
        # The light's pixels are twice as large: half a pixel of a cell is a quarter of theirs.
        coarse = self._box(low, n // 2, COARSE_M)
        light = self.light.crop(coarse).resize((n, n), Image.Resampling.BILINEAR)
        seen = ImageChops.multiply(self.colour.crop(box), light)
        if self.sky.wetness > WET_FROM:
            water = self.water.crop(coarse).resize((n, n), Image.Resampling.BILINEAR)
            share = ImageChops.multiply(water, self.ground.hard.crop(box))
            seen = Image.composite(Image.new("RGB", (n, n), self.mirrored), seen, share)
        return seen.transpose(Image.Transpose.FLIP_TOP_BOTTOM)

    def _box(self, low: np.ndarray, n: int, pixel_m: float) -> tuple[int, int, int, int]:
        x, y = (round(float(v) / pixel_m) for v in low)
        return (x, y, x + n, y + n)


def turned_square(
    plane: Image.Image, pixel_m: float, corner: Vector, per_column: Vector, per_row: Vector, pixels: int
) -> Float[np.ndarray, "p p c"]:
    """A plane seen in a turned square of pixels.

    Args:
        plane: the plane, of one or three channels.
        pixel_m: the plane's resolution, metres a pixel.
        corner: x, y of the square's upper left corner from the plane's lower corner, metres.
        per_column: world step from a column to the next, metres.
        per_row: world step from a row to the next, metres.
        pixels: how many rows and columns the square has.
    """
    (x0, y0), (ax, ay), (bx, by) = corner / pixel_m, per_column / pixel_m, per_row / pixel_m
    turned = plane.transform(
        (pixels, pixels), Image.Transform.AFFINE, (ax, bx, x0, ay, by, y0), Image.Resampling.BILINEAR
    )
    array = np.asarray(turned, np.float32)
    return array if array.ndim == 3 else array[..., None]


def light_ground(ground: Ground, scenery: Scenery, sky: Sky) -> LitGround:
    """The ground in one weather, with the shadows that fall on it."""
    raster = _Raster(ground.low_m, ground.size_m, COARSE_M)
    image = raster.blank()
    pen = ImageDraw.Draw(image)
    sun = sky.to_sun
    run = -sun[:2] / sun[2]
    for solid in scenery.solids:
        if solid.casts_shadow:
            ends = np.concatenate([solid.corners, solid.corners + run * solid.height_m])
            pen.polygon(raster.points(ends[ConvexHull(ends).vertices]), fill=255)
    crowns = _crowns(scenery.trees, run, np.random.default_rng(CROWN_SEED))
    for tree, (centres, radii) in zip(scenery.trees, crowns, strict=True):
        foot = np.array([tree.x_m, tree.y_m])
        pen.line(raster.points(np.stack([foot, foot + run * 0.45 * tree.height_m])), fill=255, width=1)
        for (x, y), r in zip(raster.points(centres), (radii / COARSE_M).tolist(), strict=True):
            pen.ellipse((x - r, y - r, x + r, y + r), fill=225)
    soft = image.filter(ImageFilter.GaussianBlur(sky.shadow_blur_m / COARSE_M))
    sunlit = 255 - np.asarray(soft)
    facing = np.full(sunlit.shape, sun[2], np.float32)
    light = sky.light(facing, sunlit.astype(np.float32) / 255, ground.open_sky.astype(np.float32) / 255)
    # The wetter, the further up the hollows are full; what is merely wet mirrors a little as well.
    full = np.clip((ground.hollows.astype(np.float32) / 255 - 0.80 + 0.34 * sky.wetness) / 0.10, 0, 1)
    share = (0.50 * full + 0.07) * sky.wetness**0.5 if sky.wetness > WET_FROM else 0 * full
    zenith, horizon = np.array(sky.zenith), np.array(sky.horizon)
    red, green, blue = (round(v) for v in 255 * 0.78 * (0.6 * horizon + 0.4 * zenith))
    return LitGround(
        ground=ground,
        sky=sky,
        sunlit=sunlit,
        colour=_damp(ground, sky.wetness),
        light=Image.fromarray((light * 255 + 0.5).astype(np.uint8)),
        water=Image.fromarray((share * 255).astype(np.uint8)),
        mirrored=(red, green, blue),
    )


def _crowns(
    trees: Sequence[Tree], run: Vector, rng: np.random.Generator
) -> Iterator[tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]]:
    """Where the shadows of each tree's tufts lie, and their radii, in metres."""
    drawn = rng.random((len(trees), TUFTS, 4))
    for tree, (up, round_about, out, wide) in zip(trees, drawn.transpose(0, 2, 1), strict=True):
        height, angle = tree.height_m * (0.42 + 0.50 * up), 2 * math.pi * round_about
        spread = 0.34 * tree.height_m * np.sqrt(out)
        aside = spread[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        yield np.array([tree.x_m, tree.y_m]) + run * height[:, None] + aside, tree.height_m * (0.04 + 0.06 * wide)


def paved_damp(wetness: float) -> float:
    """What wetness multiplies the colour of paved ground with."""
    return 1 - 0.34 * wetness


def _damp(ground: Ground, wetness: float) -> Image.Image:
    if wetness == 0.0:
        return ground.albedo
    soft, hard = (
        ground.albedo.point([round(v * factor) for v in range(256)] * 3)
        for factor in (1 - 0.10 * wetness, paved_damp(wetness))
    )
    return Image.composite(hard, soft, ground.hard)
