"""GradOpt: the pattern with the largest value, by gradient through compositor and controller.

All restarts of all groups are one batch and take one step together; each keeps its own best point, and each drop of
the learning rate starts again from there with a fresh optimiser, as in the paper.

Where a start ends depends on where it began far more than on how long it climbs, and after some 20 steps on every
fourth frame their order is much that of the end. So by default many starts run in heats on few frames, and the best
of them alone go on to all frames.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.checkpoint import load_checkpoint, save_checkpoint
from roadproof.attacks.objective import Measure
from roadproof.errors import RoadproofError
from roadproof.search_space import SearchSpace, derived_seed


@dataclass(frozen=True, slots=True)
class Heat:
    """A round before the search proper, of which the best starts go on.

    Args:
        starts: of every group: the best of the round before, and random ones where those are fewer.
        iterations: steps of each.
        every: the share of the frames used: every n-th of each drive; in the recorded world, of the steps.
        learning_rate: of these steps.
        open_loop: climb the steering shift on recorded frames, whatever the search makes large.
    """

    starts: int
    iterations: int
    every: int
    learning_rate: float = 0.1
    open_loop: bool = False

    def __post_init__(self) -> None:
        if min(self.starts, self.iterations, self.every) < 1:
            raise RoadproofError(f"{self} has a number below 1")

    def cheaper(self, measure: Measure) -> Measure:
        """What it climbs instead of a measure."""
        return (measure.open_loop() if self.open_loop else measure).thinned(self.every)

    def steps(self, schedule: Schedule) -> Schedule:
        """Its own steps, before those of a schedule."""
        own = {"iterations": self.iterations, "learning_rate": self.learning_rate}
        return replace(schedule, **own, drops=(), patience=None, heats=())


@dataclass(frozen=True, kw_only=True, slots=True)
class Schedule:
    """How many steps, and how large; by default the paper's.

    Args:
        iterations: steps of each restart.
        learning_rate: of Adam, in units of each parameter's range.
        drops: iterations at which the rate is multiplied by `factor` and every restart goes back to its best point.
        factor: see drops.
        momentum: Adam's β₁; 0.9 is Adam's own, the released code has 0.
        patience: where given, stop once no restart has gained 0.1 % over this many iterations after the last drop.
        heats: rounds that choose the restarts; none in the paper, whose restarts are random.

    References:
        The paper, "Attack Optimization": 4 × 250, 0.1, dropped by 0.1 after 100 and 200 iterations.
    """

    iterations: int = 250
    learning_rate: float = 0.1
    drops: tuple[int, ...] = (100, 200)
    factor: float = 0.1
    momentum: float = 0.9
    patience: int | None = None
    heats: tuple[Heat, ...] = ()

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise RoadproofError(f"iterations is {self.iterations}, expected 1 or more")
        if not self.learning_rate > 0:
            raise RoadproofError(f"learning rate is {self.learning_rate}, expected a value above 0")

    @staticmethod
    def stretched(iterations: int = 250, *, patience: int | None = None) -> Schedule:
        """The paper's schedule with another number of iterations: drops after 40 % and 80 % of them."""
        drops = (iterations * 2 // 5, iterations * 4 // 5)
        return Schedule(iterations=iterations, drops=drops, patience=patience)

    @staticmethod
    def in_heats(iterations: int = 100, *, patience: int | None = None) -> Schedule:
        """What finds most for its cost (measured): heats on few frames, then a short search on all of them."""
        return Schedule(
            iterations=iterations,
            drops=(iterations // 2, iterations * 4 // 5),
            factor=0.3,
            patience=patience,
            heats=(Heat(starts=24, iterations=30, every=4), Heat(starts=8, iterations=30, every=2)),
        )

    @staticmethod
    def closed_loop(iterations: int = 32) -> Schedule:
        """For a search where the car goes: heats with few pictures, then smaller steps with more: a loop amplifies.

        It begins where the steering shift is large. A controller that holds its lane well brings the car back from
        what a random pattern does, and the path has hardly a gradient there; what also turns the wheel where a car is
        aside already takes it further (measured). Random patterns join them, for controllers that need no such help.
        """
        return Schedule(
            iterations=iterations,
            learning_rate=0.05,
            drops=(iterations // 2, iterations * 4 // 5),
            factor=0.3,
            heats=(
                Heat(starts=16, iterations=12, every=8, open_loop=True),
                Heat(starts=24, iterations=4, every=6),
                Heat(starts=6, iterations=10, every=4),
            ),
        )

    @property
    def steps(self) -> int:
        """Iterations with those of the heats."""
        return self.iterations + sum(heat.iterations for heat in self.heats)

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
    measure: Measure,
    space: SearchSpace,
    *,
    schedule: Schedule,
    restarts: int,
    seed: int,
    starts: Sequence[Float[Tensor, "s k n"]] = (),
    checkpoint: Path | None = None,
    on_step: Callable[[int, float], object] = lambda _iteration, _best: None,
) -> Search:
    """Minimise −δ over a search space.

    Args:
        measure: what is driven up, for all groups.
        space: where to look.
        schedule: steps and rates.
        restarts: of every group.
        seed: of the random starts.
        starts: points to begin at, for each group in turn; random ones make up what they lack.
        checkpoint: a file that keeps the search after every step, those of the heats included; where it is there
            already and belongs to the same search, that search goes on, to the same result.
        on_step: called after every step with its number and the best δ per frame so far.

    Raises:
        RoadproofError: a number makes no sense, or the controller answers NaN to a composited frame.

    References:
        Eqs. tloss and composite; "Computing Adversarial Perturbations" of the paper.
    """
    if restarts < 1:
        raise RoadproofError(f"restarts is {restarts}, expected 1 or more")
    rungs = _rungs(schedule, restarts)
    given = [cast("list[object]", points.tolist()) for points in starts]
    identity = repr((space, schedule, restarts, seed, given, measure.fingerprint()))
    state = load_checkpoint(checkpoint, identity, measure.device) if checkpoint else None
    if state is None:
        rung, state = 0, _state_at(_starts(measure, space, rungs[0].starts, seed, starts))
    else:
        rung = int(state.pop("rung"))
        measure.frames_evaluated += int(state.pop("frames"))
    for number in range(rung, len(rungs)):
        steps, heat = rungs[number].steps, rungs[number].heat
        shown = measure if heat is None else heat.cheaper(measure)
        done = sum(before.steps.iterations for before in rungs[:number])
        if number > rung:
            state = _state_at(_gone_on(state, space, rungs[number].starts, seed, number))
        while len(state["history"]) < steps.iterations and not _stalled(state["history"], steps):
            state = _step(shown, space, steps, state)
            on_step(done + len(state["history"]), float(state["best"].max()))
            if checkpoint:
                frames = measure.frames_evaluated + (0 if heat is None else shown.frames_evaluated)
                whole = state | {"rung": torch.tensor(number), "frames": torch.tensor(frames)}
                save_checkpoint(checkpoint, identity, whole)
        if heat is not None:
            measure.frames_evaluated += shown.frames_evaluated
    stopped = "all iterations done"
    if len(state["history"]) < schedule.iterations:
        stopped = f"no restart gained 0.1 % in the last {schedule.patience} iterations"
    return Search(state["best_unit"], state["best"], state["history"].cpu(), stopped)


@dataclass(frozen=True, slots=True)
class _Rung:
    """A heat, or the search proper without one: so many starts of every group."""

    starts: int
    steps: Schedule
    heat: Heat | None = None


def _rungs(schedule: Schedule, restarts: int) -> list[_Rung]:
    if schedule.heats and schedule.heats[-1].starts < restarts:
        places = [heat.starts for heat in schedule.heats]
        raise RoadproofError(f"heats of {places} starts leave fewer than {restarts} restarts; ask for fewer")
    return [*(_Rung(heat.starts, heat.steps(schedule), heat) for heat in schedule.heats), _Rung(restarts, schedule)]


def _starts(
    measure: Measure,
    space: SearchSpace,
    count: int,
    seed: int,
    given: Sequence[Float[Tensor, "s k n"]],
) -> Float[Tensor, "g r k n"]:
    """Random points, the first of them replaced by those given."""
    unit = space.random((len(measure.groups), count), torch.Generator().manual_seed(seed))
    for group, points in enumerate(given):
        unit[group, : len(points)] = points[:count]
    return unit.to(measure.device)


def _gone_on(
    state: dict[str, Tensor], space: SearchSpace, count: int, seed: int, number: int
) -> Float[Tensor, "g r k n"]:
    """Where the best of every group are; random points make up what they lack."""
    best = state["best"].topk(min(count, state["best"].shape[1]), 1).indices
    kept = state["best_unit"][torch.arange(len(best), device=best.device)[:, None], best]
    fresh = torch.Generator().manual_seed(derived_seed(seed, number))
    drawn = space.random((len(kept), count - kept.shape[1]), fresh)
    return torch.cat([kept, drawn.to(kept)], 1)


def _state_at(unit: Float[Tensor, "g r k n"]) -> dict[str, Tensor]:
    best = torch.full(unit.shape[:2], -torch.inf, device=unit.device)
    return {"unit": unit, "best_unit": unit.clone(), "best": best, "history": best.new_empty(0, *best.shape)}


def _step(measure: Measure, space: SearchSpace, schedule: Schedule, state: dict[str, Tensor]) -> dict[str, Tensor]:
    iteration = len(state["history"])
    fresh = iteration == 0 or iteration in schedule.drops
    unit = state["best_unit"] if iteration in schedule.drops else state["unit"]
    first_stage = iteration < min(schedule.drops, default=schedule.iterations)
    value, gradient = measure.values_and_gradients(space, unit, coarse=first_stage)
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
    measure: Measure, space: SearchSpace, *, patterns: int, seed: int
) -> tuple[Float[Tensor, "g k n"], Float[Tensor, " g"]]:
    """The best of a number of random patterns for every group: the least an attack has to beat."""
    unit = space.random((1, patterns), torch.Generator().manual_seed(seed)).to(measure.device)
    unit = unit.expand(len(measure.groups), -1, -1, -1)
    best, index = measure.values(space, unit).max(1)
    return unit[torch.arange(len(unit)), index], best
