"""How a whole process uses the machine: choices for programs, so the command line makes them, not the library."""

from __future__ import annotations

import ctypes
import os

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


def sleep_while_waiting() -> None:
    """Let torch's threads sleep while one waits for another, instead of keeping its core; before torch is imported.

    Where anything else works on the machine, a thread that waits without end keeps the core from the one it waits for:
    on two cores, beside two other processes, a step of CIL took 0.5 s instead of 0.08 s. A choice of the user's own, by
    the environment variable OMP_WAIT_POLICY, stays.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
