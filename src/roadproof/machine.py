"""How a whole process uses the machine, which programs choose, not the library; and what the machine is."""

from __future__ import annotations

import ctypes
import os
import platform
import re
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

# From glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
_NEVER = -1


def keep_freed_memory() -> None:
    """Let this process keep what it frees for its next tensors, where the C library can be told to.

    Glibc gives blocks of more than 32 MiB back to the system at once, and every step of a search asks for them again:
    the page faults took 13 to 25 % of a step's processor time. Elsewhere than on glibc nothing happens.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    set_option(_MMAP_MAX, 0)
    set_option(_TRIM_THRESHOLD, _NEVER)


def give_back_freed_memory() -> None:
    """Give what this process has freed back to the system, where the C library can be told to: others may need it."""
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def sleep_while_waiting() -> None:
    """Let torch's threads sleep soon while one waits for another, where GNU OpenMP runs them; before torch is imported.

    By itself a thread that waits keeps its core for some milliseconds, also from the one it waits for where anything
    else works on the machine. Seconds a step of a search with PilotNet took with two threads on two cores, by how often
    a thread looks before it sleeps (measured; one thread alone took 1.9 s beside others, 1.3 s on free cores):

        looks           500   1,000   2,000   5,000   20,000
        free cores      1.2    1.04    1.05    0.95     0.96
        beside others     –     2.4     3.3     4.2      6.3, up to 14.8

    What the user's environment says stays.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", "5000")


@contextmanager
def threads(count: int) -> Generator[None]:
    """Let torch compute with so many threads here: the last digits of a network's answers depend on their number."""
    import torch

    usual = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(usual)


def made_with() -> dict[str, object]:
    """What figures are made with, to stand beside them: the processor, its cores, torch's threads, versions."""
    import numpy as np
    import PIL
    import torch

    import roadproof

    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "roadproof": roadproof.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "pillow": PIL.__version__,
        "torch": torch.__version__,
    }


def _processor() -> str:
    """The processor's name; its kind where the system does not say."""
    with suppress(OSError):
        if named := re.search(r"^model name\s*: (.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE):
            return named[1]
    return platform.processor() or platform.machine()


def digits() -> tuple[bool, str]:
    """What torch keeps of float32 where a GPU multiplies: whether convolutions round to TF32; its word for matrices."""
    import torch

    return torch.backends.cudnn.allow_tf32, torch.get_float32_matmul_precision()


def keep_digits(tf32: bool, matrices: str) -> None:
    """Set what `digits` tells, for the whole process."""
    import torch

    torch.backends.cudnn.allow_tf32 = tf32
    torch.set_float32_matmul_precision(matrices)
