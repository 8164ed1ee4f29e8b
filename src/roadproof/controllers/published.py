"""The published CIL checkpoint: from TensorFlow's variables to a weights file.

Convention:
    TensorFlow keeps convolution kernels as (height, width, in, out) and dense weights as (in, out); torch as
    (out, in, height, width) and (out, in). Both networks flatten the last feature map in H, W, C order, so no rows of
    the first dense layer change places.

References:
    Variable names and shapes are those in the index of `model.ckpt-450000` (carla-simulator/imitation-learning).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.controllers.cil import CIL
from roadproof.controllers.conditional import BRANCHES
from roadproof.controllers.weights_file import save_controller
from roadproof.errors import ControllerError, OutputError
from roadproof.io.arrays import archive_names, read_archive
from roadproof.io.files import one_line

_MOST_NAMES = 5


def convert_cil(checkpoint: Path, out: Path, *, overwrite: bool = False) -> None:
    """Write the CIL network of CARLA's imitation learning agent as weights that `load_controller` loads.

    Nothing but the network is looked at: the optimiser's variables, which the published checkpoint also holds, may be
    there or not.

    Args:
        checkpoint: an `.npz` file with one array a TensorFlow variable, under the variable's name; or, where
            TensorFlow is installed, the checkpoint itself by its name without `.index`, such as `model.ckpt-450000`.
        out: path of the weights file, which ends in `.safetensors`; the card in its header names the checkpoint.
        overwrite: whether an existing file may be replaced.

    Raises:
        ControllerError: the checkpoint is missing or damaged, TensorFlow is needed and absent, or a variable is
            missing, of the wrong shape or type, not finite, or a negative variance.
        OutputError: the output file has another ending, is already there, or cannot be written.
    """
    if out.suffix != ".safetensors":
        raise OutputError(f"output file is {out}, expected a name that ends in .safetensors")
    if out.exists() and not overwrite:
        raise OutputError(
            f"{out} exists already; choose a new file, or replace it by --overwrite (Python: overwrite=True)"
        )
    network, variable_of = CIL(), _variable_names()
    read = _from_archive if checkpoint.suffix == ".npz" else _from_checkpoint
    variables = read(checkpoint, variable_of.values())
    network.load_state_dict(
        {
            name: _tensor(variables[variable_of[name]], tuple(like.shape), checkpoint, variable_of[name])
            for name, like in network.state_dict().items()
        }
    )
    save_controller(
        network, out, origin=f"TensorFlow checkpoint of CARLA's imitation learning agent: {checkpoint.name}"
    )


def _variable_names() -> dict[str, str]:
    """The name in TensorFlow of every tensor of `CIL`.

    Convolutions, normalisations and dense layers are each numbered from 1 in the order in which the graph was built.
    A bias is the nameless variable of the scope that it was made in.
    """
    names: dict[str, str] = {}
    for layer in range(8):
        names[f"convolutions.{layer}.conv.weight"] = f"W_c_{layer + 1}"
        names[f"convolutions.{layer}.conv.bias"] = f"Network/conv_block{layer}/Variable"
        names[f"convolutions.{layer}.norm.bias"] = f"bn{layer + 1}/beta"
        names[f"convolutions.{layer}.norm.running_mean"] = f"bn{layer + 1}/moving_mean"
        names[f"convolutions.{layer}.norm.running_var"] = f"bn{layer + 1}/moving_variance"
    dense = [
        ("image.0", "fc1"),
        ("image.3", "fc2"),
        ("speed.0", "Speed/fc3"),
        ("speed.3", "Speed/fc4"),
        ("join.0", "fc5"),
    ]
    heads = [*(f"branches.{branch}" for branch in range(BRANCHES)), "speed_branch"]
    for branch, head in enumerate(heads):
        first = len(dense) + 1
        scope = f"Branch_{branch}"
        dense += [(f"{head}.0", f"{scope}/fc{first}"), (f"{head}.3", f"{scope}/fc{first + 1}"), (f"{head}.6", scope)]
    for number, (layer, scope) in enumerate(dense, start=1):
        names[f"{layer}.weight"] = f"W_f_{number}"
        names[f"{layer}.bias"] = f"Network/{scope}/Variable"
    return names


def _from_archive(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    remedy = f"make it where TensorFlow is installed: {_recipe('model.ckpt-450000', path.name)}"
    _require_all(names, archive_names(path, ControllerError, remedy), path)
    return read_archive(path, names, ControllerError, remedy)


def _from_checkpoint(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    index = Path(f"{path}.index")
    if not index.is_file():
        raise ControllerError(
            f"{path} is no checkpoint: {index} does not exist; expected an .npz file, or a TensorFlow checkpoint's "
            "name without .index, such as model.ckpt-450000"
        )
    try:
        tensorflow: Any = importlib.import_module("tensorflow")
    except ImportError as error:
        raise ControllerError(
            f"reading {path} needs TensorFlow, which cannot be imported ({one_line(error)}); where it can, make an "
            f".npz file and give that instead: {_recipe(path.name, 'cil.npz')}"
        ) from error
    try:
        reader = tensorflow.train.load_checkpoint(str(path))
        held: Collection[str] = reader.get_variable_to_shape_map().keys()
        read: Callable[[str], np.ndarray] = reader.get_tensor
        _require_all(names, held, path)
        return {name: np.asarray(read(name)) for name in names}
    except ControllerError:
        raise
    except Exception as error:  # the reader raises its own and the system's
        raise ControllerError(f"{path} is not a TensorFlow checkpoint or is damaged: {one_line(error)}") from error


def _recipe(checkpoint: str, archive: str) -> str:
    return (
        f"import numpy, tensorflow as tf; reader = tf.train.load_checkpoint({checkpoint!r}); "
        f"numpy.savez({archive!r}, **{{name: reader.get_tensor(name) for name in reader.get_variable_to_shape_map()}})"
    )


def _require_all(names: Collection[str], held: Collection[str], path: Path) -> None:
    missing = [name for name in names if name not in held]
    if missing:
        shown = ", ".join(missing[:_MOST_NAMES]) + (", …" if len(missing) > _MOST_NAMES else "")
        raise ControllerError(
            f"{path} lacks {len(missing)} of the {len(names)} variables of the published CIL: {shown}; "
            "expected the checkpoint of carla-simulator/imitation-learning with its variables' own names"
        )


def _tensor(variable: np.ndarray, shape: tuple[int, ...], path: Path, name: str) -> Float[Tensor, "..."]:
    """A TensorFlow variable as a torch tensor of the given shape, with its axes in torch's order."""
    what = f"{path}: variable {name}"
    order = {4: (3, 2, 0, 1), 2: (1, 0), 1: (0,)}[len(shape)]
    expected = tuple(shape[order.index(axis)] for axis in range(len(shape)))
    if variable.shape != expected:
        raise ControllerError(f"{what} has shape {variable.shape}, expected {expected}; is it the published CIL?")
    if variable.dtype.kind != "f":
        raise ControllerError(f"{what} is of type {variable.dtype}, expected floating-point numbers")
    with np.errstate(over="ignore"):  # what float32 cannot hold is refused below
        values = np.array(variable.transpose(order), np.float32, order="C")
    if not np.isfinite(values).all():
        raise ControllerError(f"{what} has NaN or infinite values; export the checkpoint again")
    if name.endswith("moving_variance") and values.min() < 0:
        raise ControllerError(f"{what} has the negative value {values.min()}; a variance is at least 0")
    return torch.from_numpy(values)
