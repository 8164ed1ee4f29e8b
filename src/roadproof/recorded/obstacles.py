"""What stands beside the road, and what becomes of a car that runs into it.

A car is three circles on its long axis. Where one of them, b ahead of the middle, is inside a box by a depth h, the car
is pushed out along the box's normal n and turned, and while it touches it is slowed by μ:

    P⁺ = P + h/w n,   ψ⁺ = ψ + h l/(w k²),   w = 1 + l²/k²,   l = b (cos ψ n_y − sin ψ n_x)
    v⁺ = min(v, |P⁺ − P₀|/dt) − μ dt          P₀ is where it was a step before

So it slides along a guard rail, and stands before a post. k and μ were fitted to two drives along a rail in the town:
wheels that grip turn a car further than a free body of its size.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.compositing.view import compiles_kernels
from roadproof.datatypes import Obstacle
from roadproof.recorded.vehicle import Motion
from roadproof.traffic.agents import CAR_WIDTH_M

AHEAD_M, RADIUS_M = (-1.3, 0.0, 1.3), CAR_WIDTH_M / 2
"""The circles of an ordinary car: their middles along its axis, and their radius."""

GYRATION_M, SLOWED_MPS2 = 0.75, 3.0
"""The k and μ of the formulas above."""

NEAR_M = 15.0
"""Nothing further from the clean drive can be reached while the canvas is in view."""

_PUSHES = 4


class Obstacles:
    """The obstacles near a path; those that the path itself goes through, as under a bridge, do not count.

    Args:
        obstacles: what stands beside the road.
        path: x, y of the clean drive, metres from the middle of the canvas, (n, 2).
        middle: world x, y of the middle of the canvas, metres.
        device: torch device on which cars are driven.
    """

    def __init__(
        self,
        obstacles: Sequence[Obstacle],
        path: Float[np.ndarray, "n 2"],
        middle: tuple[float, float],
        *,
        device: torch.device | str = "cpu",
    ) -> None:
        rows = [(o.x_m - middle[0], o.y_m - middle[1], o.yaw_rad, o.half_length_m, o.half_width_m) for o in obstacles]
        boxes = torch.tensor(rows, dtype=torch.float64).reshape(-1, 5)
        away = _seen(torch.tensor(path), boxes).away.amin(0)
        self._boxes = boxes[(away > RADIUS_M) & (away < NEAR_M)].to(device)
        self._ahead = torch.tensor(AHEAD_M, dtype=torch.float64, device=device)

    def __len__(self) -> int:
        return len(self._boxes)

    def hold(self, before: Motion, car: Motion, dt_s: float, *, asks: bool = True) -> Motion:
        """Where cars are a step later that would be inside an obstacle; those of the others do not change.

        Args:
            before: cars before the step.
            car: cars after the step, as if there were no obstacles.
            dt_s: seconds per step.
            asks: whether the device is asked if any car touches; else all is computed, to the same end.
        """
        if not len(self):
            return car
        if compiles_kernels(car.x_m.device):
            # Triton may be missing.
            from roadproof.recorded.contact import held

            states = torch.stack([car.x_m, car.y_m, car.yaw_rad, car.speed_mps, before.x_m, before.y_m], 1)
            x, y, yaw, speed = held(states, self._boxes, self._ahead, _rules(dt_s)).unbind(1)
            return car._replace(x_m=x, y_m=y, yaw_rad=yaw, speed_mps=speed)
        return self._pushed(before, car, dt_s, asks=asks)

    def _pushed(self, before: Motion, car: Motion, dt_s: float, *, asks: bool) -> Motion:
        """What `hold` gives, as plain tensor operations."""
        x, y, yaw = car.x_m, car.y_m, car.yaw_rad
        # Most of the time nothing touches: that is asked without gradients, which would cost twice as much.
        here = (each.detach() for each in (x, y, yaw))
        if asks and not (_seen(self._circles(*here), self._boxes).away < RADIUS_M).any():
            return car
        pushed = torch.zeros_like(x)
        for _ in range(_PUSHES):
            away, normal = _distances(self._circles(x, y, yaw), self._boxes)
            depth, deepest = (RADIUS_M - away).flatten(1).max(1)
            if asks and not (depth > 0).any():
                break
            n_x, n_y = normal.flatten(1, 2).gather(1, deepest[:, None, None].expand(-1, 1, 2))[:, 0].unbind(1)
            lever = self._ahead[deepest // len(self)] * (torch.cos(yaw) * n_y - torch.sin(yaw) * n_x)
            push = depth.clamp_min(0.0) / (1 + (lever / GYRATION_M) ** 2)
            x, y, yaw = x + push * n_x, y + push * n_y, yaw + push * lever / GYRATION_M**2
            pushed = pushed + push
        went = ((x - before.x_m).square() + (y - before.y_m).square() + 1e-18).sqrt() / dt_s
        slowed = (went.minimum(car.speed_mps) - SLOWED_MPS2 * dt_s).clamp_min(0.0)
        return car._replace(x_m=x, y_m=y, yaw_rad=yaw, speed_mps=torch.where(pushed > 0, slowed, car.speed_mps))

    def _circles(
        self, x: Float[Tensor, " r"], y: Float[Tensor, " r"], yaw: Float[Tensor, " r"]
    ) -> Float[Tensor, "r 3 2"]:
        """The middles of each car's circles."""
        ahead = self._ahead
        return torch.stack([x[:, None] + ahead * yaw.cos()[:, None], y[:, None] + ahead * yaw.sin()[:, None]], -1)


def _rules(dt_s: float) -> dict[str, float]:
    """The numbers by which `hold` pushes cars."""
    slowed = SLOWED_MPS2 * dt_s
    return {"radius": RADIUS_M, "gyration": GYRATION_M, "slowed": slowed, "dt_s": dt_s, "pushes": _PUSHES}


class _Seen(NamedTuple):
    """Points as they lie before boxes.

    Args:
        place: in the axes of each box, metres, (*p, B, 2).
        past: how far beyond its sides, metres, (*p, B, 2).
        away: distance from it, metres, negative inside, (*p, B).
    """

    place: Float[Tensor, "*p b 2"]
    past: Float[Tensor, "*p b 2"]
    away: Float[Tensor, "*p b"]


def _seen(points: Float[Tensor, "*p 2"], boxes: Float[Tensor, "b 5"]) -> _Seen:
    x, y, yaw, half_length, half_width = boxes.unbind(1)
    c, s = torch.cos(yaw), torch.sin(yaw)
    dx, dy = points[..., None, 0] - x, points[..., None, 1] - y
    place = torch.stack([c * dx + s * dy, c * dy - s * dx], -1)
    past = place.abs() - torch.stack([half_length, half_width], -1)
    outside, inside = past.clamp_min(0.0), past.amax(-1)
    # The small addition keeps the gradient finite inside.
    far = (outside.square().sum(-1) + 1e-18).sqrt()
    return _Seen(place, past, torch.where(inside > 0, far, inside))


def _distances(
    points: Float[Tensor, "*p 2"], boxes: Float[Tensor, "b 5"]
) -> tuple[Float[Tensor, "*p b"], Float[Tensor, "*p b 2"]]:
    """Distance of points from boxes, negative inside, and the unit vectors that point away from them."""
    place, past, away = _seen(points, boxes)
    yaw = boxes[:, 2]
    c, s = torch.cos(yaw), torch.sin(yaw)
    # Inside the nearest side counts.
    side = (past.argmax(-1, keepdim=True) == torch.arange(2, device=points.device)).to(points)
    outward = torch.where((away > 0)[..., None], past.clamp_min(0.0) / away.clamp_min(1e-9)[..., None], side)
    normal = outward * torch.where(place < 0, -1.0, 1.0)
    world = torch.stack([c * normal[..., 0] - s * normal[..., 1], s * normal[..., 0] + c * normal[..., 1]], -1)
    return away, world
