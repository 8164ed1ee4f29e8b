"""Keeping a running search on disk, so that an interrupted one goes on where it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from roadproof.io.files import write_tensors
from roadproof.io.identity import digest


def save_checkpoint(path: Path, identity: str, state: dict[str, Tensor]) -> None:
    """Write the tensors of a search, marked with the identity of that search.

    Raises:
        OutputError: the file cannot be written.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in state.items()}
    write_tensors(path, tensors, {"identity": digest(identity)})


def load_checkpoint(path: Path, identity: str, device: torch.device) -> dict[str, Tensor] | None:
    """The tensors of a search; None if there is no file, it is damaged, or it belongs to another search."""
    if not path.exists():
        return None
    try:
        with cast("Any", safe_open)(path, framework="pt") as stored:
            metadata: dict[str, str] = stored.metadata() or {}
            if metadata.get("identity") != digest(identity):
                return None
            names: list[str] = stored.keys()
            return {name: stored.get_tensor(name).to(device) for name in names}
    except (SafetensorError, OSError):
        return None
