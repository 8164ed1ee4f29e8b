"""Which controller it is: known by what it is and what it answers, not by what it is called.

A controller that is trained again and keeps its name has other weights; a function that its author changed has another
source. Drives, recordings and runs that were made with the one are not taken for those of the other.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from itertools import product
from typing import Any, TypedDict, cast

import numpy as np
from jaxtyping import UInt8
from torch import nn

from roadproof.controllers.asking import frame_size_of, next_act_of
from roadproof.controllers.protocol import Controller
from roadproof.datatypes import Command, Control
from roadproof.errors import ControllerError
from roadproof.io.identity import digest, stated
from roadproof.io.known import known_by, plain_fields

Answers = list[tuple[float, ...]]

_SPEEDS_MPS = (2.0, 8.0)
_ELAPSED_S = (0.0, 0.05, 0.3, 2.0)
"""Times from picture to picture for a controller that remembers: what it does with near and with far ones tells."""


def answers_of(controller: Controller, size: tuple[int, int]) -> Answers:
    """Steer, throttle and brake for four made-up pictures, to four digits: the same for the same controller.

    Args:
        controller: the controller; it is asked to act at 6 m/s, following the lane. One that remembers sees the
            pictures as those of one drive.
        size: (height, width) of the pictures in px, if the controller does not name its own.

    Raises:
        ControllerError: the controller raises, or answers with something that is no control.
    """
    rng = np.random.default_rng(0)
    size = frame_size_of(controller) or size
    answers: Answers = []
    memory: object = None
    for elapsed_s in _ELAPSED_S:
        seen = (_picture(rng, size), 6.0, 2)
        control, memory = next_act_of(controller, memory, *seen, elapsed_s)
        answers.append(_rounded(control))
    return answers


def identity_of(driver: object, size: tuple[int, int]) -> str:
    """A short digest of all that tells a driver: weights, settings, source, and a controller's answers to any command.

    What a controller keeps of being asked, as a count, does not tell it from others.

    Args:
        driver: a controller, or a function that drives, such as `training.expert.expert`.
        size: (height, width) in px of the pictures it is shown, if the controller does not name its own.

    Returns:
        16 hexadecimal digits; empty for a function of which only the name is known, as for ours.

    Raises:
        ControllerError: the controller raises, or answers with something that is no control.
    """
    return told_of(driver, size)[1]


def told_of(driver: object, size: tuple[int, int]) -> tuple[Answers, str]:
    """What `answers_of` and `identity_of` give for a driver, which is asked once; a function has no answers."""
    if not isinstance(driver, Controller):
        told = known_by(driver)
        return [], "" if set(told) == {"function"} else digest(stated(told))[:16]
    # Whatever it makes when it is first asked is there then.
    first = answers_of(driver, size)
    before = plain_fields(driver)
    asked = _answers_to_all(driver, size)
    after = plain_fields(driver)
    steady = {name: value for name, value in before.items() if after.get(name) == value}
    return first, digest(stated([known_by(driver), steady, first, asked]))[:16]


def architecture_of(controller: Controller) -> str:
    """What a controller is made of, whatever it has learnt: its type, and a hash of its layers and tensors' shapes.

    Of one that is no module, the modules count that its attributes are or hold.
    """
    name = type(controller).__qualname__
    kept = [controller] if isinstance(controller, nn.Module) else _modules_in(getattr(controller, "__dict__", {}))
    if not kept:
        return name
    layers = [type(layer).__qualname__ for module in kept for layer in module.modules()]
    states = [(path, value) for module in kept for path, value in module.state_dict().items()]
    shapes = [(path, list(getattr(value, "shape", ()))) for path, value in states]
    return f"{name}-{digest(json.dumps([layers, shapes]))[:8]}"


class Parts(TypedDict):
    """The parts by which a folder knows a driver: `io.identity.ANSWERS` and `CONTROLLER`."""

    answers: str
    controller_digest: str


def parts_of(driver: object, size: tuple[int, int]) -> Parts:
    """The parts by which a folder knows a driver, by name; arguments and errors are those of `identity_of`."""
    answers, which = told_of(driver, size)
    return {"answers": digest(stated(answers))[:16] if answers else "", "controller_digest": which}


def _modules_in(value: object) -> list[nn.Module]:
    """The modules that a value is or holds, in dicts, lists and tuples within each other."""
    if isinstance(value, nn.Module):
        return [value]
    held: Iterable[Any] = ()
    if isinstance(value, dict):
        held = cast("dict[Any, Any]", value).values()
    elif isinstance(value, list | tuple):
        held = cast("list[Any]", value)
    return [module for each in held for module in _modules_in(each)]


def _answers_to_all(controller: Controller, size: tuple[int, int]) -> list[tuple[float, ...] | None]:
    """What a controller answers to every command at two speeds; None to one that it refuses."""
    rng = np.random.default_rng(1)
    answers: list[tuple[float, ...] | None] = []
    for command, speed_mps in product(Command, _SPEEDS_MPS):
        seen = (_picture(rng, frame_size_of(controller) or size), speed_mps, int(command))
        try:
            answers.append(_rounded(next_act_of(controller, None, *seen, 0.0)[0]))
        except ControllerError:
            answers.append(None)
    return answers


def _picture(rng: np.random.Generator, size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """A made-up picture of coarse noise."""
    height, width = size
    coarse = rng.integers(0, 256, (6, 8, 3), np.uint8)
    frame = np.repeat(np.repeat(coarse, -(-height // 6), 0), -(-width // 8), 1)[:height, :width]
    return np.ascontiguousarray(frame)


def _rounded(control: Control) -> tuple[float, ...]:
    return tuple(round(value, 4) for value in (control.steer, control.throttle, control.brake))
