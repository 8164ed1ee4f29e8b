"""Each ONNX operator against the reference implementation that comes with ONNX, and a whole network's gradients."""

from pathlib import Path

import numpy as np
import pytest
import torch

onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from roadproof.controllers.onnx_graph import OnnxGraph
from roadproof.controllers.onnx_operators import OPERATORS
from roadproof.errors import ControllerError

RNG = np.random.default_rng(0)
IMAGE = RNG.normal(size=(2, 4, 7, 9)).astype(np.float32)
MATRIX = RNG.normal(size=(3, 5)).astype(np.float32)
POSITIVE = np.abs(MATRIX) + 0.1
KERNEL = RNG.normal(size=(6, 4, 3, 3)).astype(np.float32)
BIAS = RNG.normal(size=6).astype(np.float32)
CHANNEL = [RNG.uniform(0.5, 1.5, size=4).astype(np.float32) for _ in range(4)]
TRUTH = MATRIX > 0


def ints(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def scalar(value: float) -> np.ndarray:
    return np.array(value, dtype=np.float32)


SAME = {"kernel_shape": [3, 3], "strides": [2, 2]}
ONE_INPUT = (
    *("Abs", "Elu", "Erf", "Exp", "Gelu", "HardSigmoid", "HardSwish", "Identity", "LeakyRelu", "Neg", "Relu", "Selu"),
    *("Sigmoid", "Softmax", "Softplus", "Tanh", "Transpose", "Shape", "Dropout"),
)
TWO_INPUTS = ("Add", "Sub", "Mul", "Div", "Max", "Min", "Greater", "Less", "Equal")
CASES = [
    *((name, [MATRIX], {}) for name in ONE_INPUT),
    *((name, [MATRIX, MATRIX[::-1].copy()], {}) for name in TWO_INPUTS),
    *((name, [TRUTH, TRUTH[::-1].copy()], {}) for name in ("And", "Or")),
    *((name, [IMAGE], {"keepdims": 0}) for name in ("ReduceMean", "ReduceSum", "ReduceMax")),
    *((name, [IMAGE, ints(2, 3)], {}) for name in ("ReduceMean", "ReduceSum", "ReduceMax")),
    ("AveragePool", [IMAGE], {"kernel_shape": [2, 3], "strides": [2, 2]}),
    ("AveragePool", [IMAGE], {**SAME, "pads": [1, 1, 1, 1]}),
    ("AveragePool", [IMAGE], {**SAME, "pads": [1, 1, 1, 1], "count_include_pad": 1}),
    ("BatchNormalization", [IMAGE, *CHANNEL], {"epsilon": 1e-3}),
    ("Cast", [MATRIX], {"to": TensorProto.INT64}),
    ("Clip", [MATRIX, scalar(-0.5), scalar(0.5)], {}),
    ("Clip", [MATRIX, None, scalar(0.5)], {}),
    ("Concat", [MATRIX, MATRIX], {"axis": -1}),
    ("ConstantOfShape", [ints(2, 3)], {}),
    ("ConstantOfShape", [ints(2, 3)], {"value": numpy_helper.from_array(ints(7))}),
    ("Conv", [IMAGE, KERNEL, BIAS], {}),
    ("Conv", [IMAGE, KERNEL], {"strides": [2, 1], "pads": [0, 1, 2, 1]}),
    ("Conv", [IMAGE, KERNEL[:, :2], BIAS], {"group": 2, "dilations": [2, 2]}),
    ("Conv", [IMAGE, KERNEL], {"auto_pad": "SAME_UPPER", "strides": [2, 2]}),
    ("Conv", [IMAGE, KERNEL], {"auto_pad": "SAME_LOWER", "strides": [2, 2]}),
    ("Div", [ints(7, -7, 9), ints(2, 2, 3)], {}),
    ("Elu", [MATRIX], {"alpha": 0.3}),
    ("Expand", [MATRIX, ints(2, 3, 1)], {}),
    ("Flatten", [IMAGE], {}),
    ("Flatten", [IMAGE], {"axis": 3}),
    ("Gather", [MATRIX, ints(0, -1)], {"axis": 1}),
    ("Gather", [IMAGE, np.array(-2)], {"axis": 2}),
    ("GatherElements", [MATRIX, ints(0, -1, 2, 1, 4, -5)[:, None].reshape(3, 2)], {"axis": 1}),
    ("Gelu", [MATRIX], {"approximate": "tanh"}),
    ("Gemm", [MATRIX, MATRIX], {"transB": 1, "alpha": 0.5}),
    ("Gemm", [MATRIX, MATRIX, RNG.normal(size=5).astype(np.float32)], {"transA": 1, "beta": 2.0}),
    ("GlobalAveragePool", [IMAGE], {}),
    ("MatMul", [IMAGE, IMAGE.swapaxes(2, 3).copy()], {}),
    ("MaxPool", [IMAGE], SAME),
    ("MaxPool", [IMAGE], {**SAME, "pads": [1, 1, 0, 1]}),
    ("Not", [TRUTH], {}),
    ("PRelu", [MATRIX, scalar(0.2)], {}),
    ("Pad", [IMAGE, ints(0, 0, 1, 2, 0, 0, 3, 4), scalar(0.5)], {}),
    ("Pad", [IMAGE, ints(0, 0, 1, 2, 0, 0, 3, 4)], {"mode": "reflect"}),
    ("Pad", [IMAGE, ints(1, 2, 3, 4), None, ints(2, -1)], {"mode": "edge"}),
    ("Pow", [POSITIVE, scalar(1.7)], {}),
    ("Reshape", [IMAGE, ints(0, -1)], {}),
    ("Reshape", [IMAGE, ints(7, 8, 9)], {"allowzero": 1}),
    ("Shape", [IMAGE], {"start": 1, "end": -1}),
    ("Slice", [IMAGE, ints(1, -4), ints(100, -1), ints(2, 3), ints(2, 1)], {}),
    ("Slice", [MATRIX, ints(-1), ints(-100), ints(1), ints(-2)], {}),
    ("Slice", [MATRIX, ints(1), ints(3)], {}),
    ("Softmax", [IMAGE], {"axis": 1}),
    ("Sqrt", [POSITIVE], {}),
    ("Squeeze", [IMAGE[:1, :, :1], ints(0, -2)], {}),
    ("Squeeze", [IMAGE[:1]], {}),
    ("Transpose", [IMAGE], {"perm": [0, 2, 3, 1]}),
    ("Unsqueeze", [MATRIX, ints(0, -1)], {}),
    ("Where", [TRUTH, MATRIX, scalar(0.0)], {}),
]


def model(nodes, inputs, output="y", *, constants=None, opset=20):
    graph = helper.make_graph(
        nodes,
        "graph",
        [helper.make_tensor_value_info(name, helper.np_dtype_to_tensor_dtype(v.dtype), v.shape) for name, v in inputs],
        [helper.make_empty_tensor_value_info(output)],
        [numpy_helper.from_array(value, name) for name, value in (constants or {}).items()],
    )
    # An output without a type and a shape would not pass the checker; neither is used.
    graph.output[0].type.tensor_type.elem_type = TensorProto.FLOAT
    graph.output[0].type.tensor_type.shape.SetInParent()
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=10)


def written(made, folder: Path) -> Path:
    onnx.save(made, folder / "net.onnx")
    return folder / "net.onnx"


def test_every_operator_has_a_case():
    assert {name for name, _, _ in CASES} == set(OPERATORS)


@pytest.mark.parametrize(("operator", "inputs", "attributes"), CASES, ids=lambda x: x if isinstance(x, str) else "")
def test_an_operator_is_that_of_the_reference(operator, inputs, attributes, tmp_path):
    names = ["" if value is None else f"x{i}" for i, value in enumerate(inputs)]
    given = {name: value for name, value in zip(names, inputs, strict=True) if name}
    made = model([helper.make_node(operator, names, ["y"], **attributes)], list(given.items()))
    expected = ReferenceEvaluator(made).run(None, given)[0]
    answer = OnnxGraph(written(made, tmp_path))(*(torch.tensor(value) for value in given.values()))
    assert answer.shape == expected.shape
    np.testing.assert_allclose(answer.numpy(), expected, rtol=1e-4, atol=1e-5)


def test_a_whole_network_and_its_input_gradients_are_those_of_the_reference(pilotnet_data):
    graph = OnnxGraph(pilotnet_data / "pilotnet.onnx")
    assert graph.inputs == {"frames_yuv": (None, 3, 66, 200)}
    reference = np.load(pilotnet_data / "reference.npz", allow_pickle=False)
    frames = torch.tensor(reference["frames_yuv"]).requires_grad_()
    steer = graph(frames)
    (gradient,) = torch.autograd.grad(steer.sum(), frames)
    np.testing.assert_allclose(steer.detach().numpy(), reference["steer"], atol=2e-6)
    np.testing.assert_allclose(gradient.numpy(), reference["grad_of_sum"], atol=1e-6)


def test_a_value_used_twice_or_given_out_is_kept_until_then(tmp_path):
    nodes = [
        helper.make_node("Relu", ["x"], ["a"]),
        helper.make_node("Neg", ["a"], ["b"]),
        helper.make_node("Add", ["a", "a"], ["y"]),
        helper.make_node("Mul", ["y", "b"], ["unused"]),
    ]
    graph = OnnxGraph(written(model(nodes, [("x", MATRIX)]), tmp_path))
    np.testing.assert_allclose(graph(torch.tensor(MATRIX)).numpy(), 2 * MATRIX.clip(min=0))


def test_constants_move_with_the_module_and_are_cast_with_it(tmp_path):
    nodes = [
        helper.make_node("Constant", [], ["two"], value=numpy_helper.from_array(scalar(2.0))),
        helper.make_node("Mul", ["x", "two"], ["d"]),
        helper.make_node("Add", ["d", "c"], ["y"]),
    ]
    made = model(nodes, [("x", MATRIX)], constants={"c": MATRIX})
    graph = OnnxGraph(written(made, tmp_path)).double()
    answer = graph(torch.tensor(MATRIX, dtype=torch.float64))
    assert answer.dtype == torch.float64
    np.testing.assert_allclose(answer.numpy(), 3 * MATRIX.astype(np.float64))


def test_what_cannot_be_computed_is_named(tmp_path):
    def refused(made, message):
        with pytest.raises(ControllerError, match=message) as refusal:
            OnnxGraph(written(made, tmp_path))
        assert "\n" not in str(refusal.value)

    x = [("x", MATRIX)]
    refused(model([helper.make_node("Sin", ["x"], ["y"])], x), r"operator ai\.onnx\.Sin")
    refused(model([helper.make_node("Relu", ["x"], ["y"])], x, opset=11), r"operator set \[11\], expected 13")
    two = model([helper.make_node("Relu", ["x"], ["y"]), helper.make_node("Neg", ["x"], ["z"])], x)
    two.graph.output.append(helper.make_tensor_value_info("z", TensorProto.FLOAT, (3, 5)))
    refused(two, "2 outputs, expected one")
    (tmp_path / "bad.onnx").write_bytes(b"no graph")
    with pytest.raises(ControllerError, match=r"bad\.onnx is not a valid ONNX file"):
        OnnxGraph(tmp_path / "bad.onnx")
    graph = OnnxGraph(written(model([helper.make_node("MatMul", ["x", "x"], ["y"])], x), tmp_path))
    with pytest.raises(ControllerError, match=r"MatMul → y cannot take shapes \(3, 5\), \(3, 5\)"):
        graph(torch.tensor(MATRIX))
