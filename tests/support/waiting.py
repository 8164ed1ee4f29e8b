"""Finds what no CUDA graph can hold, where there is no GPU: numbers asked of the device, or sent to it."""

import contextlib
import dataclasses

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


class WaitingError(RuntimeError):
    pass


class _NoWaiting(TorchDispatchMode):
    refused = ("_local_scalar_dense", "nonzero", "lift_fresh", "masked_select", "is_nonzero", "equal", "_unique2")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        devices = {leaf.device for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)}
        answer = func(*args, **(kwargs or {}))
        after = {leaf.device for leaf in tree_leaves(answer) if isinstance(leaf, torch.Tensor)}
        mixed = len(devices) > 1 and name in ("copy_", "_to_copy", "index")
        moved = name in ("_to_copy", "copy_") and devices and not after <= devices
        by_mask = name == "index" and any(each is not None and each.dtype == torch.bool for each in args[1])
        if name in self.refused or mixed or moved or by_mask:
            raise WaitingError(f"{name} waits for the device")
        return answer


class _NothingFromNumbers(TorchFunctionMode):
    # Torch hides from its dispatcher what some of these do.
    refused = (torch.tensor, torch.as_tensor, torch.from_numpy, torch.Tensor.new_tensor, torch.Tensor.tolist)

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func in self.refused:
            raise WaitingError(f"{func.__name__} waits for the device")
        return func(*args, **(kwargs or {}))


@contextlib.contextmanager
def no_waiting():
    """Refuses what no graph can hold: numbers that the host asks for or sends, and shapes that depend on numbers."""
    with _NoWaiting(), _NothingFromNumbers():
        yield


def by_hand(advance, restart, device):
    """In place of a CUDA graph: the step itself, once it was seen to ask for nothing."""
    with no_waiting():
        advance()
    restart()
    # Some operations ask for numbers only where no mode looks on, as does the gradient of a cumulative product.
    with torch.autograd.profiler.profile() as profiled:
        advance()
    restart()
    waited = {event.name.removeprefix("aten::") for event in profiled.function_events} & set(_NoWaiting.refused)
    if waited:
        raise WaitingError(f"{', '.join(waited)} waits for the device")
    return advance


def on_meta(value):
    """A record with its tensors on the device "meta", which has shapes and every operation, but no numbers."""
    if isinstance(value, torch.Tensor):
        return value.to("meta")
    if isinstance(value, tuple) and hasattr(value, "_fields"):
        return type(value)(*map(on_meta, value))
    if isinstance(value, list | tuple):
        return type(value)(on_meta(each) for each in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = {each.name: on_meta(getattr(value, each.name)) for each in dataclasses.fields(value)}
        return dataclasses.replace(value, **fields)
    return value
