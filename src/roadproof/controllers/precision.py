"""Which number formats a device computes in, and how fast."""

from __future__ import annotations

import torch

from roadproof.machine import keep_digits


def multiplies_bfloat16(device: torch.device | str) -> bool:
    """Whether a device has arithmetic for bfloat16; on a processor without, it is about 16 times slower than float32.

    Measured on CIL's forward and backward pass with AVX2 alone; AVX-512 is as fast as in float32, or twice.
    """
    return torch.device(device).type != "cpu" or torch.backends.cpu.get_cpu_capability() == "AVX512"


def mixed_precision(place: torch.device) -> torch.autocast:
    """Let networks compute in bfloat16 where the device has it; geometry and colours need all their digits."""
    return torch.autocast(place.type, torch.bfloat16, enabled=multiplies_bfloat16(place))


def multiply_in(dtype: str) -> None:
    """Let GPUs round float32 to TF32 where they multiply, for "tf32", or keep all digits; for the whole process.

    Torch's own choice is TF32 in convolutions alone. Of a gradient of PilotNet it costs about 0.1 %, of CIL 1 to 4 %
    (`benchmarks/gradopt_step.py`).
    """
    keep_digits(dtype == "tf32", "high" if dtype == "tf32" else "highest")
