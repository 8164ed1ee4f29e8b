"""From a spec to a controller: a weights file (`weights_file`), an exported network, your own Python."""

from __future__ import annotations

import copy
import importlib.util
import re
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple, cast

import torch
from torch import nn
from torch.utils.weak import WeakTensorKeyDictionary

from roadproof.controllers.asking import frame_size_of
from roadproof.controllers.cards import ControllerCard
from roadproof.controllers.cil import CIL
from roadproof.controllers.precision import lay_out
from roadproof.controllers.protocol import Controller, missing_members
from roadproof.controllers.shipped import installed_weights, shipped_names, shipped_weights
from roadproof.controllers.weights_file import ARCHITECTURES, card_beside, existing, fill_from, from_weights, tensors_of
from roadproof.errors import ControllerError, DeviceError
from roadproof.foreign import call
from roadproof.io.identity import digest

DTYPES = {"float32": torch.float32, "tf32": torch.float32, "bfloat16": torch.bfloat16, "float64": torch.float64}
SPECS = (
    "the name of a shipped one (`roadproof controllers`), FILE.safetensors, cil:FILE.safetensors, "
    "pilotnet:FILE.safetensors, FILE.pt2, FILE.onnx, module:factory (a function in your Python) or "
    "module:factory@FILE.safetensors (with other weights)"
)


def runs_code(spec: str) -> bool:
    """Whether loading a controller from this spec runs its author's code: an exported network, or Python."""
    return spec.endswith(".pt2") or _python_of(spec) is not None


def load_controller(spec: str | Path, *, device: str = "cpu", dtype: str = "float32") -> Controller:
    """Load a controller for attack or driving: in eval mode, its parameters without gradients.

    Args:
        spec: one of
            `cil`, `pilotnet` …: one that comes with roadproof, see `shipped` (those of `cil`: extra `cil`);
            `FILE.safetensors`: weights; the card in its header (`save_controller`) or beside it as `FILE.json` says
            of which network;
            `cil:FILE.safetensors`, `pilotnet:FILE.safetensors`: weights without a card, of the published network on
            the frames of CARLA's agent;
            `FILE.pt2`, `FILE.onnx`: a network exported by `torch.export` or to ONNX (extra `onnx`), see `exported`;
            `module:factory`: a function without arguments that returns a `Controller`; the current directory is
            importable;
            `module:factory@FILE.safetensors`: the same, a `torch.nn.Module`, with weights that `harden` tuned.
        device: "cpu", "cuda" or "cuda:N".
        dtype: precision in which the network computes: "float32", "bfloat16" or "float64", or on a GPU "tf32": float32,
            for which `precision.multiply_in` says how to multiply. Frames may stay in float32.

    Raises:
        ControllerError: the spec or file does not exist, the weights are not installed or do not fit, or the object is
            no controller.
        DeviceError: the device or dtype is not available.

    Note:
        A `.pt2` file and `module:factory` run what their authors wrote: load only what you trust. Weights files hold
        numbers alone.
    """
    place, precision = device_of(device), _dtype(dtype)
    if dtype == "tf32" and place.type != "cuda":
        raise DeviceError(f"dtype tf32 is how GPUs multiply, {device} does not; use float32")
    text = str(spec)
    # A factory may give the same object each time: what another holds keeps its digits.
    controller = _found(text, place, precision, own=precision != torch.float32)
    return call(f"moving the controller to {place} in {dtype}", _placed, controller, place, precision)


def load_trainable(spec: str) -> nn.Module:
    """A controller ready for training: nothing merged, in float32, on the CPU, in eval mode, with gradients.

    Args:
        spec: spec as `load_controller` takes it. In the module of a Python factory, those parameters are trained that
            its author left with gradients, or all if there are none.

    Raises:
        ControllerError: as `load_controller`; or the controller is an exported network, or no module with parameters,
            or keeps more than tensors.
    """
    if spec.endswith((".pt2", ".onnx")):
        raise ControllerError(
            f"{spec} is an exported network; to train on, give the Python it came from: module:factory"
        )
    network = _found(spec, torch.device("cpu"), torch.float32, own=True)
    if not isinstance(network, nn.Module) or not any(True for _ in network.parameters()):
        raise ControllerError(
            f"{spec} gives a {type(network).__name__}, expected a torch.nn.Module with parameters, so that it can learn"
        )
    if not any(each.requires_grad for each in network.parameters()):
        network.requires_grad_(True)
    tensors_of(network)  # refused here rather than once it has learnt
    return network.eval()


def _found(text: str, device: torch.device, dtype: torch.dtype, *, own: bool) -> Controller | nn.Module:
    """The controller of a spec as its maker returns it, before it is set up for use; of its own, where it changes."""
    head, _, tail = text.partition(":")
    if head in ARCHITECTURES and tail:
        return from_weights(Path(tail), ControllerCard(architecture=head))
    if re.fullmatch(r"[a-z][a-z0-9-]*", text):
        return from_weights(shipped_weights(text), None)
    if (python := _python_of(text)) is not None:
        maker = f"{python.module}:{python.factory}"
        made = _from_python(maker) if python.weights is None and not own else _own_from_python(maker)
        if python.weights is not None:
            if not isinstance(made, nn.Module):
                raise ControllerError(f"{maker} gives a {type(made).__name__}, which has no weights to replace")
            fill_from(python.weights, made)
        return made
    if text.endswith(".safetensors"):
        return from_weights(Path(text), None)
    if text.endswith((".pt2", ".onnx")):
        path = existing(Path(text))
        # Exported networks are met in their own room: ONNX is an extra.
        from roadproof.controllers.exported import exported_controller

        return exported_controller(path, card_beside(path) or ControllerCard(), device=device, dtype=dtype)
    if text.endswith(PICKLES):
        raise ControllerError(
            f"{text} is a file of torch.save or TorchScript, which may run code when it is opened; in Python, export "
            "its network with torch.export.save(torch.export.export(network, ...), 'FILE.pt2') or torch.onnx.export, "
            "or name a function of yours that returns it: module:factory"
        )
    raise ControllerError(f"unknown controller {text!r}, expected {SPECS}")


def files_of(spec: str) -> tuple[Path, ...]:
    """The files that are there of a user's controller: its weights or network, its card, and its function's module.

    Nothing is imported, but for the packages that a module lies in. A controller that comes with roadproof has none.
    """
    head, _, tail = spec.partition(":")
    named: list[Path] = []
    if head in ARCHITECTURES and tail:
        named = [Path(tail)]
    elif (python := _python_of(spec)) is not None:
        with _current_directory_importable(), suppress(ImportError, ValueError):
            found = importlib.util.find_spec(python.module)
            named += [Path(found.origin)] if found and found.origin else []
        named += [] if python.weights is None else [python.weights]
    elif (path := Path(spec)).suffix:
        named = [path, path.with_suffix(".json")]
        if path.suffix == ".onnx":
            from roadproof.controllers.onnx_graph import external_data_of

            with suppress(ControllerError):
                named += external_data_of(path)
    return tuple(path for path in named if path.is_file())


def files_digest(spec: str) -> str:
    """The digest of a controller's files: weights, and the module that a function is written in; empty without any."""
    shipped = installed_weights(spec) if spec in shipped_names() else None
    contents = [file.read_bytes() for file in (files_of(spec) if shipped is None else (shipped,))]
    return digest(*contents)[:16] if contents else ""


PICKLES = (".pt", ".pth", ".ckpt", ".pkl", ".ts", ".torchscript", ".jit")
"""What files of torch.save and TorchScript are called."""


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


class _Python(NamedTuple):
    module: str
    factory: str
    weights: Path | None


def _python_of(spec: str) -> _Python | None:
    """What a spec names of the user's Python, module:factory or module:factory@FILE; None where it is another."""
    head, _, tail = spec.partition(":")
    factory, at, weights = tail.partition("@")
    names = (*head.split("."), *factory.split("."))
    if head in ARCHITECTURES or not all(part.isidentifier() for part in names):
        return None
    return _Python(head, factory, Path(weights) if at else None)


_learns = WeakTensorKeyDictionary()
"""Whether a parameter of a module that a factory returned wanted a gradient when it did so first."""


def _own_from_python(spec: str) -> Controller | nn.Module:
    """What a factory returns, and if that is a module, one of which nobody else holds a tensor, as it was made."""
    made = _from_python(spec)
    if not isinstance(made, nn.Module):
        return made
    again = cast("nn.Module", _from_python(spec))
    held = {each.data_ptr() for each in _tensors(made)}
    if not any(each.data_ptr() in held for each in _tensors(again)):
        return again
    copied = call(f"copying what {spec} returns each time (let it return a new one)", copy.deepcopy, again)
    for parameter, before in zip(copied.parameters(), again.parameters(), strict=True):
        parameter.requires_grad_(cast("bool", _learns[before]))
    return copied


def _tensors(module: nn.Module) -> list[torch.Tensor]:
    return [each for each in (*module.parameters(), *module.buffers()) if each.numel()]


def _from_python(spec: str) -> Controller:
    factory = imported(spec, f"a function without arguments; or give {SPECS}")
    with _current_directory_importable():
        controller: object = call(spec, factory)
        missing = call(spec, missing_members, controller)
    if missing:
        raise ControllerError(
            f"{spec} returned a {type(controller).__name__} without {', '.join(missing)}, expected a Controller"
        )
    if isinstance(controller, nn.Module):
        for each in controller.parameters():
            if each not in _learns:
                _learns[each] = each.requires_grad
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
        controller.eval().requires_grad_(False).to(device=device, dtype=dtype)
        lay_out(controller)
    assert isinstance(controller, Controller)
    return controller


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
