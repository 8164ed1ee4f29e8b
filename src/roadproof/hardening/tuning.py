"""Fine-tuning a controller on painted pictures: it learns to answer as it did where nothing was painted.

The teacher is the controller before. Every batch has pictures of one street, most of them painted, and pictures of
drives through the town, half of them with rectangles pasted on the road; the target is what the teacher answers to the
same picture without paint, and far aside a steering that returns. On what stays bare this is distillation: clean
driving stays. Some patterns are found ones, some random, and most climb a few steps against the controller as it is
now, so that it does not learn a handful of patterns by heart.

The controller is tuned in eval mode: dropout is off, and the statistics of batch normalisation stay as they were, as
all buffers do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias, cast

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from roadproof.attacks.checkpoint import Checkpoint
from roadproof.controllers import Controller
from roadproof.controllers.asking import next_controls_of
from roadproof.controllers.conditional import ConditionalNetwork
from roadproof.controllers.precision import multiplies_bfloat16
from roadproof.errors import TrainingError
from roadproof.foreign import call
from roadproof.hardening.views import Street, Views
from roadproof.search_space import SearchSpace
from roadproof.training.dataset import Dataset
from roadproof.training.pasting import PastedPaint

PEDALS = 0.3
"""What throttle and brake count in the loss, against 1 for steering."""


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


TrainingStep: TypeAlias = Callable[[nn.Module, TuningBatch], Tensor]
"""The loss of a batch, differentiable in the controller's parameters; one of the user's own, or `training_step`."""

OnStep: TypeAlias = Callable[[int, float], object]
"""Called with the step and the mean loss since the call before."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Tuning:
    """How a controller is fine-tuned in each round.

    Args:
        steps: how many batches the controller learns from.
        batch: how many pictures there are in a batch.
        learning_rate: AdamW's largest; it rises over the first steps and falls along a cosine to almost nothing.
        bare: share of the street's pictures that stay without paint.
        found: share of the painted patterns that attacks found; the others are random.
        climbs: how many steps a pattern climbs against the controller before it is painted.
        climb: length of each climbing step, in units of each parameter's range.

    Raises:
        TrainingError: a number is out of range.
    """

    steps: int = 2000
    batch: int = 48
    learning_rate: float = 1e-3
    bare: float = 0.25
    found: float = 0.5
    climbs: int = 8
    climb: float = 0.1

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch < 4 or not self.learning_rate > 0 or self.climbs < 0 or not self.climb >= 0:
            raise TrainingError(
                f"tuning of {self.steps} steps of {self.batch} pictures at rate {self.learning_rate:g}, {self.climbs} "
                f"climbs of {self.climb:g}; expected 1 or more, 4 or more, above 0, and nothing below 0"
            )
        for name in ("bare", "found"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise TrainingError(f"{name} is {getattr(self, name)}, expected a share in [0, 1]")

    @property
    def pictures(self) -> int:
        """How many pictures the controller sees in all, those of climbing patterns included."""
        return self.steps * self.batch * (2 + self.climbs) // 2

    def rate(self, step: int) -> float:
        """The learning rate of a step."""
        rising = max(1.0, 0.04 * self.steps)
        falling = 0.005 + 0.995 * 0.5 * (1.0 + math.cos(math.pi * step / self.steps))
        return self.learning_rate * min((step + 1) / rising, 1.0) * falling


def answers(
    controller: Controller, frames: Float[Tensor, "b 3 h w"], speed_mps: Float[Tensor, " b"], command: Int[Tensor, " b"]
) -> Float[Tensor, "b c"]:
    """Steer, throttle and brake where a controller says them for batches, else steer alone.

    Those of a conditional network are its linear ones: the rules of its agent have no gradient where they cut. A
    temporal controller is asked about frames as the first ones of a drive.

    Raises:
        ControllerError: the controller raises, or answers wrongly.
    """
    with _mixed(frames.device):
        if isinstance(controller, ConditionalNetwork):
            return controller(frames, speed_mps, command).controls.float()
        return next_controls_of(controller, None, frames, speed_mps, command, 0.0)[0].float()


def training_step(model: nn.Module, batch: TuningBatch) -> Float[Tensor, ""]:
    """Huber's loss of steering, and of the pedals where the controller answers with them."""
    answer = answers(cast("Controller", model), batch.frames, batch.speed_mps, batch.command)
    each = functional.smooth_l1_loss(answer, batch.target, beta=0.01, reduction="none").mean(0)
    return each[0] + PEDALS * each[1:].sum()


def tune(
    network: nn.Module,
    teacher: Controller,
    streets: Sequence[Street],
    space: SearchSpace,
    found: Float[Tensor, "p k n"],
    town: Dataset | None,
    tuning: Tuning,
    *,
    seed: int,
    device: torch.device | str = "cpu",
    step: TrainingStep = training_step,
    checkpoint: Path | None = None,
    on_step: OnStep = lambda _step, _loss: None,
) -> None:
    """Fine-tune a controller in place.

    Args:
        network: a controller whose parameters want gradients, on `device`.
        teacher: the controller before, on `device`.
        streets: the streets that pictures are drawn from, in turn; each already has ways (`Street.add_ways`).
        space: the search space of the patterns.
        found: patterns that attacks found, as points of the search space.
        town: frames of clean drives through the town, learnt from besides; None for none.
        tuning: how many batches there are, and what they are made of.
        seed: the seed of everything drawn.
        device: the torch device on which the controller learns.
        step: the function that gives the loss of a batch.
        checkpoint: the file that keeps an interrupted tuning, which goes on from there; None for none.
        on_step: called at every tenth step and at the last with the step and the mean loss since the call before.

    Raises:
        TrainingError: the training step gives anything but one finite number with a gradient.
        ControllerError: a controller or the training step raises, or a controller answers wrongly.
    """
    place = torch.device(device)
    # Convolutions by channels-last pictures run 1.3 times as fast.
    network.to(device=place, memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
    parameters = [each for each in network.parameters() if each.requires_grad]
    optimiser = torch.optim.AdamW(parameters, tuning.learning_rate, weight_decay=0.0)
    pictures = _Pictures(space, found.to(device), tuning, teacher, cast("Controller", network))
    count = tuning.batch if town is None else tuning.batch // 2
    paste, weights, total = PastedPaint(0.5), None if town is None else town.weights(), 0.0
    begun = 0 if checkpoint is None else _resume(parameters, optimiser, checkpoint)
    for number in range(begun, tuning.steps):
        draw = torch.Generator().manual_seed(seed * 1_000_003 + number)
        parts = [pictures.of_street(streets[number % len(streets)], count, draw)]
        if town is not None and weights is not None:
            seen = town.batch(torch.multinomial(weights, count, replacement=True, generator=draw), device)
            with torch.no_grad():
                target = answers(teacher, seen.frames, seen.speed_mps, seen.command)
            parts.append(TuningBatch(paste(seen.frames, draw), seen.speed_mps, seen.command, target))
        batch = TuningBatch(*(torch.cat(columns) for columns in zip(*parts, strict=True)))
        for group in optimiser.param_groups:
            group["lr"] = tuning.rate(number)
        with _mixed(place):
            loss = call("the training step", step, network, batch)
        loss = _checked(loss, number)
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, 5.0)
        optimiser.step()
        total += float(loss.detach())
        if (number + 1) % 10 == 0 or number + 1 == tuning.steps:
            if checkpoint is not None:
                _keep(parameters, optimiser, checkpoint, number + 1)
            on_step(number + 1, total / (number % 10 + 1))
            total = 0.0


def _keep(parameters: Sequence[nn.Parameter], optimiser: torch.optim.AdamW, path: Path, steps: int) -> None:
    """Keep the parameters and AdamW's moments after so many steps."""
    kept = {"steps": torch.tensor(steps)}
    for k, each in enumerate(parameters):
        kept |= {f"{k}.value": each} | {f"{k}.{name}": moment for name, moment in optimiser.state[each].items()}
    Checkpoint(path, "").save(kept)


def _resume(parameters: Sequence[nn.Parameter], optimiser: torch.optim.AdamW, path: Path) -> int:
    """Put back what a file keeps, where there is one that is whole; the number of steps done."""
    kept = Checkpoint(path, "").load(parameters[0].device)
    if kept is None:
        return 0
    for k, each in enumerate(parameters):
        own = {name.partition(".")[2]: value for name, value in kept.items() if name.startswith(f"{k}.")}
        each.data.copy_(own.pop("value"))
        # A parameter that had no gradient has no moments.
        if own:
            optimiser.state[each] = own
    return int(kept["steps"])


@dataclass(frozen=True, slots=True, eq=False)
class _Pictures:
    """Draws pictures of streets, and patterns on them, which it makes worse for the controller that learns."""

    space: SearchSpace
    found: Float[Tensor, "p k n"]
    tuning: Tuning
    teacher: Controller
    network: Controller

    def of_street(self, street: Street, count: int, draw: torch.Generator) -> TuningBatch:
        """Pictures of a street, most of them painted."""
        views = street.draw(count, draw)
        with torch.no_grad():
            target = answers(self.teacher, views.frames, views.speed_mps, views.command)
            target[:, 0] = street.returning(views.place, target[:, 0])
        unit = self._climbed(self._drawn(len(views.frames), draw), views, target[:, 0])
        bare = (torch.rand(len(unit), generator=draw) < self.tuning.bare).to(unit.device)
        with torch.no_grad():
            painted = views.painted(self.space.pattern(unit))
        frames = torch.where(bare[:, None, None, None], views.frames, painted)
        return TuningBatch(frames, views.speed_mps, views.command, target)

    def _drawn(self, count: int, generator: torch.Generator) -> Float[Tensor, "b k n"]:
        """Points of the search space: some found ones, slightly moved, some random ones."""
        unit = self.space.random((count,), generator).to(self.found)
        known = torch.rand(count, generator=generator) < (self.tuning.found if len(self.found) else 0.0)
        moved = 0.02 * torch.randn(unit.shape, generator=generator)
        if bool(known.any()):
            picked = torch.randint(len(self.found), (count,), generator=generator)
            near = self.space.project(self.found[picked.to(unit.device)] + moved.to(unit))
            unit = torch.where(known.to(unit.device)[:, None, None], near, unit)
        return unit

    def _climbed(
        self, unit: Float[Tensor, "b k n"], views: Views, target: Float[Tensor, " b"]
    ) -> Float[Tensor, "b k n"]:
        """The same, some steps towards where the controller's steering is further from its target."""
        if views.canvas is None:
            return unit
        for _ in range(self.tuning.climbs):
            leaf = unit.detach().requires_grad_()
            frames = views.painted(self.space.pattern(leaf))
            steer = answers(self.network, frames, views.speed_mps, views.command)[:, 0]
            (gradient,) = torch.autograd.grad((steer - target).abs().sum(), leaf)
            unit = self.space.project(leaf.detach() + self.tuning.climb * gradient.sign())
        return unit


def _mixed(place: torch.device) -> torch.autocast:
    """For networks alone: geometry and colours need all their digits."""
    return torch.autocast(place.type, torch.bfloat16, enabled=multiplies_bfloat16(place))


def _checked(loss: object, number: int) -> Tensor:
    """The loss, where it is one."""
    if not isinstance(loss, Tensor) or loss.numel() != 1 or not loss.requires_grad:
        told = f"a tensor of shape {tuple(loss.shape)}" if isinstance(loss, Tensor) else f"a {type(loss).__name__}"
        raise TrainingError(f"the training step gave {told}, expected one number with a gradient to the parameters")
    if not bool(loss.isfinite().all()):
        raise TrainingError(
            f"the loss is {loss.item()} at step {number + 1}; lower the learning rate, or mend the step"
        )
    return loss.reshape(())
