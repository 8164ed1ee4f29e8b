"""GradOpt: the pattern with the largest value, by gradient through compositor and controller.

All starts of all groups are one batch and take one step together; each keeps its own best point.

A search is a ladder of rungs. Where a start ends depends on where it began far more than on how long it climbs, and
after some 20 steps on every fourth frame their order is much that of the end. So many starts climb the first rungs on
few frames, and the best of them alone go on (successive halving). What makes two of them good are often different
figures, so offspring with figures of both compete for the places too. The last rungs have the starts and frames of the
whole search, and smaller and smaller steps; each begins at the best points so far with a fresh optimiser, as in the
paper. A group that is far behind by then gives its places to the others: some controllers give way to one side only.
Where none has found anything by then, the first rungs are climbed a second time from other points.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Required, TypedDict, Unpack, cast

import torch
from jaxtyping import Float, Int64
from torch import Tensor

from roadproof.attacks.batched import BatchedMeasure
from roadproof.attacks.captured import Replay, replay_of, steps_in_words
from roadproof.attacks.checkpoint import Checkpoint
from roadproof.attacks.groups import Points, Values
from roadproof.attacks.objective import Objective, RecordedMeasure
from roadproof.attacks.side_by_side import Beside, Sides
from roadproof.attacks.step import State, begun, corrected, require_finite_step, state_at, stepped
from roadproof.attacks.surrogate import FIXED
from roadproof.compositing.view import compiles_kernels
from roadproof.controllers.precision import for_climbing
from roadproof.errors import RoadproofError
from roadproof.processes import Pool
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
        groups_compete: whether a group whose best is below `BEHIND` of the best of all gives its starts to the others
            before this rung, unless the measure is a user's own.
        screened: how many of the random starts of every group are the best of `DRAWN` that are valued first.
        offspring: how many children of the rung before's best points compete with these for the places of this one.
        needs: value that the best start must have reached before this rung, unless the measure is a user's own. Where
            none has, the rungs before are climbed once more from other points, and the best of both go on. In none of
            these may groups compete.

    Raises:
        RoadproofError: `starts`, `iterations`, `learning_rate` or `every` is not positive.
    """

    starts: int
    iterations: int
    learning_rate: float = 0.1
    every: int = 1
    open_loop: bool = False
    groups_compete: bool = False
    screened: int = 0
    offspring: int = 0
    needs: float = -math.inf

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

BEHIND = 1 / 3
"""Where groups compete, one that has reached less than this share of the best group's value gives its places away."""


DRAWN = 256
"""Random points of which a rung that screens keeps the best."""

PARENTS, MUTATION = 12, 0.02
"""Best points of a group that have offspring, and how far these are moved: the spread of every share of a range."""


def dropping(
    starts: int,
    iterations: int,
    learning_rate: float,
    *,
    after: tuple[float, float],
    factor: float,
) -> Ladder:
    """Rungs whose learning rate falls by a factor twice, after the given shares of the iterations."""
    once, twice = (max(1, int(iterations * share + 1e-9)) for share in after)
    parts = (once, twice - once, iterations - twice)
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
        gave_way: best value of each group that gave its places to the others, by its number; the G groups above are
            the rest, in their order.
        steps: how steps were run on a GPU, in words; empty on a CPU.
        beside: the measure of the G groups, side by side where they were searched so; None has nobody ready.
    """

    best_unit: Points
    best: Values
    history: Float[Tensor, "i _ c"]
    gave_way: dict[int, float] = field(default_factory=dict[int, float])
    steps: str = ""
    beside: Beside | RecordedMeasure | None = None


class Running(TypedDict, total=False):
    """How a search is run, whatever its method.

    Args:
        seed: seed of everything random; required.
        starts: points to begin at, one tensor (S, K, N) per group; random points fill the remaining starts.
        checkpoint: file that keeps the search after every step and from which the same search goes on; None for none.
            One of its name with ".again" before the ending lies beside it while a search is begun once more.
        objective: what is made large; its name stands in the checkpoint, where a search for another is refused.
        on_step: called after every step with its number and the best value so far; the number stays while a search is
            begun once more. On a GPU some steps are taken together (`captured.LOOK_S`); then the file is written, and
            this called, after the last of them.
        pool: processes in which groups are valued side by side; None has threads do it.
    """

    seed: Required[int]
    starts: Sequence[Float[Tensor, "_ k n"]]
    checkpoint: Path | None
    objective: Objective
    on_step: Callable[[int, float], object]
    pool: Pool[Any] | None


def aim_of(running: Running) -> str:
    """The name of the objective that a search is for; empty where nobody said."""
    return running["objective"].name if "objective" in running else ""


def gradopt(
    measure: RecordedMeasure,
    space: SearchSpace,
    rungs: Ladder,
    *,
    momentum: float = 0.9,
    all_digits: bool = False,
    **running: Unpack[Running],
) -> Search:
    """Make a measure large over a search space.

    Args:
        measure: the measure that is made large, for all groups.
        space: the search space.
        rungs: the rungs of the search in order, each with its starts, iterations and learning rate.
        momentum: Adam's β₁; 0.9 is Adam's own, the released code has 0.
        all_digits: whether the controller itself is climbed with. Otherwise it is `precision.for_climbing`, which has
            fewer digits where that is faster; the values returned are the controller's own either way.
        **running: seed, starts, checkpoint and callback; see `Running`.

    Raises:
        RoadproofError: the controller answers NaN to a composited frame, or the checkpoint is of another objective.

    References:
        Eqs. tloss and composite; "Computing Adversarial Perturbations" of the paper.
    """
    climbing = measure if all_digits else _for_climbing(measure)
    views = tuple(rung.view(climbing) for rung in rungs)
    for view in views:
        if view is not measure:
            # What it took to make it; from now on each counts what a rung takes.
            measure.frames_evaluated += view.frames_evaluated
            view.frames_evaluated = 0
    climb = _Climb(measure, climbing, views, Sides((*views, measure), running.get("pool")), space, momentum, Counter())
    state, behind = _climbed(climb, rungs, **running)
    best, last = state["best"], _of_groups(measure, behind)
    beside = climb.sides.of(len(rungs), last)
    if isinstance(last, BatchedMeasure) and (last.variation is not None or climbing is not measure):
        # Every step had looks of its own, or fewer digits; results are compared in the same ones.
        last.redraw(FIXED)
        best = beside.values(space, state["best_unit"])
    gave_way = {k: value for k, value in enumerate(cast("list[float]", behind.tolist())) if not math.isnan(value)}
    kernels = measure.device.type == "cpu" or compiles_kernels(measure.device)
    steps = steps_in_words(climb.run, kernels=kernels)
    return Search(state["best_unit"], best, state["history"].cpu(), gave_way, steps, beside)


@dataclass(frozen=True, slots=True, eq=False)
class _Climb:
    """What is climbed: the measure, the same of the network to climb with, and its view from each rung.

    `run` counts how steps were run.
    """

    measure: RecordedMeasure
    climbing: RecordedMeasure
    views: tuple[RecordedMeasure, ...]
    sides: Sides
    space: SearchSpace
    momentum: float
    run: Counter[str | None]


def _climbed(climb: _Climb, rungs: Ladder, **running: Unpack[Running]) -> tuple[State, Float[Tensor, " g"]]:
    """The state after these rungs, and the best value of each group that has given way by then, else NaN."""
    measure, climbing, space, momentum = climb.measure, climb.climbing, climb.space, climb.momentum
    seed, starts = running["seed"], running.get("starts", ())
    on_step = running.get("on_step", lambda _iteration, _best: None)
    given = [cast("list[object]", points.tolist()) for points in starts]
    identity = repr((space, rungs, momentum, seed, given, measure.fingerprint()))
    # Values of few digits are no other's.
    identity += "" if climbing is measure else " in few digits"
    checkpoint = Checkpoint(running.get("checkpoint"), identity, aim_of(running))
    state = checkpoint.load(measure.device)
    at, behind = 0, torch.full((len(measure.groups),), torch.nan)
    again = checkpoint.path and checkpoint.path.with_suffix(f".again{checkpoint.path.suffix}")
    if state is None:
        if again is not None:
            again.unlink(missing_ok=True)
        state = state_at(_starts(measure, space, rungs[0].starts, seed, starts))
    else:
        at, behind = int(state.pop("rung")), state.pop("behind").cpu()
        # What it took to make the measures is among them.
        measure.frames_evaluated = int(state.pop("frames"))
    for number in range(at, len(rungs)):
        rung, done = rungs[number], sum(before.iterations for before in rungs[:number])
        looks_back = number > at and isinstance(measure, BatchedMeasure)
        goes_on = number > at and rung.goes_on(rungs[number - 1])
        if looks_back and (best := float(state["best"].max())) < rung.needs:
            _as_at_first(climb.views[:number])
            apart: Running = {"seed": derived_seed(seed, 3 * 10**6), "starts": (), "checkpoint": again}
            apart["on_step"] = _standing_at(done, best, on_step)
            other, _ = _climbed(climb, rungs[:number], **{**running, **apart})
            state |= {name: torch.cat([state[name], other[name]], 1) for name in ("best_unit", "best")}
            goes_on = False
        if looks_back and rung.groups_compete:
            state, behind = _without_those_behind(state, behind)
        climbed = _of_groups(climb.views[number], behind)
        beside = climb.sides.of(number, climbed)
        if number > at:
            if rung.offspring:
                state = _with_offspring(beside, space, state, rung.offspring, derived_seed(seed, 2 * 10**6 + number))
            places = rung.starts * len(measure.groups) // len(state["best"])
            state = _next_rung(state, space, places, derived_seed(seed, number), goes_on=goes_on)
        free = rung.starts - (0 if number else max(map(len, starts), default=0))
        if min(rung.screened, free) > 0 and not int(state["done"]):
            # Far from the numbers of other draws.
            own = derived_seed(seed, 10**6 + number)
            state["unit"] = _screened(beside, space, state["unit"], min(rung.screened, free), own)
        adam = {"learning_rate": rung.learning_rate, "momentum": momentum}
        replay = replay_of(climbed, space, iterations=rung.iterations, state=state, **adam)
        climb.run["" if isinstance(replay, Replay) else replay] += rung.iterations - int(state["done"])
        while int(state["done"]) < rung.iterations:
            if isinstance(climbed, BatchedMeasure):
                climbed.redraw(derived_seed(seed, 1 + done + int(state["done"])))
            state = replay.go_on() if isinstance(replay, Replay) else _step(beside, space, state, **adam)
            on_step(done + int(state["done"]), float(state["best"].max()))
            frames = measure.frames_evaluated + (0 if climbed is measure else climbed.frames_evaluated)
            told = {"rung": torch.tensor(number), "frames": torch.tensor(frames), "behind": behind}
            checkpoint.save(state | told)
        # The memory of a graph is free before the next is recorded.
        del replay
        if climbed is not measure:
            measure.frames_evaluated += climbed.frames_evaluated
            climbed.frames_evaluated = 0
    if again is not None:
        again.unlink(missing_ok=True)
    return state, behind


def _as_at_first(views: Sequence[RecordedMeasure]) -> None:
    """Give measures the looks that they had before steps drew others: in these alone points are compared."""
    for view in views:
        if isinstance(view, BatchedMeasure):
            # Not part of a search's cost: one that is resumed has them already.
            counted = view.frames_evaluated
            view.redraw(FIXED)
            view.frames_evaluated = counted


def _standing_at(number: int, best: float, on_step: Callable[[int, float], object]) -> Callable[[int, float], object]:
    """What is told of steps that are taken once more: they count no further."""
    return lambda _, value: on_step(number, max(best, value))


def _starts(
    measure: RecordedMeasure, space: SearchSpace, count: int, seed: int, given: Sequence[Float[Tensor, "_ k n"]]
) -> Points:
    """Random points of every group, of which the first are replaced by the points given."""
    unit = space.random((len(measure.groups), count), torch.Generator().manual_seed(seed))
    for group, points in enumerate(given):
        unit[group, : len(points)] = points[:count]
    return unit.to(measure.device)


def _screened(measure: RecordedMeasure | Beside, space: SearchSpace, unit: Points, count: int, seed: int) -> Points:
    """The starts, the last of which are the best of many random points by a measure."""
    drawn = space.random((len(unit), DRAWN), torch.Generator().manual_seed(seed)).to(unit)
    kept = _at(drawn, measure.values(space, drawn).topk(count, 1).indices)
    return torch.cat([unit[:, :-count], kept], 1)


def _at(unit: Points, index: Int64[Tensor, "g i"]) -> Float[Tensor, "g i k n"]:
    """Of every group's points those with the given numbers."""
    return unit[torch.arange(len(unit), device=index.device)[:, None], index]


def _for_climbing(measure: RecordedMeasure) -> RecordedMeasure:
    """The measure of the network to climb with, which may be the measure itself."""
    if not isinstance(measure, BatchedMeasure) or measure.is_derived:
        return measure
    network = for_climbing(measure.controller, measure.device)
    return measure if network is measure.controller else measure.of_controller(network)


def _of_groups(measure: RecordedMeasure, behind: Float[Tensor, " g"]) -> RecordedMeasure:
    """The measure of the groups that have not given way."""
    kept = cast("list[int]", behind.isnan().nonzero()[:, 0].tolist())
    if len(kept) < len(behind) and isinstance(measure, BatchedMeasure):
        return measure.of_groups(kept)
    return measure


def _without_those_behind(state: State, behind: Float[Tensor, " g"]) -> tuple[State, Float[Tensor, " g"]]:
    """The state without groups that are far behind, and the best value of each group that has given way, else NaN."""
    best = state["best"].amax(1)
    ahead = best >= BEHIND * best.max()
    if bool(ahead.any()) and not bool(ahead.all()):
        behind = behind.clone()
        behind[behind.isnan()] = torch.where(ahead, torch.nan, best).cpu()
        state = state | {name: state[name][ahead] for name in ("unit", "best_unit", "best")}
    return state, behind


def _with_offspring(
    measure: RecordedMeasure | Beside, space: SearchSpace, state: State, count: int, seed: int
) -> State:
    """The best points of every group and their offspring, each with every figure of one of two parents, a little moved.

    All are valued by the measure of the rung to come.
    """
    generator = torch.Generator().manual_seed(seed)
    groups, points = state["best"].shape
    best = _at(state["best_unit"], state["best"].topk(min(PARENTS, points), 1).indices)
    mother, father = torch.randint(best.shape[1], (2, groups, count), generator=generator).to(best.device)
    from_mother = torch.rand(groups, count, space.figures, 1, generator=generator).to(best) < 0.5
    moved = MUTATION * torch.randn(groups, count, *best.shape[2:], generator=generator).to(best)
    children = space.project(torch.where(from_mother, _at(best, mother), _at(best, father)) + moved)
    unit = torch.cat([best, children], 1)
    return {"best_unit": unit, "best": measure.values(space, unit)}


def _next_rung(state: State, space: SearchSpace, places: int, seed: int, *, goes_on: bool) -> State:
    """State of the next rung, begun at the best points of every group; random points fill the remaining places."""
    if goes_on:
        return {name: state[name] for name in ("best_unit", "best", "history")} | begun(state["best_unit"])
    unit = _at(state["best_unit"], state["best"].topk(min(places, state["best"].shape[1]), 1).indices)
    drawn = space.random((len(unit), places - unit.shape[1]), torch.Generator().manual_seed(seed))
    return state_at(torch.cat([unit, drawn.to(unit)], 1))


def _step(
    measure: RecordedMeasure | Beside, space: SearchSpace, state: State, *, learning_rate: float, momentum: float
) -> State:
    """A step, one operation at a time."""
    rate, root = corrected(learning_rate, momentum, 1 + int(state["done"]))
    changed, value, finite = stepped(measure, space, momentum, rate, root, state)
    require_finite_step(finite)
    return changed | {"history": torch.cat([state["history"], value[None]]), "done": state["done"] + 1}
