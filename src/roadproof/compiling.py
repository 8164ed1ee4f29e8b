"""Kernels for a CPU that Numba compiles when they are first called, and how many threads run them.

Numba has no type information, and reads the code of its kernels itself: modules with kernels leave their arguments
without types.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, partial
from inspect import getsource
from pathlib import Path
from threading import Lock
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from roadproof.io.identity import digest, stated

_numba: Any = importlib.import_module("numba")

_ROUNDED = {"nsz", "arcp", "contract", "afn", "reassoc"}
"""What may be computed otherwise than written, but for NaN and infinity, which stay what they are."""

_ALIKE: dict[str, Any] = {"fastmath": _ROUNDED, "error_model": "numpy"}
"""A division by 0 gives what it gives in tensors."""

_OPTIONS = {"nogil": True} | _ALIKE

inline: Any = _numba.njit(inline="always", **_ALIKE)
"""A function that kernels use, compiled as a part of them."""


class Kernel:
    """A function that is compiled when it is first called, and kept on the disk where there is a place for that.

    What is kept has a name of its own for every source and every number, so that nothing else is taken for it. Where it
    cannot be read or written, the function is compiled anew.

    Args:
        function: a function of a module; it may use functions and numbers that stand above it there.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function, self._lock = function, Lock()
        try:
            function.__qualname__ = self._name = f"{function.__qualname__}_{_told(function)[:16]}"
            self._compiled, self._is_kept = _numba.njit(function, cache=True, **_OPTIONS), True
        except (OSError, RuntimeError):  # no source, or no folder that can be written
            self._compiled, self._is_kept = _numba.njit(function, **_OPTIONS), False

    def __call__(self, *arguments: Any) -> Any:  # noqa: ANN401  # as of the function
        """What the function gives."""
        compiled = self._compiled
        try:
            return compiled(*arguments)
        except Exception:  # whatever a damaged file or a full disk raises, before anything is computed
            with self._lock:
                if compiled is self._compiled:
                    if not self._is_kept:
                        raise
                    with suppress(OSError):
                        for file in Path(compiled.stats.cache_path).glob(f"*.{self._name}-*"):
                            file.unlink()
                    self._compiled, self._is_kept = _numba.njit(self._function, **_OPTIONS), False
            return self._compiled(*arguments)


@cache
def _threads(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count)


def _told(function: Callable[..., Any]) -> str:
    """A digest of all that a function becomes machine code from."""
    module = sys.modules[function.__module__]
    kinds = (int, float, cast("type[object]", np.number))
    numbers = sorted((name, repr(value)) for name, value in vars(module).items() if isinstance(value, kinds))
    used = {value.py_func.__module__ for value in vars(module).values() if hasattr(value, "py_func")}
    sources = [getsource(sys.modules[name]) for name in sorted(used | {module.__name__})]
    return digest(*sources, stated(numbers), stated([sorted(_ROUNDED), _ALIKE["error_model"]]))


def run(kernel: Kernel, arguments: Sequence[Tensor | float | int], parts: int, *, worth: int = 1) -> None:
    """Run a kernel for each part of its work, on no more threads than torch has.

    Args:
        kernel: the kernel; its last argument is the number of the part.
        arguments: its other arguments; tensors are given as arrays, in the order in which their numbers lie.
        parts: number of parts, each of which writes what no other does.
        worth: how many parts are worth a thread: torch's own, which wait for more work, are in the way of others.
    """
    given = [each.detach().numpy() if isinstance(each, Tensor) else each for each in arguments]
    if (threads := min(torch.get_num_threads(), parts // worth)) > 1:
        list(_threads(threads).map(partial(kernel, *given), range(parts)))
    else:
        for part in range(parts):
            kernel(*given, part)
