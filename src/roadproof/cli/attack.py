"""`roadproof attack`: recorded drives and a controller in, the strongest pattern and its pictures out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli.options import ControllerSpec, Device, Figures, choice, number
from roadproof.errors import RoadproofError
from roadproof.limits import MANY, MAX_SEED

if TYPE_CHECKING:
    from roadproof.attacks import AttackResult, Schedule, ShownDrive
    from roadproof.search_space import SearchSpace


def attack(
    recordings: Annotated[Path, typer.Argument(help="Folder with a set of recorded drives.", show_default=False)],
    controller: ControllerSpec,
    figures: Figures = 5,
    family: Annotated[
        str, typer.Option(help="Where figures may lie: published, published-canvas-centre or free.")
    ] = "published",
    shape: Annotated[str, typer.Option(help="rectangle, ellipse, triangle or diamond.")] = "rectangle",
    black: Annotated[bool, typer.Option("--black", help="All paint is black; only shapes are searched.")] = False,
    albedo: Annotated[tuple[float, float], typer.Option(help="Darkest and brightest paint, 0 to 1.")] = (0.0, 1.0),
    max_painted_share: Annotated[
        float | None, number("Largest share of the canvas that may be painted.", 0.0, 1.0, show_default=False)
    ] = None,
    objective: Annotated[
        str | None,
        typer.Option(
            help="deviation: metres aside, driven in the recordings; steering: shift on recorded frames, as published."
            "  [default: deviation where the set has poses and both sides]",
            show_default=False,
        ),
    ] = None,
    groups: Annotated[
        str, typer.Option(help="Drives attacked together: clean+right,clean+left, or all.")
    ] = "clean+right,clean+left",
    schedule: Annotated[
        str, typer.Option(help="heats: many starts on few frames, the best go on; published: random starts.")
    ] = "heats",
    iterations: Annotated[
        int | None,
        number(
            "Steps of every restart; after heats 100, for a deviation 32; 250 as published.",
            1,
            MANY,
            show_default=False,
        ),
    ] = None,
    restarts: Annotated[int, number("Patterns of every group that are searched to the end.", 1, 1000)] = 4,
    gradient: Annotated[str, typer.Option(help="exact, or published: the authors' way, to compare with.")] = "exact",
    patience: Annotated[
        int | None, number("Stop after so many late steps without gain.", 1, MANY, show_default=False)
    ] = None,
    random_patterns: Annotated[
        int, number("Random patterns a group that the self-check compares with; 0 for none.", 0, 100_000)
    ] = 100,
    seed: Annotated[int, number("Of the random starts.", 0, MAX_SEED)] = 0,
    device: Device = "cpu",
    dtype: Annotated[str, typer.Option(help="What the controller computes in: float32 or bfloat16.")] = "float32",
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/attack"),
) -> None:
    """Find the painted pattern that moves a controller most on recorded drives."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from roadproof.attacks import GRADIENTS, OBJECTIVES, SteeringShift, show_pattern
    from roadproof.attacks import attack as run
    from roadproof.cli.progress import progress
    from roadproof.controllers import load_controller
    from roadproof.controllers.checks import require_usable
    from roadproof.controllers.precision import multiplies_bfloat16
    from roadproof.coverage import Shape
    from roadproof.io.locks import hold
    from roadproof.objectives import parse_groups
    from roadproof.recordings import Push, load_recordings
    from roadproof.search_space import FAMILIES, SearchSpace

    space = SearchSpace(
        figures=figures,
        family=choice(family, "family", FAMILIES),
        shape=Shape(choice(shape, "shape", tuple(Shape))),
        colour=not black,
        albedo=albedo,
        max_painted_share=max_painted_share,
    )
    hold(out)
    drives = load_recordings(recordings)
    pushed = {Push.LEFT, Push.RIGHT} <= {drive.push for drive in drives.recordings}
    driven_in = gradient == "exact" and drives.is_placed and pushed
    word = objective or ("deviation" if driven_in else "steering")
    wanted = OBJECTIVES[choice(word, "objective", tuple(OBJECTIVES))]
    if gradient != "exact":
        if word != "steering":
            raise RoadproofError(f"--gradient {gradient} is of the steering shift; expected --objective steering")
        wanted = SteeringShift(choice(gradient, "gradient", GRADIENTS))
    steps = _schedule(choice(schedule, "schedule", ("heats", "published")), word, iterations, patience)
    attacked = load_controller(controller, device=device, dtype=dtype)
    if dtype == "bfloat16" and not multiplies_bfloat16(device):
        typer.echo("this processor has no bfloat16 arithmetic: --dtype float32 is about 16 times faster here", err=True)
    chosen = parse_groups(groups, drives)
    require_usable(attacked, size=(drives.view.height_px, drives.view.width_px), device=device, drives=False)
    checkpoint = out / "search.safetensors"
    with progress("Searching", steps.steps) as on_step:
        result = run(
            drives,
            attacked,
            space,
            objective=wanted,
            groups=chosen,
            schedule=steps,
            restarts=restarts,
            seed=seed,
            device=device,
            random_patterns=random_patterns,
            checkpoint=checkpoint,
            on_step=on_step,
        )
    result.save(out)
    winner = next(group for group in chosen if str(group) == result.group)
    shown = show_pattern(result.pattern, drives, attacked, winner, device=device)
    _draw(result, shown, out)
    checkpoint.unlink(missing_ok=True)
    _summarise(result, space, out)


def _schedule(kind: str, objective: str, iterations: int | None, patience: int | None) -> Schedule:
    from roadproof.attacks import Schedule

    if kind == "heats":
        make = Schedule.closed_loop if objective == "deviation" else Schedule.in_heats
    else:
        make = Schedule.stretched
    return replace(make() if iterations is None else make(iterations), patience=patience)


def _draw(result: AttackResult, shown: tuple[ShownDrive, ...], out: Path) -> None:
    """The search's curves, and one film strip for each drive of the winner's group."""
    from roadproof.report import film_strip, search_curves

    search_curves(result.history, tuple(result.by_group), out / "search.png")
    for drive in shown:
        film_strip(
            drive.clean,
            drive.painted,
            drive.clean_steer,
            drive.painted_steer,
            out / f"film-{drive.name}.png",
            title=f"{drive.name}: predicted steering on composited frames, mean shift {drive.mean_shift:+.2f}",
        )


def _summarise(result: AttackResult, space: SearchSpace, out: Path) -> None:
    from rich.console import Console

    say = Console(soft_wrap=True, highlight=False).print
    sides = ", ".join(f"{name} {value:+.3f}" for name, value in result.by_group.items())
    shift = f"{result.surrogate_shift:+.3f} steer a frame on recorded frames"
    if result.predicted_m is not None:
        least, most = result.predicted_range_m or (result.predicted_m, result.predicted_m)
        shift = (
            f"{result.predicted_m:.2f} m of deviation predicted ({least:.2f} to {most:.2f} over small errors of "
            f"steering), nothing was driven for real; {shift}"
        )
    say(f"Strongest for {result.group}: {shift}")
    say(f"Best {result.objective} of each group: {sides}")
    say(
        f"{space.figures} figures, {result.restarts} restarts × {len(result.history)} iterations, {result.stopped}; "
        f"{result.cost.controller_frames} frames in {result.cost.seconds:.0f} s"
    )
    for check in result.checks:
        say(f"  {'ok ' if check.passed else 'BAD'} {check.name}: {check.finding}{check.advice and '; ' + check.advice}")
    say(f"Results in {out}: pattern.json, pattern.png, result.json, search.png, film-*.png", markup=False)
