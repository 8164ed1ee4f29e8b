"""GradOpt: the pattern with the largest value, by gradient through compositor and controller.

All starts of all groups are one batch and take one step together; each keeps its own best point.

A search is a ladder of rungs. Where a start ends depends on where it began far more than on how long it climbs, and
after some 20 steps on every fourth frame their order is much that of the end. So many starts climb the first rungs on
few frames, and the best of them alone go on (successive halving). The last rungs have the starts and frames of the
whole search, and smaller and smaller steps; each begins at the best points so far with a fresh optimiser, as in the
paper.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Required, TypedDict, Unpack, cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.checkpoint import load_checkpoint, save_checkpoint
from roadproof.attacks.objective import Measure, RecordedMeasure, Varied
from roadproof.attacks.surrogate import FIXED
from roadproof.errors import RoadproofError
from roadproof.search_space import SearchSpace, derived_seed


@dataclass(frozen=True, slots=True)
class Rung:
    """A part of a search: steps of one size on the same frames, from a number of starts.

    Args:
        starts: number of starts of every group: the best of the rung before, and random points if those are fewer.
        iterations: number of steps of each start.
        learning_rate: Adam's learning rate, as a share of each parameter's range.
        every: use every n-th frame of each drive; in the recorded world, a picture every n-th step. 1 uses all.
        open_loop: whether to climb the steering shift on recorded frames, whatever the objective of the search.

    Raises:
        RoadproofError: `starts`, `iterations`, `learning_rate` or `every` is not positive.
    """

    starts: int
    iterations: int
    learning_rate: float = 0.1
    every: int = 1
    open_loop: bool = False

    def __post_init__(self) -> None:
        if min(self.starts, self.iterations, self.every) < 1 or not self.learning_rate > 0:
            raise RoadproofError(f"{self} has a number that is too small; expected 1 or more, and a rate above 0")

    def view(self, measure: RecordedMeasure) -> RecordedMeasure:
        """The measure that this rung climbs: thinned or open loop, or the measure itself if it uses all frames."""
        climbed = measure.open_loop() if self.open_loop else measure
        return climbed if self.every == 1 else climbed.thinned(self.every)

    def goes_on(self, before: Rung) -> bool:
        """Whether this rung takes smaller steps than another with the same starts on the same frames."""
        return (self.starts, self.every, self.open_loop) == (before.starts, before.every, before.open_loop)


Ladder = tuple[Rung, ...]


def dropping(
    starts: int, iterations: int, learning_rate: float, *, after: tuple[float, float], factor: float
) -> Ladder:
    """Rungs whose learning rate falls by a factor twice, after the given shares of the iterations."""
    first, second = (max(1, int(iterations * share + 1e-9)) for share in after)
    parts = (first, second - first, iterations - second)
    rates = (learning_rate * factor**k for k in range(3))
    return tuple(Rung(starts, each, rate) for each, rate in zip(parts, rates, strict=True) if each > 0)


@dataclass(frozen=True, slots=True, eq=False)
class Search:
    """The outcome of a search.

    Args:
        best_unit: best point of every group and start, in the unit cube, (G, R, K, N).
        best: value at each best point, (G, R).
        history: value at every iteration of the last rungs, those with all frames and the final number of starts, (i,
            g, c); without gradients the best value so far, (calls, 1, 1).
    """

    best_unit: Float[Tensor, "g r k n"]
    best: Float[Tensor, "g r"]
    history: Float[Tensor, "i g c"]


class Running(TypedDict, total=False):
    """How a search is run, whatever its method.

    Args:
        seed: seed of everything random; required.
        starts: points to begin at, one tensor (S, K, N) per group; random points fill the remaining starts.
        checkpoint: file that keeps the search after every step and from which the same search goes on; None for none.
        on_step: called after every step with its number and the best value so far.
    """

    seed: Required[int]
    starts: Sequence[Float[Tensor, "s k n"]]
    checkpoint: Path | None
    on_step: Callable[[int, float], object]


def gradopt(
    measure: RecordedMeasure, space: SearchSpace, rungs: Ladder, *, momentum: float = 0.9, **running: Unpack[Running]
) -> Search:
    """Make a measure large over a search space.

    Args:
        measure: the measure that is made large, for all groups.
        space: the search space.
        rungs: the rungs of the search in order, each with its starts, iterations and learning rate.
        momentum: Adam's β₁; 0.9 is Adam's own, the released code has 0.
        **running: seed, starts, checkpoint and callback; see `Running`.

    Raises:
        RoadproofError: the controller answers NaN to a composited frame.

    References:
        Eqs. tloss and composite; "Computing Adversarial Perturbations" of the paper.
    """
    seed, starts = running["seed"], running.get("starts", ())
    checkpoint, on_step = running.get("checkpoint"), running.get("on_step", lambda _iteration, _best: None)
    given = [cast("list[object]", points.tolist()) for points in starts]
    identity = repr((space, rungs, momentum, seed, given, measure.fingerprint()))
    state = load_checkpoint(checkpoint, identity, measure.device) if checkpoint else None
    at = 0
    if state is None:
        state = _state_at(_starts(measure, space, rungs[0].starts, seed, starts))
    else:
        at = int(state.pop("rung"))
        measure.frames_evaluated += int(state.pop("frames"))
    for number in range(at, len(rungs)):
        rung = rungs[number]
        if number > at:
            state = _next_rung(state, space, rungs[number - 1], rung, derived_seed(seed, number))
        climbed, done = rung.view(measure), sum(before.iterations for before in rungs[:number])
        while int(state["done"]) < rung.iterations:
            if isinstance(climbed, Varied):
                climbed.redraw(derived_seed(seed, 1 + done + int(state["done"])))
            state = _step(climbed, space, rung.learning_rate, momentum, state)
            on_step(done + int(state["done"]), float(state["best"].max()))
            if checkpoint:
                frames = measure.frames_evaluated + (0 if climbed is measure else climbed.frames_evaluated)
                whole = state | {"rung": torch.tensor(number), "frames": torch.tensor(frames)}
                save_checkpoint(checkpoint, identity, whole)
        if climbed is not measure:
            measure.frames_evaluated += climbed.frames_evaluated
    best = state["best"]
    if isinstance(measure, Varied) and measure.variation is not None:
        # Every step had looks of its own; results are compared in the same ones.
        measure.redraw(FIXED)
        best = measure.values(space, state["best_unit"])
    return Search(state["best_unit"], best, state["history"].cpu())


def _starts(
    measure: RecordedMeasure,
    space: SearchSpace,
    count: int,
    seed: int,
    given: Sequence[Float[Tensor, "s k n"]],
) -> Float[Tensor, "g r k n"]:
    """Random points of every group, of which the first are replaced by the points given."""
    unit = space.random((len(measure.groups), count), torch.Generator().manual_seed(seed))
    for group, points in enumerate(given):
        unit[group, : len(points)] = points[:count]
    return unit.to(measure.device)


def _state_at(unit: Float[Tensor, "g r k n"]) -> dict[str, Tensor]:
    best = torch.full(unit.shape[:2], -torch.inf, device=unit.device)
    history = best.new_empty(0, *best.shape)
    return {"unit": unit, "best_unit": unit.clone(), "best": best, "history": history, "done": torch.tensor(0)}


def _next_rung(state: dict[str, Tensor], space: SearchSpace, before: Rung, rung: Rung, seed: int) -> dict[str, Tensor]:
    """State of the next rung, begun at the best points of every group; random points fill the remaining starts."""
    if rung.goes_on(before):
        kept = ("best_unit", "best", "history")
        return {name: state[name] for name in kept} | {"unit": state["best_unit"], "done": torch.tensor(0)}
    best = state["best"].topk(min(rung.starts, before.starts), 1).indices
    unit = state["best_unit"][torch.arange(len(best), device=best.device)[:, None], best]
    drawn = space.random((len(unit), rung.starts - unit.shape[1]), torch.Generator().manual_seed(seed))
    return _state_at(torch.cat([unit, drawn.to(unit)], 1))


def _step(
    measure: RecordedMeasure, space: SearchSpace, learning_rate: float, momentum: float, state: dict[str, Tensor]
) -> dict[str, Tensor]:
    unit = state["unit"]
    value, gradient = measure.values_and_gradients(space, unit)
    if not bool(value.isfinite().all() and gradient.isfinite().all()):
        raise RoadproofError("the controller's answer or gradient is NaN on a painted frame; try --dtype float32")
    better = value > state["best"]
    leaf = torch.nn.Parameter(unit.clone())
    adam = torch.optim.Adam([leaf], lr=learning_rate, betas=(momentum, 0.999))
    if int(state["done"]):
        adam.state[leaf] = {name: state[name].clone() for name in ("step", "exp_avg", "exp_avg_sq")}
    leaf.grad = -gradient
    adam.step()
    return {
        "unit": space.project(leaf.detach()),
        "best_unit": torch.where(better[..., None, None], unit, state["best_unit"]),
        "best": torch.where(better, value, state["best"]),
        "history": torch.cat([state["history"], value[None]]),
        "done": state["done"] + 1,
        **{name: adam.state[leaf][name] for name in ("step", "exp_avg", "exp_avg_sq")},
    }


def random_search(
    measure: Measure, space: SearchSpace, *, patterns: int, seed: int
) -> tuple[Float[Tensor, "g k n"], Float[Tensor, " g"]]:
    """The best of a number of random patterns for every group: the least an attack has to beat."""
    unit = space.random((1, patterns), torch.Generator().manual_seed(seed)).to(measure.device)
    unit = unit.expand(len(measure.groups), -1, -1, -1)
    best, index = measure.values(space, unit).max(1)
    return unit[torch.arange(len(unit)), index], best
