"""Which number formats a device computes in at full speed."""

from __future__ import annotations

import torch


def multiplies_bfloat16(device: torch.device | str) -> bool:
    """Whether a device has arithmetic for bfloat16; on a processor without, it is about 16 times slower than float32.

    Measured on CIL's forward and backward pass with AVX2 alone; AVX-512 is as fast as in float32, or twice.
    """
    return torch.device(device).type != "cpu" or torch.backends.cpu.get_cpu_capability() == "AVX512"


def mixed_precision(place: torch.device) -> torch.autocast:
    """Let networks compute in bfloat16 where the device has it; geometry and colours need all their digits."""
    return torch.autocast(place.type, torch.bfloat16, enabled=multiplies_bfloat16(place))
