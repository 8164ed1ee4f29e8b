"""Asking a controller, whoever wrote it: what it raises or answers wrongly becomes one line.

Everything that searches or drives asks through these functions, so that a controller needs no wrapper: it is pickled,
compiled and told from others as it is.
"""

from __future__ import annotations

import math
from typing import cast

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from roadproof.controllers.frames import one_frame_batch
from roadproof.controllers.protocol import Commands, Controller, Frames, PedalController, Speeds, TemporalController
from roadproof.datatypes import Control
from roadproof.errors import ControllerError, SimulatorError
from roadproof.foreign import call
from roadproof.io.pictures import MOST_PIXELS
from roadproof.limits import is_whole

NO_GRADIENT = "compute it in torch from the frames on: no detach, no_grad, numpy, argmax or rounding on the way"


def steer_of(
    controller: Controller, frames: Frames, speed_mps: Speeds, command: Commands, *, finite: bool = True
) -> Float[Tensor, " b"]:
    """What `Controller.steer` answers, checked: steering of each frame, in steer units, (B,).

    Without `finite` it is not looked for NaN and infinity, for which the device has to be waited for.

    Raises:
        ControllerError: the controller raises, or does not answer with one finite number per frame that is
            differentiable in frames that carry gradients; the message names what came.
    """
    answer = answer_of(controller, "steer", frames, speed_mps, command)
    return _usable(answer, "steer", frames, finite=finite)


def controls_of(
    controller: PedalController, frames: Frames, speed_mps: Speeds, command: Commands, *, finite: bool = True
) -> Float[Tensor, "b 3"]:
    """What `PedalController.controls` answers, checked: steer, throttle and brake of each frame, (B, 3).

    Raises:
        ControllerError: the controller raises, or answers wrongly, as in `steer_of` but with three numbers per frame.
    """
    return _usable(answer_of(controller, "controls", frames, speed_mps, command), "controls", frames, finite=finite)


def controls_after_of(
    controller: TemporalController,
    memory: object,
    frames: Frames,
    speed_mps: Speeds,
    command: Commands,
    elapsed_s: float,
    *,
    finite: bool = True,
) -> tuple[Float[Tensor, "b 3"], object]:
    """What `TemporalController.controls_after` answers, checked: controls of each car, (B, 3), and what it remembers.

    Raises:
        ControllerError: the controller raises, or answers wrongly, as in `controls_of`, or without a memory.
    """
    member = "controls_after"
    what = f"the controller's {member}"
    pair = cast("object", call(what, controller.controls_after, memory, frames, speed_mps, command, elapsed_s))
    answers = cast("tuple[object, ...]", pair) if isinstance(pair, tuple) else ()
    if len(answers) != 2:
        found = _in_words(cast("object", pair))
        raise ControllerError(f"{what} answered {found}, expected a tuple: the controls, and what it remembers")
    answer, after = answers
    return _usable(_checked(answer, member, frames), member, frames, finite=finite), after


def next_controls_of(
    controller: Controller,
    memory: object,
    frames: Frames,
    speed_mps: Speeds,
    command: Commands,
    elapsed_s: float,
    *,
    finite: bool = True,
) -> tuple[Float[Tensor, "b c"], object]:
    """All that a controller of any kind says: steer, throttle and brake, (B, 3), or steer alone, (B, 1).

    It comes with what is remembered; the arguments are those of `TemporalController.controls_after`, and `finite` is
    that of `steer_of`.

    Raises:
        ControllerError: the controller raises, or answers wrongly.
    """
    if isinstance(controller, TemporalController):
        return controls_after_of(controller, memory, frames, speed_mps, command, elapsed_s, finite=finite)
    if isinstance(controller, PedalController):
        return controls_of(controller, frames, speed_mps, command, finite=finite), None
    return steer_of(controller, frames, speed_mps, command, finite=finite)[:, None], None


def next_act_of(
    controller: Controller,
    memory: object,
    frame: UInt8[np.ndarray, "h w 3"],
    speed_mps: float,
    command: int,
    elapsed_s: float,
) -> tuple[Control, object]:
    """What a controller of any kind does for one frame, as plain numbers, and what it remembers.

    Raises:
        ControllerError: the controller raises, or answers wrongly.
    """
    if not isinstance(controller, TemporalController):
        return act_of(controller, frame, speed_mps, command), None
    with torch.no_grad():
        one = one_frame_batch(controller, frame, speed_mps, command)
        controls, after = controls_after_of(controller, memory, *one, elapsed_s)
    return Control(*map(float, controls[0])), after


def act_of(controller: Controller, frame: UInt8[np.ndarray, "h w 3"], speed_mps: float, command: int) -> Control:
    """What `Controller.act` answers for one frame, as plain numbers.

    Raises:
        ControllerError: the controller raises, or answers with something that is no `Control` of numbers.
    """
    try:
        control = call("the controller's act", controller.act, frame, speed_mps, command)
    except SimulatorError as error:
        # Of a network that is not the user's own code no line says what was wrong.
        raise ControllerError(f"the controller's act gives no control: {error}; check its weights") from error
    if not isinstance(control, Control):  # pyright: ignore[reportUnnecessaryIsInstance]  # controllers are the user's
        raise ControllerError(f"the controller's act answered {_in_words(control)}, expected a roadproof.Control")
    values = cast("tuple[object, ...]", (control.steer, control.throttle, control.brake))
    if all(isinstance(value, float | int) for value in values):
        return control
    try:
        return Control(
            *(float(value.detach() if isinstance(value, Tensor) else cast("float", value)) for value in values)
        )
    except (TypeError, ValueError, RuntimeError) as error:
        words = ", ".join(_in_words(value) for value in values)
        raise ControllerError(f"the controller's act answered a Control of {words}; expected three numbers") from error


def frame_size_of(controller: Controller) -> tuple[int, int] | None:
    """`Controller.input_size`: (height, width) of the frames it takes, or None when it takes any size.

    Raises:
        ControllerError: asking for it raises, or gives something else.
    """
    size: object = call("the controller's input_size", getattr, controller, "input_size")
    if size is None:
        return None
    pair = cast("tuple[object, ...]", size) if isinstance(size, tuple) else ()
    if len(pair) != 2 or not all(is_whole(side) and side > 0 for side in pair):
        raise ControllerError(
            f"the controller's input_size is {size!r:.100}, expected a tuple (height, width) of whole numbers above 0, "
            "or None for any size"
        )
    if math.prod(cast("tuple[int, int]", pair)) > MOST_PIXELS:
        raise ControllerError(f"the controller's input_size is {size!r:.100}, expected {MOST_PIXELS:,} pixels at most")
    return cast("tuple[int, int]", size)


def require_size(controller: Controller, size: tuple[int, int], given: str, advice: str) -> None:
    """Refuse a controller that takes frames of another size, before it is asked about any.

    Args:
        controller: the controller.
        size: (height, width) of the frames that it will be given.
        given: who gives them, for the message, such as "the simulator gives".
        advice: what to do, for the message.

    Raises:
        ControllerError: the controller takes frames of another size.
    """
    if (own := frame_size_of(controller)) not in (None, size):
        raise ControllerError(
            f"the controller takes frames of {own[1]}×{own[0]}, {given} {size[1]}×{size[0]} (width×height); {advice}"
        )


def answer_of(
    controller: Controller, member: str, frames: Frames, speed_mps: Speeds, command: Commands
) -> Float[Tensor, "b ..."]:
    """What `steer` or `controls` answers, checked for shape, dtype and device, but not for its values.

    Raises:
        ControllerError: the controller raises, or its answer has not the promised shape, dtype or device.
    """
    answer: object = call(f"the controller's {member}", getattr(controller, member), frames, speed_mps, command)
    return _checked(answer, member, frames)


def _checked(answer: object, member: str, frames: Frames) -> Float[Tensor, "b ..."]:
    """An answer with the promised shape, dtype and device."""
    what = f"the controller's {member}"
    shape = (len(frames),) if member == "steer" else (len(frames), 3)
    meant = "one value a frame" if member == "steer" else "steer, throttle and brake a frame"
    expected = f"expected a floating-point tensor of shape {shape}, {meant}"
    if not isinstance(answer, Tensor):
        raise ControllerError(f"{what} answered {_in_words(answer)}, {expected}")
    if answer.shape != shape or not answer.is_floating_point() or answer.layout is not torch.strided:
        sparse = "" if answer.layout is torch.strided else f", {answer.layout}"
        raise ControllerError(f"{what} answered shape {tuple(answer.shape)}, {answer.dtype}{sparse}, {expected}")
    if answer.device != frames.device:
        raise ControllerError(f"{what} answered on {answer.device}, expected {frames.device}, where the frames are")
    return answer


def _usable(
    answer: Float[Tensor, "b ..."], member: str, frames: Frames, *, finite: bool = True
) -> Float[Tensor, "b ..."]:
    """An answer that is finite, where that is looked for, and has a gradient if the frames carry them."""
    if finite and not bool((known := answer.detach().isfinite()).all()):
        broken = int((~known.reshape(len(answer), -1).all(1)).sum())
        raise ControllerError(
            f"the controller's {member} answered NaN or infinity for {broken} of {len(answer)} frames; check its "
            "weights, divisions by zero and logarithms"
        )
    if torch.is_grad_enabled() and frames.requires_grad and not answer.requires_grad:
        raise ControllerError(f"the controller's {member} answered without a gradient to the frames; {NO_GRADIENT}")
    return answer


def _in_words(value: object) -> str:
    """The type of an unexpected answer with its shape or value, in a few words."""
    if isinstance(value, np.ndarray | Tensor):
        kind = "a numpy array" if isinstance(value, np.ndarray) else "a tensor"
        return f"{kind} of shape {tuple(cast('tuple[int, ...]', value.shape))}, {value.dtype}"
    if value is None:
        return "None"
    return f"a {type(value).__name__}"
