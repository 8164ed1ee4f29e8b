"""Every surface of the town as a small picture, made from seeded noise: no file is read.

Pictures are (H, W, 3 or 4) uint8 with sides that are powers of two; row 0 is the upper edge. Grains (`asphalt_grain`
and its like) hold only the fine structure around a mean of `GRAIN_MEAN`; the colour comes from the ground below.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFilter

Plane = Float[np.ndarray, "_ _"]
Picture = UInt8[np.ndarray, "_ _ _"]

GRAIN_MEAN = 212.0
"""Mean level of a grain: the ground's colour is divided by it, so that the product comes out right."""


def fractal_noise(
    height: int, width: int, *, seed: int, cells: int = 4, octaves: int = 5, persistence: float = 0.55
) -> Plane:
    """Smooth noise in [0, 1] that tiles without a seam.

    Args:
        height: rows of the picture.
        width: columns of the picture.
        seed: the seed of the noise.
        cells: lattice cells down the picture in the coarsest octave.
        octaves: how many octaves are added at most, each twice as fine as the one before; none is finer than a pixel.
        persistence: amplitude of an octave as a share of the amplitude of the one before.
    """
    rng = np.random.default_rng(seed)
    total, weight, amplitude = np.zeros((height, width), np.float32), 0.0, 1.0
    for octave in range(octaves):
        down = cells * 2**octave
        across = max(2, round(down * width / height))
        if down > height or across > width:
            break
        lattice = rng.random((down, across), dtype=np.float32)
        total += amplitude * _stretch(_stretch(lattice, height).T, width).T
        weight += amplitude
        amplitude *= persistence
    return total / weight


def _stretch(lattice: Float[np.ndarray, "n m"], rows: int) -> Float[np.ndarray, "r m"]:
    """Periodic smoothstep interpolation down the first axis."""
    position = np.arange(rows, dtype=np.float32) * (len(lattice) / rows)
    below = position.astype(int)
    t = (position - below.astype(np.float32))[:, None]
    t = t * t * (3 - 2 * t)
    return lattice[below] * (1 - t) + lattice[(below + 1) % len(lattice)] * t


def _to_bytes(colour: Float[np.ndarray, "h w 3"], alpha: Plane | None = None) -> Picture:
    rgb = np.clip(colour + 0.5, 0, 255).astype(np.uint8)
    if alpha is None:
        return rgb
    return np.dstack([rgb, np.clip(alpha + 0.5, 0, 255).astype(np.uint8)])


def _grain(deviation: Plane) -> Picture:
    deviation = deviation - deviation.mean()
    return _to_bytes(np.repeat((GRAIN_MEAN * (1 + deviation))[..., None], 3, axis=2))


def asphalt_grain() -> Picture:
    """Three metres of asphalt: stones, some light, some dark, in a fine binder."""
    n = 256
    rng = np.random.default_rng(1)
    stones = np.asarray(
        Image.fromarray((rng.random((n, n)) * 255).astype(np.uint8)).filter(ImageFilter.GaussianBlur(0.8)), np.float32
    )
    stones = (stones - stones.mean()) / stones.std()
    rough = fractal_noise(n, n, seed=2, cells=8, octaves=4) - 0.5
    light = (stones > 2.2) * 0.10 - (stones < -2.3) * 0.08
    return _grain(0.040 * stones + 0.16 * rough + light)


def slab_grain() -> Picture:
    """Two metres of pavement: four by four slabs with joints."""
    n = 256
    rng = np.random.default_rng(3)
    shade = np.kron(rng.random((4, 4)) - 0.5, np.ones((64, 64))) * 0.07
    fine = 0.10 * (fractal_noise(n, n, seed=3, cells=8) - 0.5) + 0.05 * (rng.random((n, n)) - 0.5)
    total = shade + fine
    for joint in range(0, n, 64):
        total[joint : joint + 2] -= 0.22
        total[:, joint : joint + 2] -= 0.22
    return _grain(total)


def grass_grain() -> Picture:
    """Four metres of lawn: tufts and blades."""
    n = 256
    tufts = fractal_noise(n, n, seed=5, cells=8, octaves=3) - 0.5
    blades = fractal_noise(n, n, seed=6, cells=64, octaves=2, persistence=0.9) - 0.5
    return _grain(0.28 * tufts + 0.42 * blades)


def concrete() -> Picture:
    """Cast concrete and render, near white: tinted by the mesh."""
    n = 128
    rng = np.random.default_rng(8)
    value = 228 + 40 * (fractal_noise(n, n, seed=8) - 0.5) + 8 * (rng.random((n, n)) - 0.5)
    return _to_bytes(np.repeat(value[..., None], 3, axis=2))


def roof_tiles() -> Picture:
    """One side of a tiled roof, 26 rows of tiles, tinted by the mesh."""
    n = 256
    rng = np.random.default_rng(9)
    yy, xx = np.mgrid[0:n, 0:n]
    row, column = yy // 10, (xx + (yy // 10 % 2) * 4) // 8
    value = 190 + 50 * (rng.random((n // 10 + 1, n // 8 + 1))[row, column] - 0.5)
    value = value * np.where(yy % 10 < 2, 0.66, 1.0) * (0.86 + 0.28 * fractal_noise(n, n, seed=9))
    return _to_bytes(np.repeat(value[..., None], 3, axis=2))


LEAF_REACH = 15
LEAF_SQUARED = ((np.mgrid[0:LEAF_REACH, 0:LEAF_REACH] - LEAF_REACH // 2) ** 2).sum(axis=0)

WALLS = np.array(
    [
        (186, 158, 134), (205, 193, 165), (158, 98, 78), (208, 206, 198),
        (142, 148, 156), (196, 170, 128), (176, 122, 96),
    ],
    np.float32,
)  # fmt: skip
"""Wall colours of the town, RGB levels."""


def facade(kind: int) -> Picture:
    """Two storeys of three bays: 7.5 m × 6.2 m of a town house."""
    n = 256
    rng = np.random.default_rng(100 + kind)
    wall = WALLS[kind % len(WALLS)]
    image = wall * (0.90 + 0.20 * fractal_noise(n, n, seed=200 + kind))[..., None]
    if kind in (2, 6):
        image = _bricks(image, rng)
    trim = wall * 0.30 + 158
    for top in (0, 128):
        image[top + 116 : top + 122] = trim * 0.94
        image[top + 122 : top + 126] *= 0.74
        for left in (18, 103, 188):
            _window(image, top + 26, left, 76, 50, trim, rng, balcony=kind == 3)
    return _to_bytes(image)


def _bricks(image: Float[np.ndarray, "h w 3"], rng: np.random.Generator) -> Float[np.ndarray, "h w 3"]:
    n = len(image)
    yy, xx = np.mgrid[0:n, 0:n]
    row = yy // 4
    column = (xx + (row % 2) * 5) // 10
    image = image * (0.90 + 0.2 * rng.random((n // 4, n // 10 + 2))[row, column])[..., None]
    joint = (yy % 4 == 0) | ((xx + (row % 2) * 5) % 10 == 0)
    image[joint] = image[joint] * 0.75 + 38
    return image


def _window(
    image: Float[np.ndarray, "h w 3"],
    top: int,
    left: int,
    height: int,
    width: int,
    trim: Float[np.ndarray, " 3"],
    rng: np.random.Generator,
    *,
    balcony: bool,
) -> None:
    """Frame, panes that mirror the sky, curtains or a lit room, a sill and its shadow."""
    bottom, right = top + height, left + width
    image[top - 5 : bottom + 3, left - 4 : right + 4] = trim
    down = np.linspace(0, 1, height)[:, None, None]
    across = np.linspace(0, 1, width)[None, :, None]
    sky = np.array([150, 172, 190]) * (1 - down) + np.array([44, 52, 62]) * down
    pane = sky * (0.45 + 0.45 * rng.random()) * (0.9 + 0.25 * np.abs(across - rng.random()))
    style = rng.random()
    if style > 0.82:
        pane = pane * 0.45 + np.array([110, 92, 58])
    elif style > 0.4:
        curtain = (np.abs(across - 0.5) > rng.uniform(0.22, 0.42)) & (down > 0.02)
        pane = np.where(curtain, pane * 0.35 + np.array([128, 124, 114]), pane)
    else:
        blind = down < rng.uniform(0.05, 0.5)
        slats = 0.92 + 0.08 * np.cos(np.arange(height) * math.pi / 2)[:, None, None]
        pane = np.where(blind, np.array([168, 162, 148]) * slats, pane)
    image[top:bottom, left:right] = pane
    image[top : top + 5, left:right] *= 0.5
    image[top:bottom, left : left + 2] *= 0.7
    middle = (left + right) // 2
    image[top:bottom, middle - 1 : middle + 2] = trim * 0.98
    image[top + height // 3 - 1 : top + height // 3 + 1, left:right] = trim * 0.98
    image[bottom + 2 : bottom + 6, left - 6 : right + 6] = trim * 1.04
    image[bottom + 6 : bottom + 10, left - 6 : right + 6] *= 0.72
    if balcony:
        image[bottom - 26 : bottom - 23, left - 8 : right + 8] = 52
        image[bottom - 26 : bottom + 4, left - 8 : right + 8 : 5] = 60


def shop_front(kind: int) -> Picture:
    """Eight metres of ground floor: two shop windows under an awning and a door."""
    n = 256
    rng = np.random.default_rng(500 + kind)
    wall = np.array([[112, 96, 86], [98, 104, 112], [140, 122, 102], [88, 84, 80]], np.float32)[kind % 4]
    image = wall * (0.9 + 0.2 * fractal_noise(n, n, seed=510 + kind))[..., None]
    image[:14] = wall * 0.5 + 90
    cloth = np.array([[142, 46, 42], [44, 82, 124], [58, 106, 74], [176, 140, 70]], np.float32)[kind % 4]
    down = np.linspace(0, 1, 150)[:, None, None]
    for left, width in ((10, 98), (146, 98)):
        right = left + width
        image[62:228, left - 4 : right + 4] = wall * 0.42
        glass = np.array([118, 136, 146]) * (1 - down) + np.array([36, 40, 46]) * down
        goods = fractal_noise(150, width, seed=520 + 7 * kind + left, cells=6, octaves=3)[..., None]
        shelf = np.where(down > 0.45, (goods - 0.5) * 110, 0) * rng.uniform(0.4, 1.0, 3)
        image[70:220, left:right] = glass + shelf
        image[70:220, left + width // 2 - 2 : left + width // 2 + 2] = 66
        stripes = 0.84 + 0.16 * np.sign(np.sin(np.arange(width + 12) * math.pi / 8))[None, :, None]
        image[30:64, left - 6 : right + 6] = cloth * stripes * np.linspace(1.12, 0.86, 34)[:, None, None]
        image[64:82, left:right] *= 0.5
    image[70:256, 112:142] = wall * 0.34
    image[78:250, 116:138] = np.array([58, 64, 70])
    image[78:150, 116:138] = np.array([92, 106, 116])
    image[236:] *= 0.74
    return _to_bytes(image)


def tree(kind: int) -> Picture:
    """A broad-leaved tree as a cut-out: clumps of leaves lit from above, the sky between them, a forked trunk."""
    n = 256
    rng = np.random.default_rng(600 + kind)
    image, alpha = np.zeros((n, n, 3), np.float32), np.zeros((n, n), np.float32)
    bark = Image.new("L", (n, n), 0)
    pen = ImageDraw.Draw(bark)
    pen.polygon([(121, 256), (135, 256), (132, 150), (130, 110), (126, 110), (124, 150)], fill=255)
    for _ in range(9):
        y = rng.uniform(112, 168)
        pen.line([(128, y), (128 + rng.uniform(-62, 62), y - rng.uniform(34, 64))], fill=255, width=3)
    trunk = np.asarray(bark) > 0
    shade = 0.75 + 0.5 * rng.random((n, n, 1))
    image[trunk] = (np.array([84, 70, 56]) * shade)[trunk]
    alpha[trunk] = 255
    leaf = np.array([[66, 92, 40], [80, 100, 46], [56, 82, 44], [96, 100, 50], [72, 96, 56]], np.float32)[kind % 5]
    clumps = [(rng.uniform(0, 2 * math.pi), math.sqrt(rng.random()), rng.uniform(16, 30)) for _ in range(60)]
    # Far clumps first: low ones are dark, high ones catch the sun.
    crowns = sorted((100 + 82 * r * math.sin(a), 128 + 96 * r * math.cos(a), size) for a, r, size in clumps)
    for cy, cx, size in reversed(crowns):
        for _ in range(20):
            angle, radius = rng.uniform(0, 2 * math.pi), size * math.sqrt(rng.random())
            _leaf(image, alpha, cx + radius * math.cos(angle), cy + 0.8 * radius * math.sin(angle), leaf, cy, size, rng)
    seen = alpha > 0
    image[~seen] = image[seen].mean(axis=0)
    return _to_bytes(image, alpha)


def _leaf(
    image: Float[np.ndarray, "h w 3"],
    alpha: Plane,
    x: float,
    y: float,
    colour: Float[np.ndarray, " 3"],
    clump_y: float,
    clump_size: float,
    rng: np.random.Generator,
) -> None:
    """A ragged tuft of leaves, brighter towards the top of its clump and of the crown."""
    radius = rng.uniform(3.5, 7.0)
    top, left, reach = int(y) - 7, int(x) - 7, LEAF_REACH
    if not (0 <= top < len(image) - reach and 0 <= left < len(image) - reach):
        return
    size = radius**2 * (0.35 + 0.8 * rng.random((reach, reach), np.float32))
    ragged = size > LEAF_SQUARED
    light = 0.70 + 0.26 * (clump_y - y) / clump_size + 0.22 * (100 - clump_y) / 90 + rng.uniform(-0.1, 0.1)
    speckle = 0.86 + 0.28 * rng.random((reach, reach, 1), np.float32)
    patch = image[top : top + reach, left : left + reach]
    patch[ragged] = (colour * max(light, 0.30) * speckle)[ragged]
    alpha[top : top + reach, left : left + reach][ragged] = 255


def hedge() -> Picture:
    """Two metres of clipped hedge."""
    n = 128
    leaves = fractal_noise(n, n, seed=700, cells=16, octaves=4, persistence=0.8)
    light = np.linspace(1.1, 0.7, n)[:, None]
    return _to_bytes(np.array([64, 86, 42]) * ((0.35 + 1.3 * leaves) * light)[..., None])


def guard_rail() -> Picture:
    """The two waves of a steel guard rail; tiles along its length."""
    n = 64
    wave = 168 + 56 * np.cos(np.arange(n) / n * 4 * math.pi)
    spots = 14 * (fractal_noise(n, n, seed=11, cells=8, octaves=3) - 0.5)
    return _to_bytes((wave[:, None] + spots)[..., None] * np.array([0.96, 0.99, 1.02]))


def contact_shadow() -> Picture:
    """A soft dark spot for below cars and people, black with alpha."""
    n = 64
    yy, xx = np.mgrid[0:n, 0:n] / (n - 1) * 2 - 1
    reach = np.maximum(np.abs(xx), np.abs(yy)) ** 4 * 0.5 + 0.5 * (xx**2 + yy**2) ** 2
    return _to_bytes(np.zeros((n, n, 3), np.float32), 200 * np.clip(1 - reach**0.9, 0, 1))


def rain_streaks(drops: int) -> Picture:
    """Falling drops in front of the lens, faint and slightly slanted; tiles both ways."""
    n = 256
    rng = np.random.default_rng(12)
    sheet = Image.new("L", (n, 2 * n), 0)
    pen = ImageDraw.Draw(sheet)
    for _ in range(drops):
        x, y, length = rng.uniform(0, n), rng.uniform(0, n), rng.uniform(10, 34)
        pen.line([(x, y), (x + 0.10 * length, y + length)], fill=int(rng.uniform(36, 96)), width=1)
    plane = np.asarray(sheet.filter(ImageFilter.GaussianBlur(0.6)), np.float32)
    return _to_bytes(np.full((n, n, 3), 205, np.float32), np.maximum(plane[:n], plane[n:]))


def plain() -> Picture:
    """White, for meshes that bring their own colour."""
    return np.full((8, 8, 3), 255, np.uint8)


ATLAS_TILE = 256


def atlas(pictures: Sequence[Picture], columns: int) -> Picture:
    """Pictures side by side, from the upper left, each brought to `ATLAS_TILE` pixels square."""
    rows = _atlas_rows(len(pictures), columns)
    channels = pictures[0].shape[2]
    sheet = np.zeros((rows * ATLAS_TILE, columns * ATLAS_TILE, channels), np.uint8)
    for i, picture in enumerate(pictures):
        y, x = divmod(i, columns)
        tile = np.asarray(Image.fromarray(picture).resize((ATLAS_TILE, ATLAS_TILE), Image.Resampling.BILINEAR))
        sheet[y * ATLAS_TILE : (y + 1) * ATLAS_TILE, x * ATLAS_TILE : (x + 1) * ATLAS_TILE] = tile
    return sheet


def atlas_uv(uv: Float[np.ndarray, "n 2"], index: int, columns: int, count: int) -> Float[np.ndarray, "n 2"]:
    """Coordinates in an atlas of `count` pictures from coordinates in its picture `index`."""
    rows = _atlas_rows(count, columns)
    y, x = divmod(index, columns)
    inside = np.clip(uv, 0, 1) * (1 - 1 / ATLAS_TILE) + 0.5 / ATLAS_TILE
    corner = np.array([x, rows - 1 - y])
    return (inside + corner) / (columns, rows)


def _atlas_rows(count: int, columns: int) -> int:
    """Rows of an atlas, a power of two."""
    rows = 1
    while rows * columns < count:
        rows *= 2
    return rows
