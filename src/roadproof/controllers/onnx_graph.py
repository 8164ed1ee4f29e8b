"""An ONNX graph as a torch module: evaluated node by node, so that gradients flow to the frames.

Why not a converter from elsewhere: those alive need torchvision, or are a single first release that fails where a
network takes the last of a row (`x[:, -1]`) and cannot be sent to other processes; a steering network needs some ninety
operators, each a line or a few.
"""

from __future__ import annotations

import importlib
from pathlib import Path, PurePath
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor, nn

from roadproof.controllers.onnx_operators import DTYPES, OPERATORS, SEVERAL_OUTPUTS
from roadproof.errors import ControllerError
from roadproof.foreign import in_one_line
from roadproof.io.identity import digest, stated

_OLDEST_OPERATOR_SET = 13


class _Node(NamedTuple):
    operator: str
    attributes: dict[str, Any]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    spent: tuple[str, ...] = ()
    """Values that no later node needs."""


class OnnxGraph(nn.Module):
    """The graph of an ONNX file with one output; its floating-point constants are buffers.

    Args:
        path: an `.onnx` file; external data must lie in its folder.

    Raises:
        ControllerError: the extra is not installed, or the file is not ONNX, is older than operator set 13, has several
            outputs, or uses an operator that is not supported; the message names it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        model = _read(path)
        self.path = path
        self._buffer_of: dict[str, str] = {}
        try:
            self._build(model)
        except ControllerError:
            raise
        except Exception as error:  # whatever a damaged file makes the reader of its tensors raise
            raise ControllerError(f"{path} holds an ONNX graph that cannot be read: {in_one_line(error)}") from error

    def _build(self, model: Any) -> None:  # noqa: ANN401
        from onnx import TensorProto, helper, numpy_helper

        path, graph = self.path, model.graph
        versions = [opset.version for opset in model.opset_import if opset.domain in ("", "ai.onnx")]
        if not versions or versions[0] < _OLDEST_OPERATOR_SET:
            raise ControllerError(
                f"{path} uses ONNX operator set {versions}, expected {_OLDEST_OPERATOR_SET} or newer; "
                "convert it with onnx.version_converter or export it again"
            )
        if len(graph.output) != 1:
            raise ControllerError(f"{path} has {len(graph.output)} outputs, expected one: the steering")
        self.output: str = graph.output[0].name
        for constant in graph.initializer:
            self._keep(constant.name, torch.tensor(numpy_helper.to_array(constant)))
        self.inputs = {
            value.name: tuple(dim.dim_value or None for dim in value.type.tensor_type.shape.dim)
            for value in graph.input
            if value.name not in self._buffer_of
        }
        """Shape of each input; None where it is not fixed."""
        kinds = {value.name: DTYPES.get(value.type.tensor_type.elem_type) for value in graph.input}
        self.whole = {name for name, kind in kinds.items() if kind is None or not kind.is_floating_point}
        """Inputs that are whole numbers."""
        ends = stated([[value.name for value in values] for values in (graph.input, graph.output)])
        self.identity = digest(ends, *map(_without_notes, graph.node))
        """A hash of all but the constants, which are buffers."""
        nodes: list[_Node] = []
        for node in graph.node:
            attributes = {a.name: helper.get_attribute_value(a) for a in node.attribute}
            if isinstance(attributes.get("value"), TensorProto):
                attributes["value"] = torch.tensor(numpy_helper.to_array(attributes["value"]))
            if node.op_type == "Split":  # without sizes in parts as long as each other, as many as are used
                attributes.setdefault("num_outputs", len(node.output))
            if node.op_type == "Constant":
                self._keep(node.output[0], torch.as_tensor(next(iter(attributes.values()))))
                continue
            several = any(node.output[1:]) and node.op_type not in SEVERAL_OUTPUTS
            if node.op_type not in OPERATORS or node.domain not in ("", "ai.onnx") or several:
                raise ControllerError(
                    f"{path} uses the ONNX operator {node.domain or 'ai.onnx'}.{node.op_type}"
                    f"{' with several outputs' if several else ''}, which roadproof does not know; known are "
                    f"{', '.join(OPERATORS)}. Export the network as .pt2, or wrap it yourself as module:factory"
                )
            nodes.append(_Node(node.op_type, attributes, tuple(node.input), tuple(node.output)))
        self._nodes = _with_spent_values(nodes, keep=self.output)

    def _keep(self, name: str, constant: Tensor) -> None:
        self._buffer_of[name] = buffer = f"constant_{len(self._buffer_of)}"
        self.register_buffer(buffer, constant)

    def forward(self, *inputs: Tensor) -> Tensor:
        """The output of the graph for its inputs, which come in the file's order.

        Raises:
            ControllerError: a node cannot be computed; the message names it and the shapes it met.
        """
        # The graph says where it computes with fractions; a command comes as a whole number.
        own = next((each.dtype for each in inputs if each.is_floating_point()), torch.float32)
        given = zip(self.inputs, inputs, strict=True)
        values: dict[str, Tensor | None] = {"": None}
        values |= {name: each if name in self.whole else each.to(own) for name, each in given}
        values |= {name: cast("Tensor", getattr(self, buffer)) for name, buffer in self._buffer_of.items()}
        for node in self._nodes:
            arguments = [values[name] for name in node.inputs]
            try:
                answer = OPERATORS[node.operator](node.attributes, arguments)
                answers = answer if isinstance(answer, tuple) else (answer,)
                values |= {name: answers[k] for k, name in enumerate(node.outputs) if name}
            except (RuntimeError, ValueError, IndexError, KeyError, TypeError) as error:
                shapes = ", ".join("none" if x is None else str(tuple(x.shape)) for x in arguments)
                raise ControllerError(
                    f"{self.path}: ONNX node {node.operator} → {node.outputs[0]} cannot take shapes {shapes}: {error}"
                ) from error
            for name in node.spent:
                del values[name]
        output = values[self.output]
        assert output is not None
        return output


def _without_notes(node: Any) -> bytes:  # noqa: ANN401
    """A node without what its exporter notes of where it comes from."""
    bare = type(node)()
    bare.CopyFrom(node)
    for note in ("doc_string", "metadata_props", "name"):
        if note in bare.DESCRIPTOR.fields_by_name:
            bare.ClearField(note)
    return bare.SerializeToString(deterministic=True)


def _with_spent_values(nodes: list[_Node], keep: str) -> tuple[_Node, ...]:
    """The nodes, each with the values that it is the last to use; without this every map would stay in memory."""
    made = {output for node in nodes for output in node.outputs}
    seen, result = {keep}, list[_Node]()
    for node in reversed(nodes):
        result.append(node._replace(spent=tuple(({*node.inputs} & made) - seen)))
        seen.update(node.inputs)
    return tuple(reversed(result))


def external_data_of(path: Path) -> tuple[Path, ...]:
    """The files beside an ONNX file that hold its tensors, where it does not hold them itself; none leaves its folder.

    Raises:
        ControllerError: the extra is not installed, or the file is not ONNX.
    """
    graph = _read(path, whole=False).graph
    tensors = [*graph.initializer, *(each.t for node in graph.node for each in node.attribute)]
    told = [entry for tensor in tensors for entry in tensor.external_data if entry.key == "location"]
    names = [PurePath(name) for name in sorted({entry.value for entry in told})]
    return tuple(path.parent / name for name in names if not name.is_absolute() and ".." not in name.parts)


def _read(path: Path, *, whole: bool = True) -> Any:  # noqa: ANN401
    try:
        onnx: Any = importlib.import_module("onnx")
    except ImportError as error:
        raise ControllerError(f"{path} needs the ONNX reader: pip install 'roadproof[onnx]'") from error
    try:
        model = onnx.load(path, load_external_data=whole)
        if whole:
            onnx.checker.check_model(model)
    except Exception as error:  # the reader raises its own, protobuf's and the system's
        raise ControllerError(f"{path} is not a valid ONNX file: {in_one_line(error)}") from error
    return model
