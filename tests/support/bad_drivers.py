"""Controllers that do everything wrong that a stranger's may."""

import multiprocessing
import os
import sys
import time
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import torch

from roadproof.datatypes import Control


class Honest:
    """The mean brightness, right minus left."""

    input_size = (88, 200)

    def steer(self, frames, speed_mps, command):
        return frames[..., 100:].mean((1, 2, 3)) - frames[..., :100].mean((1, 2, 3))

    def act(self, frame, speed_mps, command):
        return Control(0.0, throttle=0.3)


class OfItsOwnBase(BaseException):
    """Passes what catches exceptions."""


class OfItsOwnError(Exception):
    """Its message cannot be had, and it has several lines."""

    def __str__(self):
        raise RuntimeError("no words")


def endless(depth=0):
    return endless(depth + 1)


def raising(error):
    def member(self, *arguments):
        raise error  # the line that is told

    return member


def answering(answer):
    """Steers by what `answer` makes of the honest answer."""

    def steer(self, frames, speed_mps, command):
        return answer(Honest.steer(self, frames, speed_mps, command))

    return steer


def controller(**members):
    return lambda: type("Bad", (Honest,), members)()


def unchecked(steer):
    """A control as it can be made where nothing checks types."""
    control = Control(0.0)
    object.__setattr__(control, "steer", steer)
    return control


# Exceptions, by the name they are told with.
RAISED = {
    "OfItsOwnBase": OfItsOwnBase("out"),
    "ZeroDivisionError": ZeroDivisionError("division by zero"),
    "ValueError": ValueError("two\nlines " + 1000 * "and more "),
    "KeyError": KeyError("road"),
    "SystemExit": SystemExit(7),
    "MemoryError": MemoryError(),
    "OfItsOwnError": OfItsOwnError(),
    "NotImplementedError": NotImplementedError(),
    "RuntimeError": RuntimeError("CUDA error: device-side assert triggered"),
}
STEER_RAISES = {name: controller(steer=raising(error)) for name, error in RAISED.items()}
STEER_RAISES["RecursionError"] = controller(steer=lambda self, *_: endless())
ACT_RAISES = {name: controller(act=raising(error)) for name, error in RAISED.items()}
ACT_RAISES["RecursionError"] = controller(act=lambda self, *_: endless())
INTERRUPTED = controller(act=raising(KeyboardInterrupt()))

# Wrong answers of steer, and what is said of them.
STEERS_WRONG = {
    "column": (lambda steer: steer[:, None], r"answered shape \((\d+), 1\), torch.float32, expected .* shape \(\1,\)"),
    "scalar": (lambda steer: steer.mean(), r"answered shape \(\)"),
    "one_more": (lambda steer: torch.cat([steer, steer[:1]]), r"answered shape \(\d+,\), torch.float32, expected"),
    "three_columns": (lambda steer: steer[:, None].expand(-1, 3), r"answered shape \(\d+, 3\)"),
    "numpy": (lambda steer: steer.detach().numpy(), r"answered a numpy array of shape \(\d+,\), float32, expected"),
    "list": (lambda steer: steer.tolist(), "answered a list, expected a floating-point tensor"),
    "number": (lambda steer: 0.1, "answered a float, expected"),
    "integers": (lambda steer: (10 * steer).long(), r"torch.int64, expected a floating-point tensor"),
    "None": (lambda steer: None, "answered None, expected"),
    "sparse": (lambda steer: steer.detach().to_sparse(), r"torch.float32, torch.sparse_coo, expected"),
    "NaN": (lambda steer: steer * float("nan"), r"NaN or infinity for (\d+) of \1 frames"),
    "one_infinity": (lambda steer: steer / torch.arange(len(steer)).clamp(max=1), "NaN or infinity for 1 of"),
    "detached": (lambda steer: steer.detach(), "without a gradient to the frames; compute it in torch"),
    "argmax": (
        lambda steer: torch.stack([steer, -steer], 1).argmax(1).float(),
        "without a gradient to the frames; compute it in torch",
    ),
}
STEERS = {name: controller(steer=answering(answer)) for name, (answer, _) in STEERS_WRONG.items()}

# Wrong answers of act, and what is said of them.
ACTS_WRONG = {
    "tuple": (lambda: (0.1, 0.2, 0.0), "answered a tuple, expected a roadproof.Control"),
    "None": (lambda: None, "answered None, expected a roadproof.Control"),
    "number": (lambda: 0.1, "answered a float, expected a roadproof.Control"),
    "array": (lambda: np.zeros(3), r"answered a numpy array of shape \(3,\), float64, expected"),
    "NaN": (lambda: Control(float("nan")), r"failed at \S*bad_drivers.py:\d+: control steer is nan"),
    "text": (lambda: unchecked("left"), "answered a Control of a str, a float, a float; expected three numbers"),
}
ACTS = {name: controller(act=lambda self, *_, answer=answer: answer()) for name, (answer, _) in ACTS_WRONG.items()}
TENSOR = controller(act=lambda self, *_: unchecked(torch.tensor(0.25, requires_grad=True)))


class InPlace(Honest):
    """Its gradient cannot be had: the backward pass meets what was changed in place."""

    def steer(self, frames, speed_mps, command):
        bright = frames.sigmoid()
        answer = bright.mean((1, 2, 3))
        bright += 1
        return answer


class WritesIntoFrames(Honest):
    """Answers well, and leaves other frames behind."""

    def steer(self, frames, speed_mps, command):
        answer = super().steer(frames, speed_mps, command)
        with torch.no_grad():
            frames.data.mul_(0.5)
        return answer


class Pedals(Honest):
    def controls(self, frames, speed_mps, command):
        return self.steer(frames, speed_mps, command)[:, None]


def sized(size):
    return controller(input_size=size)


SIZES = {
    "huge": controller(input_size=(10**9, 10**9)),
    "text": sized("88x200"),
    "list": sized([88, 200]),
    "one": sized((88,)),
    "zero": sized((0, 200)),
    "fractions": sized((88.0, 200.0)),
    "truths": sized((True, True)),
}
SIZE_RAISES = controller(input_size=property(raising(OSError("no camera"))))


def leaves():
    sys.exit("no licence")


def fails():
    return 1 / 0


def nothing():
    return None


class Hanging(Honest):
    """Its act does not come back, deaf to Ctrl-C's exception where `deaf`."""

    deaf = False

    def act(self, frame, speed_mps, command):
        while True:
            try:
                time.sleep(0.02)
            except KeyboardInterrupt:
                if not self.deaf:
                    raise


class Deaf(Hanging):
    deaf = True


class FailingInWorkers(Honest):
    """Acts well in the first process, where drives are named by what it answers."""

    def act(self, frame, speed_mps, command):
        if multiprocessing.parent_process() is not None:
            self.fail()
        return Honest.act(self, frame, speed_mps, command)

    def fail(self):
        return 1 / 0


class FailingFunction:
    """A driver that is a function; its policy fails in processes beside the first."""

    def __call__(self, simulator):
        return self.policy

    def policy(self, seen):
        return Control(0.0, throttle=1 / (multiprocessing.parent_process() is None))


class DyingInWorkers(FailingInWorkers):
    def fail(self):
        os._exit(3)


class FailingInOneWorker(FailingInWorkers):
    """Fails once, in the process that comes first; `taken` is a file that is not there yet."""

    def __init__(self, taken):
        self.taken = taken

    def fail(self):
        with suppress(FileExistsError):
            os.close(os.open(self.taken, os.O_CREAT | os.O_EXCL))
            return 1 / 0


# For the command line: bad_drivers:steers.column and so on.
raises = SimpleNamespace(**ACT_RAISES)
steers = SimpleNamespace(**STEERS)
acts = SimpleNamespace(**ACTS)
