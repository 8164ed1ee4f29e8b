"""Does a controller keep the promises that a gradient attack relies on? Measured, not believed."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional

from roadproof.checks import Check, CheckReport
from roadproof.controllers.asking import (
    NO_GRADIENT,
    act_of,
    answer_of,
    controls_after_of,
    controls_of,
    frame_size_of,
    require_size,
    steer_of,
)
from roadproof.controllers.loading import device_of
from roadproof.controllers.protocol import (
    Commands,
    Controller,
    Frames,
    PedalController,
    Speeds,
    TemporalController,
    missing_members,
)
from roadproof.datatypes import Command
from roadproof.errors import ControllerError
from roadproof.foreign import call
from roadproof.io.records import RecordFile, Saved

DRIVES = "drives"
"""The check without which nothing can be driven."""

_INTERFACE = "give the object the members of roadproof.controllers.Controller"
_STEP_S = 0.05
"""Time from a made-up frame to the next."""

_BROKEN_GRADIENT = "look for square roots and norms at zero, whose derivative is infinite"


@dataclass(frozen=True, slots=True)
class ControllerReport(CheckReport, Saved):
    """What `check_controller` found."""

    def require(self) -> None:
        """Refuse a controller that fails a check.

        Raises:
            ControllerError: a check failed; one line names each failure, what was found and what to do.
        """
        if self.failures:
            raise ControllerError(
                "; ".join(f"controller fails '{c.name}' ({c.finding}): {c.advice}" for c in self.failures)
            )


ControllerReport.FILE = RecordFile(
    kind=ControllerReport, name="roadproof-controller-check", error=ControllerError, remedy="check the controller again"
)
_ON_A_COPY = "work on a copy: steer must not write into the frames it is given"


class _Drive(NamedTuple):
    """Made-up frames with speeds and commands."""

    frames: Frames
    speed_mps: Speeds
    command: Commands


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
        controller: the object to check.
        size: (height, width) of the frames; by default the controller's `input_size`.
        device: torch device on which the controller computes.
        tolerance: largest difference between answers that should be equal, in steering; about 0.02 for bfloat16.
        seed: seed of the made-up frames.

    Returns:
        The report of all checks; what the controller does wrong stands in it and is never raised.

    Raises:
        ControllerError: the controller takes frames of any size and `size` is not given, or is no size.
        DeviceError: there is no such device.
    """
    device_of(device)
    if size is not None and min(size) < 1:
        raise ControllerError(f"size is {size}, expected a height and a width of 1 or more")
    try:
        missing = call("the controller's interface", missing_members, controller)
        own_size = None if missing else frame_size_of(cast("Controller", controller))
    except ControllerError as error:
        return ControllerReport((_failed("interface", error, _INTERFACE),))
    if missing:
        return ControllerReport((Check("interface", False, f"lacks {', '.join(missing)}", _INTERFACE),))
    size = size or own_size
    if size is None:
        raise ControllerError("the controller takes frames of any size; say at which size to check it: size=(h, w)")
    drive = _made_up_drive(size, device, seed)
    return ControllerReport(tuple(_checks(cast("Controller", controller), drive, tolerance)))


def require_usable(
    controller: Controller, *, size: tuple[int, int], device: str = "cpu", drives: bool = True, gradients: bool = True
) -> None:
    """Refuse a controller with which nothing can begin: the part of `check_controller` that takes no time.

    Args:
        controller: the controller; it is asked about two made-up frames, and for their gradient.
        size: (height, width) of the frames that it will be given.
        device: torch device on which the controller computes.
        drives: whether the controller will also be asked to act.
        gradients: whether gradients are needed.

    Raises:
        ControllerError: the controller takes another frame size, raises, answers wrongly, writes into its frames, or
            has no finite gradient.
        DeviceError: there is no such device.
    """
    device_of(device)
    require_size(controller, size, "here they have", "use a controller for these, or record for this one")
    few = _Drive(*(values[:2] for values in _made_up_drive(size, device, seed=0)))
    leaf = few.frames.clone().requires_grad_()
    steer = steer_of(controller, leaf, few.speed_mps, few.command)
    if not torch.equal(leaf, few.frames):
        raise ControllerError(f"the controller's steer changes the frames that it is given; {_ON_A_COPY}")
    gradient = _gradient_of(steer, leaf) if gradients else leaf
    if gradient is None:
        raise ControllerError(f"no gradient of the controller's steer reaches the frames; {NO_GRADIENT}")
    if not bool(gradient.isfinite().all()):
        raise ControllerError(f"the controller's gradient is NaN or infinite; {_BROKEN_GRADIENT}")
    if isinstance(controller, PedalController):
        controls_of(controller, leaf, few.speed_mps, few.command)
    if isinstance(controller, TemporalController):
        _, memory = controls_after_of(controller, None, *few, 0.0)
        controls_after_of(controller, memory, *few, _STEP_S)
    if drives:
        act_of(controller, _picture(few), float(few.speed_mps[0]), int(few.command[0]))


def _checks(controller: Controller, drive: _Drive, tolerance: float) -> Iterator[Check]:
    leaf = drive.frames.clone().requires_grad_()
    try:
        steer = answer_of(controller, "steer", leaf, drive.speed_mps, drive.command)
    except ControllerError as error:
        advice = "make steer accept (b, 3, h, w) frames, (b,) speeds and commands, and answer one value a frame"
        yield _failed("answers", error, advice)
    else:
        yield Check("answers", True, f"shape {tuple(steer.shape)}, {steer.dtype}", "")
        yield from _steer_checks(controller, drive, steer, tolerance)
        yield from _gradient_checks(steer, leaf)
    if isinstance(controller, PedalController):
        yield _pedal_check(controller, drive)
    if isinstance(controller, TemporalController):
        yield from _memory_checks(controller, drive, tolerance)
    yield _act_check(controller, drive)


def _steer_checks(
    controller: Controller, drive: _Drive, steer: Float[Tensor, " b"], tolerance: float
) -> Iterator[Check]:
    count, before, answer = len(drive.frames), drive.frames.clone(), steer.detach()
    broken = int((~answer.isfinite()).sum())
    advice = "look for divisions by zero and logarithms, and for NaN in the weights"
    yield Check("finite answers", broken == 0, f"{broken} of {count} NaN or infinite", advice)
    parts = [_Drive(*(values[i : i + 1] for values in drive)) for i in range(count)]
    advice = "switch dropout and noise off (eval mode), and keep no state from call to call"
    yield _repeated("determinism", controller, [drive], answer, tolerance, advice)
    advice = "answer each frame by itself: batch normalisation in eval mode, no statistics over the batch"
    yield _repeated("batch consistency", controller, parts, answer, tolerance, advice)
    yield Check("frames untouched", torch.equal(before, drive.frames), "frames compared", _ON_A_COPY)


def _repeated(
    name: str,
    controller: Controller,
    parts: Sequence[_Drive],
    first: Float[Tensor, " b"],
    tolerance: float,
    advice: str,
) -> Check:
    """Whether frames asked about again, a part at a time, are answered as they were at first."""
    try:
        with torch.no_grad():
            again = torch.cat([answer_of(controller, "steer", *part) for part in parts])
    except ControllerError as error:
        return _failed(name, error, advice)
    return _equal(name, first, again, tolerance, advice)


def _gradient_checks(steer: Float[Tensor, " b"], leaf: Float[Tensor, "b 3 h w"]) -> Iterator[Check]:
    try:
        gradient = _gradient_of(steer, leaf)
    except ControllerError as error:
        yield _failed("gradients", error, NO_GRADIENT)
        return
    if gradient is None:
        yield Check("gradients", False, "none reach the frames", NO_GRADIENT)
        return
    largest = gradient.flatten(1).abs().amax(dim=1)
    dead = int((largest == 0).sum())
    yield Check("gradients", dead == 0, f"zero for {dead} of {len(largest)} frames", NO_GRADIENT)
    broken = int((~gradient.flatten(1).isfinite().all(dim=1)).sum())
    found = f"NaN or infinite for {broken} of {len(largest)} frames"
    yield Check("finite gradients", broken == 0, found, _BROKEN_GRADIENT)


def _gradient_of(steer: Float[Tensor, " b"], leaf: Float[Tensor, "b 3 h w"]) -> Float[Tensor, "b 3 h w"] | None:
    """The gradient of the summed steering in the frames; None if no gradient reaches them.

    Raises:
        ControllerError: the backward pass raises.
    """
    if not steer.requires_grad:
        return None
    backward = functools.partial(torch.autograd.grad, steer.sum(), leaf, allow_unused=True)
    gradient: Tensor | None = call("the gradient of the controller's steer", backward)[0]
    return gradient


def _pedal_check(controller: PedalController, drive: _Drive) -> Check:
    advice = "answer finite steer, throttle and brake of each frame inside their ranges, differentiable in the frames"
    try:
        controls = controls_of(controller, drive.frames.clone().requires_grad_(), drive.speed_mps, drive.command)
    except ControllerError as error:
        return _failed("pedals", error, advice)
    least = controls.new_tensor([-1.0, 0.0, 0.0])
    outside = int(((controls < least) | (controls > 1)).any(1).sum())
    return Check("pedals", outside == 0, f"outside their ranges for {outside} of {len(controls)} frames", advice)


def _memory_checks(controller: TemporalController, drive: _Drive, tolerance: float) -> Iterator[Check]:
    """Whether what is remembered does what a search and many cars side by side rely on."""
    shapes = "answer controls_after with a tuple: (b, 3) controls inside their ranges, and what is to be remembered"
    leaf, later = drive.frames.clone().requires_grad_(), drive._replace(frames=drive.frames.flip(3))
    try:
        first, memory = controls_after_of(controller, None, leaf, drive.speed_mps, drive.command, 0.0)
        once, again = (controls_after_of(controller, memory, *later, _STEP_S)[0] for _ in range(2))
        parts = [_Drive(*(values[i : i + 1] for values in drive)) for i in range(len(drive.frames))]
        alone = torch.cat([controls_after_of(controller, None, *part, 0.0)[0] for part in parts])
        gradient = _gradient_of(once[:, 0], leaf)
        alike = steer_of(controller, leaf, drive.speed_mps, drive.command).clamp(-1.0, 1.0)
    except ControllerError as error:
        yield _failed("memory", error, shapes)
        return
    first, once, again = (each.detach() for each in (first, once, again))
    yield _equal(
        "memory", first[:, 0], alike.detach(), tolerance, "let steer answer as controls_after does without a memory"
    )
    advice = "make a new memory at every call: what is given must not be written to, and nothing kept besides"
    yield _equal("memory untouched", once[:, 0], again[:, 0], tolerance, advice)
    yield _equal(
        "cars apart", first[:, 0], alone[:, 0].detach(), tolerance, "remember every car of the batch by itself"
    )
    found = gradient is not None and bool(gradient.isfinite().all())
    told = "reaches" if found else "does not reach"
    advice = "keep tensors in the memory as they are: no detach, no_grad or numpy, or paint seen before has no effect"
    yield Check("gradient through memory", found, f"it {told} the frames before", advice)


def _act_check(controller: Controller, drive: _Drive) -> Check:
    advice = "return a finite Control inside its ranges (Control.clipped) for one uint8 frame"
    try:
        control = act_of(controller, _picture(drive), float(drive.speed_mps[0]), int(drive.command[0]))
    except ControllerError as error:
        return _failed(DRIVES, error, advice)
    return Check(DRIVES, control == control.clipped(), f"{control}", advice)


def _failed(name: str, error: ControllerError, advice: str) -> Check:
    return Check(name, False, str(error), advice)


def _picture(drive: _Drive) -> UInt8[np.ndarray, "h w 3"]:
    """The first frame of a drive as a camera gives it, 8-bit RGB."""
    levels = (drive.frames[0].permute(1, 2, 0) * 255).round().to(torch.uint8)
    return np.ascontiguousarray(levels.cpu().numpy())


def _equal(name: str, one: Float[Tensor, " b"], other: Float[Tensor, " b"], tolerance: float, advice: str) -> Check:
    if one.shape != other.shape:
        return Check(name, False, f"shapes {tuple(one.shape)} and {tuple(other.shape)}", advice)
    # NaN in both places is the business of another check.
    difference = torch.where(one.isnan() & other.isnan(), 0.0, (one - other).abs())
    largest = float(difference.max())
    return Check(name, largest <= tolerance, f"answers differ by up to {largest:.2g}", advice)


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
