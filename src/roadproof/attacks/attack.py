"""The verb: attack recorded drives."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, cast, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.checks import check_search
from roadproof.attacks.gradopt import Schedule, Search, gradopt
from roadproof.attacks.published import PublishedSurrogate
from roadproof.attacks.result import AttackResult, Candidate, Cost
from roadproof.attacks.surrogate import Surrogate
from roadproof.controllers import Controller
from roadproof.objectives import LEFT_GROUP, RIGHT_GROUP, Group
from roadproof.recordings import RecordingSet
from roadproof.search_space import SearchSpace

Gradient = Literal["exact", "published"]
GRADIENTS: tuple[Gradient, ...] = get_args(Gradient)


def attack(
    recordings: RecordingSet,
    controller: Controller,
    space: SearchSpace,
    *,
    groups: Sequence[Group] = (RIGHT_GROUP, LEFT_GROUP),
    schedule: Schedule | None = None,
    restarts: int = 4,
    seed: int = 0,
    device: torch.device | str = "cpu",
    gradient: Gradient = "exact",
    random_patterns: int = 0,
    starts: Sequence[Candidate] = (),
    checkpoint: Path | None = None,
    on_step: Callable[[int, float], object] = lambda _iteration, _best: None,
) -> AttackResult:
    """Find the pattern that shifts a controller's steering most on recorded drives.

    Args:
        recordings: the drives, with their view of the canvas and its colours.
        controller: on `device`.
        space: the patterns allowed.
        groups: drives attacked together; the paper's two sides by default, of which the stronger is kept.
        schedule: `Schedule.in_heats()` by default; `Schedule()` is the paper's.
        restarts: of every group.
        seed: of the random starts.
        device: where to search.
        gradient: "exact", or "published": the authors' binary compositing and local linearisation, to compare with.
        random_patterns: random patterns a group that the self-check compares with; 0 for none.
        starts: of an earlier search, to search on from: each for its own group, instead of as many random ones.
        checkpoint: file that keeps the search after every step; an interrupted one goes on from it.
        on_step: called after every step with its number and the best shift so far.

    Raises:
        ControllerError: the controller takes other frames, or answers NaN.
        RecordingError: a group names drives that the set lacks.
    """
    schedule = schedule or Schedule.in_heats()
    kind = PublishedSurrogate if gradient == "published" else Surrogate
    surrogate = kind(recordings, controller, groups, device=device)
    start = time.perf_counter()
    search = gradopt(
        surrogate,
        space,
        schedule=schedule,
        restarts=restarts,
        seed=seed,
        starts=[_points(space, starts, group) for group in groups],
        checkpoint=checkpoint,
        on_step=on_step,
    )
    cost = Cost(controller_frames=surrogate.frames_evaluated, seconds=time.perf_counter() - start)
    checks = check_search(surrogate, space, search, random_patterns=random_patterns, seed=seed)
    candidates = _candidates(search, space, groups)
    return AttackResult(
        pattern=candidates[0].pattern,
        group=candidates[0].group,
        surrogate_shift=candidates[0].surrogate_shift,
        by_group={str(group): float(best) for group, best in zip(groups, search.best.amax(1), strict=True)},
        candidates=candidates,
        history=search.history.double().numpy(),
        stopped=search.stopped,
        cost=cost,
        checks=checks,
        space=space,
        schedule=schedule,
        restarts=restarts,
        seed=seed,
    )


def kept_attack(folder: Path, search: Callable[[Path], AttackResult]) -> AttackResult:
    """A search that is done once: what it found is read from its folder where it is there already.

    Args:
        folder: of the result.
        search: does it; gets the checkpoint to go on from.

    Raises:
        RoadproofError: the result is damaged, or the search refuses.
        OutputError: the folder cannot be written.
    """
    checkpoint = folder / "search.safetensors"
    if not (folder / "result.json").exists():
        search(checkpoint).save(folder)
    checkpoint.unlink(missing_ok=True)
    return AttackResult.load(folder)


def _points(space: SearchSpace, starts: Sequence[Candidate], group: Group) -> Float[Tensor, "s k n"]:
    """Those of a group, as points."""
    points = [space.point(start.pattern) for start in starts if start.group == str(group)]
    return torch.stack(points) if points else torch.empty(0, space.figures, len(space.names))


def _candidates(search: Search, space: SearchSpace, groups: Sequence[Group]) -> tuple[Candidate, ...]:
    """Every start's best, the strongest first."""
    restarts = search.best.shape[1]
    order = cast("list[int]", search.best.flatten().argsort(descending=True).tolist())
    return tuple(
        Candidate(
            space.pattern(search.best_unit[index // restarts, index % restarts].cpu()),
            str(groups[index // restarts]),
            float(search.best[index // restarts, index % restarts]),
        )
        for index in order
    )
