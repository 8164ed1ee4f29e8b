"""Keeping a running search on disk, so that an interrupted one goes on where it was."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from roadproof.errors import RoadproofError
from roadproof.io.files import write_tensors
from roadproof.io.identity import digest


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """The file that keeps a running search, marked with the identity of that search.

    Args:
        path: file that keeps the search; None keeps nothing.
        identity: text that tells this search from every other.
        aim: name of the objective; empty where nobody said.
    """

    path: Path | None
    identity: str
    aim: str = ""

    def save(self, state: dict[str, Tensor]) -> None:
        """Write the tensors of the search by name.

        Raises:
            OutputError: the file cannot be written.
        """
        if self.path is not None:
            tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in state.items()}
            write_tensors(self.path, tensors, {"identity": digest(self.identity), "aim": self.aim})

    def load(self, device: torch.device) -> dict[str, Tensor] | None:
        """The tensors on a device; None if there is no file, it is damaged, or it belongs to another search.

        Raises:
            RoadproofError: the file holds a search for another objective.
        """
        if self.path is None or not self.path.exists():
            return None
        try:
            with cast("Any", safe_open)(self.path, framework="pt") as stored:
                metadata: dict[str, str] = stored.metadata() or {}
                if (other := metadata.get("aim", "")) != self.aim and other and self.aim:
                    raise RoadproofError(
                        f"{self.path} holds an interrupted search for the {other}, this one is for the {self.aim}; "
                        "choose another folder, or remove it"
                    )
                if metadata.get("identity") != digest(self.identity):
                    return None
                names: list[str] = stored.keys()
                return {name: stored.get_tensor(name).to(device) for name in names}
        except (SafetensorError, OSError):
            return None
