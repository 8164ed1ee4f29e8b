"""How what a process works with comes to it, a user's controller among it."""

from __future__ import annotations

import io
import pickle
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any, cast

import torch

from roadproof import foreign
from roadproof.errors import ControllerError, SimulatorError

_PICKLED = "several processes need a controller that can be pickled: define its class in a module, or use one process"


def require_picklable(driver: object) -> None:
    """Refuse a controller, or another driver, that cannot travel to processes beside this one.

    Raises:
        ControllerError: the driver cannot be pickled; the message says why and what to do.
    """
    try:
        foreign.call("pickling the controller", pickle.dumps, driver)
    except ControllerError as error:
        raise ControllerError(f"{error}; {_PICKLED}") from error.__cause__


def require_opens_travels(opens: object) -> None:
    """Refuse what opens a simulator for each process beside this one, where it cannot travel there.

    Raises:
        SimulatorError: it cannot be pickled; the message says why and what to do.
    """
    try:
        pickle.dumps(opens)
    except Exception as error:  # of whatever a user's function holds
        raise SimulatorError(
            f"what opens a simulator for each process cannot travel there: {foreign.in_one_line(error)}; give a "
            "function of a module, or functools.partial of one"
        ) from error


class _Processor(pickle.Pickler):
    """Pickles what is on a GPU as if it were on the processor."""

    def reducer_override(self, thing: Any) -> Any:  # noqa: ANN401  # as of `pickle`
        if isinstance(thing, torch.device) and thing.type == "cuda":
            return torch.device, ("cpu",)
        if not isinstance(thing, torch.Tensor) or not thing.is_cuda:
            return NotImplemented
        here = thing.detach().cpu().requires_grad_(thing.requires_grad)
        parameter = isinstance(thing, torch.nn.Parameter)
        here = torch.nn.Parameter(here, thing.requires_grad) if parameter else here
        return cast("Any", here).__reduce_ex__(2)


def pickled(thing: object) -> bytes:
    """Anything as bytes: torch would have shared memory hold its tensors, of which containers have little."""
    with io.BytesIO() as file:
        _Processor(file).dump(thing)
        return file.getvalue()


def travelling(function: Callable[..., object]) -> bytes:
    """A function as it travels to a process, with whatever controller is in it.

    Raises:
        ControllerError: something in it cannot be pickled.
    """
    try:
        return pickled(function)
    except Exception as error:  # of a user's controller
        raise ControllerError(f"a controller cannot travel to another process: {error}; {_PICKLED}") from error


@lru_cache(maxsize=1)
def arrived(travelled: bytes | Path) -> Callable[[object, object], object]:
    """What a process is to call; a controller that came with it stays as the pieces before left it.

    Args:
        travelled: what `travelling` gave, or a file of it.
    """
    content = travelled.read_bytes() if isinstance(travelled, Path) else travelled
    return foreign.call("a controller that travelled to another process", pickle.loads, content)
