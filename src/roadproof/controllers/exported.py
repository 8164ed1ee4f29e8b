"""Networks exported by others: `torch.export` (.pt2) and ONNX (.onnx).

Convention:
    An exported network takes a batch of any size. Its inputs are told apart by name: `frames` (RGB in [0, 1]) or
    `frames_yuv` (OpenCV's YUV, x / 127.5 − 1), and `speed_mps` and `command` if it wants them; a single input may
    have any name and is then `frames`. An input of shape (b, n, 3, h, w) holds the last n frames of a drive, oldest
    first, and the card says how far apart they lie. The only output is the steering, (b,) or (b, 1), positive to the
    right. A card beside the file (`cards`) says more: the size of the recorded frames, rows to keep, colour, mean and
    deviation. Without one, frames come at the network's own size.
"""

from __future__ import annotations

import logging
import os
import warnings
import zipfile
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from roadproof.controllers.cards import ControllerCard
from roadproof.controllers.frames import FramePreparation
from roadproof.controllers.history import HistoryController
from roadproof.controllers.onnx_graph import OnnxGraph
from roadproof.controllers.steering import CruiseControl, SteeringController
from roadproof.controllers.trajectory import TrajectoryController
from roadproof.errors import ControllerError, DeviceError
from roadproof.foreign import in_one_line
from roadproof.io.identity import digest

InputShapes = dict[str, tuple[int | None, ...]]

_YUV_SIGNED = FramePreparation(colour="yuv", mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))


def exported_controller(
    path: Path, card: ControllerCard, *, device: torch.device, dtype: torch.dtype
) -> SteeringController | TrajectoryController | HistoryController:
    """A controller around an exported network.

    Args:
        path: a `.pt2` or `.onnx` file.
        card: card that says how frames are prepared for the network.
        device: torch device on which the network computes.
        dtype: precision in which the network computes; a `.pt2` file has its own.

    Raises:
        ControllerError: the file cannot be read, its inputs cannot be told apart, its batch is fixed, or it takes
            several frames and the card does not say how far apart; or an input has another shape or type than it is
            given.
        DeviceError: the precision of a `.pt2` file is another.
    """
    network = TorchProgram(path, device) if path.suffix == ".pt2" else OnnxGraph(path)
    if isinstance(network, TorchProgram):
        own = {parameter.dtype for parameter in network.parameters() if parameter.is_floating_point()} - {dtype}
        if own:
            raise DeviceError(f"{path} computes in {own.pop()}, not {dtype}; ask for that dtype or export it again")
    names, frames, preparation = _bound(network.inputs, card, path)
    _check_inputs(network, names, path)
    cruise = CruiseControl(target_mps=card.target_speed_mps)
    if card.tracking is not None:
        single = TrajectoryController(
            network, preparation=preparation, law=card.tracking, dt_s=card.dt_s, inputs=names, cruise=cruise
        )
    else:
        single = SteeringController(network, preparation=preparation, inputs=names, cruise=cruise)
    if frames is None and card.frames_apart_s is None:
        return single
    if frames is None or card.frames_apart_s is None:
        raise ControllerError(
            f"{path} takes {'one frame' if frames is None else f'{frames} frames'} at once and its card says "
            f"frames_apart_s {card.frames_apart_s}; networks of several frames take (b, n, 3, h, w), oldest first, and "
            "their card says how many seconds lie between two"
        )
    return HistoryController(single, frames=frames, apart_s=card.frames_apart_s)


class TorchProgram(nn.Module):
    """A program saved by `torch.export.save`, with its weights frozen; it computes in the precision it was saved in.

    Args:
        path: a `.pt2` file.
        device: torch device on which the program computes.

    Raises:
        ControllerError: the file cannot be read, or was exported for one batch size only.
    """

    def __init__(self, path: Path, device: torch.device) -> None:
        super().__init__()
        from torch.export.passes import move_to_device_pass

        self.path = path
        self.inputs: InputShapes = {}
        self.whole: set[str] = set()
        try:
            with _pickles_refused(), _quiet():
                program = torch.export.load(path)
                parts = [each for each in program.graph_module.modules() if isinstance(each, torch.fx.GraphModule)]
                self.identity = digest(*(str(each.graph) for each in parts))
                """A hash of all but the weights."""
                program = move_to_device_pass(program, device)
                wanted = program.graph_signature.user_inputs
                for node in program.graph.nodes:
                    if node.op == "placeholder" and node.name in wanted:
                        like = node.meta["val"]
                        shape = cast("tuple[int | torch.SymInt, ...]", like.shape)
                        self.inputs[node.name] = tuple(size if isinstance(size, int) else None for size in shape)
                        if not like.is_floating_point():
                            self.whole.add(node.name)
                self.program = program.module()
        except Exception as error:  # whatever the archive's contents make the reader raise
            if _is_torchscript(path):
                raise ControllerError(
                    f"{path} is TorchScript, not a torch.export file; export the Python network it came from again: "
                    "torch.export.save(torch.export.export(network, ...), 'FILE.pt2')"
                ) from error
            raise ControllerError(
                f"{path} is not a torch.export file that this torch, {torch.__version__}, reads: "
                f"{_first_sentence(error)}"
            ) from error
        for name, shape in self.inputs.items():
            if shape and shape[0] is not None:
                raise ControllerError(
                    f"{path}: input {name} was exported for batches of exactly {shape[0]}; export it with "
                    'dynamic_shapes={0: torch.export.Dim("batch")} for every input'
                )

    def forward(self, *inputs: Tensor) -> Tensor:
        """The program's output for its inputs, which come in the program's order.

        Raises:
            ControllerError: the output cannot be computed, most often for inputs of other shapes than exported.
        """
        try:
            answer: Any = self.program(*inputs)
        except (RuntimeError, ValueError, IndexError, KeyError, TypeError, AssertionError) as error:
            shapes = ", ".join(str(tuple(x.shape)) for x in inputs)
            raise ControllerError(f"{self.path} cannot take shapes {shapes}: {in_one_line(error)}") from error
        if isinstance(answer, tuple) and len(cast("tuple[object, ...]", answer)) == 1:
            answer = cast("tuple[object, ...]", answer)[0]
        if not isinstance(answer, Tensor):
            kind = type(cast("object", answer)).__name__
            raise ControllerError(
                f"{self.path} answers with a {kind}, expected one output: the steering, or points ahead"
            )
        return answer

    def train(self, mode: bool = True) -> TorchProgram:  # noqa: ARG002
        """Do nothing: an exported program stays in the mode in which it was exported."""
        return self


def _bound(
    shapes: InputShapes, card: ControllerCard, path: Path
) -> tuple[tuple[str, ...], int | None, FramePreparation]:
    """The kind of each input of a network, how many frames it takes where several, and how they are prepared."""
    known = {"frames", "frames_yuv", "speed_mps", "command"}
    names = list(shapes)
    if len(names) == 1 and names[0] not in known:
        names = ["frames"]
    pictures = [name for name in names if name.startswith("frames")]
    if not set(names) <= known or len(pictures) != 1:
        raise ControllerError(
            f"{path} takes inputs named {', '.join(names)}; expected frames or frames_yuv, and speed_mps and command "
            "if it wants them: export it with these names"
        )
    picture = shapes[list(shapes)[names.index(pictures[0])]]
    preparation = card.preparation or (_YUV_SIGNED if pictures[0] == "frames_yuv" else FramePreparation())
    if pictures[0] == "frames_yuv" and preparation.colour != "yuv":
        raise ControllerError(
            f"{path} takes frames_yuv and its card says colour {preparation.colour!r}; say 'yuv' there, with the mean "
            "and std that it learnt with, or name its input frames"
        )
    size = picture[-2:] if len(picture) in (4, 5) else (None, None)
    if size[0] is not None and size[1] is not None:
        fixed = (size[0], size[1])
        if preparation.network_size not in (None, fixed):
            raise ControllerError(f"the card of {path} says network_size {preparation.network_size}, the file {fixed}")
        whole = preparation.rows is None and preparation.network_size is None
        frame_size = preparation.frame_size or (fixed if whole else None)
        preparation = replace(preparation, network_size=fixed, frame_size=frame_size)
    frames = picture[1] if len(picture) == 5 else None
    if len(picture) == 5 and frames is None:
        raise ControllerError(f"{path} takes any number of frames at once; export it for one number of them")
    return tuple("frames" if name in pictures else name for name in names), frames, preparation


def _check_inputs(network: TorchProgram | OnnxGraph, names: Sequence[str], path: Path) -> None:
    """Refuse a network that takes its inputs in another shape or type than they come, which it might not tell."""
    for (own, shape), name in zip(network.inputs.items(), names, strict=True):
        if name == "frames":
            fits = len(shape) in (4, 5) and shape[-3] in (3, None) and own not in network.whole
            expected = "floating-point RGB or YUV of shape (b, 3, h, w), or (b, n, 3, h, w) where it takes several"
        else:
            fits, expected = len(shape) == 1, "shape (b,)"
        if shape and not fits:
            sizes = ", ".join("any" if size is None else str(size) for size in shape)
            kind = "whole numbers" if own in network.whole else "floating-point numbers"
            raise ControllerError(
                f"{path} takes {own} as {kind} of shape ({sizes}), expected {expected}; export it with what it does to "
                "them first"
            )


def _is_torchscript(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith("/constants.pkl") for name in archive.namelist())
    except (OSError, zipfile.BadZipFile, NotImplementedError):
        return False


def _first_sentence(error: Exception) -> str:
    """The first sentence of an error of torch; the rest points to logs and stack traces."""
    lines = str(error).strip().splitlines()
    return lines[0].split(". ")[0] if lines else type(error).__name__


@contextmanager
def _quiet() -> Generator[None, None, None]:
    """Suppress torch's log output about an error; the exception says the same."""
    log = logging.getLogger("torch.export")
    before = log.disabled
    log.disabled = True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.disabled = before


@contextmanager
def _pickles_refused() -> Generator[None, None, None]:
    """Let torch read tensors only: its archive reader would otherwise unpickle what an archive asks it to."""
    name = "TORCH_FORCE_WEIGHTS_ONLY_LOAD"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
