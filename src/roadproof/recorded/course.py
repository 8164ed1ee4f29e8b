"""The clean drive as a line that other drives are compared with, and the bare road's law of steering along it.

    symbol    meaning                                                                  unit
    s         arclength along the clean path                                           m
    d         offset from it, positive to the right                                    m
    e         heading error, positive to the left                                      rad

Near the clean drive a controller answers to the bare road with about

    u = u_clean(s) + p d + q e + r d |d|

fitted to its answers to the recorded frames. The law stands for the picture where there is none, past the last recorded
frame; p and q alone stand for what the picture would say of a small change of pose when gradients are taken.
"""

from __future__ import annotations

import math
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.driving.deviation import passage
from roadproof.errors import CanvasNotReachedError, RecordingError
from roadproof.geometry import CanvasPlacement
from roadproof.recorded.nearest import Poses
from roadproof.recorded.vehicle import curvatures
from roadproof.recordings import Track

_FAR_M = 4.0
_LONGEST_GAP_S = 0.5


class Place(NamedTuple):
    """Where R cars are beside the clean path.

    Args:
        s_m: arclength s along the clean path, metres, (R,).
        right_m: offset d from the clean path, metres, right positive, (R,); differentiable in the pose.
        turned_rad: heading error e, radians, left positive, (R,); differentiable in the pose.
    """

    s_m: Float[Tensor, " r"]
    right_m: Float[Tensor, " r"]
    turned_rad: Float[Tensor, " r"]


class Course:
    """The clean drive as a line, with the part of it from which the canvas is in view.

    Args:
        track: track of the clean drive: its poses and controls.
        canvas: place of the canvas in the world.
        shown: number of the step of the first recorded frame; there is no picture before it.
        device: torch device on which cars are compared with the path.

    Raises:
        RecordingError: the drive is too short, does not move, is not known all the way to the canvas' end, or its first
            recorded frame lies beyond that.
    """

    def __init__(
        self, track: Track, canvas: CanvasPlacement, shown: int, *, device: torch.device | str = "cpu"
    ) -> None:
        # A log may lose a step; in longer gaps the way may bend.
        track = track.filled(_LONGEST_GAP_S)
        begin = int(track.rows(np.array([shown]))[0])
        rows = next(part for part in track.stretches() if begin < part.stop)
        seen = passage(np.stack([track.x_m, track.y_m], 1), canvas)
        if seen.stop > rows.stop:
            last, on = track.step[rows.stop - 1 : rows.stop + 1]
            raise RecordingError(
                f"the clean drive's track lacks steps {last + 1} to {on - 1}, between its first frame and the canvas' "
                f"end; expected gaps of at most {_LONGEST_GAP_S:g} s there; add them, or record it again"
            )
        if rows.stop - rows.start < 3:
            raise RecordingError("the clean drive has fewer than three steps that follow each other; record more of it")
        x, y = track.x_m[rows] - canvas.x_m, track.y_m[rows] - canvas.y_m
        moved = np.hypot(np.diff(x), np.diff(y))
        if moved.sum() < 1.0:
            raise CanvasNotReachedError("the clean drive moves less than a metre past the canvas; check its track")
        seen = slice(max(seen.start - rows.start, 0), seen.stop - rows.start)
        kappa = curvatures(track, rows)
        self.seen, self.dt_s = seen, track.dt_s
        self.first = max(seen.start, begin - rows.start)
        self.count = seen.stop - self.first
        if self.count < 1:
            raise RecordingError(
                f"the clean drive's first frame, of step {shown}, comes after the canvas' end on its track; "
                "check where the set says that its canvas lies"
            )
        self.canvas = canvas

        def on_device(values: Float[np.ndarray, " n"]) -> Float[Tensor, " n"]:
            return torch.tensor(values, dtype=torch.float64, device=device)

        self.arclength_m = on_device(np.concatenate([[0.0], moved.cumsum()]))
        self.poses = Poses(on_device(x), on_device(y), on_device(np.unwrap(track.yaw_rad[rows])))
        self.speed_mps = on_device(track.speed_mps[rows])
        self.steer = on_device(track.steer[rows])
        self.curvature = on_device(np.concatenate([kappa[:1], kappa]))
        self._law = on_device(np.zeros(3))

    def locate(self, poses: Poses) -> Place:
        """The nearest point of the clean path to each car, and the car's offset and heading error there."""
        here, path = poses.detached(), self.poses
        index = ((here.x_m[:, None] - path.x_m).square() + (here.y_m[:, None] - path.y_m).square()).argmin(1)
        x, y, yaw = path.x_m[index], path.y_m[index], path.yaw_rad[index]
        c, s = torch.cos(yaw), torch.sin(yaw)
        dx, dy = poses.x_m - x, poses.y_m - y
        turned = poses.yaw_rad - yaw
        turned = turned - 2 * math.pi * torch.round(turned.detach() / (2 * math.pi))
        return Place(self.arclength_m[index] + (c * dx + s * dy).detach(), s * dx - c * dy, turned)

    def at(self, values: Float[Tensor, " n"], s_m: Float[Tensor, " r"]) -> Float[Tensor, " r"]:
        """Values given at the points of the path, interpolated at arclengths; beyond its ends the end's value holds."""
        high = torch.searchsorted(self.arclength_m, s_m.contiguous(), right=True).clamp(1, len(values) - 1)
        start, end = self.arclength_m[high - 1], self.arclength_m[high]
        share = ((s_m - start) / (end - start).clamp_min(1e-6)).clamp(0.0, 1.0)
        return torch.lerp(values[high - 1], values[high], share)

    def fit_law(self, poses: Poses, answers: Float[Tensor, " n"]) -> None:
        """Fit the law of steering on the bare road to a controller's answers to the recorded frames."""
        place = self.locate(poses)
        d, e = place.right_m, place.turned_rad
        terms = torch.stack([d, e, d * d.abs()], 1)
        weight = torch.eye(3, dtype=d.dtype, device=d.device) * 1e-3 * len(d)
        left = answers.to(d) - self.at(self.steer, place.s_m)
        self._law = cast("Tensor", torch.linalg.solve(terms.mT @ terms + weight, terms.mT @ left))

    def law(self, place: Place) -> Float[Tensor, " r"]:
        """Steering on the bare road at each place, by the fitted law."""
        d = place.right_m.clamp(-_FAR_M, _FAR_M)
        p, q, r = self._law.unbind()
        return self.at(self.steer, place.s_m) + p * d + q * place.turned_rad + r * d * d.abs()

    def feedback(self, place: Place) -> Float[Tensor, " r"]:
        """Zero, with p and q as gradient in the pose, which stands for what the picture would answer to a move."""
        p, q, _ = self._law.unbind()
        d, e = place.right_m, place.turned_rad
        return p * (d - d.detach()) + q * (e - e.detach())
