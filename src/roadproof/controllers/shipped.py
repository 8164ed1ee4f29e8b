"""Controllers that come with the package, by name, and their cards: what they learnt from and what they can do."""

from __future__ import annotations

import difflib
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from roadproof.errors import ControllerError

FOLDER = Path(__file__).parent / "assets"


@dataclass(frozen=True, kw_only=True, slots=True)
class ModelCard:
    """What there is to know about a shipped controller.

    Args:
        name: name by which the controller is loaded.
        summary: what the controller is, in one line.
        network: architecture and size of the network.
        data: what the network was trained on.
        training: how the network was trained: samples, rounds, seeds, time.
        can: what the controller does, with the scores that show it.
        cannot: what the controller does not do, or not well.
    """

    name: str
    summary: str
    network: str
    data: str
    training: str
    can: str
    cannot: str


def shipped_names() -> tuple[str, ...]:
    """Names of the controllers that come with the package."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.safetensors")))


def shipped_weights(name: str) -> Path:
    """The weights file of a shipped controller.

    Raises:
        ControllerError: no shipped controller has this name; the message names the nearest.
    """
    names = shipped_names()
    if name not in names:
        nearest = difflib.get_close_matches(name, names, n=1)
        hint = f"did you mean {nearest[0]!r}?" if nearest else f"there are {', '.join(names)}"
        raise ControllerError(f"no controller called {name!r} comes with roadproof; {hint}")
    return FOLDER / f"{name}.safetensors"


def model_card(name: str) -> ModelCard:
    """The card of a shipped controller.

    Raises:
        ControllerError: no shipped controller has this name.
    """
    path = shipped_weights(name).with_suffix(".toml")
    content: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    texts = {field.name: str(content[field.name]).strip() for field in fields(ModelCard) if field.name != "name"}
    return ModelCard(name=name, **texts)
