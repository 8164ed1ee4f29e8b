"""From a spec to a controller: weights files, exported networks, your own Python."""

from __future__ import annotations

import copy
import importlib.util
import re
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Shaped
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from roadproof.controllers.asking import frame_size_of
from roadproof.controllers.cards import ControllerCard, read_card
from roadproof.controllers.cil import CIL
from roadproof.controllers.conditional_pilotnet import ConditionalPilotNet
from roadproof.controllers.pilotnet import PILOTNET_ON_CARLA, PilotNet, pilotnet_controller
from roadproof.controllers.protocol import Controller, missing_members
from roadproof.controllers.shipped import shipped_weights
from roadproof.controllers.steering import CruiseControl, NetworkController
from roadproof.controllers.temporal import TemporalNet, temporal_controller
from roadproof.controllers.trajectory import TrajectoryController
from roadproof.controllers.waypoint import WaypointNet, waypoint_controller
from roadproof.errors import ControllerError, DeviceError
from roadproof.foreign import call
from roadproof.io.files import AnyPath, as_path, write_tensors

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float64": torch.float64}
SPECS = (
    "the name of a shipped one (`roadproof controllers`), FILE.safetensors, cil:FILE.safetensors, "
    "pilotnet:FILE.safetensors, FILE.pt2, FILE.onnx, module:factory (a function in your Python) or "
    "module:factory@FILE.safetensors (with other weights)"
)

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


def runs_code(spec: str) -> bool:
    """Whether loading a controller from this spec runs its author's code: an exported network, or Python."""
    head, _, tail = spec.partition(":")
    return spec.endswith(".pt2") or (bool(tail) and head not in ARCHITECTURES)


def load_network(path: Path) -> CIL | ConditionalPilotNet | TrajectoryController:
    """A network ready for training: batch normalisation not merged, gradients on, in float32.

    Raises:
        ControllerError: the file is missing, damaged, or holds weights that cannot be trained on here.
    """
    network = _from_weights(path, None)
    if not isinstance(network, CIL | ConditionalPilotNet | TrajectoryController):
        raise ControllerError(
            f"{path} holds a PilotNet, expected CIL, a conditional PilotNet, a waypoint or a temporal network"
        )
    return network


def load_controller(spec: str | Path, *, device: str = "cpu", dtype: str = "float32") -> Controller:
    """Load a controller for attack or driving: in eval mode, its parameters without gradients.

    Args:
        spec: one of
            `cil`, `pilotnet` …: one that comes with roadproof, see `shipped` (`cil` and `cil-small`: extra `cil`);
            `FILE.safetensors`: weights; the card in its header (`save_controller`) or beside it as `FILE.json` says
            of which network;
            `cil:FILE.safetensors`, `pilotnet:FILE.safetensors`: weights without a card, of the published network on
            the frames of CARLA's agent;
            `FILE.pt2`, `FILE.onnx`: a network exported by `torch.export` or to ONNX (extra `onnx`), see `exported`;
            `module:factory`: a function without arguments that returns a `Controller`; the current directory is
            importable;
            `module:factory@FILE.safetensors`: the same, a `torch.nn.Module`, with weights that `harden` tuned.
        device: "cpu", "cuda" or "cuda:N".
        dtype: precision in which the network computes: "float32", "bfloat16" or "float64". Frames may stay in float32.

    Raises:
        ControllerError: the spec or file does not exist, the weights are not installed or do not fit, or the object is
            no controller.
        DeviceError: the device or dtype is not available.

    Note:
        A `.pt2` file and `module:factory` run what their authors wrote: load only what you trust. Weights files hold
        numbers alone.
    """
    place, precision = device_of(device), _dtype(dtype)
    text = str(spec)
    controller = _found(text, place, precision)
    return call(f"moving the controller to {place} in {dtype}", _placed, controller, place, precision)


def load_trainable(spec: str) -> nn.Module:
    """A controller ready for training: nothing merged, in float32, on the CPU, in eval mode, with gradients.

    Args:
        spec: spec as `load_controller` takes it. In the module of a Python factory, those parameters are trained that
            its author left with gradients, or all if there are none.

    Raises:
        ControllerError: as `load_controller`; or the controller is an exported network, or no module with parameters.
    """
    if spec.endswith((".pt2", ".onnx")):
        raise ControllerError(
            f"{spec} is an exported network; to train on, give the Python it came from: module:factory"
        )
    network = _found(spec, torch.device("cpu"), torch.float32)
    if not isinstance(network, nn.Module) or not any(True for _ in network.parameters()):
        raise ControllerError(
            f"{spec} gives a {type(network).__name__}, expected a torch.nn.Module with parameters, so that it can learn"
        )
    if not any(each.requires_grad for each in network.parameters()):
        network.requires_grad_(True)
    # A factory may give the same object each time.
    return copy.deepcopy(network).eval()


def _found(text: str, device: torch.device, dtype: torch.dtype) -> Controller | nn.Module:
    """The controller of a spec as its maker returns it, before it is set up for use."""
    head, _, tail = text.partition(":")
    factory, at, weights = tail.partition("@")
    if head in ARCHITECTURES and tail:
        return _from_weights(Path(tail), ControllerCard(architecture=head))
    if re.fullmatch(r"[a-z][a-z0-9-]*", text):
        return _from_weights(shipped_weights(text), None)
    if factory and all(part.isidentifier() for part in (*head.split("."), *factory.split("."))):
        made = _from_python(head, factory)
        if at:
            if not isinstance(made, nn.Module):
                raise ControllerError(
                    f"{head}:{factory} gives a {type(made).__name__}, which has no weights to replace"
                )
            _fill(made, _read_weights(_existing(Path(weights)))[0], Path(weights))
        return made
    if text.endswith(".safetensors"):
        return _from_weights(Path(text), None)
    if text.endswith((".pt2", ".onnx")):
        path = _existing(Path(text))
        # Exported networks are met in their own room: ONNX is an extra.
        from roadproof.controllers.exported import exported_controller

        return exported_controller(path, _card_beside(path) or ControllerCard(), device=device, dtype=dtype)
    if text.endswith(PICKLES):
        raise ControllerError(
            f"{text} is a file of torch.save or TorchScript, which may run code when it is opened; in Python, export "
            "its network with torch.export.save(torch.export.export(network, ...), 'FILE.pt2') or torch.onnx.export, "
            "or name a function of yours that returns it: module:factory"
        )
    raise ControllerError(f"unknown controller {text!r}, expected {SPECS}")


def files_of(spec: str) -> tuple[Path, ...]:
    """The files that are there of a user's controller: its weights or network, and its function's module.

    Nothing is imported, but for the packages that a module lies in. A controller that comes with roadproof has none.
    """
    head, _, tail = spec.partition(":")
    factory, at, weights = tail.partition("@")
    named = [Path(weights)] if at else []
    if factory and all(part.isidentifier() for part in (*head.split("."), *factory.split("."))):
        with _current_directory_importable(), suppress(ImportError, ValueError):
            found = importlib.util.find_spec(head)
            named = [*([Path(found.origin)] if found and found.origin else []), *named]
    elif head not in ARCHITECTURES or tail:
        named = [Path(tail if head in ARCHITECTURES else spec)]
    return tuple(path for path in named if path.suffix and path.is_file())


PICKLES = (".pt", ".pth", ".ckpt", ".pkl", ".ts", ".torchscript", ".jit")
"""What files of torch.save and TorchScript are called."""


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
        ControllerError: the controller is another network, or a folded one; save it as it was trained.
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
    kept = torch.float16 if dtype == "float16" else torch.float32
    tensors = {name: tensor.detach().cpu().to(kept).contiguous() for name, tensor in network.state_dict().items()}
    write_tensors(as_path(path), tensors, {_METADATA_KEY: replace(card, origin=origin).to_json()})


def _from_weights(path: Path, card: ControllerCard | None) -> nn.Module:
    state, header = _read_weights(_existing(path))
    if card is None:
        card = read_card(header, str(path)) if header is not None else _card_beside(path)
    if card is None or card.architecture not in ARCHITECTURES:
        found = "nothing" if card is None or card.architecture is None else repr(card.architecture)
        raise ControllerError(
            f"{path} says {found} about its architecture; write {' or '.join(f'{a}:{path}' for a in ARCHITECTURES)}, "
            f"or put a card beside it as {path.with_suffix('.json').name}"
        )
    made = ARCHITECTURES[card.architecture](card)
    _fill(made.network if isinstance(made, NetworkController) else made, state, path)
    return made


def _read_weights(path: Path) -> tuple[dict[str, Shaped[Tensor, "..."]], str | None]:
    """The tensors of a safetensors file, and the text of the card in its header; None without a card."""
    try:
        with cast("Any", safe_open)(path, framework="pt") as file:
            state: dict[str, Tensor] = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            metadata: dict[str, str] = file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise ControllerError(f"{path} is not a safetensors file or is damaged: {error}") from error
    return state, metadata.get(_METADATA_KEY)


def _fill(network: nn.Module, state: dict[str, Shaped[Tensor, "..."]], path: Path) -> None:
    expected = network.state_dict()
    name = type(network).__name__
    for key in sorted(expected.keys() ^ state.keys()):
        fault = "lacks" if key in expected else "has an unexpected"
        raise ControllerError(f"{path} {fault} tensor {key}; is it really a {name}?")
    for key, tensor in state.items():
        if tensor.shape != expected[key].shape:
            shapes = f"{tuple(tensor.shape)}, expected {tuple(expected[key].shape)}"
            raise ControllerError(f"{path}: tensor {key} has shape {shapes} for this {name}")
        if not tensor.isfinite().all():
            raise ControllerError(f"{path}: tensor {key} has NaN or infinite values")
    network.load_state_dict(state)


def imported(spec: str, expected: str) -> Callable[..., object]:
    """A function of the user's own Python, "module:function"; the current directory is importable.

    Args:
        spec: the function's module and name, with a colon between.
        expected: description of what the function should be, for messages.

    Raises:
        ControllerError: the module cannot be imported, lacks the function, or has something else of that name.
    """
    module_name, _, name = spec.partition(":")
    with _current_directory_importable():
        try:
            found: object = call(f"the import of {module_name}", importlib.import_module, module_name)
            for part in name.split("."):
                found = getattr(found, part)
        except (ControllerError, AttributeError) as error:
            reason = error.__cause__ or error
            # What a module of the user's lacks itself is told with its line.
            absent = isinstance(reason, ModuleNotFoundError) and f"{module_name}.".startswith(f"{reason.name}.")
            if not absent and isinstance(error, ControllerError):
                raise
            raise ControllerError(f"cannot import {spec}: {reason}; expected {expected}") from reason
    if not callable(found):
        raise ControllerError(f"{spec} is {found!r:.100}, expected {expected}")
    return found


def _from_python(module_name: str, factory_name: str) -> Controller:
    spec = f"{module_name}:{factory_name}"
    factory = imported(spec, f"a function without arguments; or give {SPECS}")
    with _current_directory_importable():
        controller: object = call(spec, factory)
        missing = call(spec, missing_members, controller)
    if missing:
        raise ControllerError(
            f"{spec} returned a {type(controller).__name__} without {', '.join(missing)}, expected a Controller"
        )
    frame_size_of(made := cast("Controller", controller))
    return made


@contextmanager
def _current_directory_importable() -> Generator[None, None, None]:
    added = str(Path.cwd())
    # Last, so that nothing in the folder hides an installed module.
    sys.path.append(added)
    try:
        yield
    finally:
        # What the user's module added stays.
        if added in sys.path:
            del sys.path[-1 - sys.path[::-1].index(added)]


def _placed(controller: Controller | nn.Module, device: torch.device, dtype: torch.dtype) -> Controller:
    if isinstance(controller, CIL):
        controller = controller.folded()
    if isinstance(controller, nn.Module):
        controller.eval().requires_grad_(False)
        # Measured on two processors: convolutions by channels-last weights run 1.3 times as fast, gradients included.
        cast("Any", controller).to(device=device, dtype=dtype, memory_format=torch.channels_last)
    assert isinstance(controller, Controller)
    return controller


def _card_beside(path: Path) -> ControllerCard | None:
    card = path.with_suffix(".json")
    try:
        return read_card(card.read_text(encoding="utf-8"), str(card)) if card.is_file() else None
    except (OSError, UnicodeDecodeError) as error:
        raise ControllerError(f"cannot read the card {card}: {error}") from error


def _existing(path: Path) -> Path:
    if path.is_dir():
        raise ControllerError(f"controller file {path} is a folder, expected a file of weights or an exported network")
    if not path.is_file():
        raise ControllerError(f"controller file {path} does not exist; check the path")
    return path


def device_of(device: str) -> torch.device:
    """The torch device of a name: "cpu", "cuda" or "cuda:N".

    Raises:
        DeviceError: there is no such device.
    """
    try:
        place = torch.device(device)
    except RuntimeError as error:
        raise DeviceError(f"device {device!r} is unknown, expected cpu, cuda or cuda:N") from error
    if place.type == "cuda" and (place.index or 0) >= torch.cuda.device_count():
        raise DeviceError(
            f"device {device!r} is not there: this torch sees {torch.cuda.device_count()} CUDA devices; use cpu"
        )
    if place.type not in ("cpu", "cuda"):
        raise DeviceError(f"device {device!r} is not supported, expected cpu, cuda or cuda:N")
    return place


def _dtype(dtype: str) -> torch.dtype:
    if dtype not in DTYPES:
        raise DeviceError(f"dtype {dtype!r} is unknown, expected one of {', '.join(DTYPES)}")
    return DTYPES[dtype]
