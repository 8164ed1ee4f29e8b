"""GradOpt: the pattern that shifts steering most, by gradient through compositor and controller.

All restarts of all groups are one batch and take one step together; each keeps its own best point, and each drop of
the learning rate starts again from there with a fresh optimiser, as in the paper.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.checkpoint import load_checkpoint, save_checkpoint
from roadproof.attacks.surrogate import Surrogate
from roadproof.errors import RoadproofError
from roadproof.search_space import SearchSpace


@dataclass(frozen=True, kw_only=True, slots=True)
class Schedule:
    """How many steps, and how large.

    Args:
        iterations: steps of each restart.
        learning_rate: of Adam, in units of each parameter's range.
        drops: iterations at which the rate is multiplied by `factor` and every restart goes back to its best point.
        factor: see drops.
        momentum: Adam's β₁; 0.9 is Adam's own, the released code has 0.
        patience: where given, stop once no restart has gained 0.1 % over this many iterations after the last drop.

    References:
        The paper, "Attack Optimization": 4 × 250, 0.1, dropped by 0.1 after 100 and 200 iterations.
    """

    iterations: int = 250
    learning_rate: float = 0.1
    drops: tuple[int, ...] = (100, 200)
    factor: float = 0.1
    momentum: float = 0.9
    patience: int | None = None

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise RoadproofError(f"iterations is {self.iterations}, expected 1 or more")
        if not self.learning_rate > 0:
            raise RoadproofError(f"learning rate is {self.learning_rate}, expected a value above 0")

    @staticmethod
    def stretched(iterations: int, *, patience: int | None = None) -> Schedule:
        """The paper's schedule with another number of iterations: drops after 40 % and 80 % of them."""
        drops = (iterations * 2 // 5, iterations * 4 // 5)
        return Schedule(iterations=iterations, drops=drops, patience=patience)

    def rate(self, iteration: int) -> float:
        """Learning rate at an iteration."""
        return self.learning_rate * self.factor ** sum(iteration >= drop for drop in self.drops)


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """Where a search came to.

    Args:
        best_unit: the best point of every group and restart.
        best: its δ per frame.
        history: δ per frame at every iteration done.
        stopped: why it ended.
    """

    best_unit: Float[Tensor, "g r k n"]
    best: Float[Tensor, "g r"]
    history: Float[Tensor, "i g r"]
    stopped: str


def gradopt(
    surrogate: Surrogate,
    space: SearchSpace,
    *,
    schedule: Schedule,
    restarts: int,
    draws: int = 1,
    seed: int,
    checkpoint: Path | None = None,
    on_step: Callable[[int, float], None] = lambda _iteration, _best: None,
) -> Search:
    """Minimise −δ over a search space.

    Args:
        surrogate: what is driven up, for all groups.
        space: where to look.
        schedule: steps and rates.
        restarts: starts of every group.
        draws: random points drawn for each start, which is the best of them; 1, a random start, in the paper.
        seed: of the starts.
        checkpoint: a file that keeps the search after every step; where it is there already and belongs to the same
            search, that search goes on, to the same result.
        on_step: called after every step with its number and the best δ per frame so far.

    Raises:
        RoadproofError: a number makes no sense, or the controller answers NaN to a composited frame.

    References:
        Eqs. tloss and composite; "Computing Adversarial Perturbations" of the paper.
    """
    for name, value in (("restarts", restarts), ("draws", draws)):
        if value < 1:
            raise RoadproofError(f"{name} is {value}, expected 1 or more")
    identity = repr((space, schedule, restarts, draws, seed, surrogate.fingerprint()))
    state = load_checkpoint(checkpoint, identity, surrogate.device) if checkpoint else None
    if state is None:
        unit = _starts(surrogate, space, restarts, draws, seed)
        best = torch.full(unit.shape[:2], -torch.inf, device=unit.device)
        state = {"unit": unit, "best_unit": unit.clone(), "best": best, "history": best.new_empty(0, *best.shape)}
    stopped = "all iterations done"
    while len(state["history"]) < schedule.iterations:
        state = _step(surrogate, space, schedule, state)
        on_step(len(state["history"]), float(state["best"].max()))
        if checkpoint:
            save_checkpoint(checkpoint, identity, state)
        if _stalled(state["history"], schedule):
            stopped = f"no restart gained 0.1 % in the last {schedule.patience} iterations"
            break
    return Search(state["best_unit"], state["best"], state["history"].cpu(), stopped)


def _starts(surrogate: Surrogate, space: SearchSpace, restarts: int, draws: int, seed: int) -> Float[Tensor, "g r k n"]:
    generator = torch.Generator().manual_seed(seed)
    points = space.random((len(surrogate.groups), restarts * draws), generator).to(surrogate.device)
    if draws == 1:
        return points
    groups = len(points)
    best = surrogate.values(space, points).view(groups, restarts, draws).argmax(-1)
    drawn = points.view(groups, restarts, draws, *points.shape[2:])
    return drawn[torch.arange(groups)[:, None], torch.arange(restarts), best]


def _step(surrogate: Surrogate, space: SearchSpace, schedule: Schedule, state: dict[str, Tensor]) -> dict[str, Tensor]:
    iteration = len(state["history"])
    fresh = iteration == 0 or iteration in schedule.drops
    unit = state["best_unit"] if iteration in schedule.drops else state["unit"]
    first_stage = iteration < min(schedule.drops, default=schedule.iterations)
    value, gradient = surrogate.values_and_gradients(space, unit, coarse=first_stage)
    if not bool(value.isfinite().all() and gradient.isfinite().all()):
        raise RoadproofError(
            f"the controller's answer or gradient is NaN at iteration {iteration}; try --dtype float32, or check it"
        )
    better = value > state["best"]
    leaf = torch.nn.Parameter(unit.clone())
    adam = torch.optim.Adam([leaf], lr=schedule.rate(iteration), betas=(schedule.momentum, 0.999))
    if not fresh:
        adam.state[leaf] = {name: state[name].clone() for name in ("step", "exp_avg", "exp_avg_sq")}
    leaf.grad = -gradient
    adam.step()
    return {
        "unit": space.project(leaf.detach()),
        "best_unit": torch.where(better[..., None, None], unit, state["best_unit"]),
        "best": torch.where(better, value, state["best"]),
        "history": torch.cat([state["history"], value[None]]),
        **{name: adam.state[leaf][name] for name in ("step", "exp_avg", "exp_avg_sq")},
    }


def _stalled(history: Float[Tensor, "i g r"], schedule: Schedule) -> bool:
    last_stage = history[max(schedule.drops, default=0) :]
    if schedule.patience is None or len(last_stage) <= schedule.patience:
        return False
    before = history[: -schedule.patience].amax(0)
    return bool((history.amax(0) - before <= 1e-3 * before.abs()).all())


def random_search(
    surrogate: Surrogate, space: SearchSpace, *, patterns: int, seed: int
) -> tuple[Float[Tensor, "g k n"], Float[Tensor, " g"]]:
    """The best of a number of random patterns for every group: the least an attack has to beat."""
    unit = space.random((1, patterns), torch.Generator().manual_seed(seed)).to(surrogate.device)
    unit = unit.expand(len(surrogate.groups), -1, -1, -1)
    best, index = surrogate.values(space, unit).max(1)
    return unit[torch.arange(len(unit)), index], best
