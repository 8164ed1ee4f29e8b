"""Cars and people as meshes around their own origin: x ahead, y left, on the ground."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from roadproof.simulators.town.meshes import ORIGIN, Mesh, MeshBuilder, Pose, Rgb, lofted

GLASS: Rgb = (0.13, 0.16, 0.19)
SKY_IN_GLASS: Rgb = (0.36, 0.42, 0.48)
RUBBER: Rgb = (0.06, 0.06, 0.065)
STEEL: Rgb = (0.60, 0.61, 0.63)
SKIN: tuple[Rgb, ...] = ((0.78, 0.60, 0.50), (0.56, 0.40, 0.31), (0.66, 0.48, 0.38), (0.86, 0.70, 0.60))
HAIR: tuple[Rgb, ...] = ((0.16, 0.11, 0.08), (0.10, 0.09, 0.09), (0.42, 0.30, 0.18), (0.50, 0.49, 0.48))

PAINTS: tuple[Rgb, ...] = (
    (0.74, 0.75, 0.77), (0.16, 0.17, 0.19), (0.52, 0.10, 0.10), (0.20, 0.30, 0.48),
    (0.90, 0.90, 0.88), (0.42, 0.43, 0.45), (0.24, 0.34, 0.28), (0.70, 0.58, 0.40),
)  # fmt: skip
"""Car colours, as often as on the road: mostly greys."""
CAR_HALF_M = (2.25, 0.93)
"""Half the length and width of the box that stops others at any of these cars."""


class Body(IntEnum):
    """The shape of a car."""

    SEDAN = 0
    HATCHBACK = 1
    VAN = 2


@dataclass(frozen=True, slots=True)
class _Shape:
    """Side view: stations are (x, bottom, belt) of the body and (x, height) of the cabin's corners, metres."""

    body: tuple[tuple[float, float, float], ...]
    cabin: tuple[tuple[float, float], tuple[float, float], tuple[float, float], tuple[float, float]]
    width_m: float
    wheels: tuple[float, float]


_SHAPES = {
    Body.SEDAN: _Shape(
        ((-2.25, 0.42, 0.86), (-2.10, 0.30, 0.96), (-1.30, 0.22, 0.99), (0.0, 0.22, 0.97), (1.05, 0.22, 0.93),
         (1.95, 0.26, 0.80), (2.20, 0.34, 0.70), (2.25, 0.44, 0.62)),
        ((-1.75, 0.96), (-0.85, 1.43), (0.35, 1.45), (1.20, 0.92)), 0.91, (-1.38, 1.42),
    ),
    Body.HATCHBACK: _Shape(
        ((-2.0, 0.42, 0.90), (-1.92, 0.30, 1.00), (-1.20, 0.22, 1.01), (0.0, 0.22, 0.99), (1.05, 0.22, 0.96),
         (1.75, 0.26, 0.84), (1.98, 0.34, 0.72), (2.02, 0.44, 0.62)),
        ((-1.92, 1.00), (-1.50, 1.46), (0.25, 1.50), (1.15, 0.95)), 0.89, (-1.25, 1.30),
    ),
    Body.VAN: _Shape(
        ((-2.25, 0.42, 1.02), (-2.20, 0.30, 1.12), (-1.30, 0.24, 1.13), (0.0, 0.24, 1.12), (1.25, 0.24, 1.08),
         (2.00, 0.28, 0.94), (2.20, 0.36, 0.78), (2.25, 0.46, 0.66)),
        ((-2.20, 1.12), (-2.05, 1.86), (0.75, 1.88), (1.55, 1.04)), 0.95, (-1.40, 1.45),
    ),
}  # fmt: skip


def car(body: Body, paint: Rgb) -> Mesh:
    """A parked or driving car of 4.0 to 4.5 m."""
    shape, builder = _SHAPES[body], MeshBuilder()
    _hull(builder, shape, paint)
    _cabin(builder, shape, paint)
    for x in shape.wheels:
        for side in (-1, 1):
            _wheel(builder, x, side * (shape.width_m + 0.005), side)
    _lamps(builder, shape)
    return builder.build()


def _face(builder: MeshBuilder, corners: np.ndarray, albedo: Rgb | np.ndarray) -> None:
    """A flat face, turned outwards from the middle of the car."""
    outwards = corners.mean(axis=0) - (0.55 * corners[:, 0].mean(), 0.0, 0.75)
    if np.cross(corners[1] - corners[0], corners[2] - corners[0]) @ outwards < 0:
        corners = corners[::-1]
        albedo = albedo[::-1] if isinstance(albedo, np.ndarray) else albedo
    builder.quad(corners, albedo=albedo)


def _hull(builder: MeshBuilder, shape: _Shape, paint: Rgb) -> None:
    """The body below the windows: rings from sill to shoulder, lofted from tail to nose."""
    w = shape.width_m
    rings = np.array(
        [[(x, 0.92 * w, low), (x, w, 0.55 * low + 0.45 * belt), (x, 0.95 * w, belt)] for x, low, belt in shape.body]
    )
    mirror = np.array([1.0, -1, 1])
    sill: Rgb = (0.5 * paint[0], 0.5 * paint[1], 0.5 * paint[2])
    for back, front in itertools.pairwise(rings):
        for side in (np.ones(3), mirror):
            _face(builder, np.array([back[0], front[0], front[1], back[1]]) * side, sill)
            _face(builder, np.array([back[1], front[1], front[2], back[2]]) * side, paint)
        _face(builder, np.array([back[2] * mirror, front[2] * mirror, front[2], back[2]]), paint)
    end_paint: Rgb = (0.86 * paint[0], 0.86 * paint[1], 0.86 * paint[2])
    for end, out in ((rings[0], -0.012), (rings[-1], 0.012)):
        corners = np.array([end[0] * mirror, end[0], end[2], end[2] * mirror])
        _face(builder, corners, end_paint)
        bumper = corners + np.array([out, 0.0, 0.0])
        bumper[2:, 2] = bumper[0, 2] + 0.12
        _face(builder, bumper, (0.12, 0.12, 0.13))


def _cabin(builder: MeshBuilder, shape: _Shape, paint: Rgb) -> None:
    """Windows all round that mirror the sky above, pillars and a roof."""
    (x0, z0), (x1, z1), (x2, z2), (x3, z3) = shape.cabin
    low, high = 0.95 * shape.width_m, (0.74 if z1 < 1.7 else 0.88) * shape.width_m
    base = np.array([(x0, low, z0 - 0.03), (x1, high, z1), (x2, high, z2), (x3, low, z3 - 0.03)])
    mirror = np.array([1.0, -1, 1])
    screen = np.array([GLASS, GLASS, SKY_IN_GLASS, SKY_IN_GLASS])
    for foot, top in ((base[0], base[1]), (base[3], base[2])):
        _face(builder, np.array([foot * mirror, foot, top, top * mirror]), paint)
        # The pane leaves a rim of body colour.
        inner = np.array([[0.88, 0.06], [-0.88, 0.06], [-0.86, 0.93], [0.86, 0.93]])
        pane = np.array([foot * (1 - v) + top * v for _, v in inner]) * np.column_stack(
            [np.ones(4), inner[:, 0] * -1, np.ones(4)]
        )
        _face(builder, pane + np.array([0.014 * np.sign(foot[0] - top[0]), 0.0, 0.014]), screen)
    _face(builder, np.array([base[1] * mirror, base[2] * mirror, base[2], base[1]]) + np.array([0, 0, 0.02]), paint)
    middle = 0.45 * x1 + 0.55 * x2
    for side in (np.ones(3), mirror):
        _face(builder, base * side, paint)
        for begin, end in ((x0, middle - 0.04), (middle + 0.04, x3)):
            corners: list[tuple[float, float, float]] = []
            for x, up in ((begin, 0.10), (end, 0.10), (end, 0.88), (begin, 0.88)):
                left, right = x0 + (x1 - x0) * up + 0.12, x3 + (x2 - x3) * up - 0.12
                corners.append((min(max(x, left), right), low + (high - low) * up + 0.014, z0 + (z1 - z0) * up))
            _face(builder, np.array(corners) * side, screen)


def _wheel(builder: MeshBuilder, x: float, y: float, side: int) -> None:
    angle = np.linspace(0, 2 * math.pi, 13)[:-1]
    for radius, colour, out in ((0.38, (0.03, 0.03, 0.03), 0.002), (0.33, RUBBER, 0.010), (0.20, STEEL, 0.018)):
        circle = np.column_stack(
            [x + radius * np.cos(angle), np.full(12, y + side * out), 0.33 + radius * np.sin(angle)]
        )
        fan = np.array([[0, i, i + 1] for i in range(1, 11)])
        triangles = fan if side < 0 else fan[:, ::-1]
        builder.add(circle, np.array([0.0, side, 0.0]), np.zeros((12, 2)), colour, triangles)


def _lamps(builder: MeshBuilder, shape: _Shape) -> None:
    front, back = shape.body[-2], shape.body[0]
    w = shape.width_m
    tail, z = back[0] - 0.016, back[2]
    x, nose = front[0] + 0.065, front[2]
    for side in (1, -1):
        low, high = sorted((side * 0.48 * w, side * 0.88 * w))
        _panel(builder, (tail, tail), (high, low), (z - 0.20, z - 0.04), (0.66, 0.07, 0.06))
        _panel(builder, (x, x - 0.02), (low, high), (nose - 0.20, nose - 0.06), (0.93, 0.93, 0.89))
    plate = back[0] - 0.02
    _panel(builder, (plate, plate), (0.26, -0.26), (0.56, 0.67), (0.9, 0.9, 0.86))


def _panel(
    builder: MeshBuilder, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], albedo: Rgb
) -> None:
    """A flat face across the car from its lower edge (x[0], z[0]) to its upper one (x[1], z[1])."""
    corners = [(x[0], y[0], z[0]), (x[0], y[1], z[0]), (x[1], y[1], z[1]), (x[1], y[0], z[1])]
    builder.quad(np.array(corners), albedo=albedo)


def person(kind: int, stride: float) -> Mesh:
    """Someone on foot, 1.75 m tall.

    Args:
        kind: a number that picks clothes, skin and hair.
        stride: phase of the step, −1 to 1; 0 has the feet together.
    """
    rng = np.random.default_rng(900 + kind)
    cloth, jeans = rng.uniform(0.18, 0.66), rng.uniform(0.12, 0.32)
    shirt, trousers = cloth + rng.uniform(-0.12, 0.12, 3), jeans + rng.uniform(-0.05, 0.05, 3)
    skin, hair = SKIN[kind % len(SKIN)], HAIR[(kind // 2) % len(HAIR)]
    builder = MeshBuilder()
    for side in (1, -1):
        swing = side * stride
        hip, knee = (0.0, 0.09 * side, 0.86), (0.13 * swing, 0.09 * side, 0.46)
        _limb(builder, hip, knee, 0.095, 0.072, tuple(trousers))
        _limb(builder, knee, (0.27 * swing - 0.04, 0.09 * side, 0.07), 0.072, 0.055, tuple(trousers))
        foot = Pose(0.27 * swing, 0.09 * side)
        builder.box((-0.09, -0.05, 0.0), (0.17, 0.05, 0.09), foot, (0.10, 0.09, 0.09))
        elbow = (-0.12 * swing, 0.27 * side, 1.12)
        _limb(builder, (0.0, 0.23 * side, 1.42), elbow, 0.062, 0.05, tuple(shirt))
        _limb(builder, elbow, (-0.10 * swing + 0.10, 0.25 * side, 0.86), 0.048, 0.035, skin)
    torso = [(0.82, 0.72), (0.95, 0.76), (1.20, 0.86), (1.40, 1.0), (1.47, 0.72), (1.52, 0.32)]
    builder.tube(torso, 0.205, ORIGIN, tuple(shirt), 10)
    head = [(1.48, 0.5), (1.54, 0.52), (1.60, 0.95), (1.67, 1.0), (1.74, 0.8), (1.78, 0.3)]
    builder.tube(head, 0.098, ORIGIN, skin, 8)
    builder.tube([(1.64, 1.0), (1.70, 1.1), (1.76, 0.9), (1.80, 0.45), (1.81, 0.0)], 0.105, Pose(-0.015, 0.0), hair, 8)
    return builder.build()


def _limb(
    builder: MeshBuilder,
    top: tuple[float, float, float],
    bottom: tuple[float, float, float],
    upper: float,
    lower: float,
    albedo: Rgb,
) -> None:
    angle = np.linspace(0, 2 * math.pi, 7)
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(7)])
    points = np.concatenate([circle * lower + bottom, circle * upper + top])
    builder.add(points, np.concatenate([circle, circle]), np.zeros((14, 2)), albedo, lofted(2, 6))
