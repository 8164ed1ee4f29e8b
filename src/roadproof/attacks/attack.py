"""The verb: attack recorded drives."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.batched import BatchedMeasure
from roadproof.attacks.checks import (
    check_bounds,
    check_gradients,
    check_groups,
    check_search,
    check_steps,
    check_world,
)
from roadproof.attacks.closed_loop import ClosedLoopMeasure
from roadproof.attacks.driven import DrivenMeasure, InSimulator
from roadproof.attacks.gradopt import Search
from roadproof.attacks.groups import Group, known_as, require_names
from roadproof.attacks.method import Method
from roadproof.attacks.methods import BayesianOptimisation, GradOpt, Published, stored
from roadproof.attacks.objective import (
    Measure,
    Objective,
    PathDeviation,
    Readings,
    RecordedMeasure,
    SteeringShift,
    own_objective,
    variation_of,
)
from roadproof.attacks.result import RESULT_FILE, AttackResult, Candidate, Cost
from roadproof.attacks.side_by_side import Beside, Sides
from roadproof.attacks.site import site_of
from roadproof.attacks.speed import SpeedMeasure
from roadproof.checks import Check
from roadproof.controllers import Controller
from roadproof.controllers.identity import parts_of
from roadproof.controllers.loading import device_of
from roadproof.errors import ControllerError, RecordingError, RoadproofError
from roadproof.io.files import AnyPath, as_path
from roadproof.io.identity import digest, require_same
from roadproof.io.identity import stated as as_text
from roadproof.io.known import known_by
from roadproof.io.records import plain
from roadproof.limits import check_seed, is_whole
from roadproof.paint import Site, conspicuousness
from roadproof.processes import Pool
from roadproof.recordings import RecordingSet
from roadproof.roads.marks import site_at
from roadproof.search_space import SearchSpace


def attack(
    recordings: RecordingSet | InSimulator,
    controller: Controller,
    space: SearchSpace,
    *,
    objective: Objective | None = None,
    method: Method | None = None,
    groups: Sequence[Group] | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
    random_patterns: int = 0,
    starts: Sequence[Candidate] = (),
    checkpoint: AnyPath | None = None,
    pool: Pool[Any] | None = None,
    on_step: Callable[[int, float], object] = lambda _iteration, _best: None,
) -> AttackResult:
    """Find the pattern that moves a controller most, on recorded drives or in a simulator.

    Args:
        recordings: the drives, with their view of the canvas and its colours; or a stretch of road in a simulator,
            where every pattern takes a drive, and the method has to do without gradients.
        controller: the controller that is attacked; it computes on `device`.
        space: the search space: the patterns that are allowed.
        objective: what is made large: `PathDeviation()` or `SpeedChange()`, which drive in the recordings and need
            their tracks; `SteeringShift()`, as published; or one of your own. By default `usual_objective`.
        method: `GradOpt()` by default; `Published()`, or one that needs no gradient, as `CMAES()` or `TPE()`.
        groups: groups of recorded drives, each attacked together; none in a simulator. By default, for a method with
            gradients and drives perturbed to both sides, the paper's two sides, of which the stronger is kept, or for a
            speed change slower and faster; otherwise one group of all drives, to whichever side they give way.
        seed: seed of everything random, 0 to 2³² − 1; 0 by default.
        device: torch device on which a search on recordings computes.
        random_patterns: number of random patterns per group for the self-check on recordings; 0 leaves that check out.
        starts: candidates of an earlier search to start from, each in its own group, in place of as many random starts;
            those of groups that are not attacked are left out.
        checkpoint: file that keeps the search after every step, so that an interrupted one goes on; None for none.
        pool: processes that are open, in which groups are searched side by side; None has threads do it, which are
            slower: they wait for each other.
        on_step: called after every step with its number and the best value so far, in the objective's unit.

    Raises:
        ControllerError: the controller takes frames of another size, or answers NaN.
        RecordingError: a group names drives that the set lacks, two groups have one name, or starts are given and none
            is of a group that is attacked.
        PatternError: the method cannot search these patterns, or the limits on paint leave none on this road.
        DeviceError: there is no such device.
        RoadproofError: the seed or the number of random patterns is out of range; the method needs gradients, which a
            simulator does not give; groups, a device or random patterns are given for one; or `rollout` fails there.
    """
    check_seed(seed, "seed", RoadproofError)
    method = method or GradOpt()
    objective = objective or usual_objective(recordings, method)
    method.check_space(space)
    made_of: dict[str, Any] = {}
    with suppress(ControllerError):  # one that cannot drive is attacked all the same
        made_of = _made_of(recordings, controller, space, objective, method, groups, seed, starts, random_patterns)
    site, measure = _begun(recordings, controller, objective, method, groups, device, random_patterns)
    start = time.perf_counter()
    groups, space = measure.groups, space.on(site)
    search = method.search(
        measure,
        space,
        objective=objective,
        seed=seed,
        starts=_points(space, starts, groups),
        checkpoint=None if checkpoint is None else as_path(checkpoint),
        pool=pool,
        on_step=on_step,
    )
    frames = measure.frames_evaluated
    if search.gave_way and isinstance(measure, BatchedMeasure):
        measure = measure.of_groups([k for k in range(len(groups)) if k not in search.gave_way])
    beside = search.beside
    if beside is None and isinstance(measure, RecordedMeasure):
        beside = Sides((measure,), pool).of(0, measure)
    readings = (None, None) if beside is None else beside.readings(space, search.best_unit)
    candidates = _candidates(measure, search, space, method, readings)
    cost = Cost(
        controller_frames=frames,
        seconds=time.perf_counter() - start,
        simulator_calls=measure.calls if isinstance(measure, DrivenMeasure) else 0,
    )
    return AttackResult(
        **{each.name: getattr(candidates[0], each.name) for each in fields(Candidate)},
        objective=objective.name,
        by_group={str(group): float(best) for group, best in zip(measure.groups, search.best.amax(1), strict=True)},
        candidates=candidates,
        history=search.history.double().numpy(),
        cost=cost,
        checks=_checks(measure, beside, method, space, search, groups, candidates[0], random_patterns, seed),
        space=space,
        method=method,
        seed=seed,
        conspicuousness=conspicuousness(candidates[0].pattern, space.site or site),
        made_of=made_of,
    )


def usual_objective(recordings: RecordingSet | InSimulator, method: Method) -> Objective:
    """What an attack makes large where nobody says.

    It is the deviation in a simulator, and where recordings can be driven in to both sides; the steering shift in other
    recordings, and for the published searches.
    """
    driven = isinstance(recordings, InSimulator) or (recordings.is_placed and recordings.has_both_sides)
    return PathDeviation() if driven and not isinstance(method, Published | BayesianOptimisation) else SteeringShift()


def _begun(
    recordings: RecordingSet | InSimulator,
    controller: Controller,
    objective: Objective,
    method: Method,
    groups: Sequence[Group] | None,
    device: torch.device | str,
    random_patterns: int,
) -> tuple[Site, Measure]:
    """What is known of the canvas, and the measure that is made large, once both are known to fit what is asked for."""
    if isinstance(recordings, InSimulator):
        _refuse_in_simulator(method, groups=groups, device=str(device) != "cpu", random_patterns=random_patterns)
        return site_at(recordings.simulator, recordings.scenario), DrivenMeasure(recordings, controller, objective)
    device_of(str(device))
    if not is_whole(random_patterns) or random_patterns < 0:
        raise RoadproofError(f"random_patterns is {random_patterns}, expected a whole number, 0 or more")
    groups = groups or method.groups(recordings, objective)
    require_names(groups)
    return site_of(recordings), method.measure(objective, recordings, controller, groups, device=device)


def _refuse_in_simulator(method: Method, **given: object) -> None:
    """Refuse a method that drives cannot serve, and what an attack in a simulator would not use."""
    if method.by_gradient:
        raise RoadproofError(
            f"method {method.word} needs gradients, and a drive in a simulator has none; record and calibrate the "
            "stretch and attack the recordings, or give a method without gradients, as CMAES(calls=140)"
        )
    if names := " and ".join(name for name, value in given.items() if value):
        raise RoadproofError(f"an attack in a simulator does not use {names}; leave it out, or attack recordings")


def _made_of(
    recordings: RecordingSet | InSimulator,
    controller: Controller,
    space: SearchSpace,
    objective: Objective,
    method: Method,
    groups: Sequence[Group] | None,
    seed: int,
    starts: Sequence[Candidate],
    random_patterns: int,
) -> dict[str, Any]:
    """What identifies a search on recordings, by name, as JSON has it; empty where no search goes on from it."""
    if not isinstance(recordings, RecordingSet):
        return {}
    begun = [(each.group, known_by(each.pattern)) for each in starts]
    made_of = {
        "space": space.stated,
        "objective": objective.name,
        "objective_fields": own_objective(objective) or plain(objective),
        "method": stored(method),
        "groups": groups and [known_as(group, recordings) for group in groups],
        "seed": seed,
        "drives": recordings.digest()[:16],
        "marks": recordings.marks_digest()[:16],
        "starts": digest(as_text(begun))[:16],
        **parts_of(controller, (recordings.view.height_px, recordings.view.width_px)),
    }
    # Results are older than this part; those of the pipeline compare with no random patterns.
    made_of |= {"random_patterns": random_patterns} if random_patterns else {}
    made_of |= {"asphalt": site_of(recordings).asphalt} if space.limits is not None else {}
    made_of |= {"counted_from": "the bare road in the same look"} if variation_of(objective) is not None else {}
    return cast("dict[str, Any]", plain(made_of))


def _checks(
    measure: Measure,
    beside: RecordedMeasure | Beside | None,
    method: Method,
    space: SearchSpace,
    search: Search,
    groups: Sequence[Group],
    found: Candidate,
    random_patterns: int,
    seed: int,
) -> tuple[Check, ...]:
    """The self-checks that suit what a search ran on: recordings, a recorded world or a simulator."""
    of_search = (*check_groups(groups, search), *check_steps(search))
    if beside is None:
        return check_bounds(space, search), *of_search
    checks = check_search(beside, space, search, random_patterns=random_patterns, seed=seed)
    if method.by_gradient:
        checks = (check_gradients(beside, space, search), *checks)
    if isinstance(measure, ClosedLoopMeasure):
        checks += check_world(measure, found.pattern)
    return *checks, *of_search


def kept_attack(
    folder: Path,
    recordings: RecordingSet,
    controller: Controller,
    space: SearchSpace,
    *,
    objective: Objective,
    method: Method,
    groups: Sequence[Group] | None = None,
    seed: int = 0,
    device: torch.device | str = "cpu",
    random_patterns: int = 0,
    starts: Sequence[Candidate] = (),
    pool: Pool[Any] | None = None,
    on_step: Callable[[int, float], object] = lambda _iteration, _best: None,
) -> AttackResult:
    """Search once: if the folder already holds the result of this search, read it instead.

    `folder` is that of the result, and keeps the checkpoint of the running search; all else is as in `attack`.

    Raises:
        RoadproofError: the stored result is damaged, belongs to another search or does not say to which, the controller
            cannot be told from another, or the search itself fails.
        OutputError: the folder cannot be written.
    """
    checkpoint, path = folder / "search.safetensors", folder / "result.json"
    if path.exists():
        try:
            made_of = _made_of(recordings, controller, space, objective, method, groups, seed, starts, random_patterns)
        except ControllerError as error:
            raise ControllerError(
                f"{folder} holds a search, perhaps of another controller: this one cannot drive, by which it would be "
                f"known ({error}); choose another folder, or remove it"
            ) from None
        require_same(folder, "a search", RESULT_FILE.content(path).get("made_of"), made_of, RoadproofError)
    else:
        attack(
            recordings,
            controller,
            space,
            objective=objective,
            method=method,
            groups=groups,
            seed=seed,
            device=device,
            random_patterns=random_patterns,
            starts=starts,
            checkpoint=checkpoint,
            pool=pool,
            on_step=on_step,
        ).save(folder)
    checkpoint.unlink(missing_ok=True)
    return AttackResult.load(folder)


def _points(space: SearchSpace, starts: Sequence[Candidate], groups: Sequence[Group]) -> list[Float[Tensor, "_ k n"]]:
    """The start candidates of each group as points of the space; a group without sides, in a simulator, takes all."""
    own = [[start for start in starts if not group.sides or start.group == str(group)] for group in groups]
    if starts and not any(own):
        raise RecordingError(
            f"all starts are of {', '.join(sorted({start.group for start in starts}))}, the groups are "
            f"{', '.join(map(str, groups))}; give the starts' groups, or replace(start, group=...) them"
        )
    none = torch.empty(0, space.figures, len(space.names))
    return [torch.stack([start.point_in(space) for start in some]) if some else none for some in own]


def _candidates(
    measure: Measure, search: Search, space: SearchSpace, method: Method, readings: Readings | tuple[None, None]
) -> tuple[Candidate, ...]:
    """Every start's best, the strongest first: by what is predicted where that is known, else by its own value.

    Of what is predicted with small errors the least counts: where the way forks, a pattern that depends on
    a hair does not come first. A method without gradients tries every pattern for all groups; it stands for the one
    that it is best for.
    """
    shifts, predicted = readings
    restarts = search.best.shape[1]
    rank = search.best.cpu() if predicted is None else predicted.amin(-1)
    if predicted is not None and isinstance(measure, SpeedMeasure):
        rank = measure.rank(predicted)
    order = cast("list[int]", rank.flatten().argsort(descending=True).tolist())
    suits = cast("list[int]", search.best.argmax(0).tolist())
    candidates: list[Candidate] = []
    for group, restart in (divmod(index, restarts) for index in order):
        if not method.by_gradient and group != suits[restart]:
            continue
        unit = search.best_unit[group, restart].cpu()
        point = tuple(map(tuple, cast("list[list[float]]", unit.tolist()))) if space.is_limited else None
        pattern = space.pattern(unit)
        candidate = partial(Candidate, pattern, str(measure.groups[group]), point=point)
        if isinstance(measure, DrivenMeasure):
            candidates.append(candidate(driven=measure.effect(pattern)))
            continue
        # A published value is a sum over frames, one of the user's own is no steering at all.
        shift = float(search.best[group, restart] if shifts is None else shifts[group, restart])
        if predicted is None:
            candidates.append(candidate(shift))
            continue
        each = predicted[group, restart]
        mean, spread = float(each.mean()), (float(each.min()), float(each.max()))
        if isinstance(measure, SpeedMeasure):
            candidates.append(candidate(shift, predicted_mps=mean, predicted_range_mps=spread))
        else:
            candidates.append(candidate(shift, mean, spread))
    return tuple(candidates)
