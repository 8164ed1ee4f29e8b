"""Weights files: safetensors with a card in the header or beside it, which says of which network they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Shaped
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from roadproof.controllers.cards import CARD_FORMAT, ControllerCard, read_card
from roadproof.controllers.cil import CIL
from roadproof.controllers.conditional_pilotnet import ConditionalPilotNet
from roadproof.controllers.pilotnet import PILOTNET_ON_CARLA, PilotNet, pilotnet_controller
from roadproof.controllers.steering import CruiseControl, NetworkController
from roadproof.controllers.temporal import TemporalNet, temporal_controller
from roadproof.controllers.trajectory import TrajectoryController
from roadproof.controllers.waypoint import WAYPOINT_CRUISE, WaypointNet, waypoint_controller
from roadproof.errors import ControllerError
from roadproof.io.files import AnyPath, as_path, write_tensors
from roadproof.io.text import text_of

_METADATA_KEY = "roadproof"

ARCHITECTURES: dict[str, Callable[[ControllerCard], CIL | ConditionalPilotNet | NetworkController]] = {
    "cil": lambda card: CIL(width=card.width),
    "pilotnet": lambda card: pilotnet_controller(
        activation=card.activation,
        preparation=card.preparation or PILOTNET_ON_CARLA,
        cruise=CruiseControl(target_mps=card.target_speed_mps),
    ),
    "conditional-pilotnet": lambda card: ConditionalPilotNet(preparation=card.preparation or PILOTNET_ON_CARLA),
    "waypoint": lambda card: waypoint_controller(preparation=card.preparation, law=card.tracking),
    "temporal": lambda card: temporal_controller(preparation=card.preparation, law=card.tracking),
}
"""What makes the network that a card describes, with fresh weights, by the name of its architecture."""


def load_network(path: Path) -> CIL | ConditionalPilotNet | TrajectoryController:
    """A network ready for training: batch normalisation not merged, gradients on, in float32.

    Raises:
        ControllerError: the file is missing, damaged, or holds weights that cannot be trained on here.
    """
    network = from_weights(path, None)
    if not isinstance(network, CIL | ConditionalPilotNet | TrajectoryController):
        raise ControllerError(
            f"{path} holds a PilotNet, expected CIL, a conditional PilotNet, a waypoint or a temporal network"
        )
    return network


def save_controller(
    controller: CIL | ConditionalPilotNet | NetworkController,
    path: AnyPath,
    *,
    dtype: str = "float32",
    origin: str | None = None,
) -> None:
    """Write a CIL, PilotNet, waypoint or temporal controller as safetensors, its card in the header.

    Args:
        controller: the network as it was trained, not folded.
        path: path of the file to write.
        dtype: format of the stored numbers, "float16" or "float32"; half the bytes cost about 0.001 of steering.
        origin: what the weights were made from, in words, for the card.

    Raises:
        ControllerError: the controller is another network, or a folded one, which is to be saved as it was trained; or
            it keeps its speed as no card says; or the format is unknown, or too small for a number.
        OutputError: the file cannot be written; an older file of that name stays whole.
    """
    network: nn.Module = controller
    if isinstance(controller, ConditionalPilotNet):
        card = ControllerCard(architecture="conditional-pilotnet", preparation=controller.preparation)
    elif isinstance(controller, CIL):
        if controller.is_folded:
            raise ControllerError("a folded CIL cannot be saved; save the network it was folded from")
        card = ControllerCard(architecture="cil", width=controller.width)
    elif isinstance(network := controller.network, PilotNet):
        card = ControllerCard(
            architecture="pilotnet",
            activation=network.activation,
            target_speed_mps=controller.cruise.target_mps,
            preparation=controller.preparation,
        )
    elif isinstance(network, WaypointNet) and isinstance(controller, TrajectoryController):
        name = "temporal" if isinstance(network, TemporalNet) else "waypoint"
        card = ControllerCard(architecture=name, preparation=controller.preparation, tracking=controller.law)
    else:
        raise ControllerError(
            f"cannot save a {type(network).__name__}, expected CIL, PilotNet, a waypoint or a temporal network; export "
            "it instead"
        )
    if not isinstance(controller, CIL | ConditionalPilotNet):
        usual = CruiseControl(target_mps=card.target_speed_mps) if card.architecture == "pilotnet" else WAYPOINT_CRUISE
        if controller.cruise != usual:
            raise ControllerError(f"a card cannot hold {controller.cruise}, expected {usual}; save it with that")
    if dtype not in ("float16", "float32"):
        raise ControllerError(f"dtype is {dtype!r}, expected 'float16' or 'float32'")
    kept = torch.float16 if dtype == "float16" else torch.float32
    tensors = {name: tensor.to(kept) for name, tensor in tensors_of(network).items()}
    if too_large := [name for name, tensor in tensors.items() if not tensor.isfinite().all()]:
        raise ControllerError(f"tensor {too_large[0]} has NaN or numbers too large for {dtype}; save in float32")
    write_tensors(as_path(path), tensors, {_METADATA_KEY: replace(card, origin=origin).to_json()})


def tensors_of(network: nn.Module) -> dict[str, Shaped[Tensor, "..."]]:
    """What a file of a network's weights holds, each tensor for itself.

    Raises:
        ControllerError: the network has more than tensors to keep.
    """
    state: dict[str, object] = network.state_dict()
    if other := [name for name, value in state.items() if not isinstance(value, Tensor)]:
        raise ControllerError(
            f"{type(network).__name__} keeps {other[0]} beside its tensors (get_extra_state), which no weights file "
            "holds; let a buffer hold it"
        )
    return {name: cast("Tensor", value).detach().cpu().clone().contiguous() for name, value in state.items()}


def from_weights(path: Path, card: ControllerCard | None) -> nn.Module:
    """The network of a weights file.

    Args:
        path: the weights file.
        card: what the network is, where neither the file's header nor a card beside it says so.

    Raises:
        ControllerError: the file is missing or damaged, nothing says of which network it is, or it does not fit that.
    """
    state, header = _read(existing(path))
    if header is not None:
        own = read_card(header, str(path))
    else:
        # Where the architecture is named, a file of the same name may be anything.
        own = card_beside(path) if card is None or _is_card(path.with_suffix(".json")) else None
    if own is not None and own.architecture is None and card is not None:
        own = replace(own, architecture=card.architecture)
    if own is not None and card is not None and own.architecture != card.architecture:
        raise ControllerError(
            f"{path if header is not None else path.with_suffix('.json')} says that it is {own.architecture!r}, not "
            f"{card.architecture!r}; give the path alone"
        )
    card = own or card
    if card is None or card.architecture not in ARCHITECTURES:
        found = "nothing" if card is None or card.architecture is None else repr(card.architecture)
        raise ControllerError(
            f"{path} says {found} about its architecture; write {' or '.join(f'{a}:{path}' for a in ARCHITECTURES)}, "
            f"or put a card beside it as {path.with_suffix('.json').name}"
        )
    # A card may ask for gigabytes that its file does not hold.
    with torch.device("meta"):
        _check_shapes(_network_of(ARCHITECTURES[card.architecture](card)), state, path)
    made = ARCHITECTURES[card.architecture](card)
    _fill(_network_of(made), state, path)
    return made


def fill_from(path: Path, network: nn.Module) -> None:
    """Give a network the weights of a file.

    Raises:
        ControllerError: the file is missing or damaged, or holds the weights of another network.
    """
    state, _ = _read(existing(path))
    _check_shapes(network, state, path)
    _fill(network, state, path)


def _read(path: Path) -> tuple[dict[str, Shaped[Tensor, "..."]], str | None]:
    """The tensors of a safetensors file, and the text of the card in its header; None without a card."""
    try:
        with cast("Any", safe_open)(path, framework="pt") as file:
            state: dict[str, Tensor] = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata: dict[str, str] = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise ControllerError(f"{path} is not a safetensors file or is damaged: {error}") from error
    return state, metadata.get(_METADATA_KEY)


def _network_of(made: CIL | ConditionalPilotNet | NetworkController) -> nn.Module:
    return made.network if isinstance(made, NetworkController) else made


def _check_shapes(network: nn.Module, state: dict[str, Shaped[Tensor, "..."]], path: Path) -> None:
    """Refuse tensors of other names or shapes than the network's, which needs no numbers for it."""
    expected, name = network.state_dict(), type(network).__name__
    for key in sorted(expected.keys() ^ state.keys()):
        fault = "lacks" if key in expected else "has an unexpected"
        raise ControllerError(f"{path} {fault} tensor {key}; is it really a {name}?")
    for key, tensor in state.items():
        if tensor.shape != expected[key].shape:
            shapes = f"{tuple(tensor.shape)}, expected {tuple(expected[key].shape)}"
            raise ControllerError(f"{path}: tensor {key} has shape {shapes} for this {name}")


def _fill(network: nn.Module, state: dict[str, Shaped[Tensor, "..."]], path: Path) -> None:
    """Give a network tensors of its shapes, once their numbers are known to be some."""
    expected = network.state_dict()
    for key, tensor in state.items():
        if tensor.is_floating_point() != expected[key].is_floating_point():
            raise ControllerError(f"{path}: tensor {key} is of type {tensor.dtype}, expected {expected[key].dtype}")
        # Of numbers of 8 bits torch does not tell. A mask of a network's own may be infinite.
        if not tensor.float().isfinite().all() and not torch.equal(tensor.float(), expected[key].float()):
            raise ControllerError(f"{path}: tensor {key} has NaN or infinite values")
    network.load_state_dict(state)


def _is_card(path: Path) -> bool:
    try:
        return path.is_file() and CARD_FORMAT in text_of(path)
    except (OSError, ValueError):
        return False


def card_beside(path: Path) -> ControllerCard | None:
    """The card beside the file of a network, `FILE.json`; None where there is none.

    Raises:
        ControllerError: the card cannot be read.
    """
    card = path.with_suffix(".json")
    if not card.is_file():
        return None
    try:
        text = text_of(card)
    except (OSError, ValueError) as error:
        raise ControllerError(f"cannot read the card {card}: {error}") from error
    return read_card(text, str(card))


def existing(path: Path) -> Path:
    """The path of a controller's file that is there.

    Raises:
        ControllerError: there is no such file.
    """
    if path.is_dir():
        raise ControllerError(f"controller file {path} is a folder, expected a file of weights or an exported network")
    if not path.is_file():
        raise ControllerError(f"controller file {path} does not exist; check the path")
    return path
