"""Keeping a running search on disk, so that an interrupted one goes on where it was."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from roadproof.errors import RoadproofError
from roadproof.io.files import write_tensors
from roadproof.io.identity import digest


def save_checkpoint(path: Path, identity: str, state: dict[str, Tensor], *, aim: str = "") -> None:
    """Write the tensors of a search, marked with the identity of that search.

    Args:
        path: file to write.
        identity: text that tells this search from every other.
        state: the tensors of the search by name.
        aim: name of the objective; empty where nobody said.

    Raises:
        OutputError: the file cannot be written.
    """
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in state.items()}
    write_tensors(path, tensors, {"identity": digest(identity), "aim": aim})


def load_checkpoint(path: Path, identity: str, device: torch.device, *, aim: str = "") -> dict[str, Tensor] | None:
    """The tensors of a search; None if there is no file, it is damaged, or it belongs to another search.

    Args:
        path: file that may hold a search.
        identity: text that tells this search from every other.
        device: torch device of the tensors.
        aim: name of the objective; empty where nobody said.

    Raises:
        RoadproofError: the file holds a search for another objective.
    """
    if not path.exists():
        return None
    try:
        with cast("Any", safe_open)(path, framework="pt") as stored:
            metadata: dict[str, str] = stored.metadata() or {}
            if (other := metadata.get("aim", "")) != aim and other and aim:
                raise RoadproofError(
                    f"{path} holds an interrupted search for the {other}, this one is for the {aim}; choose another "
                    "folder, or remove it"
                )
            if metadata.get("identity") != digest(identity):
                return None
            names: list[str] = stored.keys()
            return {name: stored.get_tensor(name).to(device) for name in names}
    except (SafetensorError, OSError):
        return None
