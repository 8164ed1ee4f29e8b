"""One step of a search by gradient, from tensors to tensors: value and gradient, Adam, bounds, the best so far.

Nothing here asks the device for a number, so that the same operations run one by one or are replayed (`captured`).

    symbol        meaning                                                    shape
    unit          points of the search space                                 (g, r, k, n)
    g             gradient that Adam goes down: minus that of the value      (g, r, k, n)
    m, v          running means of g and g², `exp_avg` and `exp_avg_sq`      (g, r, k, n)
    rate, root    α / (1 − β₁ᵗ) and √(1 − β₂ᵗ) of step t, from 1             numbers, or (1,)
"""

from __future__ import annotations

import torch
from torch import Tensor

from roadproof.attacks.groups import Points
from roadproof.attacks.objective import RecordedMeasure
from roadproof.attacks.side_by_side import Beside
from roadproof.errors import RoadproofError
from roadproof.search_space import SearchSpace

State = dict[str, Tensor]
"""The tensors of a search by name."""

BETA_2, EPSILON = 0.999, 1e-8
"""Adam's own."""


def state_at(unit: Points) -> State:
    """The state of a search that begins at some points."""
    best = torch.full(unit.shape[:2], -torch.inf, device=unit.device)
    return {"best_unit": unit.clone(), "best": best, "history": best.new_empty(0, *best.shape)} | begun(unit)


def begun(unit: Points) -> State:
    """Points at which a fresh optimiser begins."""
    still = {"exp_avg": torch.zeros_like(unit), "exp_avg_sq": torch.zeros_like(unit)}
    return {"unit": unit, "done": torch.tensor(0), **still}


def corrected(learning_rate: float, momentum: float, number: int) -> tuple[float, float]:
    """Rate and root of a step, whose number counts from 1."""
    return learning_rate / (1 - momentum**number), (1 - BETA_2**number) ** 0.5


def stepped(
    measure: RecordedMeasure | Beside,
    space: SearchSpace,
    momentum: float,
    rate: float | Tensor,
    root: float | Tensor,
    state: State,
) -> tuple[State, Tensor, Tensor]:
    """A step: the tensors that it changes, the values before it, (g, r), and whether all was finite, ().

    Args:
        measure: the measure that is made large.
        space: the search space.
        momentum: Adam's β₁.
        rate: rate of this step, see `corrected`.
        root: root of this step.
        state: points, best points with their values, and Adam's running means.

    References:
        Kingma and Ba, "Adam", 2015; the operations and their order are those of `torch.optim.Adam`.
    """
    unit = state["unit"]
    value, gradient = measure.values_and_gradients(space, unit)
    # A user's own measure may have more digits.
    value, gradient = value.to(state["best"]), gradient.to(unit)
    finite = value.isfinite().all() & gradient.isfinite().all()
    better = value > state["best"]
    down = -gradient
    mean = state["exp_avg"].lerp(down, 1 - momentum)
    square = state["exp_avg_sq"].mul(BETA_2).addcmul_(down, down, value=1 - BETA_2)
    moved = unit - rate * mean / (square.sqrt() / root).add_(EPSILON)
    changed = {
        "unit": space.project(moved),
        "best_unit": torch.where(better[..., None, None], unit, state["best_unit"]),
        "best": torch.where(better, value, state["best"]),
        "exp_avg": mean,
        "exp_avg_sq": square,
    }
    return changed, value, finite


def require_finite_step(finite: Tensor) -> None:
    """Wait for the device, and refuse what came after values or gradients that are not finite.

    Raises:
        RoadproofError: a value or a gradient was NaN or infinite.
    """
    if not bool(finite):
        raise RoadproofError("the controller's answer or gradient is NaN on a painted frame; try --dtype float32")
