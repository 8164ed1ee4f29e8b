"""Controllers that come with the package, by name, and their cards: what they learnt from and what they can do."""

from __future__ import annotations

import difflib
import importlib.util
import tomllib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from roadproof.errors import ControllerError

FOLDER = Path(__file__).parent / "assets"
"""The cards of all shipped controllers, and those of their weights that are small."""
INSTALL = "pip install 'roadproof[cil]'"
"""What installs the large ones, which are a distribution of their own."""


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
    """Names of the shipped controllers, whether their weights are installed or not."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def shipped_weights(name: str) -> Path:
    """The weights file of a shipped controller.

    Raises:
        ControllerError: no shipped controller has this name, where the message names the nearest; or its weights are
            not installed.
    """
    found = installed_weights(name)
    if found is None:
        raise ControllerError(f"the controller {name!r} needs its weights, which are not installed: {INSTALL}")
    return found


def installed_weights(name: str) -> Path | None:
    """The weights file of a shipped controller, or None where it is not installed.

    Raises:
        ControllerError: no shipped controller has this name; the message names the nearest.
    """
    file = _card_file(name).with_suffix(".safetensors").name
    large = importlib.util.find_spec("roadproof_cil")
    folders = (FOLDER, *((large.submodule_search_locations or ()) if large else ()))
    return next((path for folder in folders if (path := Path(folder, file)).is_file()), None)


def model_card(name: str) -> ModelCard:
    """The card of a shipped controller, whether its weights are installed or not.

    Raises:
        ControllerError: no shipped controller has this name; the message names the nearest.
    """
    content: dict[str, Any] = tomllib.loads(_card_file(name).read_text(encoding="utf-8"))
    texts = {field.name: str(content[field.name]).strip() for field in fields(ModelCard) if field.name != "name"}
    return ModelCard(name=name, **texts)


def _card_file(name: str) -> Path:
    names = shipped_names()
    if name not in names:
        nearest = difflib.get_close_matches(name, names, n=1)
        hint = f"did you mean {nearest[0]!r}?" if nearest else f"there are {', '.join(names)}"
        raise ControllerError(f"no controller called {name!r} comes with roadproof; {hint}")
    return FOLDER / f"{name}.toml"
