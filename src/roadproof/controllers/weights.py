"""Fresh weights that come from a seed alone."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

import torch
from torch import nn


@contextmanager
def seeded(seed: int) -> Generator[None, None, None]:
    """Draw random numbers from the seed inside the block; afterwards the global random state is as it was."""
    with torch.random.fork_rng(devices=[]):  # pyright: ignore[reportUnknownMemberType]
        torch.manual_seed(seed)  # pyright: ignore[reportUnknownMemberType]
        yield


def initialise_xavier(network: nn.Module, *, bias: float) -> None:
    """Give every convolution and dense layer Xavier weights and constant biases."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.Linear):
            nn.init.xavier_uniform_(module.weight)
            nn.init.constant_(module.bias, bias)  # pyright: ignore[reportArgumentType]
