"""The canvas' pixels in short runs with a bounding box each, so that figures skip the runs they do not touch.

Convention:
    The leading dimension v is 1 where all patterns are painted on the same pixels, as in recorded frames, or B where
    each pattern of a batch has pixels of its own, as in pictures from B poses.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from roadproof.coverage import MIN_VARIANCE

RUN = 8
"""Pixels in a run: more would lie further from the edge that crosses the run, fewer would make more runs to test."""

_SLACK_PX = 1e-2  # far above the rounding of float32 on a canvas of 400 px, far below a footprint


@dataclass(frozen=True, slots=True, eq=False)
class Runs:
    """P pixels as N runs of `RUN`; the last is filled up with copies of the last pixel, which nothing is painted on.

    Args:
        features: features of the footprints, see `Footprints`, (v, 6, N, RUN).
        centre: box of each run's footprints on the canvas: middle x and y in canvas px, then 1, (v, 3, N).
        reach: half the width and height of that box, canvas px, (v, 2, N).
        clean: clean colours of the pixels, see `CanvasView`; p = N · RUN.
        gain: A of the pixels, see `CanvasView`.
        bias: B of the pixels, see `CanvasView`.
    """

    features: Float[Tensor, "v 6 n run"]
    centre: Float[Tensor, "v 3 n"]
    reach: Float[Tensor, "v 2 n"]
    clean: Float[Tensor, "v 3 p"]
    gain: Float[Tensor, "v 3 p"]
    bias: Float[Tensor, "v 3 p"]

    @staticmethod
    def of(
        features: Float[Tensor, "v 6 p"],
        clean: Float[Tensor, "v p 3"],
        gain: Float[Tensor, "v p 3"],
        bias: Float[Tensor, "v p 3"],
    ) -> Runs:
        """Pixels cut into runs in the order in which they stand."""
        missing = -features.shape[2] % RUN
        last = features[..., -1:].expand(-1, -1, missing)
        whole = torch.cat([features, last], 2).view(len(features), 6, -1, RUN)
        middle = whole[:, :2]
        half = whole[:, [3, 5]].clamp_min(MIN_VARIANCE).sqrt() + _SLACK_PX
        low, high = (middle - half).amin(-1), (middle + half).amax(-1)
        centre = torch.cat([(low + high) / 2, torch.ones_like(low[:, :1])], 1)
        planes = [torch.nn.functional.pad(part.mT, (0, missing)) for part in (clean, gain, bias)]
        return Runs(whole, centre, (high - low) / 2, *planes)

    def __len__(self) -> int:
        return self.features.shape[2]

    def part(self, runs: slice) -> Runs:
        """Some of the runs of every view."""
        pixels = slice(runs.start * RUN, runs.stop * RUN)
        planes = (self.clean[..., pixels], self.gain[..., pixels], self.bias[..., pixels])
        return Runs(self.features[:, :, runs], self.centre[..., runs], self.reach[..., runs], *planes)

    def relation(self, rows: Float[Tensor, "b k 6 6"]) -> tuple[Bool[Tensor, "b k n"], Bool[Tensor, "b k n"]]:
        """Which runs lie wholly inside each figure, and which may be crossed by its edges.

        Args:
            rows: rows as `_edge_rows` gives them: the first four yield the distances to the four edges.
        """
        distance = self._lined(rows[..., :4, :3], self.centre)
        depth = torch.minimum(distance[..., :2, :], distance[..., 2:, :])
        reach = self._lined(rows[..., :2, :2].abs(), self.reach)
        inside = (depth - reach).amin(-2) > 0
        return inside, ((depth + reach).amin(-2) > 0).logical_and_(~inside)

    def picked(self, pattern: Int[Tensor, " e"], run: Int[Tensor, " e"]) -> Float[Tensor, "6 c"]:
        """Features of the pixels of some runs, each of one pattern's view, run after run."""
        if len(self.features) == 1:
            return self.features[0].index_select(1, run).flatten(1)
        return self.features[pattern, :, run].permute(1, 0, 2).flatten(1)

    @staticmethod
    def _lined(rows: Float[Tensor, "b k i j"], points: Float[Tensor, "v j n"]) -> Float[Tensor, "b k i n"]:
        """Rows applied to the points of their own view, or of the one there is."""
        flat = rows.flatten(1, 2)
        lined = flat.flatten(0, 1) @ points[0] if len(points) == 1 else flat @ points
        return lined.view(*rows.shape[:3], -1)
