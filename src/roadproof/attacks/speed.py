"""How a pattern changes the car's speed in the recorded world: the measure of a search in m/s, with gradients.

Patterns × starts are driven side by side (`attacks.closed_loop`), in each weather that was recorded. The value of a
pattern for "faster" is the mean, over weathers, starts and the instants at which the canvas is in view, of

    v − v̄

with v the car's speed and v̄ that of the drive over the bare road from the same start, in the recorded world too, at the
same instant; for "slower" it is the negative of that. So it is how far the car comes, or stays behind, divided by the
time of the passage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.closed_loop import ClosedLoopMeasure
from roadproof.attacks.groups import SPEEDS, Direction, Group, Values, require_directions, to_side
from roadproof.compositing.variation import Looks
from roadproof.controllers import Controller, PedalController
from roadproof.errors import ControllerError
from roadproof.patterns import Pattern
from roadproof.recorded.world import RecordedWorld, Rolled


class SpeedMeasure(ClosedLoopMeasure):
    """Predicted change of the speed by patterns in a recorded world, for every group at once.

    Its groups are "slower", "faster" or "all", whichever the car gives way to; its arguments and errors are those of
    `ClosedLoopMeasure`.
    """

    def steered(self, groups: Sequence[Group]) -> tuple[Group, ...]:
        """All drives, steered to either side: how far paint that changes the speed also turns the wheel."""
        require_directions(groups, SPEEDS, "speed change")
        return tuple(replace(group, direction=Direction.EITHER) for group in groups)

    def told(self) -> tuple[object, ...]:
        """What tells this measure from others on the same drives: the steering shift has other groups."""
        return *super().told(), [str(group.direction) for group in self.groups]

    def open_loop(self) -> SpeedMeasure:
        """The measure itself: no controller holds a speed so well that a search has to begin elsewhere."""
        return self

    def read(self, world: RecordedWorld, rolled: Rolled) -> Float[Tensor, " r"]:
        """The mean change of the speed in each drive, m/s, positive where the car is faster."""
        return self.changed(world, rolled, lambda drives: drives.speed_mps).mean(1)

    def predict(self, world: RecordedWorld, patterns: Pattern, looks: Looks | None) -> Float[np.ndarray, "r s"]:
        """The mean change of the speed, m/s, negative where the car is slower, of R patterns in each of S drives."""
        return self.predictions(world, patterns, looks).speed_change_mps

    def rank(self, predicted: Float[Tensor, "g r s"]) -> Values:
        """The least change over small errors in each group's direction, m/s."""
        sides = [to_side(part, group.direction) for group, part in zip(self.groups, predicted, strict=True)]
        return torch.stack(sides).amin(-1)


def require_pedals(controller: Controller) -> None:
    """Refuse a controller whose speed in the recorded world is not its own.

    There a controller that only steers is given the pedals that bring it to the clean drive's speed, whatever it sees.

    Raises:
        ControllerError: the controller has no batched `controls`.
    """
    if not isinstance(controller, PedalController):
        raise ControllerError(
            "the controller only steers, so in recordings it has the clean drive's speed whatever is painted; give it "
            "controls (roadproof.controllers.PedalController), or search the deviation"
        )
