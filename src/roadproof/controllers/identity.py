"""Which controller it is: known by what it answers, not by what it is called.

A controller that is trained again and keeps its name answers otherwise; so does a function whose author changed it.
Drives, recordings and runs that were made with the one are not taken for those of the other.
"""

from __future__ import annotations

import numpy as np

from roadproof.controllers.asking import act_after_of, act_of, frame_size_of
from roadproof.controllers.protocol import Controller, TemporalController
from roadproof.io.identity import digest, stated

Answers = list[tuple[float, ...]]

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
    height, width = frame_size_of(controller) or size
    answers: Answers = []
    memory: object = None
    for elapsed_s in _ELAPSED_S:
        coarse = rng.integers(0, 256, (6, 8, 3), np.uint8)
        frame = np.repeat(np.repeat(coarse, -(-height // 6), 0), -(-width // 8), 1)[:height, :width]
        seen = (np.ascontiguousarray(frame), 6.0, 2)
        if isinstance(controller, TemporalController):
            control, memory = act_after_of(controller, memory, *seen, elapsed_s)
        else:
            control = act_of(controller, *seen)
        answers.append(tuple(round(value, 4) for value in (control.steer, control.throttle, control.brake)))
    return answers


def identity_of(driver: object, size: tuple[int, int]) -> str:
    """A short digest of a controller's answers; empty for a function, which its user names.

    Args:
        driver: a controller, or a function that drives, such as `training.expert.expert`.
        size: (height, width) in px of the pictures it is shown, if the controller does not name its own.

    Raises:
        ControllerError: the controller raises, or answers with something that is no control.
    """
    if not isinstance(driver, Controller):
        return ""
    return digest(stated(answers_of(driver, size)))[:16]
