"""The ONNX operators that steering networks are made of, in torch: differentiable, on any device.

Each entry of `OPERATORS` takes the node's attributes and its inputs (None where an optional one is left out) and
gives its output, or a tuple where it may have several. Meanings are those of operator set 13 and newer
(https://onnx.ai/onnx/operators/). What an operator asks for that is not done here is a ValueError.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from roadproof.controllers.onnx_recurrent import gru, lstm

Attributes = dict[str, Any]
Inputs = Sequence[Any]
Operator = Callable[[Attributes, Inputs], Tensor | tuple[Tensor, ...]]

# ONNX' codes of element types (TensorProto.DataType).
DTYPES = {
    1: torch.float32, 2: torch.uint8, 3: torch.int8, 5: torch.int16, 6: torch.int32, 7: torch.int64,
    9: torch.bool, 10: torch.float16, 11: torch.float64, 16: torch.bfloat16,
}  # fmt: skip

_SELU = (1.67326319217681884765625, 1.05070102214813232421875)
"""Selu's own alpha and gamma."""

# How torch says what Resize asks for: mode, where the pixels of the result lie, and how the nearest is rounded.
_RESIZED: dict[tuple[bytes, bytes, bytes | None], tuple[str, bool | None]] = {
    (b"linear", b"half_pixel", None): ("linear", False),
    (b"linear", b"pytorch_half_pixel", None): ("linear", False),
    (b"linear", b"align_corners", None): ("linear", True),
    (b"cubic", b"half_pixel", None): ("bicubic", False),
    (b"cubic", b"pytorch_half_pixel", None): ("bicubic", False),
    (b"cubic", b"align_corners", None): ("bicubic", True),
    (b"nearest", b"asymmetric", b"floor"): ("nearest", None),
    (b"nearest", b"half_pixel", b"round_prefer_ceil"): ("nearest-exact", None),
}


def _integers(x: Tensor | None) -> list[int] | None:
    return None if x is None else [int(value) for value in x.reshape(-1)]


def _get(x: Inputs, index: int) -> Tensor | None:
    return x[index] if len(x) > index else None


def _axes(a: Attributes, x: Inputs) -> list[int] | None:
    """The axes of an operator: an attribute in older operator sets, an input in newer ones."""
    return a.get("axes") or _integers(_get(x, 1))


def _padded(a: Attributes, x: Tensor, value: float) -> Tensor:
    """Pad the picture by the attributes `pads` (all begins, then all ends) or `auto_pad`."""
    sizes, kernel = x.shape[2:], a["kernel_shape"]
    count = len(kernel)
    pads = a.get("pads", [0] * 2 * count)
    mode = a.get("auto_pad", b"NOTSET")
    if mode in (b"SAME_UPPER", b"SAME_LOWER"):
        strides, dilations = a.get("strides", [1] * count), a.get("dilations", [1] * count)
        total = [
            max((math.ceil(n / s) - 1) * s + (k - 1) * d + 1 - n, 0)
            for n, k, s, d in zip(sizes, kernel, strides, dilations, strict=True)
        ]
        small, large = [t // 2 for t in total], [t - t // 2 for t in total]
        pads = small + large if mode == b"SAME_UPPER" else large + small
    if not any(pads):
        return x
    last_first = [pad for axis in reversed(range(count)) for pad in (pads[axis], pads[axis + count])]
    return functional.pad(x, last_first, value=value)


def _conv(a: Attributes, x: Inputs) -> Tensor:
    a = {"kernel_shape": list(x[1].shape[2:]), **a}
    count = len(a["kernel_shape"])
    convolve = {1: functional.conv1d, 2: functional.conv2d, 3: functional.conv3d}[count]
    return convolve(
        _padded(a, x[0], 0.0),
        x[1],
        _get(x, 2),
        stride=a.get("strides", 1),
        dilation=a.get("dilations", 1),
        groups=a.get("group", 1),
    )


def _transposed_conv(a: Attributes, x: Inputs) -> Tensor:
    count = x[1].ndim - 2
    pads = a.get("pads", [0] * 2 * count)
    if pads[:count] != pads[count:] or "output_shape" in a or a.get("auto_pad", b"NOTSET") != b"NOTSET":
        raise ValueError("pads that differ at the two ends, output_shape or auto_pad")
    convolve = {1: functional.conv_transpose1d, 2: functional.conv_transpose2d, 3: functional.conv_transpose3d}[count]
    return convolve(
        x[0],
        x[1],
        _get(x, 2),
        stride=a.get("strides", 1),
        padding=pads[:count],
        output_padding=a.get("output_padding", 0),
        groups=a.get("group", 1),
        dilation=a.get("dilations", 1),
    )


def _resize(a: Attributes, x: Inputs) -> Tensor:
    if a.get("antialias") or a.get("exclude_outside") or "axes" in a:
        raise ValueError("antialias, exclude_outside or axes")
    if a.get("keep_aspect_ratio_policy", b"stretch") != b"stretch" or a.get("cubic_coeff_a", -0.75) != -0.75:
        raise ValueError("keep_aspect_ratio_policy other than stretch, or cubic_coeff_a other than -0.75")
    mode, places = a.get("mode", b"nearest"), a.get("coordinate_transformation_mode", b"half_pixel")
    rounding = a.get("nearest_mode", b"round_prefer_floor") if mode == b"nearest" else None
    picture: Tensor = x[0]
    sizes, scales = _integers(_get(x, 3)), _get(x, 2)
    stays = sizes[:2] == [*picture.shape[:2]] if sizes else scales is None or bool((scales[:2] == 1).all())
    if not stays:
        raise ValueError("another number of pictures or channels")
    size = sizes[2:] if sizes else None
    factor = None if sizes or scales is None else [float(each) for each in scales[2:]]
    if (mode, places, rounding) == (b"nearest", b"half_pixel", b"round_prefer_floor"):
        return _nearest_first(picture, size, factor)
    if (mode, places, rounding) not in _RESIZED:
        raise ValueError(f"{mode.decode()} at {places.decode()}{f', {rounding.decode()}' if rounding else ''}")
    kind, corners = _RESIZED[mode, places, rounding]
    if kind.endswith("linear"):
        kind = ("linear", "bilinear", "trilinear")[picture.ndim - 3]
    resized = functional.interpolate(picture, size=size, scale_factor=factor, mode=kind, align_corners=corners)
    pairs = zip(picture.shape, resized.shape, strict=True)
    if places == b"pytorch_half_pixel" and any(after == 1 < before for before, after in pairs):
        raise ValueError("pytorch_half_pixel down to one pixel")
    return resized


def _nearest_first(picture: Tensor, size: list[int] | None, factor: list[float] | None) -> Tensor:
    """The nearest pixels, of two as near the first; torch's "nearest-exact" takes the second."""
    for axis, count in enumerate(picture.shape[2:]):
        scale = factor[axis] if factor else (size or [])[axis] / count
        places = torch.arange(size[axis] if size else math.floor(count * scale), device=picture.device) + 0.5
        index = (places.double() / scale - 1).ceil().clamp(0, count - 1).long()
        picture = picture.index_select(axis + 2, index)
    return picture


def _depth_to_space(a: Attributes, x: Inputs) -> Tensor:
    size, (batch, channels, height, width) = a["blocksize"], x[0].shape
    if a.get("mode", b"DCR") == b"CRD":
        return functional.pixel_shuffle(x[0], size)
    apart = x[0].reshape(batch, size, size, channels // size**2, height, width).permute(0, 3, 4, 1, 5, 2)
    return apart.reshape(batch, channels // size**2, height * size, width * size)


def _ceils(a: Attributes, x: Tensor, padded: Tensor) -> bool:
    """Whether windows may reach beyond the picture; in one that was padded they would begin in the padding too."""
    ceils = bool(a.get("ceil_mode")) and set(a.get("strides", [1])) != {1}
    if ceils and padded is not x:
        raise ValueError("ceil_mode with pads")
    return ceils


def _max_pool(a: Attributes, x: Inputs) -> Tensor:
    padded, kernel = _padded(a, x[0], -math.inf), a["kernel_shape"]
    pool = {1: functional.max_pool1d, 2: functional.max_pool2d, 3: functional.max_pool3d}[len(kernel)]
    ceil_mode = _ceils(a, x[0], padded)
    return pool(padded, kernel, a.get("strides", 1), dilation=a.get("dilations", 1), ceil_mode=ceil_mode)


def _average_pool(a: Attributes, x: Inputs) -> Tensor:
    if set(a.get("dilations", [1])) != {1}:
        raise ValueError("dilations")
    padded, kernel, strides = _padded(a, x[0], 0.0), a["kernel_shape"], a.get("strides", 1)
    pool = {1: functional.avg_pool1d, 2: functional.avg_pool2d, 3: functional.avg_pool3d}[len(kernel)]
    mean = pool(padded, kernel, strides, ceil_mode=_ceils(a, x[0], padded))
    if a.get("count_include_pad") or padded is x[0]:
        return mean
    # Averages over real pixels only: divide by their share of the window.
    return mean / pool(_padded(a, torch.ones_like(x[0]), 0.0), kernel, strides)


def _gemm(a: Attributes, x: Inputs) -> Tensor:
    left = x[0].T if a.get("transA") else x[0]
    right = x[1].T if a.get("transB") else x[1]
    product = a.get("alpha", 1.0) * (left @ right)
    return product if _get(x, 2) is None else product + a.get("beta", 1.0) * x[2]


def _split(a: Attributes, x: Inputs) -> tuple[Tensor, ...]:
    axis = a.get("axis", 0)
    count, parts = a.get("num_outputs"), _integers(_get(x, 1))
    size = -(-x[0].shape[axis] // count) if count else 0
    return x[0].split(parts or size, axis)


def _reshape(a: Attributes, x: Inputs) -> Tensor:
    shape = _integers(x[1]) or []
    if not a.get("allowzero"):
        shape = [x[0].shape[axis] if size == 0 else size for axis, size in enumerate(shape)]
    return x[0].reshape(shape)


def _flatten(a: Attributes, x: Inputs) -> Tensor:
    axis = a.get("axis", 1)
    # After the last axis comes one more, which is no negative one.
    first = x[0].shape[: axis if axis >= 0 else axis + x[0].ndim]
    return x[0].reshape(math.prod(first), -1)


def _squeeze(a: Attributes, x: Inputs) -> Tensor:
    axes = _axes(a, x)
    return x[0].squeeze() if axes is None else x[0].squeeze(tuple(axes))


def _unsqueeze(a: Attributes, x: Inputs) -> Tensor:
    axes = _axes(a, x) or []
    result: Tensor = x[0]
    for axis in sorted(axis % (x[0].ndim + len(axes)) for axis in axes):
        result = result.unsqueeze(axis)
    return result


def _slice(_: Attributes, x: Inputs) -> Tensor:
    starts, ends = _integers(x[1]) or [], _integers(x[2]) or []
    axes = _integers(_get(x, 3)) or list(range(len(starts)))
    steps = _integers(_get(x, 4)) or [1] * len(starts)
    result: Tensor = x[0]
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        kept = list(range(result.shape[axis]))[start : None if step < 0 and end < -result.shape[axis] else end : step]
        result = result.index_select(axis, torch.tensor(kept, device=result.device, dtype=torch.int64))
    return result


def _gather(a: Attributes, x: Inputs) -> Tensor:
    axis = a.get("axis", 0) % x[0].ndim
    index = x[1].to(x[0].device) % x[0].shape[axis]
    shape = (*x[0].shape[:axis], *index.shape, *x[0].shape[axis + 1 :])
    return x[0].index_select(axis, index.reshape(-1)).reshape(shape)


def _gather_elements(a: Attributes, x: Inputs) -> Tensor:
    axis = a.get("axis", 0)
    return x[0].gather(axis, x[1] % x[0].shape[axis])


def _gather_nd(a: Attributes, x: Inputs) -> Tensor:
    batch = x[1].shape[: a.get("batch_dims", 0)]
    data, index = (part.reshape(-1, *part.shape[len(batch) :]) if batch else part[None] for part in x)
    row = torch.arange(len(index), device=index.device).view(-1, *[1] * (index.ndim - 2))
    found = data[(row, *index.unbind(-1))]
    return found.reshape(*batch, *found.shape[1:])


def _pad(a: Attributes, x: Inputs) -> Tensor:
    pads, count = _integers(x[1]) or [], x[0].ndim
    axes = [axis % count for axis in _integers(_get(x, 3)) or range(count)]
    begin, end = dict(zip(axes, pads[: len(axes)], strict=True)), dict(zip(axes, pads[len(axes) :], strict=True))
    last_first = [pad for axis in reversed(range(count)) for pad in (begin.get(axis, 0), end.get(axis, 0))]
    mode = {b"constant": "constant", b"reflect": "reflect", b"edge": "replicate"}[a.get("mode", b"constant")]
    if mode != "constant":
        # torch reflects and repeats the last two axes of a picture only.
        if any(last_first[2 * (count - 2) :]):
            raise ValueError(f"{mode} along the first two axes")
        return functional.pad(x[0], last_first[: 2 * (count - 2)], mode=mode)
    value = _get(x, 2)
    return functional.pad(x[0], last_first, value=0.0 if value is None else float(value))


def _expand(_: Attributes, x: Inputs) -> Tensor:
    # A size of 1 in the shape asks for the input's own: the broadcast of both.
    like = x[0].new_empty(_integers(x[1]) or [])
    return torch.broadcast_tensors(x[0], like)[0]  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]


def _constant_of_shape(a: Attributes, x: Inputs) -> Tensor:
    value = a.get("value", torch.zeros(1))
    return value.to(x[0].device).expand(_integers(x[0]) or [])


def _reduced(kind: Callable[..., Tensor]) -> Operator:
    def apply(a: Attributes, x: Inputs) -> Tensor:
        axes = _axes(a, x)
        if not axes and a.get("noop_with_empty_axes"):
            return x[0]
        return kind(x[0], dim=tuple(axes or range(x[0].ndim)), keepdim=bool(a.get("keepdims", 1)))

    return apply


def _batch_normalization(a: Attributes, x: Inputs) -> Tensor:
    if a.get("training_mode"):
        raise ValueError("training_mode")
    return functional.batch_norm(x[0], x[3], x[4], x[1], x[2], training=False, eps=a.get("epsilon", 1e-5))


def _dropout(_: Attributes, x: Inputs) -> Tensor:
    training = _get(x, 2)
    if training is not None and bool(training):
        raise ValueError("training_mode")
    return x[0]


def _length(x: Tensor, *, dim: tuple[int, ...], keepdim: bool) -> Tensor:
    return x.square().sum(dim, keepdim=keepdim).sqrt()


def _elementwise(kind: Callable[..., Tensor]) -> Operator:
    return lambda _, x: kind(*x)


OPERATORS: dict[str, Operator] = {
    "Abs": _elementwise(torch.abs),
    "Add": _elementwise(torch.add),
    "And": _elementwise(torch.logical_and),
    "AveragePool": _average_pool,
    "BatchNormalization": _batch_normalization,
    "Cast": lambda a, x: x[0].to(DTYPES[a["to"]]),
    "Ceil": _elementwise(torch.ceil),
    "Celu": lambda a, x: functional.celu(x[0], a.get("alpha", 1.0)),
    "Clip": lambda _, x: torch.clamp(x[0], min=_get(x, 1), max=_get(x, 2)),
    "Concat": lambda a, x: torch.cat(list(x), dim=a["axis"]),
    "ConstantOfShape": _constant_of_shape,
    "Conv": _conv,
    "ConvTranspose": _transposed_conv,
    "Cos": _elementwise(torch.cos),
    "DepthToSpace": _depth_to_space,
    "Div": lambda _, x: torch.div(x[0], x[1], rounding_mode=None if x[0].is_floating_point() else "trunc"),
    "Dropout": _dropout,
    "Einsum": lambda a, x: torch.einsum(a["equation"].decode(), *x),
    "Elu": lambda a, x: functional.elu(x[0], a.get("alpha", 1.0)),
    "Equal": _elementwise(torch.eq),
    "Erf": _elementwise(torch.erf),
    "Exp": _elementwise(torch.exp),
    "Expand": _expand,
    "Flatten": _flatten,
    "Floor": _elementwise(torch.floor),
    "GRU": gru,
    "Gather": _gather,
    "GatherElements": _gather_elements,
    "GatherND": _gather_nd,
    "Gelu": lambda a, x: functional.gelu(x[0], approximate=a.get("approximate", b"none").decode()),
    "Gemm": _gemm,
    "GlobalAveragePool": lambda _, x: x[0].mean(dim=tuple(range(2, x[0].ndim)), keepdim=True),
    "GlobalMaxPool": lambda _, x: x[0].amax(dim=tuple(range(2, x[0].ndim)), keepdim=True),
    "Greater": _elementwise(torch.gt),
    "GreaterOrEqual": _elementwise(torch.ge),
    "GroupNormalization": lambda a, x: functional.group_norm(x[0], a["num_groups"], x[1], x[2], a.get("epsilon", 1e-5)),
    "HardSigmoid": lambda a, x: (x[0] * a.get("alpha", 0.2) + a.get("beta", 0.5)).clamp(0.0, 1.0),
    "HardSwish": _elementwise(functional.hardswish),
    "Identity": lambda _, x: x[0],
    "InstanceNormalization": lambda a, x: functional.instance_norm(
        x[0], weight=x[1], bias=x[2], eps=a.get("epsilon", 1e-5)
    ),
    "LSTM": lstm,
    "LayerNormalization": lambda a, x: functional.layer_norm(
        x[0], x[0].shape[a.get("axis", -1) :], x[1], _get(x, 2), a.get("epsilon", 1e-5)
    ),
    "LeakyRelu": lambda a, x: functional.leaky_relu(x[0], a.get("alpha", 0.01)),
    "Less": _elementwise(torch.lt),
    "LessOrEqual": _elementwise(torch.le),
    "Log": _elementwise(torch.log),
    "LogSoftmax": lambda a, x: x[0].log_softmax(dim=a.get("axis", -1)),
    "MatMul": _elementwise(torch.matmul),
    "Max": lambda _, x: reduce(torch.maximum, x),
    "MaxPool": _max_pool,
    "Min": lambda _, x: reduce(torch.minimum, x),
    "Mish": lambda _, x: functional.mish(x[0]),
    "Mod": lambda a, x: (torch.fmod if a.get("fmod") else torch.remainder)(x[0], x[1]),
    "Mul": _elementwise(torch.mul),
    "Neg": _elementwise(torch.neg),
    "Not": _elementwise(torch.logical_not),
    "Or": _elementwise(torch.logical_or),
    "PRelu": lambda _, x: torch.where(x[0] < 0, x[0] * x[1], x[0]),
    "Pad": _pad,
    "Pow": lambda _, x: torch.pow(x[0], x[1]).to(x[0].dtype),
    "Range": lambda _, x: torch.arange(*(part.item() for part in x), dtype=x[0].dtype, device=x[0].device),
    "Reciprocal": _elementwise(torch.reciprocal),
    "ReduceL2": _reduced(_length),
    "ReduceMax": _reduced(torch.amax),
    "ReduceMean": _reduced(torch.mean),
    "ReduceMin": _reduced(torch.amin),
    "ReduceSum": _reduced(torch.sum),
    "Relu": _elementwise(torch.relu),
    "Reshape": _reshape,
    "Resize": _resize,
    "Round": _elementwise(torch.round),
    "Selu": lambda a, x: a.get("gamma", _SELU[1]) * functional.elu(x[0], a.get("alpha", _SELU[0])),
    "Shape": lambda a, x: torch.tensor(
        x[0].shape[a.get("start", 0) : a.get("end")], dtype=torch.int64, device=x[0].device
    ),
    "Sigmoid": _elementwise(torch.sigmoid),
    "Sign": _elementwise(torch.sign),
    "Sin": _elementwise(torch.sin),
    "Slice": _slice,
    "Softmax": lambda a, x: x[0].softmax(dim=a.get("axis", -1)),
    "Softplus": lambda _, x: functional.softplus(x[0]),
    "Softsign": lambda _, x: functional.softsign(x[0]),
    "Split": _split,
    "Sqrt": _elementwise(torch.sqrt),
    "Squeeze": _squeeze,
    "Sub": _elementwise(torch.sub),
    "Sum": lambda _, x: reduce(torch.add, x),
    "Tanh": _elementwise(torch.tanh),
    "Tile": lambda _, x: x[0].repeat(_integers(x[1]) or []),
    "Transpose": lambda a, x: x[0].permute(a.get("perm", list(reversed(range(x[0].ndim))))),
    "Unsqueeze": _unsqueeze,
    "Where": _elementwise(torch.where),
}

SEVERAL_OUTPUTS = ("GRU", "LSTM", "Split")
"""Operators of which more than the first output may be used."""
