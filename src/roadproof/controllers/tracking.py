"""From a trajectory to steering: the laws that make a car follow points ahead of it, differentiable in the points.

Notation:
    | name | meaning | shape |
    |---|---|---|
    | path | points to pass, in order, from near to far: metres ahead of and left of the car's middle | b n 2 |
    | curvature | of the arc that the car shall take, 1/m, left positive | b |

    steer = −atan(wheelbase · curvature) / full lock

References:
    Coulter (1992), Implementation of the pure pursuit path tracking algorithm; Kong et al. (2015), Kinematic and
    dynamic vehicle models for autonomous driving control design (the linear model of the bicycle).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.constants import constant
from roadproof.errors import ControllerError

LEAST_M = 0.1
"""Points nearer to each other than this say nothing about a direction."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrackingLaw:
    """What all laws know of the car.

    Args:
        wheelbase_m: distance between the axles, metres, above 0.
        full_lock_rad: angle of the front wheels at steer 1, radians, above 0 and below π/2.

    Raises:
        ControllerError: a number is out of its range.
    """

    wheelbase_m: float = 2.8
    full_lock_rad: float = 0.65

    def __post_init__(self) -> None:
        for name, least, most in self.ranges():
            if not least < (value := getattr(self, name)) < most:
                raise ControllerError(
                    f"{name} of the tracking law is {value}, expected above {least:g}, below {most:g}"
                )

    def ranges(self) -> tuple[tuple[str, float, float], ...]:
        """Name, lower and upper bound of each number."""
        return (("wheelbase_m", 0.0, 100.0), ("full_lock_rad", 0.0, 1.57))

    def curvature(self, path: Float[Tensor, "b n 2"], speed_mps: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
        """Curvature of the arc that leads the car on to the path, 1/m, left positive."""
        raise NotImplementedError

    def steer(self, path: Float[Tensor, "b n 2"], speed_mps: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
        """Steering on to a path, positive to the right, not clipped; differentiable in the path."""
        return -torch.atan(self.wheelbase_m * self.curvature(path, speed_mps)) / self.full_lock_rad


@dataclass(frozen=True, kw_only=True, slots=True)
class PurePursuit(TrackingLaw):
    """The arc from the rear axle through a point of the path: κ = 2 y / d².

    Args:
        sight_s: how far along the path the point lies, in seconds of travel.
        sight_m: the least distance of that point from the rear axle, metres, more than half the wheelbase.
    """

    sight_s: float = 0.75
    sight_m: float = 4.5

    def ranges(self) -> tuple[tuple[str, float, float], ...]:
        """Name, lower and upper bound of each number."""
        # Named: `super()` without arguments does not find its class in dataclasses with slots.
        return (*TrackingLaw.ranges(self), ("sight_s", -1e-9, 100.0), ("sight_m", 0.5 * self.wheelbase_m, 1000.0))

    def curvature(self, path: Float[Tensor, "b n 2"], speed_mps: Float[Tensor, " b"]) -> Float[Tensor, " b"]:
        """Curvature of the arc that leads the car on to the path, 1/m, left positive."""
        rear = constant((-0.5 * self.wheelbase_m, 0.0), path)
        sight = (self.sight_s * speed_mps.to(path.dtype)).clamp_min(self.sight_m) - 0.5 * self.wheelbase_m
        aim = point_along(path, sight) - rear
        return 2.0 * aim[:, 1] / aim.square().sum(1).clamp_min(LEAST_M**2)


@dataclass(frozen=True, kw_only=True, slots=True)
class LinearMPC(TrackingLaw):
    """The first of a few curvatures that together pass the points best: model predictive control of a linear model.

    With curvature κ_j on the j-th of equal pieces of the way ahead, and small angles, y(x) = ∫ (x − s) κ(s) ds. What is
    made small, by normal equations, is Σ w_i (y(x_i) − y_i)² + smooth_m4 Σ (κ_{j+1} − κ_j)², with the weights
    w = exp(−(x / horizon)²): far points matter less.

    Args:
        horizon_m: distance up to which points matter, metres.
        pieces: number of pieces of constant curvature.
        smooth_m4: weight of the change of curvature from piece to piece, m⁴.
    """

    horizon_m: float = 6.0
    pieces: int = 4
    smooth_m4: float = 1.0

    def ranges(self) -> tuple[tuple[str, float, float], ...]:
        """Name, lower and upper bound of each number."""
        return (*TrackingLaw.ranges(self), ("horizon_m", 0.0, 1000.0), ("pieces", 0.0, 33.0), ("smooth_m4", 0.0, 1e9))

    def curvature(self, path: Float[Tensor, "b n 2"], speed_mps: Float[Tensor, " b"]) -> Float[Tensor, " b"]:  # noqa: ARG002
        """Curvature of the arc that leads the car on to the path, 1/m, left positive."""
        x, y = path.double().unbind(2)
        piece = x.amax(1).clamp(LEAST_M, 2.0 * self.horizon_m) / self.pieces
        edges = piece[:, None] * torch.arange(self.pieces + 1, device=x.device)
        beyond = (x[:, :, None] - edges[:, None]).clamp_min(0.0).square()
        bends = 0.5 * (beyond[:, :, :-1] - beyond[:, :, 1:])
        changes = torch.diff(torch.eye(self.pieces, dtype=x.dtype, device=x.device), dim=0)
        # A car that stands has all points where it is: the small term keeps its curvature at 0.
        weighed = bends * torch.exp(-(x / self.horizon_m).square())[:, :, None]
        normal = weighed.mT @ bends + self.smooth_m4 * changes.mT @ changes
        normal = normal + LEAST_M**4 * torch.eye(self.pieces, dtype=x.dtype, device=x.device)
        found = cast("Tensor", torch.linalg.solve(normal, (weighed.mT @ y[:, :, None])[:, :, 0]))
        return found[:, 0].to(path.dtype)


LAWS: dict[str, type[PurePursuit] | type[LinearMPC]] = {"pure-pursuit": PurePursuit, "linear-mpc": LinearMPC}
"""The laws by the name that cards call them."""


def law_name(law: PurePursuit | LinearMPC) -> str:
    """The name that cards call a law."""
    return next(name for name, kind in LAWS.items() if isinstance(law, kind))


def point_along(path: Float[Tensor, "b n 2"], distance_m: Float[Tensor, " b"]) -> Float[Tensor, "b 2"]:
    """The point of each path at a distance along it from the car, (B, 2).

    Args:
        path: points ahead of and left of the car, from near to far, metres.
        distance_m: distance from the car's middle along the path, metres; a path that is shorter goes on in the
            direction of its end as seen from the car.
    """
    points = torch.cat([torch.zeros_like(path[:, :1]), path], 1)
    steps = torch.diff(points, dim=1)
    lengths = lengths_of(steps)
    ends = lengths.cumsum(1)
    piece = torch.searchsorted(ends.detach(), distance_m[:, None].detach()).clamp_max(steps.shape[1] - 1)
    place = piece[:, :, None].expand(-1, 1, 2)
    length = lengths.gather(1, piece)[:, 0]
    left = distance_m - (ends.gather(1, piece)[:, 0] - length)
    share = (left / length).clamp_max(1.0)
    along = points.gather(1, place)[:, 0] + share[:, None] * steps.gather(1, place)[:, 0]
    end = path[:, -1]
    direction = end / lengths_of(end).clamp_min(LEAST_M)[:, None]
    return along + (distance_m - ends[:, -1]).clamp_min(0.0)[:, None] * direction


def lengths_of(steps: Float[Tensor, "*s 2"]) -> Float[Tensor, "*s"]:
    """Lengths of steps in metres, with a finite gradient where a step is none."""
    return (steps.square().sum(-1) + 1e-18).sqrt()
