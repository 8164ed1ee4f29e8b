"""Does a controller keep the promises that a gradient attack relies on? Measured, not believed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from roadproof.controllers.protocol import Controller
from roadproof.datatypes import Command, Control
from roadproof.errors import ControllerError


@dataclass(frozen=True, slots=True)
class ControllerCheck:
    """One promise and whether it is kept.

    Args:
        name: short and stable.
        passed: whether it is.
        found: what was measured.
        advice: what to do when it is not.
    """

    name: str
    passed: bool
    found: str
    advice: str


@dataclass(frozen=True, slots=True)
class ControllerReport:
    """All checks, in the order they were made. After one that leaves nothing to measure there are no more."""

    checks: tuple[ControllerCheck, ...]

    @property
    def passed(self) -> bool:
        """Whether every check passed."""
        return all(check.passed for check in self.checks)

    @property
    def failures(self) -> tuple[ControllerCheck, ...]:
        """The checks that did not pass."""
        return tuple(check for check in self.checks if not check.passed)

    def require(self) -> None:
        """Refuse a controller that fails.

        Raises:
            ControllerError: names what failed, what was found and what to do, in one line.
        """
        if self.failures:
            raise ControllerError(
                "; ".join(f"controller fails '{c.name}' ({c.found}): {c.advice}" for c in self.failures)
            )


class _Drive(NamedTuple):
    """Made-up frames with speeds and commands."""

    frames: Float[Tensor, "b 3 h w"]
    speed_mps: Float[Tensor, " b"]
    command: Int[Tensor, " b"]


def check_controller(
    controller: object,
    *,
    size: tuple[int, int] | None = None,
    device: str = "cpu",
    tolerance: float = 1e-4,
    seed: int = 0,
) -> ControllerReport:
    """Try a controller on eight made-up frames, two for each command.

    Args:
        controller: what is to be checked.
        size: (height, width) of the frames; by default the controller's `input_size`.
        device: where the controller computes.
        tolerance: largest difference between answers that should be equal, in steering; about 0.02 for bfloat16.
        seed: of the frames.

    Returns:
        The report; it never raises for what the controller does.

    Raises:
        ControllerError: the controller takes any size and none was given.
    """
    if not isinstance(controller, Controller):
        missing = [name for name in ("input_size", "steer", "act") if not hasattr(controller, name)]
        advice = "give the object the members of roadproof.controllers.Controller"
        return ControllerReport((ControllerCheck("interface", False, f"lacks {', '.join(missing)}", advice),))
    size = size or controller.input_size
    if size is None:
        raise ControllerError("the controller takes frames of any size; say at which size to check it: size=(h, w)")
    return ControllerReport(tuple(_checks(controller, _made_up_drive(size, device, seed), tolerance)))


def _checks(controller: Controller, drive: _Drive, tolerance: float) -> Iterator[ControllerCheck]:
    count, before = len(drive.frames), drive.frames.clone()
    leaf = drive.frames.clone().requires_grad_()
    try:
        steer = controller.steer(leaf, drive.speed_mps, drive.command)
    except Exception as error:  # whatever a stranger's controller raises is its answer
        found = f"{type(error).__name__}: {error}"
        yield ControllerCheck(
            "answers", False, found, "make steer accept (b, 3, h, w) frames, (b,) speeds and commands"
        )
        return
    shaped = steer.shape == (count,) and steer.is_floating_point()
    advice = "return one floating-point steering value a frame"
    yield ControllerCheck("answers", shaped, f"shape {tuple(steer.shape)}, {steer.dtype}", advice)
    if not shaped:
        return

    answer = steer.detach()
    broken = int((~answer.isfinite()).sum())
    advice = "look for divisions by zero and logarithms, and for NaN in the weights"
    yield ControllerCheck("finite answers", broken == 0, f"{broken} of {count} NaN or infinite", advice)

    with torch.no_grad():
        again = controller.steer(drive.frames, drive.speed_mps, drive.command)
        alone = torch.cat([controller.steer(*(x[i : i + 1] for x in drive)) for i in range(count)])
    advice = "switch dropout and noise off (eval mode), and keep no state from call to call"
    yield _equal("determinism", answer, again, tolerance, advice)
    advice = "answer each frame by itself: batch normalisation in eval mode, no statistics over the batch"
    yield _equal("batch consistency", answer, alone, tolerance, advice)
    advice = "work on a copy: steer must not write into the frames it is given"
    yield ControllerCheck("frames untouched", torch.equal(before, drive.frames), "frames compared", advice)

    yield from _gradient_checks(steer, leaf)
    yield _act_check(controller, drive)


def _gradient_checks(steer: Float[Tensor, " b"], leaf: Float[Tensor, "b 3 h w"]) -> Iterator[ControllerCheck]:
    gradient = None
    if steer.requires_grad:
        (gradient,) = torch.autograd.grad(steer.sum(), leaf, allow_unused=True)
    advice = "compute steer in torch from the frames on: no detach, no_grad, numpy or rounding on the way"
    if gradient is None:
        yield ControllerCheck("gradients", False, "none reach the frames", advice)
        return
    largest = gradient.flatten(1).abs().amax(dim=1)
    dead = int((largest == 0).sum())
    yield ControllerCheck("gradients", dead == 0, f"zero for {dead} of {len(largest)} frames", advice)
    broken = int((~gradient.flatten(1).isfinite().all(dim=1)).sum())
    advice = "look for square roots and norms at zero, whose derivative is infinite"
    found = f"NaN or infinite for {broken} of {len(largest)} frames"
    yield ControllerCheck("finite gradients", broken == 0, found, advice)


def _act_check(controller: Controller, drive: _Drive) -> ControllerCheck:
    frame = (drive.frames[0].permute(1, 2, 0) * 255).round().to(torch.uint8).cpu().numpy()
    advice = "return a finite Control inside its ranges (Control.clipped) for one uint8 frame"
    try:
        act = cast("Callable[..., object]", controller.act)
        control = act(np.ascontiguousarray(frame), float(drive.speed_mps[0]), int(drive.command[0]))
    except Exception as error:  # as above
        return ControllerCheck("drives", False, f"{type(error).__name__}: {error}", advice)
    inside = isinstance(control, Control) and control == control.clipped()
    return ControllerCheck("drives", inside, f"{control}", advice)


def _equal(
    name: str, one: Float[Tensor, " b"], other: Float[Tensor, " b"], tolerance: float, advice: str
) -> ControllerCheck:
    if one.shape != other.shape:
        return ControllerCheck(name, False, f"shapes {tuple(one.shape)} and {tuple(other.shape)}", advice)
    # NaN in both places is the business of another check.
    difference = torch.where(one.isnan() & other.isnan(), 0.0, (one - other).abs())
    largest = float(difference.max())
    return ControllerCheck(name, largest <= tolerance, f"answers differ by up to {largest:.2g}", advice)


def _made_up_drive(size: tuple[int, int], device: str, seed: int) -> _Drive:
    """Smooth colours under fine noise, more like a picture than noise alone; everything drawn on the CPU."""
    generator = torch.Generator().manual_seed(seed)
    commands = [int(command) for command in Command for _ in range(2)]
    count = len(commands)
    coarse = torch.rand(count, 3, 4, 8, generator=generator)
    smooth = functional.interpolate(coarse, size=size, mode="bilinear", align_corners=True)
    frames = 0.8 * smooth + 0.2 * torch.rand(count, 3, *size, generator=generator)
    return _Drive(
        frames.to(device),
        (10 * torch.rand(count, generator=generator)).to(device),
        torch.tensor(commands, device=device),
    )
