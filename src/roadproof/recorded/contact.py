"""Holding cars at obstacles on a GPU: what `obstacles` says, all pushes of a step and their derivatives in one kernel.

Operation by operation a step of a few cars takes several hundred kernels there and back. Here each car is one program.
It carries the derivatives with it: every number has a value and a row of eight, six of which are used, its derivatives
with respect to

    x, y, yaw, speed of the car after the step as if there were no obstacles; x, y before the step
"""

# Triton ships no type information, and reads the source of its kernels itself.
# ruff: noqa: ANN001, ANN202
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportInvalidTypeForm=false

from __future__ import annotations

import importlib
from typing import Any, cast, no_type_check

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.compositing.fused import OPTIONS

triton: Any = importlib.import_module("triton")
tl: Any = importlib.import_module("triton.language")


def held(
    states: Float[Tensor, "r 6"], boxes: Float[Tensor, "b 5"], ahead: Float[Tensor, " c"], rules: dict[str, float]
) -> Float[Tensor, "r 4"]:
    """x, y, yaw and speed of cars that obstacles hold, differentiable in their states.

    Args:
        states: x, y, yaw, speed after the step as if there were no obstacles, and x, y before it; float64.
        boxes: x, y, yaw, half the length and half the width of each obstacle; float64.
        ahead: the middles of a car's circles along its axis, metres; float64.
        rules: radius, gyration, slowed (metres a second lost in a step), dt_s and pushes, as of `obstacles`.
    """
    return cast("Tensor", _Held.apply(states, boxes, ahead, rules))


class _Held(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, states: Tensor, boxes: Tensor, ahead: Tensor, rules: dict[str, float]) -> Tensor:  # noqa: ANN401
        after, slopes = states.new_empty(len(states), 4), states.new_empty(len(states), 4, 8)
        lanes = triton.next_power_of_2(len(boxes))
        given = (states.contiguous(), boxes, ahead, after, slopes, len(boxes), len(ahead), lanes)
        # Triton launches where torch is, not where the numbers are.
        with torch.cuda.device_of(states):
            _hold[(len(states),)](*given, **rules, **OPTIONS, num_warps=1)
        ctx.save_for_backward(slopes)
        return after

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None, None, None]:  # noqa: ANN401
        (slopes,) = ctx.saved_tensors
        return (grad_outputs[0][:, None] @ slopes)[:, 0, :6], None, None, None


@triton.jit
@no_type_check
def _unit(place: tl.constexpr):
    """The derivatives of an input: 1 in its own place."""
    return tl.where(tl.arange(0, 8) == place, 1.0, 0.0).to(tl.float64)


@triton.jit
@no_type_check
def _beyond(place, half):
    """How far a place lies beyond a side, and to which hand."""
    return tl.abs(place) - half, tl.where(place < 0, -1.0, 1.0).to(tl.float64)


@triton.jit
@no_type_check
def _deepest(x, y, c, s, boxes, ahead, many, circles: tl.constexpr, lanes: tl.constexpr):
    """The least distance of a car's circles' middles from any box, and which circle and box it is."""
    b = tl.arange(0, lanes)
    there = b < many
    at = boxes + b * 5
    box_x, box_y = tl.load(at, mask=there, other=0.0), tl.load(at + 1, mask=there, other=0.0)
    yaw = tl.load(at + 2, mask=there, other=0.0)
    half_length, half_width = tl.load(at + 3, mask=there, other=0.0), tl.load(at + 4, mask=there, other=0.0)
    box_c, box_s = tl.cos(yaw), tl.sin(yaw)
    least, circle, box = x * 0.0 + 1e9, 0, 0
    for k in tl.static_range(circles):
        front = tl.load(ahead + k)
        dx, dy = x + front * c - box_x, y + front * s - box_y
        beyond_u, _ = _beyond(box_c * dx + box_s * dy, half_length)
        beyond_v, _ = _beyond(box_c * dy - box_s * dx, half_width)
        out_u, out_v = tl.maximum(beyond_u, 0.0), tl.maximum(beyond_v, 0.0)
        inside = tl.maximum(beyond_u, beyond_v)
        away = tl.where(inside > 0, tl.sqrt(out_u * out_u + out_v * out_v + 1e-18), inside)
        away = tl.where(there, away, 1e9)
        nearest = tl.min(away, 0)
        nearer = nearest < least
        box = tl.where(nearer, tl.argmin(away, 0), box)
        circle = tl.where(nearer, k, circle)
        least = tl.where(nearer, nearest, least)
    return circle, box


@triton.jit
@no_type_check
def _hold(
    states,
    boxes,
    ahead,
    after,
    slopes,
    many,
    circles: tl.constexpr,
    lanes: tl.constexpr,
    radius: tl.constexpr,
    gyration: tl.constexpr,
    slowed: tl.constexpr,
    dt_s: tl.constexpr,
    pushes: tl.constexpr,
):
    r = tl.program_id(0)
    state = states + r * 6
    x, y, yaw, speed = tl.load(state), tl.load(state + 1), tl.load(state + 2), tl.load(state + 3)
    on_x, on_y, on_yaw, on_speed = _unit(0), _unit(1), _unit(2), _unit(3)
    pushed = x * 0.0
    for _ in range(pushes):
        c, s = tl.cos(yaw), tl.sin(yaw)
        circle, nearest = _deepest(x, y, c, s, boxes, ahead, many, circles, lanes)
        front, box = tl.load(ahead + circle), boxes + nearest * 5
        box_yaw = tl.load(box + 2)
        box_c, box_s = tl.cos(box_yaw), tl.sin(box_yaw)
        # The circle's middle in the box's axes.
        dx, dy = x + front * c - tl.load(box), y + front * s - tl.load(box + 1)
        on_dx, on_dy = on_x - front * s * on_yaw, on_y + front * c * on_yaw
        beyond_u, sign_u = _beyond(box_c * dx + box_s * dy, tl.load(box + 3))
        beyond_v, sign_v = _beyond(box_c * dy - box_s * dx, tl.load(box + 4))
        on_u, on_v = sign_u * (box_c * on_dx + box_s * on_dy), sign_v * (box_c * on_dy - box_s * on_dx)
        # How far it is from the box, and the normal there.
        outside = tl.maximum(beyond_u, beyond_v) > 0
        out_u, out_v = tl.maximum(beyond_u, 0.0), tl.maximum(beyond_v, 0.0)
        on_out_u, on_out_v = tl.where(beyond_u > 0, on_u, on_u * 0.0), tl.where(beyond_v > 0, on_v, on_v * 0.0)
        far = tl.sqrt(out_u * out_u + out_v * out_v + 1e-18)
        on_far = (out_u * on_out_u + out_v * on_out_v) / far
        along = beyond_u >= beyond_v
        away = tl.where(outside, far, tl.maximum(beyond_u, beyond_v))
        on_away = tl.where(outside, on_far, tl.where(along, on_u, on_v))
        n_u = sign_u * tl.where(outside, out_u / far, tl.where(along, 1.0, 0.0).to(tl.float64))
        n_v = sign_v * tl.where(outside, out_v / far, tl.where(along, 0.0, 1.0).to(tl.float64))
        on_n_u = sign_u * tl.where(outside, (on_out_u - out_u / far * on_far) / far, on_u * 0.0)
        on_n_v = sign_v * tl.where(outside, (on_out_v - out_v / far * on_far) / far, on_v * 0.0)
        n_x, n_y = box_c * n_u - box_s * n_v, box_s * n_u + box_c * n_v
        on_n_x, on_n_y = box_c * on_n_u - box_s * on_n_v, box_s * on_n_u + box_c * on_n_v
        # The push.
        depth = radius - away
        lever = front * (c * n_y - s * n_x)
        on_lever = front * (c * on_n_y - s * on_n_x - (s * n_y + c * n_x) * on_yaw)
        weight = 1.0 + lever * lever / (gyration * gyration)
        touches = depth > 0
        push = tl.where(touches, depth / weight, 0.0)
        on_push = (-on_away - push * 2.0 * lever / (gyration * gyration) * on_lever) / weight
        on_push = tl.where(touches, on_push, on_push * 0.0)
        x, on_x = x + push * n_x, on_x + on_push * n_x + push * on_n_x
        y, on_y = y + push * n_y, on_y + on_push * n_y + push * on_n_y
        yaw += push * lever / (gyration * gyration)
        on_yaw += (on_push * lever + push * on_lever) / (gyration * gyration)
        pushed += push
    went_x, went_y = x - tl.load(state + 4), y - tl.load(state + 5)
    went = tl.sqrt(went_x * went_x + went_y * went_y + 1e-18)
    on_went = (went_x * (on_x - _unit(4)) + went_y * (on_y - _unit(5))) / went / dt_s
    slower = went / dt_s < speed
    left = tl.where(slower, went / dt_s, speed) - slowed
    on_left = tl.where(left > 0, tl.where(slower, on_went, on_speed), on_speed * 0.0)
    speed = tl.where(pushed > 0, tl.maximum(left, 0.0), speed)
    on_speed = tl.where(pushed > 0, on_left, on_speed)
    there, lane = after + r * 4, slopes + r * 32 + tl.arange(0, 8)
    tl.store(there, x)
    tl.store(there + 1, y)
    tl.store(there + 2, yaw)
    tl.store(there + 3, speed)
    tl.store(lane, on_x)
    tl.store(lane + 8, on_y)
    tl.store(lane + 16, on_yaw)
    tl.store(lane + 24, on_speed)
