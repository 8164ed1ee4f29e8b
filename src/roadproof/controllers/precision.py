"""Which number formats a device computes in, and how fast."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import nn
from torch.nn import Module

from roadproof.controllers.cil import CIL
from roadproof.controllers.conditional_pilotnet import ConditionalPilotNet
from roadproof.controllers.pilotnet import PilotNet
from roadproof.controllers.protocol import Controller
from roadproof.controllers.waypoint import WaypointNet
from roadproof.machine import keep_digits


def multiplies_bfloat16(device: torch.device | str) -> bool:
    """Whether a device has arithmetic for bfloat16; on a processor without, it is about 16 times slower than float32.

    Measured on CIL's forward and backward pass with AVX2 alone. With AVX-512's instructions for it bfloat16 is as fast
    as float32, or twice, and with AMX three to four times; PilotNet with AMX is twice as fast.
    """
    if torch.device(device).type != "cpu":
        return True
    told: Mapping[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()  # not in old torch
    return torch.backends.cpu.get_cpu_capability() == "AVX512" and bool(told.get("avx512_bf16", True))


def is_torch_alone(controller: Controller | Module) -> bool:
    """Whether a controller is a network of torch's and roadproof's modules, so that nothing in it is a user's code."""
    ours = ("torch", "roadproof")
    return isinstance(controller, Module) and all(
        type(each).__module__.partition(".")[0] in ours for each in controller.modules()
    )


def lay_out(network: Module) -> None:
    """Order the weights of convolutions channels-last, in place: measured on two processors, that is 1.3 times as fast.

    Of a network with a user's code in it only the weights of torch's own convolutions: the code may look at its own in
    the order that it gave them. Torch has the order for pictures, not for weights over time as well.
    """
    weights = (*network.parameters(), *network.buffers())
    whole = is_torch_alone(network) and all(each.ndim != 5 for each in weights)
    own = [each for each in network.modules() if type(each) in (nn.Conv2d, nn.ConvTranspose2d)]
    for part in [network] if whole else own:
        cast("Any", part).to(memory_format=torch.channels_last)


def for_climbing(controller: Controller, device: torch.device) -> Controller:
    """The controller with which a gradient is climbed: in bfloat16 on a processor that has arithmetic for it.

    Of a network of roadproof's architectures in float32 it is a copy; any other controller is returned as it is: what a
    user's code or an exported network makes of bfloat16 nobody knows. A GPU waits for launches, not for products.
    """
    ours = isinstance(getattr(controller, "network", controller), CIL | ConditionalPilotNet | PilotNet | WaypointNet)
    if device.type != "cpu" or not multiplies_bfloat16(device) or not ours or not is_torch_alone(controller):
        return controller
    network = cast("Module", controller)
    if {each.dtype for each in network.parameters()} != {torch.float32}:
        return controller
    return cast("Any", copy.deepcopy(network).to(torch.bfloat16))


def mixed_precision(place: torch.device) -> torch.autocast:
    """Let networks compute in bfloat16 where the device has it; geometry and colours need all their digits."""
    return torch.autocast(place.type, torch.bfloat16, enabled=multiplies_bfloat16(place))


def multiply_in(dtype: str) -> None:
    """Let GPUs round float32 to TF32 where they multiply, for "tf32", or keep all digits; for the whole process.

    Torch's own choice is TF32 in convolutions alone. Of a gradient of PilotNet it costs about 0.1 %, of CIL 1 to 4 %
    (`benchmarks/gradopt_step.py`).
    """
    keep_digits(dtype == "tf32", "high" if dtype == "tf32" else "highest")
