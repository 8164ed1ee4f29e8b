"""Small tensors on their devices: those that many calls need, made once for each device and kept there.

To make one anew at every call copies it from the host to the device, for which a GPU has to be waited for.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

Made = TypeVar("Made")
Numbers = tuple[float, ...] | tuple[tuple[float, ...], ...]


def constant(values: Numbers, like: Tensor) -> Tensor:
    """Numbers as a tensor on the device and in the precision of another; not to be written to.

    Args:
        values: the numbers, or rows of them.
        like: the tensor that has the device and the precision.
    """
    return kept(_exact, (values,), like)


def kept(make: Callable[..., Tensor], of: tuple[Hashable, ...], like: Tensor) -> Tensor:
    """What a function makes of some values, on the device and in the precision of a tensor; not to be written to.

    Args:
        make: the function, which gives a tensor on the CPU and the same one for the same values.
        of: the values.
        like: the tensor that has the device and the precision.
    """
    if not _is_real(like):
        return make(*of).to(like)
    return _kept(make, of, like.device, like.dtype)


def _is_real(tensor: Tensor) -> bool:
    """Whether a tensor holds numbers, rather than standing for some while a compiler looks at the code."""
    return type(tensor) in (Tensor, torch.nn.Parameter) and not torch.compiler.is_compiling()


@lru_cache(maxsize=1024)
def _kept(make: Callable[..., Tensor], of: tuple[Hashable, ...], device: torch.device, dtype: torch.dtype) -> Tensor:
    with torch.inference_mode(mode=False), torch.no_grad():
        return make(*of).to(device, dtype)


def _exact(values: Numbers) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def placed(made: Made, device: torch.device | str, dtype: torch.dtype) -> Made:
    """A dataclass with the tensors of its fields, and of tuples in them, on a device and in a precision."""

    def moved(value: Any) -> Any:  # noqa: ANN401  # whatever a field holds
        if isinstance(value, tuple):
            return tuple(map(moved, cast("tuple[object, ...]", value)))
        return value.to(device, dtype) if isinstance(value, Tensor) else value

    record = cast("Any", made)
    return replace(record, **{each.name: moved(getattr(record, each.name)) for each in fields(record)})
