"""`roadproof attack`: recorded drives and a controller in, the strongest pattern and its pictures out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli.options import ControllerSpec, Device, choice

if TYPE_CHECKING:
    from roadproof.attacks import AttackResult, ShownDrive
    from roadproof.search_space import SearchSpace


def attack(
    recordings: Annotated[Path, typer.Argument(help="Folder with a set of recorded drives.", show_default=False)],
    controller: ControllerSpec,
    figures: Annotated[int, typer.Option(help="K, how many figures are painted.")] = 5,
    family: Annotated[
        str, typer.Option(help="Where figures may lie: published, published-canvas-centre or free.")
    ] = "published",
    shape: Annotated[str, typer.Option(help="rectangle, ellipse, triangle or diamond.")] = "rectangle",
    black: Annotated[bool, typer.Option("--black", help="All paint is black; only shapes are searched.")] = False,
    albedo: Annotated[tuple[float, float], typer.Option(help="Darkest and brightest paint, 0 to 1.")] = (0.0, 1.0),
    max_painted_share: Annotated[
        float | None, typer.Option(help="Largest share of the canvas that may be painted.", show_default=False)
    ] = None,
    groups: Annotated[
        str, typer.Option(help="Drives attacked together: clean+right,clean+left, or all.")
    ] = "clean+right,clean+left",
    schedule: Annotated[
        str, typer.Option(help="heats: many starts on few frames, the best go on; published: random starts.")
    ] = "heats",
    iterations: Annotated[
        int | None, typer.Option(help="Steps of every restart; 100 after heats, 250 as published.", show_default=False)
    ] = None,
    restarts: Annotated[int, typer.Option(help="Patterns of every group that are searched to the end.")] = 4,
    gradient: Annotated[str, typer.Option(help="exact, or published: the authors' way, to compare with.")] = "exact",
    patience: Annotated[
        int | None, typer.Option(help="Stop after so many late steps without gain.", show_default=False)
    ] = None,
    random_patterns: Annotated[
        int, typer.Option(help="Random patterns a group that the self-check compares with; 0 for none.")
    ] = 100,
    seed: Annotated[int, typer.Option(help="Of the random starts.")] = 0,
    device: Device = "cpu",
    dtype: Annotated[str, typer.Option(help="What the controller computes in: float32 or bfloat16.")] = "float32",
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/attack"),
) -> None:
    """Find the painted pattern that shifts a controller's steering most on recorded drives."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from roadproof.attacks import GRADIENTS, Schedule, show_pattern
    from roadproof.attacks import attack as run
    from roadproof.cli.progress import progress
    from roadproof.controllers import load_controller
    from roadproof.controllers.precision import multiplies_bfloat16
    from roadproof.coverage import Shape
    from roadproof.files import check_writable
    from roadproof.objectives import parse_groups
    from roadproof.recordings import load_recordings
    from roadproof.search_space import FAMILIES, SearchSpace

    space = SearchSpace(
        figures=figures,
        family=choice(family, "family", FAMILIES),
        shape=Shape(choice(shape, "shape", tuple(Shape))),
        colour=not black,
        albedo=albedo,
        max_painted_share=max_painted_share,
    )
    make = {"heats": Schedule.in_heats, "published": Schedule.stretched}[
        choice(schedule, "schedule", ("heats", "published"))
    ]
    steps = make(patience=patience) if iterations is None else make(iterations, patience=patience)
    check_writable(out)
    drives = load_recordings(recordings)
    attacked = load_controller(controller, device=device, dtype=dtype)
    if dtype == "bfloat16" and not multiplies_bfloat16(device):
        typer.echo("this processor has no bfloat16 arithmetic: --dtype float32 is about 16 times faster here", err=True)
    chosen = parse_groups(groups, drives)
    checkpoint = out / "search.safetensors"
    with progress("Searching", steps.steps) as on_step:
        result = run(
            drives,
            attacked,
            space,
            groups=chosen,
            schedule=steps,
            restarts=restarts,
            seed=seed,
            device=device,
            gradient=choice(gradient, "gradient", GRADIENTS),
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
    say(f"Strongest for {result.group}: {result.surrogate_shift:+.3f} steer a frame, predicted ({sides})")
    say(
        f"{space.figures} figures, {result.restarts} restarts × {len(result.history)} iterations, {result.stopped}; "
        f"{result.cost.controller_frames} frames in {result.cost.seconds:.0f} s"
    )
    for check in result.checks:
        say(f"  {'ok ' if check.passed else 'BAD'} {check.name}: {check.finding}{check.advice and '; ' + check.advice}")
    say(f"Results in {out}: pattern.json, pattern.png, result.json, search.png, film-*.png", markup=False)
