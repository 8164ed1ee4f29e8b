"""Sky, haze and rain as meshes around the eye."""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import UInt8

from roadproof.simulators.town.meshes import Mesh, MeshBuilder, lofted
from roadproof.simulators.town.shading import rgba
from roadproof.simulators.town.weather import Sky

SKY_M = 640.0
HAZE_TOP_M = 19.0


def dome() -> Mesh:
    """The sky around the eye: azimuth and elevation are the texture's coordinates."""
    around, up = 24, 6
    azimuth = np.arange(around + 1) / around * 2 * math.pi
    elevation = np.concatenate([[-0.06], np.linspace(0, math.pi / 2, up)])
    a, e = np.meshgrid(azimuth, elevation)
    points = SKY_M * np.stack([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)], axis=-1).reshape(-1, 3)
    uv = np.stack([a / (2 * math.pi), 0.002 + 0.996 * np.clip(e, 0, None) / (math.pi / 2)], axis=-1).reshape(-1, 2)
    n = len(points)
    return Mesh(points.round(4), np.zeros((n, 3)), uv.round(5), np.ones((n, 3)), lofted(up + 1, around))


def haze_cards(sky: Sky, tangent: float, eye_m: float) -> list[tuple[Mesh, UInt8[np.ndarray, "n 4"]]]:
    """Translucent cards across the view, the farthest first.

    Each card's foot fades out, so that on the ground the haze grows steadily from one card to the next.
    """
    nearest = min(40.0, max(4.0, 0.11 / sky.density_per_m))
    distances = [nearest]
    while distances[-1] < 260.0:
        distances.append(max(1.6 * distances[-1], distances[-1] + 0.07 / sky.density_per_m))
    cards: list[tuple[Mesh, UInt8[np.ndarray, "n 4"]]] = []
    for d, beyond in reversed(list(zip(distances, [*distances[1:], 1.5 * distances[-1]], strict=True))):
        strength = 1 - math.exp(-sky.density_per_m * (beyond - d if d > nearest else beyond))
        x = tangent * d
        foot, shoulder, top = -eye_m, -eye_m + eye_m * (1 - d / beyond), min(0.8 * d, HAZE_TOP_M)
        points = np.array([(s * x, d, z) for z in (foot, shoulder, top) for s in (-1, 1)], float)
        triangles = np.array([[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]])
        mesh = Mesh(points.round(4), np.zeros((6, 3)), np.zeros((6, 2)), np.ones((6, 3)), triangles)
        colours = np.tile(rgba(np.array([sky.haze]), strength), (6, 1))
        colours[:2, 3] = 0
        cards.append((mesh, colours))
    return cards


def rain_card(tangent: float, variant: int) -> Mesh:
    """A card right before the eye that fills the view."""
    d, rng = 1.0, np.random.default_rng(70 + variant)
    x = tangent * d
    builder = MeshBuilder()
    corners = np.array([(-x, d, -x), (x, d, -x), (x, d, x), (-x, d, x)])
    builder.quad(corners, np.array([[0.0, 0], [2.0, 0], [2.0, 2.0], [0, 2.0]]) + rng.random(2))
    return builder.build()
