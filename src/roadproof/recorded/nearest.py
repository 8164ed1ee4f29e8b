"""Where cars are on the ground, and which recorded frame shows most of what is seen from there."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from roadproof.errors import RecordingError


class Poses(NamedTuple):
    """Where R cars are on the ground, seen from the middle of the canvas; float64.

    Args:
        x_m: world x from the canvas' middle, metres, (R,).
        y_m: world y from the canvas' middle, metres, (R,).
        yaw_rad: heading, radians, left positive, (R,).
    """

    x_m: Float[Tensor, " r"]
    y_m: Float[Tensor, " r"]
    yaw_rad: Float[Tensor, " r"]

    def picked(self, index: Int[Tensor, " p"]) -> Poses:
        """The poses with the given indices."""
        return Poses(self.x_m[index], self.y_m[index], self.yaw_rad[index])

    def detached(self) -> Poses:
        """The same poses without a gradient."""
        return Poses(self.x_m.detach(), self.y_m.detach(), self.yaw_rad.detach())

    def ground_from_car(self) -> Float[Tensor, "r 3 3"]:
        """The rigid motion from a car's own axes (ahead, left) to the ground, (R, 3, 3)."""
        c, s, o = torch.cos(self.yaw_rad), torch.sin(self.yaw_rad), torch.zeros_like(self.yaw_rad)
        return torch.stack([c, -s, self.x_m, s, c, self.y_m, o, o, o + 1], -1).view(-1, 3, 3)


class Gap(NamedTuple):
    """How far poses are from the recorded poses whose frames show them.

    Args:
        frame: index of the recorded frame, (R,).
        ahead_m: distance along the pose's heading, metres, positive where the pose is further on, (R,).
        left_m: distance across the pose's heading, metres, positive where the pose is further left, (R,).
        turned_rad: heading of the pose minus that of the recorded frame, radians, left positive, (R,).
    """

    frame: Int[Tensor, " r"]
    ahead_m: Float[Tensor, " r"]
    left_m: Float[Tensor, " r"]
    turned_rad: Float[Tensor, " r"]


class Apart(NamedTuple):
    """How far one pose is from another.

    Args:
        ahead_m: distance along its heading, metres, positive where it is further on.
        left_m: distance across its heading, metres, positive where it is further left.
        turned_rad: difference of heading, radians, positive where it is turned to the left.
    """

    ahead_m: float
    left_m: float
    turned_rad: float


NEAREST = Apart(1.0, 0.5, 0.1)
"""Distances and a turn that count alike when a frame is chosen."""

LOOKING_THE_SAME_WAY = Apart(4.0, 2.0, 0.02)
"""The same where a frame is to show what the nearest one does not."""

_FURTHEST_M = 1e4


def nearest(poses: Poses, recorded: Poses, alike: Apart = NEAREST) -> Gap:
    """The recorded pose that is nearest to each pose, when distances and a turn count alike that are so long."""
    dx, dy = poses.x_m[:, None] - recorded.x_m, poses.y_m[:, None] - recorded.y_m
    c, s = torch.cos(poses.yaw_rad)[:, None], torch.sin(poses.yaw_rad)[:, None]
    ahead, left = c * dx + s * dy, c * dy - s * dx
    turned = torch.remainder(poses.yaw_rad[:, None] - recorded.yaw_rad + math.pi, 2 * math.pi) - math.pi
    far = (ahead / alike.ahead_m).square() + (left / alike.left_m).square() + (turned / alike.turned_rad).square()
    index = far.argmin(1)
    at = index[:, None]
    return Gap(index, ahead.gather(1, at)[:, 0], left.gather(1, at)[:, 0], turned.gather(1, at)[:, 0])


def require_on_earth(poses: Poses) -> None:
    """Refuse cars that no picture can be made for, however far off.

    Raises:
        RecordingError: a car is further from the canvas than any drive goes, or nowhere.
    """
    furthest = float(torch.stack(poses.detached()).abs().amax())
    if not furthest < _FURTHEST_M:
        raise RecordingError(
            "a car leaves all bounds in these recordings: the controller's answers and the vehicle that was identified "
            "from the drives do not go together; give drives that steer more, a Vehicle of your own, or a controller "
            "that drives this road"
        )
