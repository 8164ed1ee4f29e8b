"""Memory that large tensors come from."""

from __future__ import annotations

import ctypes

# From glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_MAX = -1, -4
_NEVER = -1


def keep_freed_memory() -> None:
    """Let this process keep what it frees for its next tensors, where the C library can be told to.

    Glibc gives blocks of more than 32 MiB back to the system at once, and every step of a search asks for them again:
    the page faults took 13 to 25 % of a step's processor time. A choice for whole processes, so the command line makes
    it, not the library; elsewhere than on glibc nothing happens.
    """
    try:
        set_option = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return
    set_option(_MMAP_MAX, 0)
    set_option(_TRIM_THRESHOLD, _NEVER)
