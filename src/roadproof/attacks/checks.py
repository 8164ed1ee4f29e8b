"""The attack distrusts itself: why a search may have found less than there is, each with a line of advice."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.attacks.closed_loop import ClosedLoopMeasure
from roadproof.attacks.gradopt import Search
from roadproof.attacks.groups import Group
from roadproof.attacks.objective import Measure, RecordedMeasure
from roadproof.attacks.side_by_side import Beside
from roadproof.checks import Check
from roadproof.patterns import Pattern
from roadproof.search_space import SearchSpace

STRAYS_M = 0.5
"""A controller that strays further on the bare road is not the one that was recorded."""

ASIDE_M, TURNED_RAD = 1.0, 0.3
"""Further from a recorded pose a picture shows much that was not recorded."""


def check_search(
    measure: RecordedMeasure | Beside, space: SearchSpace, search: Search, *, random_patterns: int, seed: int
) -> tuple[Check, ...]:
    """Look for the usual reasons why a search disappoints.

    Args:
        measure: the measure on the recordings that the search made large.
        space: the search space.
        search: the outcome of the search.
        random_patterns: number of random patterns per group to compare with; 0 leaves that check out.
        seed: seed of the random patterns.
    """
    checks = [_check_determinism(measure, space, search), check_bounds(space, search)]
    if random_patterns:
        checks.append(_check_against_random(measure, space, search, random_patterns, seed))
    return tuple(checks)


def check_world(measure: ClosedLoopMeasure, pattern: Pattern) -> tuple[Check, ...]:
    """Check whether the recorded world can be trusted, on the bare road and over the pattern found.

    Args:
        measure: the measure in the recorded world that the search made large.
        pattern: the pattern found; one pattern, not a batch.
    """
    on_device = pattern[None].mapped(lambda part: part.to(measure.device))
    with torch.no_grad():
        bare = [world.roll(measure.controller) for world in measure.worlds]
        painted = [world.roll(measure.controller, on_device) for world in measure.worlds]
    strays_m = max(float(each.right_m.abs().max()) for each in bare)
    aside_m = max(float(each.left_m.abs().max()) for each in painted)
    turned_rad = max(float(each.turned_rad.abs().max()) for each in painted)
    keeps, near = strays_m <= STRAYS_M, aside_m <= ASIDE_M and turned_rad <= TURNED_RAD
    return (
        Check(
            "keeps to the recorded road without paint",
            keeps,
            f"on the bare road it goes up to {strays_m:.2f} m aside of the recorded clean drive",
            ""
            if keeps
            else "it does not drive as the recorded controller did, so predicted paths mean little: record with it",
        ),
        Check(
            "pictures near recorded ones",
            near,
            f"over the pattern it is up to {aside_m:.2f} m and {turned_rad:.2f} rad from the recorded poses shown",
            "" if near else "metres are less certain there: drive over it, or re-record along its path (rounds)",
        ),
    )


def _check_determinism(measure: RecordedMeasure | Beside, space: SearchSpace, search: Search) -> Check:
    again = measure.values(space, search.best_unit)
    drift = float((again - search.best).abs().max())
    passed = drift <= 1e-3 * max(float(search.best.abs().max()), 1e-3)
    return Check(
        "deterministic controller",
        passed,
        f"the best patterns, shown again, differ by {drift:.2g} in value",
        "" if passed else "the controller answers differently to the same frames: put it in eval mode, fix its seeds",
    )


def check_gradients(measure: RecordedMeasure | Beside, space: SearchSpace, search: Search) -> Check:
    """Check whether gradients reach the frames through the controller, at what was found and at random patterns."""
    _, gradient = measure.values_and_gradients(space, search.best_unit)
    _, at_start = measure.values_and_gradients(
        space, space.random((len(measure.groups), 2), torch.Generator().manual_seed(0)).to(measure.device)
    )
    dead = sum(float((part == 0).float().mean()) for part in (gradient, at_start)) / 2
    passed = dead < 0.5
    return Check(
        "non-zero gradients",
        passed,
        f"{dead:.0%} of the parameters have no gradient",
        ""
        if passed
        else "the controller does not pass gradients on (argmax, rounding, detach, saturation): make it "
        "differentiable, or search without gradients",
    )


def check_bounds(space: SearchSpace, search: Search) -> Check:
    """Check whether the pattern of the highest value lies on the bounds of the search space."""
    group, restart = divmod(int(search.best.argmax()), search.best.shape[1])
    shape_parameters = search.best_unit[group, restart, :, : len(space.shape_ranges)]
    stuck = float(((shape_parameters == 0) | (shape_parameters == 1)).float().mean())
    passed = stuck < 0.5
    return Check(
        "parameters inside their bounds",
        passed,
        f"{stuck:.0%} of the shape parameters lie on a bound, of the pattern of the highest value",
        "" if passed else "the bounds hold the pattern back: widen them, use the free family, or add figures",
    )


def check_groups(groups: Sequence[Group], search: Search) -> tuple[Check, ...]:
    """Say which groups gave their places to the others; nothing where none did."""
    if not search.gave_way:
        return ()
    behind = ", ".join(f"{groups[k]} reached {value:.2f}" for k, value in search.gave_way.items())
    ahead = ", ".join(str(group) for k, group in enumerate(groups) if k not in search.gave_way)
    finding = f"{behind} before the last steps, far behind {ahead}, which was given its places"
    return (Check("places given to the better side", True, finding),)


def check_steps(search: Search) -> tuple[Check, ...]:
    """Say how steps were run on a GPU; nothing on a CPU."""
    return (Check("steps on the GPU", True, search.steps),) if search.steps else ()


def _check_against_random(
    measure: RecordedMeasure | Beside, space: SearchSpace, search: Search, patterns: int, seed: int
) -> Check:
    _, by_chance = random_search(measure, space, patterns=patterns, seed=seed + 1)
    found, chance = float(search.best.max()), float(by_chance.max())
    passed = found > chance
    return Check(
        "better than random search",
        passed,
        f"the search found {found:.3f}, the best of {patterns} random patterns a group has {chance:.3f}",
        ""
        if passed
        else "use more restarts or more calls; the controller's gradients, where they are used, may mislead",
    )


def random_search(
    measure: Measure | Beside, space: SearchSpace, *, patterns: int, seed: int
) -> tuple[Float[Tensor, "g k n"], Float[Tensor, " g"]]:
    """The best of a number of random patterns for every group: the least an attack has to beat."""
    unit = space.random((1, patterns), torch.Generator().manual_seed(seed)).to(measure.device)
    unit = unit.expand(len(measure.groups), -1, -1, -1)
    best, index = measure.values(space, unit).max(1)
    return unit[torch.arange(len(unit)), index], best
