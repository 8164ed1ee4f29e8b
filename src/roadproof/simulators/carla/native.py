"""Paint that is part of a CARLA server's world: the texture of the piece of road under the canvas.

Neither which object that piece is nor how its texture lies on it is written anywhere, so both are seen: a camera above
the canvas looks at stripes of black and white, which count in Gray code, and at the same stripes the other way round.
Where the second look is darker than the first a bit is one, whatever the light and the camera's exposure. First all
objects that may be road count their own number, then the one that was found counts the columns and the rows of its
texture.

    symbol   meaning
    u, v     place in the texture from its upper left corner, 0 to 1, to the right and down

Textures stay until the map is loaded anew, and no call tells what they were: so the map is loaded anew afterwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import compress

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from roadproof.datatypes import VehicleState
from roadproof.errors import SimulatorError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CanvasPlacement
from roadproof.homographies import apply_homography
from roadproof.simulators.carla.cameras import Camera
from roadproof.simulators.carla.inject import ASPHALT_LEVEL
from roadproof.simulators.carla.session import Session
from roadproof.simulators.carla.views import image_from_world, levels
from roadproof.simulators.protocol import PatternImage

ROAD = "road"
"""A part of the names of objects that may be pieces of road."""

TEXTURE_PX = 512
BEHIND_M, ABOVE_M = 8.0, 9.0
LOOK = CameraModel(width_px=320, height_px=320, fov_deg=80.0, up_m=ABOVE_M, pitch_deg=-48.0)
SETTLE_TICKS = 2
BITS = 5
STRIPES_PX = 128
LEAST_LEVELS = 12.0
LEAST_SHARE = 0.8
POINTS = 120
# Places are known by the stripe they lie in: of a perfect fit the middle of a stripe is wrong by 1/√12 of one.
WORST_STRIPES = 0.45

BlackWhite = Bool[np.ndarray, "h w"]


class SeveralPiecesError(SimulatorError):
    """A canvas lies on more than one piece of road."""


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """The piece of road under a canvas.

    Args:
        name: the name of the object on the server.
        texture_from_canvas: (2, 3) matrix that gives u and v of a canvas pixel (x, y, 1).
        rms_stripes: root mean square distance of stripes seen on the canvas from where the fit has them, in stripes; a
            perfect fit leaves 1/√12.
    """

    name: str
    texture_from_canvas: Float[np.ndarray, "2 3"]
    rms_stripes: float

    def __str__(self) -> str:
        return f"{self.name}, its texture flat within {self.rms_stripes:.2f} stripes (perfect: 0.29)"


def find_ground(session: Session, canvas: CanvasPlacement) -> Ground:
    """Find the piece of road under a canvas and how its texture lies; the map is loaded anew on the way.

    Raises:
        SimulatorError: the server has no such object, its texture does not change, or
            the texture is repeated or bent there; or the server does not answer.
        SeveralPiecesError: the canvas lies on several pieces of road.
    """
    try:
        return _found(session, canvas)
    except SimulatorError:
        # Half-way, roads are black and white.
        if session.painted and not session.lost:
            session.reload()
        raise


def _found(session: Session, canvas: CanvasPlacement) -> Ground:
    names = sorted(
        name for name in session.ask("its objects", session.world.get_names_of_all_objects) if ROAD in name.lower()
    )
    if not names:
        raise SimulatorError(f"the CARLA server at {session.where} has no object with {ROAD!r} in its name; {ELSE}")
    watch = _Watch(session, canvas)
    numbers = np.arange(1, len(names) + 1)
    count, valid = watch.counted(
        [
            [(list(compress(names, on)), _flat(True)), (list(compress(names, ~on)), _flat(False))]
            for bit in range(len(names).bit_length())
            for on in (_bit(numbers, bit), ~_bit(numbers, bit))
        ]
    )
    _check_share(session, valid, "no texture of its roads changes")
    found, votes = np.unique(count[valid], return_counts=True)
    if votes.max() < LEAST_SHARE * valid.sum() or not 1 <= found[votes.argmax()] <= len(names):
        several: list[int] = found[votes > 0.02 * valid.sum()].tolist()
        on = ", ".join(names[k - 1] for k in several if 1 <= k <= len(names))
        raise SeveralPiecesError(f"the canvas lies on several pieces of road of the CARLA server ({on}); {ELSE}")
    name = names[int(found[votes.argmax()]) - 1]
    # The other pieces get back what they had.
    session.reload()
    watch = _Watch(session, canvas)
    cells = np.arange(STRIPES_PX) * 2**BITS // STRIPES_PX
    places: list[Float[np.ndarray, " p"]] = []
    seen = np.ones(POINTS**2, bool)
    for down in (False, True):
        looks: list[list[tuple[list[str], BlackWhite]]] = []
        for bit in range(BITS):
            stripes = np.tile(_bit(cells, bit), (STRIPES_PX, 1))
            looks += [[([name], stripes.T if down else stripes)], [([name], ~stripes.T if down else ~stripes)]]
        count, valid = watch.counted(looks)
        places.append((count + 0.5) / 2**BITS)
        seen &= valid
    # The camera goes, and the piece gets back what it had.
    session.reload()
    _check_share(session, seen, f"the texture of {name} does not change all over the canvas")
    return _fitted(session, name, watch.points[seen], np.stack(places, axis=1)[seen])


def lay(session: Session, ground: Ground, pattern: PatternImage | None) -> None:
    """Paint the piece of road: asphalt all over, and the pattern where the canvas is."""
    session.paint([ground.name], texture_of(ground, pattern))


def texture_of(ground: Ground, pattern: PatternImage | None) -> UInt8[np.ndarray, "t t 3"]:
    """The picture for the whole piece of road, the pattern averaged over its pixels."""
    asphalt = np.full((TEXTURE_PX, TEXTURE_PX, 3), round(255 * ASPHALT_LEVEL), np.uint8)
    if pattern is None:
        return asphalt
    # Each pixel by four places in it.
    side = (np.arange(2 * TEXTURE_PX) + 0.5) / (2 * TEXTURE_PX)
    u, v = np.meshgrid(side, side)
    canvas_from_texture = np.linalg.inv(np.vstack([ground.texture_from_canvas, [0.0, 0.0, 1.0]]))
    x, y = (a * u + b * v + c for a, b, c in canvas_from_texture[:2])
    inside = (np.abs(np.stack([x, y]) - (CANVAS_SIZE_PX - 1) / 2) < CANVAS_SIZE_PX / 2).all(axis=0)
    rgba = np.zeros((*u.shape, 4), np.float32)
    column, row = (np.rint(each[inside]).astype(int).clip(0, CANVAS_SIZE_PX - 1) for each in (x, y))
    chosen = pattern[row, column].astype(np.float32)
    rgba[inside, :3] = chosen[:, :3] * (chosen[:, 3:] / 255)
    rgba[inside, 3] = chosen[:, 3] / 255
    mean = rgba.reshape(TEXTURE_PX, 2, TEXTURE_PX, 2, 4).mean(axis=(1, 3))
    return np.clip(asphalt * (1.0 - mean[..., 3:]) + mean[..., :3] + 0.5, 0, 255).astype(np.uint8)


ELSE = "paint into the pictures instead: carla://HOST:PORT?paint=inject"


class _Watch:
    """A camera above a canvas, and places on it that it looks at.

    Attributes:
        points: (p, 2) canvas px, all over the canvas but its rim.
    """

    def __init__(self, session: Session, canvas: CanvasPlacement) -> None:
        side = np.linspace(4.0, CANVAS_SIZE_PX - 5.0, POINTS)
        self.points = np.stack([axis.ravel() for axis in np.meshgrid(side, side)], axis=-1)
        self._session, self._canvas = session, canvas
        c, s = math.cos(canvas.yaw_rad), math.sin(canvas.yaw_rad)
        at = VehicleState(canvas.x_m - BEHIND_M * c, canvas.y_m - BEHIND_M * s, canvas.z_m, canvas.yaw_rad, 0.0)
        self._camera = Camera(session, "rgb", LOOK, at)
        self._camera.begin()

    def counted(
        self, looks: list[list[tuple[list[str], BlackWhite]]]
    ) -> tuple[Int[np.ndarray, " p"], Bool[np.ndarray, " p"]]:
        """What each place counts over pairs of looks at black and white in Gray code, and whether all were clear."""
        number, clear = np.zeros(len(self.points), int), np.ones(len(self.points), bool)
        before = np.zeros(len(self.points), bool)
        seen = [self._look(paints) for paints in looks]
        # From the highest bit down, each tells whether the next one is as written.
        for one, other in reversed(list(zip(seen[::2], seen[1::2], strict=True))):
            clear &= np.abs(one - other) > LEAST_LEVELS
            before ^= one > other
            number = 2 * number + before
        return number, clear

    def _look(self, paints: list[tuple[list[str], BlackWhite]]) -> Float[np.ndarray, " p"]:
        """Levels at the places with objects painted black and white."""
        for names, white in paints:
            if names:
                self._session.paint(names, np.repeat(np.where(white, 255, 0).astype(np.uint8)[..., None], 3, axis=-1))
        frame = [self._session.tick() for _ in range(SETTLE_TICKS)][-1]
        image = self._camera.picture(frame)
        grey = levels(image).astype(float).mean(axis=-1)
        at = apply_homography(image_from_world(LOOK, image) @ self._canvas.world_from_canvas, self.points)
        column, row = (
            np.rint(at[:, axis]).astype(int).clip(0, limit)
            for axis, limit in ((0, LOOK.width_px - 1), (1, LOOK.height_px - 1))
        )
        return grey[row, column]


def _fitted(
    session: Session,
    name: str,
    points: Float[np.ndarray, "p 2"],
    places: Float[np.ndarray, "p 2"],
) -> Ground:
    known = np.column_stack([points, np.ones(len(points))])
    fit, keep = np.zeros((3, 2)), np.ones(len(points), bool)
    for _ in range(3):
        fit = np.linalg.lstsq(known[keep], places[keep], rcond=None)[0]
        error = np.abs(known @ fit - places).max(axis=1)
        # A place on the border of two stripes may be told wrong by one.
        keep = error < max(1.0 / 2**BITS, float(np.median(error)) * 2)
    rms = 2**BITS * float(np.sqrt(np.mean((known @ fit - places) ** 2)))
    if rms > WORST_STRIPES or abs(float(np.linalg.det(fit[:2]))) < 1e-9:
        raise SimulatorError(
            f"the texture of {name} is repeated or bent under the canvas: places are {rms:.1f} stripes off a plane, "
            f"expected at most {WORST_STRIPES}, on the CARLA server at {session.where}; {ELSE}"
        )
    return Ground(name, fit.T, rms)


def _check_share(session: Session, valid: Bool[np.ndarray, " p"], what: str) -> None:
    if float(valid.mean()) < LEAST_SHARE:
        raise SimulatorError(
            f"{what} on the CARLA server at {session.where} (seen on {valid.mean():.0%} of the canvas, expected at "
            f"least {LEAST_SHARE:.0%}); {ELSE}"
        )


def _bit(numbers: Int[np.ndarray, " n"], bit: int) -> Bool[np.ndarray, " n"]:
    """One bit of numbers in Gray code."""
    return ((numbers ^ (numbers >> 1)) >> bit & 1).astype(bool)


def _flat(white: bool) -> BlackWhite:
    return np.full((8, 8), white)
