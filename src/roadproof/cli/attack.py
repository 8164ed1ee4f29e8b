"""`roadproof attack`: recorded drives and a controller in, the strongest pattern and its pictures out."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from roadproof.cli import options
from roadproof.cli.options import argument, number, unset
from roadproof.cli.output import answer, say, stored
from roadproof.cli.paint import Paint
from roadproof.cli.verbs import begin, keep_command
from roadproof.limits import MANY

if TYPE_CHECKING:
    from roadproof.attacks import AttackResult, Objective, Published
    from roadproof.attacks.groups import Group
    from roadproof.controllers import Controller
    from roadproof.recordings import RecordingSet


def attack(
    recordings: Annotated[Path, argument("Folder with a set of recorded drives.")],
    controller: options.ControllerSpec,
    figures: options.Figures = 5,
    family: Annotated[
        str | None,
        unset(
            "Where figures may lie: published, published-canvas-centre, published-bo or free.",
            default="published; that of its authors for the method published-bo",
        ),
    ] = None,
    shape: Annotated[str, typer.Option(help="rectangle, ellipse, triangle or diamond.")] = "rectangle",
    black: Annotated[bool, typer.Option("--black", help="All paint is black; only shapes are searched.")] = False,
    albedo: Annotated[tuple[float, float], number("Darkest and brightest paint.", 0.0, 1.0)] = (0.0, 1.0),
    max_painted_share: Annotated[
        float | None, number("Largest share of the canvas that may be painted.", 0.0, 1.0, default=False)
    ] = None,
    objective: Annotated[
        str | None,
        unset(
            "deviation: metres aside, driven in the recordings; speed: m/s slower or faster there; steering: shift on "
            "recorded frames, as published.",
            default="deviation where the set has poses and both sides, unless the method is published",
        ),
    ] = None,
    groups: Annotated[
        str | None,
        unset(
            "Drives attacked together: clean+right,clean+left, or all; slower,faster for a speed.", default="by method"
        ),
    ] = None,
    method: Annotated[
        str,
        typer.Option(
            help="gradopt; published, as the paper's authors had it; or without gradients: random, tpe, gp, cma-es, "
            "published-bo."
        ),
    ] = "gradopt",
    iterations: Annotated[
        int | None, number("gradopt: last steps.", 1, MANY, default="100; 32 for a deviation or a speed")
    ] = None,
    restarts: Annotated[
        int | None, number("gradopt, published: patterns of every group searched to the end.", 1, 1000, default="4")
    ] = None,
    masks: Annotated[
        str | None, unset("published: binary, as the code, or antialiased, as the text.", default="binary")
    ] = None,
    calls: Annotated[int | None, number("Without gradients: patterns tried.", 1, MANY, default="1000")] = None,
    random_patterns: Annotated[
        int, number("Random patterns a group that the self-check compares with; 0 for none.", 0, 100_000)
    ] = 100,
    cheapest: options.CheapestFor = None,
    limit_costs: options.LimitCosts = False,
    seed: options.Seed = 0,
    device: options.Device = "cpu",
    dtype: Annotated[
        str, typer.Option(help="What values are computed in: float32, bfloat16, float64 (slow), or on a GPU tf32.")
    ] = "float32",
    out: options.Out = Path("out/attack"),
    *,
    paint: Paint,
) -> None:
    """Find the painted pattern that moves a controller most on recorded drives."""
    from roadproof.attacks import (
        OBJECTIVES,
        Published,
        kept_attack,
        method_of,
        parse_groups,
        show_pattern,
        site_of,
        usual_objective,
    )
    from roadproof.attacks.objective import varied
    from roadproof.cli.progress import progress
    from roadproof.controllers import load_controller
    from roadproof.controllers.precision import multiply_in
    from roadproof.coverage import Shape
    from roadproof.pipeline.limit_costs import relaxed_limits
    from roadproof.pipeline.workload import Workload, of_cheapest, of_search
    from roadproof.recordings import load_recordings
    from roadproof.report.plots import draw_attack
    from roadproof.search_space import FAMILIES, SearchSpace

    given = {"iterations": iterations, "restarts": restarts, "masks": masks, "calls": calls}
    searched = method_of(method, **{name: value for name, value in given.items() if value is not None})
    space = SearchSpace(
        figures=figures,
        family=searched.family if family is None else options.choice(family, "family", FAMILIES),
        shape=Shape(options.choice(shape, "shape", tuple(Shape))),
        colour=not black,
        albedo=albedo,
        max_painted_share=max_painted_share,
        limits=paint.limits,
    )
    searched.check_space(space)
    drives = load_recordings(recordings)
    chosen_goal = None if objective is None else OBJECTIVES[options.choice(objective, "objective", tuple(OBJECTIVES))]
    goal = varied(chosen_goal or usual_objective(drives, searched), paint.variation)
    if isinstance(searched, Published):
        _check_published(searched, goal, dtype, cheapest)
    space = space.on(site_of(drives))
    if cheapest is not None:
        _check_cheapest(drives, goal)
    searches = 1 + (len(relaxed_limits(space, goal)) if limit_costs else 0)
    attacked = load_controller(controller, device=device, dtype=dtype)
    multiply_in(dtype)
    # The least paint is looked for by gradient, whatever the method.
    by_gradient = searched.by_gradient or cheapest is not None
    _check_attacked(attacked, drives, goal, by_gradient=by_gradient, device=device, dtype=dtype)
    chosen = searched.groups(drives, goal) if groups is None else parse_groups(groups, drives)
    frames = sum(len(each.frames) for each in drives.recordings)
    work = of_search(searched, goal, frames, attacked, groups=len(chosen), worlds=len(drives.by_weather()))
    less = Workload() if cheapest is None else of_cheapest(space.figures, goal, attacked)
    begin(work.times(searches) + less, out)
    with progress("Searching", searched.steps(goal)) as on_step:
        result = kept_attack(
            out,
            drives,
            attacked,
            space,
            objective=goal,
            method=searched,
            groups=chosen,
            seed=seed,
            device=device,
            random_patterns=random_patterns,
            on_step=on_step,
        )
    keep_command(out)
    winner = next(group for group in chosen if str(group) == result.group)
    draw_attack(result, show_pattern(result.pattern, drives, attacked, winner, device=device), out)
    _summarise(result, out)
    found = stored(out / "result.json")
    if cheapest is not None:
        found["cheapest"] = _less_paint(drives, attacked, result, cheapest, chosen, goal, device, out / "cheapest")
    if limit_costs:
        found["limits"] = _limit_costs(drives, attacked, result, chosen, goal, device, out)
    answer(found)


def _check_published(method: Published, objective: Objective, dtype: str, cheapest: float | None) -> None:
    """Refuse a published search with what was not published."""
    from roadproof.errors import RoadproofError

    method.check_objective(objective)
    if dtype != "float32":
        raise RoadproofError(f"the published search computes in float32, not {dtype}; leave --dtype out")
    if cheapest is not None:
        raise RoadproofError(
            "the published search looks for no least paint; leave --cheapest out, or --method published"
        )


def _check_attacked(
    attacked: Controller, drives: RecordingSet, objective: Objective, *, by_gradient: bool, device: str, dtype: str
) -> None:
    """Refuse a controller that the search cannot work on, before it begins; say where its arithmetic is slow."""
    from roadproof.attacks import SpeedChange
    from roadproof.attacks.speed import require_pedals
    from roadproof.controllers.checks import require_usable
    from roadproof.controllers.precision import multiplies_bfloat16

    size = (drives.view.height_px, drives.view.width_px)
    require_usable(attacked, size=size, device=device, drives=False, gradients=by_gradient)
    if isinstance(objective, SpeedChange):
        require_pedals(attacked)
    if dtype == "bfloat16" and not multiplies_bfloat16(device):
        typer.echo("this processor has no bfloat16 arithmetic: --dtype float32 is about 16 times faster here", err=True)


def _check_cheapest(drives: RecordingSet, objective: Objective) -> None:
    """Refuse to look for the least paint where it cannot be told."""
    from roadproof.attacks import SpeedChange
    from roadproof.errors import RecordingError, RoadproofError

    if not drives.is_placed:
        raise RecordingError("--cheapest drives in the recordings, which need poses and a canvas; these have none")
    if isinstance(objective, SpeedChange):
        raise RoadproofError("--cheapest is in metres of deviation, --objective speed in m/s; leave one of them out")


def _less_paint(
    drives: RecordingSet,
    attacked: Controller,
    strongest: AttackResult,
    wanted_m: float,
    groups: Sequence[Group],
    objective: Objective,
    device: str,
    folder: Path,
) -> dict[str, Any] | None:
    """The least paint for a deviation, which the folder keeps, as its file has it; None if there is none."""
    from roadproof.attacks import kept_cheapest
    from roadproof.attacks.cheapest import MOST_LEVELS, cheapest_in_words
    from roadproof.cli.progress import progress

    with progress("Looking for less paint", MOST_LEVELS) as show:
        less = kept_cheapest(
            folder,
            drives,
            attacked,
            strongest,
            wanted_m,
            groups=groups,
            objective=objective,
            device=device,
            on_level=show,
        )
    say(cheapest_in_words(less, wanted_m))
    return None if less is None else stored(folder / "cheapest.json")


def _limit_costs(
    drives: RecordingSet,
    attacked: Controller,
    found: AttackResult,
    groups: Sequence[Group],
    objective: Objective,
    device: str,
    out: Path,
) -> dict[str, Any]:
    """What each limit on paint costs, which the folder of the search keeps, as its file has it."""
    from roadproof.cli.progress import stages
    from roadproof.pipeline.limit_costs import LIMIT_COSTS, LimitCosts, search_without

    file = out / LIMIT_COSTS
    with stages() as show:
        searched = search_without(
            file.parent,
            drives,
            attacked,
            found,
            objective=objective,
            groups=groups,
            device=device,
            on_step=partial(show, "Searching without limits"),
        )
    costs = LimitCosts.of(found, searched)
    costs.save(file)
    say(*costs.sentences)
    return stored(file)


def _summarise(result: AttackResult, out: Path) -> None:
    sides = ", ".join(f"{name} {value:+.3f}" for name, value in result.by_group.items())
    shift = f"{result.surrogate_shift:+.3f} steer a frame on recorded frames"
    if (predicted := result.predicted_with_spread) is not None:
        looks = " and variations" if result.objective.endswith("variations") else ""
        mean, spread = predicted
        shift = f"{mean} predicted ({spread} over small errors{looks}), nothing was driven for real; {shift}"
    say(
        f"Strongest for {result.group}: {shift}",
        f"Best of each group ({result.made_large}): {sides}",
        f"{result.space.figures} figures, {result.method.word}: {result.history.shape[2]} × {len(result.history)} last "
        f"steps; {result.cost.controller_frames} frames in {result.cost.seconds:.0f} s",
    )
    if result.conspicuousness is not None:
        say(f"How conspicuous it is: {result.conspicuousness.sentence}")
    for check in result.checks:
        say(f"  {check}")
    say(f"Results in {out}: pattern.json, pattern.png, result.json, search.png, film-*.png")
