"""How far a pattern takes the car aside in the recorded world: the measure of a search in metres, with gradients.

Patterns × starts are driven side by side (`attacks.closed_loop`), in each weather that was recorded. The value of a
pattern for a side is the mean, over weathers, starts and the instants at which the canvas is in view, of

    s tanh(d / s)

with d the offset from the clean path to that side and s some metres: a car that has left the road need not go further.
With a variation d is counted from the drive over the bare road in the same look.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Unpack

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.closed_loop import ClosedLoopMeasure, Rolling
from roadproof.attacks.groups import Group
from roadproof.attacks.surrogate import Surrogate
from roadproof.compositing.variation import Looks
from roadproof.controllers import Controller
from roadproof.patterns import Pattern
from roadproof.recorded.world import RecordedWorld, Rolled
from roadproof.recordings import RecordingSet


class DeviationMeasure(ClosedLoopMeasure):
    """Predicted offset of patterns in a recorded world, for every group at once.

    Args:
        saturation_m: the s of the formula above, metres; the others and the errors are those of `ClosedLoopMeasure`.
    """

    def __init__(
        self,
        recordings: RecordingSet,
        controller: Controller,
        groups: Sequence[Group],
        *,
        saturation_m: float = 3.0,
        **rolling: Unpack[Rolling],
    ) -> None:
        super().__init__(recordings, controller, groups, **rolling)
        self._saturation_m = saturation_m

    def open_loop(self) -> Surrogate:
        """The surrogate: the steering shift on the recorded frames."""
        return self._steering

    def read(self, world: RecordedWorld, rolled: Rolled) -> Float[Tensor, " r"]:
        """The mean offset of each drive, metres, right positive, hardly more than the saturation."""
        right_m = rolled.right_m
        if self.variation is not None:
            # What a look does to the drive over the bare road is not the paint's.
            right_m = self.changed(world, rolled, lambda drives: drives.right_m)
        return (self._saturation_m * torch.tanh(right_m / self._saturation_m)).mean(1)

    def predict(self, world: RecordedWorld, patterns: Pattern, looks: Looks | None) -> Float[np.ndarray, "r s"]:
        """The paper's deviation, metres, 0 or more, of R patterns in each of S drives."""
        return self.predictions(world, patterns, looks).deviation_m

    def told(self) -> tuple[object, ...]:
        """What tells this measure from others on the same drives."""
        return self._starts, self.every, self._saturation_m
