"""The published measure: rectangles by masks, gradients by local linearisation, differences summed over frames."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.groups import Group, Points, Values, divergence
from roadproof.attacks.surrogate import Surrogate
from roadproof.compositing.published import AntialiasedView, MaskedView, pasted, view_canvas_published
from roadproof.controllers import Controller
from roadproof.patterns import visibilities
from roadproof.recordings import RecordingSet
from roadproof.search_space import SearchSpace

MASKS = ("binary", "antialiased")


class PublishedMeasure:
    """The divergence δ as published: a sum over frames, for every group.

    Each shape parameter θ lies between neighbours θ⁻ ≤ θ ≤ θ⁺ of a grid; a frame is taken to be linear between its
    renderings at both, all other parameters as they are.

    Args:
        recordings: calibrated recordings of the drives.
        controller: the controller that is attacked; it computes on `device`.
        groups: groups of drives, each attacked together with patterns of its own.
        masks: "binary" as the released code has them, "antialiased" as the paper's text says.
        device: torch device on which frames are composited.

    Raises:
        ControllerError, RecordingError: for the reasons that `Surrogate` names.

    References:
        "Computing Adversarial Perturbations" of the paper, eqs. sgrad and cgrad.
    """

    def __init__(
        self,
        recordings: RecordingSet,
        controller: Controller,
        groups: Sequence[Group],
        *,
        masks: str = "binary",
        device: torch.device | str = "cpu",
    ) -> None:
        self._exact = Surrogate(recordings, controller, groups, device=device)
        self.groups, self.controller = self._exact.groups, controller
        self.device = self._exact.device
        self.frames_evaluated = 0
        self._masks = masks
        self.grid = 1.0
        self._views: dict[bool, list[MaskedView]] = {}

    def on_grid(self, grid: float) -> PublishedMeasure:
        """The published measure, linearised between parameter values `grid` px or degrees apart."""
        other = copy.copy(self)
        other.grid, other.frames_evaluated = grid, 0
        return other

    def thinned(self, every: int) -> Surrogate:
        """The surrogate on every n-th frame of each drive."""
        return self._exact.thinned(every)

    def open_loop(self) -> Surrogate:
        """The surrogate, which has exact gradients of the steering shift."""
        return self._exact

    def values(self, space: SearchSpace, unit: Points) -> Values:
        """δ at R points per group of the published search space, (G, R)."""
        with torch.no_grad():
            rows = [[self._shown(space, group, point)[0] for point in points] for group, points in enumerate(unit)]
        return torch.stack([torch.stack(row) for row in rows])

    def values_and_gradients(self, space: SearchSpace, unit: Points) -> tuple[Values, Points]:
        """δ and the paper's approximation of its gradient, one point after another."""
        values, gradients = unit.new_empty(unit.shape[:2]), torch.empty_like(unit)
        for group, points in enumerate(unit):
            for start, point in enumerate(points):
                values[group, start], gradients[group, start] = self._climbed(space, group, point)
        return values, gradients

    def readings(self, space: SearchSpace, unit: Points) -> tuple[Values, None]:
        """The mean steering shift per frame; None for the deviation, which this measure does not know."""
        lengths = unit.new_tensor([sum(lengths) for lengths in self._exact.lengths])
        return self.values(space, unit) / lengths[:, None], None

    def fingerprint(self) -> str:
        """A digest that tells this measure from every other."""
        return f"published {self._masks} {self._exact.fingerprint()}"

    def _shown(
        self, space: SearchSpace, group: int, point: Float[Tensor, "k n"]
    ) -> tuple[Float[Tensor, ""], MaskedView, Tensor, Tensor, Tensor]:
        """δ of one point, its view, masks and colours, and the pixels that the controller saw."""
        exact, view = self._exact, self._view(group, coloured=space.colour)
        pattern = space.pattern(point.detach())
        masks, colours = view.masks(pattern.boxes), pattern.colours.requires_grad_()
        pixels = view.pixels(visibilities(masks), colours)
        frames = pasted(view, pixels).permute(0, 3, 1, 2)
        self.frames_evaluated += len(frames)
        shift = exact.steer_of(frames, group) - exact.clean_steer[group]
        value = divergence(shift, exact.lengths[group], exact.groups[group].direction) * len(shift)
        return value, view, masks, colours, pixels

    def _climbed(self, space: SearchSpace, group: int, point: Float[Tensor, "k n"]) -> tuple[Tensor, Tensor]:
        """δ of one point, and the paper's approximation of its gradient."""
        value, view, masks, colours, pixels = self._shown(space, group, point)
        on_pixels, on_colours = torch.autograd.grad(value, (pixels, colours))
        with torch.no_grad():
            shape = self._linearised(space, point, view, masks, colours, on_pixels)
        darkest, brightest = space.albedo
        return value.detach(), torch.cat([shape, on_colours * (brightest - darkest)], -1)[:, : point.shape[1]]

    def _linearised(
        self, space: SearchSpace, point: Tensor, view: MaskedView, masks: Tensor, colours: Tensor, on_pixels: Tensor
    ) -> Float[Tensor, "k s"]:
        """∂δ/∂(shape parameters) of the unit cube: 8 K renderings, in each of which one figure differs."""
        count = len(space.shape_ranges)
        spans = point.new_tensor(space.shape_ranges)
        gradients = point.new_zeros(len(point), count)
        for k in range(len(point)):
            natural = point[k, :count] * spans
            low = ((natural / self.grid).floor().clamp_max((spans / self.grid) - 1) * self.grid).clamp_min(0.0)
            ends = point.repeat(2 * count, 1, 1)
            for j in range(count):
                ends[2 * j, k, j], ends[2 * j + 1, k, j] = low[j] / spans[j], (low[j] + self.grid) / spans[j]
            # Elsewhere the two renderings are the same.
            for j, (changed, pair) in enumerate(view.changes(space.pattern(ends).boxes[:, k].view(count, 2, 5))):
                moved = masks[:, changed].repeat(2, 1, 1)
                moved[:, k] = pair
                below, above = view.pixels(visibilities(moved), colours, changed)
                gradients[k, j] = ((above - below) * on_pixels[changed]).sum() / self.grid * spans[j]
        return gradients

    def _view(self, group: int, *, coloured: bool) -> MaskedView:
        if coloured not in self._views:
            self._views[coloured] = self._made(coloured=coloured)
        return self._views[coloured][group]

    def _made(self, *, coloured: bool) -> list[MaskedView]:
        exact = self._exact
        if self._masks == "antialiased":
            return [AntialiasedView(view) for view in exact.views]
        colour = exact.recordings.colour if coloured else None  # the code draws black without its colour model
        return [
            view_canvas_published(
                np.concatenate([drive.frames for drive in members]),
                np.concatenate([drive.image_from_canvas for drive in members]),
                exact.recordings.view,
                colour,
                camera=exact.recordings.camera,
                device=self.device,
            )
            for members in (group.select(exact.recordings) for group in self.groups)
        ]
