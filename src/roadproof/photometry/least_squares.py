"""Small nonlinear least squares in double precision: Levenberg and Marquardt's method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, cast, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.errors import ColourError

_ITERATIONS = 100
_DONE = 1e-8


@runtime_checkable
class Problem(Protocol):
    """N residuals of P parameters."""

    def residuals(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, " n"]:
        """The residuals, which should be small."""
        ...

    def jacobian(self, parameters: Float[Tensor, " p"]) -> Float[Tensor, "n p"]:
        """∂residuals/∂parameters."""
        ...


def least_squares(problem: Problem, starts: Sequence[Float[Tensor, " p"]]) -> Float[Tensor, " p"]:
    """The parameters with the least sum of squares found from several starts.

    Raises:
        ColourError: no start leads to finite residuals.
    """
    best, loss = min((_descend(problem, start) for start in starts), key=lambda end: end[1])
    if not loss < float("inf"):
        raise ColourError("the colour fit does not converge; check that painted and seen colours belong together")
    return best


def _descend(problem: Problem, parameters: Tensor) -> tuple[Tensor, float]:
    value = problem.residuals(parameters)
    loss, damping = _loss(value), 1e-2
    for _ in range(_ITERATIONS):
        jacobian = problem.jacobian(parameters)
        normal, slope = jacobian.mT @ jacobian, jacobian.mT @ value
        scale = torch.diag(normal.diagonal() + 1e-9)
        before = loss
        while damping < 1e9:
            moved = parameters - cast("Tensor", torch.linalg.solve(normal + damping * scale, slope))
            moved_value = problem.residuals(moved)
            if _loss(moved_value) < loss:
                parameters, value, loss = moved, moved_value, _loss(moved_value)
                damping /= 8
                break
            damping *= 4
        if before - loss <= _DONE * before:
            break
    return parameters, loss


def _loss(value: Tensor) -> float:
    total = float(value @ value)
    return total if total == total else float("inf")
