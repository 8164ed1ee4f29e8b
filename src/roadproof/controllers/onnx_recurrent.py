"""ONNX' recurrent layers in torch, a step at a time: differentiable, in ONNX' own order of gates.

symbol   meaning                                             shape
x        inputs of T steps                                   (T, B, I)
w, r, b  weights of inputs and state, biases of both         (D, G·H, I), (D, G·H, H), (D, 2·G·H)
h        state; D directions, one or two                     (D, B, H)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

State = tuple[Tensor, ...]
Step = Callable[[Tensor, State, Tensor, Tensor], State]
"""The next state from x wᵀ + b_w of a step, the state, r, and the biases b_r."""


def gru(a: dict[str, Any], x: Sequence[Any]) -> tuple[Tensor, ...]:
    """All states (T, D, B, H) and the last (D, B, H) of a GRU, whose gates are z, r, h."""
    before = bool(a.get("linear_before_reset"))

    def step(fed: Tensor, state: State, weights: Tensor, bias: Tensor) -> State:
        (h,) = state
        fed_z, fed_r, fed_n = fed.chunk(3, 1)
        z, r, n = functional.linear(h, weights, bias).chunk(3, 1)
        z, r = torch.sigmoid(fed_z + z), torch.sigmoid(fed_r + r)
        size = h.shape[1]
        n = r * n if before else functional.linear(r * h, weights[2 * size :], bias[2 * size :])
        return ((1 - z) * torch.tanh(fed_n + n) + z * h,)

    return _unrolled(a, x, step, states=1)


def lstm(a: dict[str, Any], x: Sequence[Any]) -> tuple[Tensor, ...]:
    """All states (T, D, B, H), the last state and the last cell (D, B, H) of an LSTM, whose gates are i, o, f, c."""
    if a.get("input_forget") or (len(x) > 7 and x[7] is not None):
        raise ValueError("input_forget or peepholes")

    def step(fed: Tensor, state: State, weights: Tensor, bias: Tensor) -> State:
        h, cell = state
        i, o, f, c = (fed + functional.linear(h, weights, bias)).chunk(4, 1)
        cell = torch.sigmoid(f) * cell + torch.sigmoid(i) * torch.tanh(c)
        return torch.sigmoid(o) * torch.tanh(cell), cell

    return _unrolled(a, x, step, states=2)


def _unrolled(a: dict[str, Any], x: Sequence[Any], step: Step, *, states: int) -> tuple[Tensor, ...]:
    x = [*x, *[None] * (8 - len(x))]
    if x[4] is not None or a.get("layout") or a.keys() & {"activations", "clip"}:
        raise ValueError("sequence_lens, layout, activations or clip")
    frames, weights, recurrent, biases, _, *begin = x
    directions, size = len(weights), a["hidden_size"]
    order = {b"forward": [1], b"reverse": [-1], b"bidirectional": [1, -1]}[a.get("direction", b"forward")]
    every: list[Tensor] = []
    last: list[State] = []
    for d in range(directions):
        fed_bias, bias = recurrent.new_zeros(2 * recurrent.shape[1]).chunk(2) if biases is None else biases[d].chunk(2)
        fed = functional.linear(frames, weights[d], fed_bias)
        none = frames.new_zeros(frames.shape[1], size)
        state: State = tuple(none if each is None else each[d] for each in begin[:states])
        told: list[Tensor] = []
        for each in fed if order[d] > 0 else fed.flip(0):
            state = step(each, state, recurrent[d], bias)
            told.append(state[0])
        every.append(torch.stack(told[:: order[d]]))
        last.append(state)
    return torch.stack(every, 1), *(torch.stack(each) for each in zip(*last, strict=True))
