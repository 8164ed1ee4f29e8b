"""The canvas' pixels in short runs with a bounding box each, so that figures skip the runs they do not touch."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from roadproof.coverage import MIN_VARIANCE, Footprints

RUN = 8
"""Pixels in a run: more would lie further from the edge that crosses the run, fewer would make more runs to test."""

_SLACK_PX = 1e-2  # far above the rounding of float32 on a canvas of 400 px, far below a footprint


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """P pixels as N runs of `RUN`; the last is filled up with copies of the last pixel, which nothing is painted on.

    Args:
        features: of the footprints, see `Footprints`.
        centre: middle x, middle y and 1 of each run's box on the canvas, which holds its footprints, px.
        reach: half the width and height of the box, px.
        clean: see `CanvasView`; p = N · RUN.
        gain: see `CanvasView`.
        bias: see `CanvasView`.
    """

    features: Float[Tensor, "6 n run"]
    centre: Float[Tensor, "3 n"]
    reach: Float[Tensor, "2 n"]
    clean: Float[Tensor, "3 p"]
    gain: Float[Tensor, "3 p"]
    bias: Float[Tensor, "3 p"]

    @staticmethod
    def of(
        footprints: Footprints, clean: Float[Tensor, "p 3"], gain: Float[Tensor, "p 3"], bias: Float[Tensor, "p 3"]
    ) -> Runs:
        """Runs of pixels in their order."""
        missing = -len(footprints) % RUN
        last = footprints.features[:, -1:].expand(-1, missing)
        features = torch.cat([footprints.features, last], 1).view(6, -1, RUN)
        middle = features[:2]
        half = features[[3, 5]].clamp_min(MIN_VARIANCE).sqrt() + _SLACK_PX
        low, high = (middle - half).amin(-1), (middle + half).amax(-1)
        centre = torch.cat([(low + high) / 2, torch.ones_like(low[:1])])
        planes = [torch.nn.functional.pad(part.T, (0, missing)) for part in (clean, gain, bias)]
        return Runs(features, centre, (high - low) / 2, *planes)

    def __len__(self) -> int:
        return self.features.shape[1]

    def part(self, runs: slice) -> Runs:
        """Some of the runs."""
        pixels = slice(runs.start * RUN, runs.stop * RUN)
        planes = (self.clean[:, pixels], self.gain[:, pixels], self.bias[:, pixels])
        return Runs(self.features[:, runs], self.centre[:, runs], self.reach[:, runs], *planes)

    def relation(self, rows: Float[Tensor, "b 6 6"]) -> tuple[Bool[Tensor, "b n"], Bool[Tensor, "b n"]]:
        """Which runs lie wholly inside each figure, and which may be crossed by its edges.

        Args:
            rows: that give the distances to the four edges, first those across and along the figure to one side.
        """
        distance = rows[:, :4, :3] @ self.centre
        depth = torch.minimum(distance[:, :2], distance[:, 2:])
        reach = rows[:, :2, :2].abs() @ self.reach
        inside = (depth - reach).amin(1) > 0
        return inside, ((depth + reach).amin(1) > 0).logical_and_(~inside)
