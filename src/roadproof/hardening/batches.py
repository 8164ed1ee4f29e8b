"""What a controller is tuned on: batches of bare and painted pictures, with what a teacher answers to the bare ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from roadproof.controllers import Controller
from roadproof.controllers.asking import next_controls_of, steer_of
from roadproof.controllers.conditional import ConditionalNetwork
from roadproof.controllers.precision import mixed_precision
from roadproof.hardening.town import Town
from roadproof.hardening.views import Street, Views
from roadproof.patterns import Pattern
from roadproof.search_space import SearchSpace


class TuningBatch(NamedTuple):
    """What a training step is given.

    Args:
        frames: RGB in [0, 1], painted or bare.
        speed_mps: speed of the car at each picture.
        command: command at each picture, in CARLA's codes.
        target: what the controller should answer: steer alone, or steer, throttle and brake where it answers with them.
    """

    frames: Float[Tensor, "b 3 h w"]
    speed_mps: Float[Tensor, " b"]
    command: Int[Tensor, " b"]
    target: Float[Tensor, "b c"]


def answers(
    controller: Controller, frames: Float[Tensor, "b 3 h w"], speed_mps: Float[Tensor, " b"], command: Int[Tensor, " b"]
) -> Float[Tensor, "b c"]:
    """Steer, throttle and brake where a controller says them for batches, else steer alone; steer is not clipped.

    Those of a conditional network are its linear ones: the rules of its agent have no gradient where they cut. A
    temporal controller is asked about frames as the first ones of a drive.

    Raises:
        ControllerError: the controller raises, or answers wrongly.
    """
    with mixed_precision(frames.device):
        if isinstance(controller, ConditionalNetwork):
            return controller(frames, speed_mps, command).controls.float()
        said = next_controls_of(controller, None, frames, speed_mps, command, 0.0)[0].float()
        cut = said[:, 0].abs() >= 1.0
        if said.shape[1] == 1 or not bool(cut.any()):
            return said
        # Controls have no gradient where steering is cut; what `steer` answers is not.
        steer = steer_of(controller, frames, speed_mps, command).float()
        return torch.cat([torch.where(cut, steer, said[:, 0])[:, None], said[:, 1:]], 1)


class Shown(NamedTuple):
    """Pictures of one place, what should be answered to them, and patterns for those of them that are painted.

    Args:
        batch: all pictures, not painted yet; first those that stay bare.
        views: the pictures to paint.
        unit: the pattern of each of those.
    """

    batch: TuningBatch
    views: Views
    unit: Float[Tensor, "b k n"]

    def painted(self, pattern: Pattern) -> TuningBatch:
        """What is learnt from, differentiable in the patterns."""
        bare = self.batch.frames[: -len(self.unit)]
        return self.batch._replace(frames=torch.cat([bare, self.views.painted(pattern)]))

    def climbed(self, space: SearchSpace, step: float) -> Shown:
        """The same pictures with their patterns a step up their gradient, where they have one.

        A training step of the user's own need not look at the pictures.
        """
        unit = self.unit
        return self if unit.grad is None else self._replace(unit=space.project(unit.detach() + step * unit.grad.sign()))


@dataclass(frozen=True, slots=True, eq=False)
class Pictures:
    """Draws pictures of streets and of drives through the town, and asks the teacher about them.

    Args:
        teacher: the controller whose answers to bare pictures are the targets.
        space: the search space of the patterns.
        found: patterns that attacks found, as points of the search space; on the device of all that is drawn.
        known: share of the painted patterns that are found ones, slightly moved; the others are random.
        bare: share of the pictures that stay without paint.
    """

    teacher: Controller
    space: SearchSpace
    found: Float[Tensor, "p k n"]
    known: float
    bare: float

    def of(self, source: Street | Town, count: int, draw: torch.Generator) -> Shown:
        """Pictures of a street or of the town, most of them to be painted; one at the least."""
        bare = min(round(self.bare * count), count - 1)
        views = source.draw(count - bare, draw)
        drawn = [self._answered(source, source.draw(bare, draw, to_paint=False))] if bare else []
        drawn.append(self._answered(source, views))
        batch = TuningBatch(*(torch.cat(columns) for columns in zip(*drawn, strict=True)))
        return Shown(batch, views, self._drawn(len(views.frames), draw))

    def _answered(self, source: Street | Town, views: Views) -> TuningBatch:
        """Bare pictures with what should be answered to them."""
        with torch.no_grad():
            target = answers(self.teacher, views.frames, views.speed_mps, views.command)
            if isinstance(source, Street) and views.place is not None:
                target[:, 0] = source.returning(views.place, target[:, 0])
        return TuningBatch(views.frames, views.speed_mps, views.command, target)

    def _drawn(self, count: int, generator: torch.Generator) -> Float[Tensor, "b k n"]:
        """Points of the search space: some found ones, slightly moved, some random ones."""
        unit = self.space.random((count,), generator).to(self.found)
        known = torch.rand(count, generator=generator) < (self.known if len(self.found) else 0.0)
        moved = 0.02 * torch.randn(unit.shape, generator=generator)
        if bool(known.any()):
            picked = torch.randint(len(self.found), (count,), generator=generator)
            near = self.space.project(self.found[picked.to(unit.device)] + moved.to(unit))
            unit = torch.where(known.to(unit.device)[:, None, None], near, unit)
        return unit
