"""Each ONNX operator against the reference implementation that comes with ONNX, and a whole network's gradients."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
from onnx import TensorProto, helper, numpy_helper
from onnx.reference import ReferenceEvaluator

from roadproof.controllers.onnx_graph import OnnxGraph
from roadproof.controllers.onnx_operators import OPERATORS
from roadproof.errors import ControllerError
from roadproof.io.known import known_by

RNG = np.random.default_rng(0)
IMAGE = RNG.normal(size=(2, 4, 7, 9)).astype(np.float32)
MATRIX = RNG.normal(size=(3, 5)).astype(np.float32)
POSITIVE = np.abs(MATRIX) + 0.1
KERNEL = RNG.normal(size=(6, 4, 3, 3)).astype(np.float32)
BIAS = RNG.normal(size=6).astype(np.float32)
CHANNEL = [RNG.uniform(0.5, 1.5, size=4).astype(np.float32) for _ in range(4)]
TRUTH = MATRIX > 0
STEPS, GATES = np.ones((3, 1, 2), np.float32), np.ones((1, 8, 2), np.float32)


def ints(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def scalar(value: float) -> np.ndarray:
    return np.array(value, dtype=np.float32)


CORNERS = {"coordinate_transformation_mode": "align_corners"}
FACTORS = np.array([1.0, 1.0, 2.0, 0.5], np.float32)
SAME = {"kernel_shape": [3, 3], "strides": [2, 2]}
ONE_INPUT = (
    *("Abs", "Elu", "Erf", "Exp", "Gelu", "HardSigmoid", "HardSwish", "Identity", "LeakyRelu", "Neg", "Relu", "Selu"),
    *("Sigmoid", "Softmax", "Softplus", "Tanh", "Transpose", "Shape", "Dropout", "Ceil", "Floor", "Round", "Sign"),
    *("Celu", "Cos", "LogSoftmax", "Mish", "Reciprocal", "Sin", "Softsign"),
)
TWO_INPUTS = (
    *("Add", "Sub", "Mul", "Div", "Max", "Min", "Greater", "Less", "Equal", "GreaterOrEqual", "LessOrEqual", "Sum"),
)
REDUCED = ("ReduceMean", "ReduceSum", "ReduceMax", "ReduceMin", "ReduceL2")


def recurrent(gates: int, *, directions: int = 1) -> list[np.ndarray]:
    """Inputs of a recurrent layer of 4 steps, 2 rows, 3 values, and 5 of state."""
    shapes = ((4, 2, 3), (directions, 5 * gates, 3), (directions, 5 * gates, 5), (directions, 10 * gates))
    return [RNG.normal(size=shape).astype(np.float32) for shape in shapes]


STATE = RNG.normal(size=(1, 2, 5)).astype(np.float32)
CASES = [
    *((name, [MATRIX], {}) for name in ONE_INPUT),
    *((name, [MATRIX, MATRIX[::-1].copy()], {}) for name in TWO_INPUTS),
    *((name, [TRUTH, TRUTH[::-1].copy()], {}) for name in ("And", "Or")),
    *((name, [IMAGE], {"keepdims": 0}) for name in REDUCED),
    *((name, [IMAGE, ints(2, 3)], {}) for name in REDUCED),
    ("ReduceSum", [IMAGE, ints()], {"noop_with_empty_axes": 1}),
    ("AveragePool", [IMAGE], {"kernel_shape": [2, 3], "strides": [2, 2]}),
    ("AveragePool", [IMAGE], {**SAME, "pads": [1, 1, 1, 1]}),
    ("AveragePool", [IMAGE], {**SAME, "pads": [1, 1, 1, 1], "count_include_pad": 1}),
    ("AveragePool", [IMAGE], {**SAME, "ceil_mode": 1}),
    ("AveragePool", [IMAGE[0]], {"kernel_shape": [2]}),
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
    ("Celu", [MATRIX], {"alpha": 0.3}),
    (
        "ConvTranspose",
        [IMAGE, KERNEL[:4], BIAS[:4]],
        {"strides": [2, 1], "pads": [1, 0, 1, 0], "output_padding": [1, 0]},
    ),
    ("ConvTranspose", [IMAGE, KERNEL[:4]], {"dilations": [2, 2]}),
    ("DepthToSpace", [IMAGE], {"blocksize": 2}),
    ("DepthToSpace", [IMAGE], {"blocksize": 2, "mode": "CRD"}),
    ("Einsum", [MATRIX, MATRIX], {"equation": "ij,kj->ik"}),
    ("GRU", recurrent(3), {"hidden_size": 5, "linear_before_reset": 1}),
    ("GRU", [*recurrent(3), None, STATE], {"hidden_size": 5}),
    ("GatherND", [IMAGE, ints(0, 1, 1, -1).reshape(2, 2)], {}),
    ("GatherND", [IMAGE, ints(0, 1, -1, 2).reshape(2, 1, 2)], {"batch_dims": 1}),
    ("GlobalMaxPool", [IMAGE], {}),
    ("GroupNormalization", [IMAGE, *CHANNEL[:2]], {"num_groups": 2}),
    ("InstanceNormalization", [IMAGE, *CHANNEL[:2]], {"epsilon": 1e-3}),
    ("LSTM", recurrent(4), {"hidden_size": 5}),
    ("LSTM", [*recurrent(4), None, STATE, STATE[:, ::-1].copy()], {"hidden_size": 5}),
    ("LayerNormalization", [IMAGE, IMAGE[0, 0], IMAGE[1, 0]], {"axis": 2}),
    ("LayerNormalization", [MATRIX, MATRIX[0]], {}),
    ("Log", [POSITIVE], {}),
    ("Mod", [ints(7, -7, 9), ints(2, 2, -3)], {}),
    ("Mod", [MATRIX, POSITIVE], {"fmod": 1}),
    ("Range", [ints(2)[0], ints(11)[0], ints(3)[0]], {}),
    ("Resize", [IMAGE, None, None, ints(2, 4, 5, 13)], {"mode": "linear"}),
    ("Resize", [IMAGE, None, FACTORS], {"mode": "linear"}),
    ("Resize", [IMAGE, None, None, ints(2, 4, 5, 13)], {**CORNERS, "mode": "linear"}),
    ("Resize", [IMAGE, None, FACTORS], {"mode": "cubic"}),
    ("Resize", [IMAGE, None, FACTORS], {"coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}),
    ("Resize", [IMAGE, None, FACTORS], {}),
    ("Resize", [IMAGE, None, None, ints(2, 4, 14, 6)], {"nearest_mode": "round_prefer_floor"}),
    ("Resize", [IMAGE, None, FACTORS], {"nearest_mode": "round_prefer_ceil"}),
    ("Selu", [MATRIX], {"alpha": 1.0, "gamma": 2.0}),
    ("Split", [IMAGE, ints(1, 3)], {"axis": 1}),
    ("Tile", [MATRIX, ints(2, 1)], {}),
    ("Div", [ints(7, -7, 9), ints(2, 2, 3)], {}),
    ("Elu", [MATRIX], {"alpha": 0.3}),
    ("Expand", [MATRIX, ints(2, 3, 1)], {}),
    ("Flatten", [IMAGE], {}),
    ("Flatten", [IMAGE], {"axis": 3}),
    ("Flatten", [IMAGE], {"axis": -1}),
    ("Flatten", [IMAGE], {"axis": 4}),
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
    ("MaxPool", [IMAGE], {**SAME, "kernel_shape": [2, 2], "ceil_mode": 1}),
    ("MaxPool", [IMAGE[0]], {"kernel_shape": [3], "strides": [2]}),
    ("Not", [TRUTH], {}),
    ("PRelu", [MATRIX, scalar(0.2)], {}),
    ("Pad", [IMAGE, ints(0, 0, 1, 2, 0, 0, 3, 4), scalar(0.5)], {}),
    ("Pad", [IMAGE, ints(0, 0, 1, 2, 0, 0, 3, 4)], {"mode": "reflect"}),
    ("Pad", [IMAGE, ints(1, 2, 3, 4), None, ints(2, -1)], {"mode": "edge"}),
    ("Pow", [POSITIVE, scalar(1.7)], {}),
    ("Pow", [ints(2, 3), scalar(2.5)], {}),
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


class LastOfARow(nn.Module):
    """A network that looks at a row of the picture step by step."""

    def __init__(self):
        super().__init__()
        self.steps, self.out = nn.GRU(40, 6, batch_first=True), nn.Linear(6, 1)

    def forward(self, frames):
        return self.out(self.steps(frames.mean(1).transpose(1, 2))[0][:, -1])


def model(nodes, inputs, output="y", *, constants=None, opset=21):
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


@pytest.mark.parametrize(
    ("operator", "inputs", "attributes", "named"),
    [
        ("AveragePool", [IMAGE], {**SAME, "dilations": [2, 2]}, "dilations"),
        ("AveragePool", [IMAGE], {**SAME, "pads": [1, 1, 1, 1], "ceil_mode": 1}, "ceil_mode with pads"),
        ("MaxPool", [IMAGE], {**SAME, "pads": [1, 1, 1, 1], "ceil_mode": 1}, "ceil_mode with pads"),
        ("BatchNormalization", [IMAGE, *CHANNEL], {"training_mode": 1}, "training_mode"),
        ("Dropout", [IMAGE, scalar(0.5), np.array(True)], {}, "training_mode"),
        ("LSTM", [STEPS, GATES, GATES], {"hidden_size": 2, "input_forget": 1}, "input_forget"),
        (
            "Resize",
            [IMAGE, None, None, ints(2, 8, 7, 9)],
            {"mode": "nearest"},
            "another number of pictures or channels",
        ),
        ("Resize", [IMAGE, None, 2 * FACTORS], {"mode": "nearest"}, "another number of pictures or channels"),
        ("Pad", [IMAGE, ints(0, 1, 0, 0, 0, 0, 0, 0)], {"mode": "edge"}, "replicate along the first two axes"),
        ("Resize", [IMAGE, None, FACTORS], {"mode": "cubic", "cubic_coeff_a": -0.5}, "cubic_coeff_a other than"),
        (
            "Resize",
            [IMAGE, None, None, ints(2, 4, 14, 14)],
            {"mode": "linear", "keep_aspect_ratio_policy": "not_larger"},
            "keep_aspect_ratio_policy other than stretch",
        ),
        (
            "Resize",
            [IMAGE, None, None, ints(2, 4, 1, 9)],
            {"mode": "linear", "coordinate_transformation_mode": "pytorch_half_pixel"},
            "down to one pixel",
        ),
    ],
)
def test_what_an_operator_does_not_do_here_is_refused(operator, inputs, attributes, named, tmp_path):
    names = ["" if value is None else f"x{i}" for i, value in enumerate(inputs)]
    given = {name: value for name, value in zip(names, inputs, strict=True) if name}
    graph = OnnxGraph(written(model([helper.make_node(operator, names, ["y"], **attributes)], list(given.items())),
                              tmp_path))  # fmt: skip
    with pytest.raises(ControllerError, match=f"{operator} → y cannot take shapes .*: .*{named}"):
        graph(*(torch.tensor(value) for value in given.values()))


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


@pytest.mark.parametrize(
    ("operator", "inputs", "attributes", "outputs"),
    [
        ("Split", [IMAGE, ints(1, 3)], {"axis": 1}, 2),
        ("Split", [MATRIX], {"axis": 1, "num_outputs": 3}, 3),
        ("Split", [IMAGE], {"axis": 1}, 2),
        ("GRU", recurrent(3), {"hidden_size": 5, "linear_before_reset": 1}, 2),
        ("LSTM", recurrent(4), {"hidden_size": 5}, 3),
    ],
)
def test_every_output_of_an_operator_can_be_used(operator, inputs, attributes, outputs, tmp_path):
    names, told = [f"x{i}" for i in range(len(inputs))], [f"part{i}" for i in range(outputs)]
    flat = [helper.make_node("Flatten", [name], [f"{name}-flat"], axis=0) for name in told]
    joined = helper.make_node("Concat", [f"{name}-flat" for name in told], ["y"], axis=1)
    given = dict(zip(names, inputs, strict=True))
    # Split without sizes is older than operator set 18.
    opset = 13 if operator == "Split" and len(inputs) == 1 and "num_outputs" not in attributes else 21
    nodes = [helper.make_node(operator, names, told, **attributes), *flat, joined]
    made = model(nodes, list(given.items()), opset=opset)
    expected = ReferenceEvaluator(made).run(None, given)[0]
    answer = OnnxGraph(written(made, tmp_path))(*(torch.tensor(value) for value in given.values()))
    np.testing.assert_allclose(answer.numpy(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("operator", "layer"), [("GRU", torch.nn.GRU), ("LSTM", torch.nn.LSTM)])
def test_a_recurrent_layer_in_both_directions_is_torchs(operator, layer, tmp_path):
    torch.manual_seed(0)
    own = layer(3, 5, bidirectional=True)
    # torch has the gates in the order r, z, n and i, f, g, o.
    order = {"GRU": [1, 0, 2], "LSTM": [0, 3, 1, 2]}[operator]

    def arranged(name):
        both = [getattr(own, f"{name}_l0{way}").detach() for way in ("", "_reverse")]
        return torch.stack([torch.cat([each.chunk(len(order))[k] for k in order]) for each in both]).numpy()

    constants = {"w": arranged("weight_ih"), "r": arranged("weight_hh")}
    constants["b"] = np.concatenate([arranged("bias_ih"), arranged("bias_hh")], 1)
    attributes = {"hidden_size": 5, "direction": "bidirectional"}
    attributes |= {"linear_before_reset": 1} if operator == "GRU" else {}
    frames = torch.randn(4, 2, 3)
    made = model([helper.make_node(operator, ["x", "w", "r", "b"], ["y"], **attributes)], [("x", frames.numpy())],
                 constants=constants)  # fmt: skip
    answer = OnnxGraph(written(made, tmp_path))(frames)  # (T, 2, B, H)
    expected = own(frames)[0].detach().view(4, 2, 2, 5).transpose(1, 2)
    np.testing.assert_allclose(answer.numpy(), expected.numpy(), atol=1e-6)


@pytest.mark.parametrize(
    ("network", "size"),
    [
        (nn.Sequential(nn.Conv2d(3, 8, 3), nn.AdaptiveAvgPool2d((3, 5)), nn.Flatten(), nn.Linear(120, 1)), 5),
        (nn.Sequential(nn.Conv2d(3, 8, 8, 8), nn.GroupNorm(2, 8), nn.Mish(), nn.AdaptiveAvgPool2d(1), nn.Flatten(),
                       nn.LayerNorm(8), nn.Linear(8, 1)), 3),
        (LastOfARow(), 2),
    ],
    ids=["adaptive pooling", "norms", "recurrent"],
)  # fmt: skip
def test_todays_exporter_writes_what_is_read(network, size, tmp_path):
    network = network.eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(network, (torch.rand(2, 3, 40, 64),), str(tmp_path / "net.onnx"), dynamo=True, verbose=False,
                          dynamic_shapes=({0: torch.export.Dim("batch")},))  # fmt: skip
    frames = torch.rand(size, 3, 40, 64, requires_grad=True)
    steer = OnnxGraph(tmp_path / "net.onnx")(frames)
    (gradient,) = torch.autograd.grad(steer.sum(), frames)
    (expected,) = torch.autograd.grad(network(frames).sum(), frames)
    np.testing.assert_allclose(steer.detach().numpy(), network(frames).detach().numpy(), atol=1e-5)
    np.testing.assert_allclose(gradient.numpy(), expected.numpy(), atol=1e-5)


def test_a_whole_number_is_given_as_the_fraction_that_the_file_declares(tmp_path):
    made = model([helper.make_node("Div", ["x", "c"], ["y"])], [("x", MATRIX[0])], constants={"c": scalar(5.0)})
    commands = torch.tensor([2, 3, 4, 5, 2])
    answer = OnnxGraph(written(made, tmp_path))(commands)
    np.testing.assert_allclose(answer.numpy(), commands / 5.0, rtol=1e-6)


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


def test_graphs_of_equal_weights_are_told_apart(tmp_path):
    def known(nodes, name, output="y"):
        (tmp_path / name).mkdir()
        made = model(nodes, [("x", np.ones((1, 3)))], output, constants={"w": np.ones(3)})
        return known_by(OnnxGraph(written(made, tmp_path / name)))

    add = helper.make_node("Add", ["x", "w"], ["sum"], doc_string="where it comes from")
    plain = known([add, helper.make_node("Identity", ["sum"], ["y"])], "plain")
    assert known([add, helper.make_node("Relu", ["sum"], ["y"])], "cut") != plain
    several = [add, helper.make_node("Relu", ["sum"], ["y"]), helper.make_node("Abs", ["sum"], ["z"])]
    assert known(several, "first") != known(several, "second", "z")
    noted = helper.make_node("Add", ["x", "w"], ["sum"], name="added", doc_string="from elsewhere")
    assert known([noted, helper.make_node("Identity", ["sum"], ["y"])], "noted") == plain


def test_what_cannot_be_computed_is_named(tmp_path):
    def refused(made, message):
        with pytest.raises(ControllerError, match=message) as refusal:
            OnnxGraph(written(made, tmp_path))
        assert "\n" not in str(refusal.value)

    x = [("x", MATRIX)]
    refused(model([helper.make_node("Tan", ["x"], ["y"])], x), r"operator ai\.onnx\.Tan")
    refused(model([helper.make_node("Dropout", ["x"], ["y", "mask"])], x), r"Dropout with several outputs")
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
