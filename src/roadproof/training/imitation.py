"""Imitation: a network learns to answer as the expert would.

Every step draws its batch, its pictures' variation and its dropout from the plan's seed and the step's number, so a run
that was cut off goes on from its last checkpoint as if nothing had happened.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from pickle import UnpicklingError  # what torch raises for a file that holds more than numbers
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from roadproof.controllers import CIL, ConditionalPilotNet, TrajectoryController
from roadproof.controllers.conditional import SPEED_SCALE_MPS, ConditionalOutput
from roadproof.controllers.precision import mixed_precision
from roadproof.controllers.steering import CruiseControl
from roadproof.controllers.temporal import WINDOW, TemporalPlanner
from roadproof.controllers.trajectory import Plan
from roadproof.controllers.weights import seeded
from roadproof.errors import TrainingError
from roadproof.io.files import write_atomically
from roadproof.training.augmentation import Augmentation
from roadproof.training.dataset import Batch, Dataset
from roadproof.training.pasting import PastedPaint

Learner = CIL | ConditionalPilotNet | TrajectoryController
"""A network that can be trained: frames, speed and command in, `ConditionalOutput` or `Plan` out."""


STEER_COUNTS, THROTTLE_COUNTS, BRAKE_COUNTS, SPEED_COUNTS = 0.6, 0.2, 0.2, 0.05
"""How much each answer counts in the loss. Steering alone keeps a car in its lane, the pedals make it arrive.

A path counts as steering does, by how far its points are off as a share of their distance; a planned speed as both
pedals."""

PATH_COUNTS = 3.0
"""A point that is off by a hundredth of its distance changes steering by about three hundredths."""

WEIGHT_DECAY = 1e-2
WARM_UP = 0.04
"""Share of the steps over which the learning rate rises."""
AVERAGING = 0.997
"""Decay of the running average of the weights; the average is what is kept."""
AUGMENTATION = Augmentation()


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingPlan:
    """How a network learns.

    Args:
        samples: how many frames the network sees, repetitions counted.
        batch: how many frames a batch has; every step learns from one.
        seed: the seed of everything drawn.
        learning_rate: the largest learning rate; it rises over the first steps and then falls along a cosine to almost
            nothing.
        dropout: factor on the network's own dropout; short training learns more with less.
        pasted: share of the pictures with coloured rectangles pasted on the road, 0 to 1.

    Raises:
        TrainingError: a number is not positive, or there is not one batch to see.
    """

    samples: int
    batch: int = 128
    seed: int = 0
    learning_rate: float = 1e-3
    dropout: float = 0.4
    pasted: float = 0.0

    def __post_init__(self) -> None:
        for name in ("batch", "learning_rate"):
            if not getattr(self, name) > 0:
                raise TrainingError(f"{name} is {getattr(self, name)}, expected a value above 0")
        for name in ("dropout", "pasted"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise TrainingError(f"{name} is {getattr(self, name)}, expected a value in [0, 1]")
        if self.steps < 1:
            raise TrainingError(f"{self.samples} samples are less than one batch of {self.batch}")

    @property
    def steps(self) -> int:
        """How many batches the network learns from."""
        return self.samples // self.batch

    def rate(self, step: int) -> float:
        """The learning rate of a step."""
        rising = max(1.0, WARM_UP * self.steps)
        if step < rising:
            return self.learning_rate * (step + 1) / rising
        return self.learning_rate * (0.005 + 0.995 * 0.5 * (1.0 + math.cos(math.pi * step / self.steps)))


def imitate(
    network: Learner,
    data: Dataset,
    plan: TrainingPlan,
    *,
    checkpoint: Path | None = None,
    device: str = "cpu",
    every: int = 100,
    on_progress: Callable[[int, float], object] = lambda _step, _loss: None,
) -> Learner:
    """Train a network.

    Args:
        network: the network to start from; it is changed.
        data: the drives to learn from.
        plan: how the network learns.
        checkpoint: file to go on from where it is there, and to keep up to date; None keeps none.
        device: "cpu" or "cuda".
        every: how many steps lie between two reports, and between two checkpoints.
        on_progress: called with every report: the steps done, and the mean loss since the last one.

    Returns:
        The network with the running average of the weights, in eval mode.

    Raises:
        TrainingError: the loss is no longer finite, a batch is too small for what remembers, or the checkpoint is of
            another plan or damaged.
        OutputError: the checkpoint cannot be written.
    """
    place = torch.device(device)
    # What remembers learns from whole windows of frames; the last of each is drawn.
    window = WINDOW if isinstance(network, TemporalPlanner) else 1
    if plan.batch < window:
        raise TrainingError(
            f"batch is {plan.batch}, expected at least {window}, the frames of a network that remembers"
        )
    # Convolutions by channels-last pictures run 1.3 times as fast.
    network.to(device=place, memory_format=torch.channels_last).train()  # type: ignore[call-overload]
    scale_dropout(network, plan.dropout)
    average = copy.deepcopy(network).eval()
    optimiser = torch.optim.AdamW(network.parameters(), plan.learning_rate, weight_decay=WEIGHT_DECAY)
    first = 0 if checkpoint is None else _resume(checkpoint, plan, network, average, optimiser)
    paste = PastedPaint(plan.pasted)
    weights, losses, counted = data.weights(), torch.zeros(()), 0
    for step in range(first, plan.steps):
        for group in optimiser.param_groups:
            group["lr"] = plan.rate(step)
        draw = torch.Generator().manual_seed(plan.seed * 1_000_003 + step)
        last = torch.multinomial(weights, plan.batch // window, replacement=True, generator=draw)
        batch = data.batch(data.windows(last, window), place)
        batch = batch._replace(frames=AUGMENTATION(paste(batch.frames, draw), draw, window=window))
        losses += _step(network, batch, plan, optimiser, step)
        _average(average, network, min(AVERAGING, (1 + step) / (10 + step)))
        counted += 1
        if (step + 1) % every == 0 or step + 1 == plan.steps:
            if not losses.isfinite():
                raise TrainingError(f"the loss is {float(losses)} near step {step}; lower the learning rate")
            on_progress(step + 1, float(losses / counted))
            losses, counted = torch.zeros(()), 0
            if checkpoint is not None:
                _keep(checkpoint, plan, step + 1, network, average, optimiser)
    return average


def _step(
    network: Learner, batch: Batch, plan: TrainingPlan, optimiser: torch.optim.Optimizer, step: int
) -> Float[Tensor, ""]:
    """Learn from one batch; its loss."""
    ask = network.along if isinstance(network, TemporalPlanner) else network
    with seeded(plan.seed * 1_000_003 + step), mixed_precision(batch.frames.device):
        answer: ConditionalOutput | Plan = ask(batch.frames, batch.speed_mps, batch.command)
    if isinstance(network, TrajectoryController):
        assert isinstance(answer, Plan)
        loss = plan_loss(answer, batch, network.cruise)
    else:
        assert isinstance(answer, ConditionalOutput)
        loss = imitation_loss(answer, batch)
    optimiser.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(network.parameters(), 5.0)
    optimiser.step()
    return loss.detach().cpu()


def imitation_loss(answer: ConditionalOutput, batch: Batch) -> Float[Tensor, ""]:
    """Huber's loss of each answer, weighted and added up; only the commanded branch has answered."""
    each = functional.smooth_l1_loss(answer.controls.float(), batch.expert, beta=0.1, reduction="none").mean(dim=0)
    speed = functional.smooth_l1_loss(answer.speed.float(), batch.speed_mps / SPEED_SCALE_MPS, beta=0.1)
    return STEER_COUNTS * each[0] + THROTTLE_COUNTS * each[1] + BRAKE_COUNTS * each[2] + SPEED_COUNTS * speed


def plan_loss(answer: Plan, batch: Batch, cruise: CruiseControl) -> Float[Tensor, ""]:
    """Huber's loss of path and speed, weighted and added up.

    The speed to learn is the one for which `cruise` gives the expert's pedals; its error counts in units of them.
    """
    distance = batch.path_m.square().sum(2, keepdim=True).sqrt().clamp_min(1.0)
    path = functional.smooth_l1_loss(answer.path.float() / distance, batch.path_m / distance, beta=0.03)
    effort = batch.expert[:, 1] - batch.expert[:, 2] - cruise.hold
    assert answer.target_mps is not None
    given = (answer.target_mps.float() - batch.speed_mps) * cruise.gain_per_mps
    speed = functional.smooth_l1_loss(given, effort, beta=0.1)
    return PATH_COUNTS * STEER_COUNTS * path + (THROTTLE_COUNTS + BRAKE_COUNTS) * speed


def scale_dropout(network: nn.Module, factor: float) -> None:
    """Multiply every dropout of a network."""
    for module in network.modules():
        if isinstance(module, nn.Dropout):
            module.p *= factor


@torch.no_grad()
def _average(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Weights and running statistics alike."""
    for kept, new in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
        kept.lerp_(new, 1.0 - decay)


def _keep(
    path: Path, plan: TrainingPlan, step: int, network: nn.Module, average: nn.Module, optimiser: torch.optim.Optimizer
) -> None:
    content = {
        "plan": asdict(plan),
        "step": step,
        "network": network.state_dict(),
        "average": average.state_dict(),
        "optimiser": optimiser.state_dict(),
    }
    write_atomically(path, lambda part: torch.save(content, part))


def _resume(
    path: Path, plan: TrainingPlan, network: nn.Module, average: nn.Module, optimiser: torch.optim.Optimizer
) -> int:
    """Take up a checkpoint, where there is one; the step to go on with."""
    if not path.exists():
        return 0
    try:
        content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        kept = content["plan"]
        # Older checkpoints also say what all plans have in common today.
        if kept == kept | asdict(plan):
            network.load_state_dict(content["network"])
            average.load_state_dict(content["average"])
            optimiser.load_state_dict(content["optimiser"])
            if not 0 <= (step := int(content["step"])) <= plan.steps:
                raise ValueError(step)
            return step
    except (AttributeError, RuntimeError, ValueError, KeyError, TypeError, OSError, EOFError, UnpicklingError):
        raise TrainingError(f"checkpoint {path} is damaged or of another network; delete it") from None
    raise TrainingError(f"checkpoint {path} was made with other settings; delete it or choose another folder")
