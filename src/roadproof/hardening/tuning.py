"""Fine-tuning a controller on painted pictures: it learns to answer as it did where nothing was painted.

The teacher is the controller before. Every batch has pictures of one street and of drives through the town, most of
them painted; the target is what the teacher answers to the same picture without paint, and far aside a steering that
returns. On what stays bare this is distillation: clean driving stays. Some patterns are found ones, some random; in
every second pass over the streets they are random ones of another family. A batch is learnt from several times in a
row, and each time its patterns climb a step by the gradient of the very loss that the controller has just learnt from:
they cost nothing, and it does not learn a handful of patterns by heart ("free" adversarial training, Shafahi et al.
2019).

The controller is tuned in eval mode: dropout is off, and the statistics of batch normalisation stay as they were, as
all buffers do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from roadproof.attacks.checkpoint import Checkpoint
from roadproof.controllers import Controller
from roadproof.controllers.precision import lay_out, mixed_precision
from roadproof.datatypes import Command
from roadproof.errors import TrainingError
from roadproof.foreign import call
from roadproof.hardening.batches import Pictures, TuningBatch, answers
from roadproof.hardening.town import Town
from roadproof.hardening.views import Street
from roadproof.limits import is_whole
from roadproof.search_space import SearchSpace

_BETAS = (0.9, 0.99)
"""AdamW's. With the usual 0.999 a weight that has hardly had a gradient for hundreds of batches, and then has one in
every repeat of a batch, goes so far that networks have been lost to it."""

_APART = 10.0
"""A network is lost where its loss rises to so many times the highest before, each a mean of ten batches."""

PEDALS = 0.3
"""What throttle and brake count in the loss, against 1 for steering."""

_CURE = "mend the step (in the first tuning the same call then goes on), or lower Tuning.learning_rate elsewhere"

TrainingStep: TypeAlias = Callable[[nn.Module, TuningBatch], Tensor]
"""The loss of a batch, differentiable in the controller's parameters; one of the user's own, or `training_step`."""

OnStep: TypeAlias = Callable[[int, float], object]
"""Called with the step and the mean loss since the call before."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Tuning:
    """How a controller is fine-tuned in each round.

    Args:
        steps: how many batches the controller learns from.
        repeats: how often it learns from each in a row, while the patterns climb.
        batch: how many pictures there are in a batch.
        learning_rate: AdamW's largest; it rises over the first steps and falls along a cosine to almost nothing.
        bare: share of the pictures that stay without paint; one is painted at the least.
        found: share of the patterns that attacks found, where their own space is painted from; the others are random.
        climb: length of a pattern's step between two repeats, in units of each parameter's range.

    Raises:
        TrainingError: a number is out of range.
    """

    steps: int = 1000
    repeats: int = 8
    batch: int = 48
    learning_rate: float = 1e-3
    bare: float = 0.4
    found: float = 0.5
    climb: float = 0.1

    def __post_init__(self) -> None:
        for name, least in (("steps", 1), ("repeats", 1), ("batch", 4)):
            if not is_whole(count := getattr(self, name)) or count < least:
                raise TrainingError(f"{name} is {count!r:.40}, expected a whole number, {least} or more")
        if not 0.0 < self.learning_rate < math.inf or not 0.0 <= self.climb < math.inf:
            raise TrainingError(
                f"learning_rate is {self.learning_rate}, climb {self.climb}; expected numbers above 0, and 0 or more"
            )
        for name in ("bare", "found"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise TrainingError(f"{name} is {getattr(self, name)}, expected a share in [0, 1]")

    @property
    def pictures(self) -> int:
        """How many pictures the controller sees in all."""
        return self.updates * self.batch

    @property
    def updates(self) -> int:
        """How often the weights are changed."""
        return self.steps * self.repeats

    def rate(self, update: int) -> float:
        """The learning rate of a change of the weights."""
        rising = max(1.0, 0.04 * self.updates)
        falling = 0.005 + 0.995 * 0.5 * (1.0 + math.cos(math.pi * update / self.updates))
        return self.learning_rate * min((update + 1) / rising, 1.0) * falling


def training_step(model: nn.Module, batch: TuningBatch) -> Float[Tensor, ""]:
    """Huber's loss of steering, and of the pedals where the controller answers with them."""
    answer = answers(cast("Controller", model), batch.frames, batch.speed_mps, batch.command)
    each = functional.smooth_l1_loss(answer, batch.target, beta=0.01, reduction="none").mean(0)
    return each[0] + PEDALS * each[1:].sum()


def tune(
    network: nn.Module,
    teacher: Controller,
    streets: Sequence[Street],
    spaces: Sequence[SearchSpace],
    found: Float[Tensor, "p k n"],
    town: Town | None,
    tuning: Tuning,
    *,
    seed: int,
    device: torch.device | str = "cpu",
    step: TrainingStep = training_step,
    checkpoint: Checkpoint | None = None,
    on_step: OnStep = lambda _step, _loss: None,
) -> None:
    """Fine-tune a controller in place.

    Args:
        network: a controller whose parameters want gradients, on `device`.
        teacher: the controller before, on `device`.
        streets: the streets that pictures are drawn from, in turn; each already has ways (`Street.add_ways`).
        spaces: the search spaces of the patterns: the attacks' own in every second pass over the streets, and in the
            passes between the others in turn.
        found: patterns that attacks found, as points of the first search space.
        town: clean drives through the town, learnt from besides; None for none.
        tuning: how many batches there are, and what they are made of.
        seed: the seed of everything drawn.
        device: the torch device on which the controller learns.
        step: the function that gives the loss of a batch.
        checkpoint: the file that keeps an interrupted tuning, which goes on from there if its identity is the same;
            None for none.
        on_step: called at every tenth step and at the last with the step and the mean loss since the call before.

    Raises:
        TrainingError: the training step gives anything but one finite number with a finite gradient to parameters.
        ControllerError: a controller, the training step or its gradient raises, or a controller answers wrongly.
    """
    place = torch.device(device)
    lay_out(network.to(place).eval())
    parameters = [each for each in network.parameters() if each.requires_grad]
    optimiser = torch.optim.AdamW(parameters, tuning.learning_rate, _BETAS, weight_decay=0.0)
    passes = _passes(teacher, spaces, found.to(device), tuning)
    besides = () if town is None else (town,)
    count = tuning.batch // (1 + len(besides))
    total = 0.0
    begun, highest = (0, 0.0) if checkpoint is None else _resume(parameters, optimiser, checkpoint)
    for number in range(begun, tuning.steps):
        draw = torch.Generator().manual_seed(seed * 1_000_003 + number)
        pictures = passes[number // len(streets) % len(passes)]
        shown = [pictures.of(source, count, draw) for source in (streets[number % len(streets)], *besides)]
        for again in range(tuning.repeats):
            # After the last time they climb no more.
            climbs = again + 1 < tuning.repeats
            shown = [each._replace(unit=each.unit.detach().requires_grad_(climbs)) for each in shown]
            painted = [each.painted(pictures.space.pattern(each.unit)) for each in shown]
            batch = TuningBatch(*(torch.cat(columns) for columns in zip(*painted, strict=True)))
            for group in optimiser.param_groups:
                group["lr"] = tuning.rate(number * tuning.repeats + again)
            total += _differentiate(step, network, parameters, batch, number)
            optimiser.step()
            shown = [each.climbed(pictures.space, tuning.climb) for each in shown]
        if (number + 1) % 10 == 0 or number + 1 == tuning.steps:
            mean = total / (number % 10 + 1) / tuning.repeats
            if highest and mean > _APART * highest:
                raise TrainingError(
                    f"the tuning came apart at step {number + 1}: its loss is {mean:.3g}, and was {highest:.3g} at "
                    "most before; give another seed, or lower Tuning.learning_rate"
                )
            highest = max(highest, mean)
            if checkpoint is not None:
                _keep(parameters, optimiser, checkpoint, number + 1, highest)
            on_step(number + 1, mean)
            total = 0.0


def _passes(
    teacher: Controller, spaces: Sequence[SearchSpace], found: Float[Tensor, "p k n"], tuning: Tuning
) -> list[Pictures]:
    """What one pass over the streets after the other draws from, in turn: every second from the attacks' own space."""
    own = Pictures(teacher, spaces[0], found, tuning.found, tuning.bare)
    # What was found are points of the attacks' space alone.
    others = [replace(own, space=space, known=0.0) for space in spaces[1:]]
    return [each for other in others for each in (own, other)] or [own]


def _keep(
    parameters: Sequence[nn.Parameter],
    optimiser: torch.optim.AdamW,
    checkpoint: Checkpoint,
    steps: int,
    highest: float,
) -> None:
    """Keep the parameters and AdamW's moments after so many steps, and the highest loss so far."""
    kept = {"steps": torch.tensor(steps), "highest": torch.tensor(highest, dtype=torch.float64)}
    for k, each in enumerate(parameters):
        kept |= {f"{k}.value": each} | {f"{k}.{name}": moment for name, moment in optimiser.state[each].items()}
    checkpoint.save(kept)


def _resume(
    parameters: Sequence[nn.Parameter], optimiser: torch.optim.AdamW, checkpoint: Checkpoint
) -> tuple[int, float]:
    """Put back what a file keeps, where there is one that is whole and of this tuning.

    Returns:
        The number of steps done, and the highest loss so far; 0 for both where nothing is kept.
    """
    kept = checkpoint.load(parameters[0].device)
    if kept is None:
        return 0, 0.0
    for k, each in enumerate(parameters):
        own = {name.partition(".")[2]: value for name, value in kept.items() if name.startswith(f"{k}.")}
        each.data.copy_(own.pop("value"))
        # A parameter that had no gradient has no moments.
        if own:
            optimiser.state[each] = own
    # A file of an older roadproof does not say how high the loss was.
    return int(kept["steps"]), float(kept.get("highest", 0.0))


def require_loss(
    step: TrainingStep, network: nn.Module, teacher: Controller, *, size: tuple[int, int], device: torch.device | str
) -> None:
    """Refuse a training step that cannot teach a controller, by made-up pictures, before anything is driven.

    Args:
        step: the function that gives the loss of a batch.
        network: a controller whose parameters want gradients; it is moved to `device`.
        teacher: the controller before, on `device`.
        size: (height, width) of the pictures.
        device: the torch device on which the controller will learn.

    Raises:
        TrainingError, ControllerError: as `tune`.
    """
    frames = torch.rand(4, 3, *size, generator=torch.Generator().manual_seed(0)).to(device)
    speed_mps, command = torch.full((4,), 7.0, device=device), torch.full((4,), int(Command.FOLLOW), device=device)
    with torch.no_grad():
        # As over paint, it does not answer as its teacher yet: where a loss is 0, the gradient of a root of it is none.
        target = answers(teacher, frames, speed_mps, command) + 0.1
    parameters = [each for each in network.to(device).eval().parameters() if each.requires_grad]
    _differentiate(step, network, parameters, TuningBatch(frames, speed_mps, command, target), 0)


def _differentiate(
    step: TrainingStep, network: nn.Module, parameters: Sequence[nn.Parameter], batch: TuningBatch, number: int
) -> float:
    """Give the parameters the gradient of a batch's loss, cut to a norm of 5; the loss, of the step of this number."""
    for each in parameters:
        each.grad = None
    with mixed_precision(batch.frames.device):
        loss = _checked(call("the training step", step, network, batch), number)
    call("the gradient of the training step", torch.autograd.backward, loss)
    if all(each.grad is None for each in parameters):
        raise TrainingError(f"the loss depends on no parameter of the controller at step {number + 1}; mend the step")
    if not bool(nn.utils.clip_grad_norm_(parameters, 5.0).isfinite()):
        raise TrainingError(f"the gradient of the loss is not finite at step {number + 1}; {_CURE}")
    return float(loss.detach())


def _checked(loss: object, number: int) -> Tensor:
    """The loss, where it is one."""
    if not isinstance(loss, Tensor) or loss.numel() != 1 or not loss.requires_grad:
        told = f"a tensor of shape {tuple(loss.shape)}" if isinstance(loss, Tensor) else f"a {type(loss).__name__}"
        raise TrainingError(f"the training step gave {told}, expected one number with a gradient to the parameters")
    if not bool(loss.isfinite().all()):
        raise TrainingError(f"the loss is {loss.item()} at step {number + 1}; {_CURE}")
    return loss.reshape(())
