"""`roadproof evaluate`: a pattern driven over in many conditions; how bad it is, as a table, and a film."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli.options import (
    Device,
    DriverSpec,
    Processes,
    ScenarioFile,
    ScenarioOrRecorded,
    WorldSpec,
    check_processes,
    driver_of,
    number,
    weathers_of,
)
from roadproof.cli.worlds import check_driver, open_world, recorded_in, scenario_asked, stretch_of
from roadproof.limits import MAX_CROWD, MAX_SEED

if TYPE_CHECKING:
    from roadproof.controllers import Controller
    from roadproof.driving.evaluation import Evaluation, Row
    from roadproof.patterns import Pattern
    from roadproof.pipeline.fidelity import Fidelity
    from roadproof.recordings import RecordingSet
    from roadproof.simulators.protocol import Simulator


def evaluate(
    pattern: Annotated[
        Path, typer.Argument(help="pattern.json of an attack, or a 400×400 picture.", show_default=False)
    ],
    controller: DriverSpec = "cil",
    scenario: ScenarioOrRecorded = None,
    scenarios: ScenarioFile = None,
    weathers: Annotated[
        str | None,
        typer.Option(
            help="Weathers, with commas between; the paper's four by default, or that of the recordings.",
            show_default=False,
        ),
    ] = None,
    starts: Annotated[
        int,
        number("Drives alone in each weather, each from a start of its own; 0 for one from the scenario's.", 0, 1000),
    ] = 5,
    start_range: Annotated[
        tuple[float, float, float],
        typer.Option(help="Those starts: at most so many metres aside, radians turned and m/s faster."),
    ] = (0.3, 0.05, 2.0),
    runs: Annotated[
        int | None,
        number(
            "Drives with traffic in each weather, besides those alone; 10 by default, 0 in recordings.",
            0,
            10_000,
            show_default=False,
        ),
    ] = None,
    cars: Annotated[int, number("Other cars in those.", 0, MAX_CROWD)] = 20,
    pedestrians: Annotated[int, number("People about in those.", 0, MAX_CROWD)] = 20,
    random: Annotated[int, number("Random patterns to compare with.", 0, 1000)] = 0,
    recordings: Annotated[
        Path | None,
        typer.Option(help="The set attacked, to compare composites with what is rendered.", show_default=False),
    ] = None,
    film: Annotated[bool, typer.Option(help="Film the first weather's drive without and with paint.")] = True,
    processes: Processes = 1,
    simulator: WorldSpec = "town",
    seed: Annotated[int, number("Of the first run with traffic; the others count on.", 0, MAX_SEED)] = 0,
    device: Device = "cpu",
    out: Annotated[Path, typer.Option(help="Folder for the results; the same folder goes on where it was.")] = Path(
        "out/evaluation"
    ),
) -> None:
    """Drive over a pattern, alone and in traffic, and say how bad it is."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from roadproof.cli.progress import progress
    from roadproof.controllers import Controller
    from roadproof.driving.evaluate import PAPER_WEATHERS, random_patterns
    from roadproof.driving.evaluate import evaluate as run
    from roadproof.driving.starts import StartRange
    from roadproof.errors import PatternError
    from roadproof.io.locks import hold
    from roadproof.patterns import load_pattern, read_paint
    from roadproof.recordings import load_recordings

    inside = recorded_in(simulator)
    asked = scenario_asked(inside, scenario, scenarios)
    skies = PAPER_WEATHERS if inside is None else (inside.weather,)
    if weathers is not None:
        skies = weathers_of(weathers, "weathers")
    if inside is not None:
        check_driver(controller)
        _check_recorded(runs, recordings)
        cars = pedestrians = 0
    check_processes(processes, simulator)
    begun = StartRange(**dict(zip(StartRange.__slots__, start_range, strict=True)))
    figures = load_pattern(pattern) if pattern.suffix == ".json" else None
    paint = read_paint(pattern)
    if figures is None and (random or recordings):
        raise PatternError(f"{pattern} is a picture; --random and --recordings need the pattern.json of an attack")
    recorded = None if recordings is None else load_recordings(recordings)
    hold(out)
    who = driver_of(controller, device)
    with open_world(simulator, device) as world:
        driven = stretch_of(world, asked)
        with progress(f"Driving {driven.name}", 100, "%, {:.0f} drives") as show:
            evaluation = run(
                partial(open_world, simulator, device) if processes > 1 else world,
                who,
                driven,
                paint if figures is None else figures,
                folder=out,
                driver_name=controller,
                weathers=skies,
                starts=starts,
                start_range=begun,
                runs=runs if runs is not None else 10 if inside is None else 0,
                cars=cars,
                pedestrians=pedestrians,
                seed=seed,
                baseline=random_patterns(figures, random, seed=seed) if figures is not None and random else (),
                processes=processes,
                on_drive=lambda done, total: show(100 * done // total, done),
            )
        if film:
            from roadproof.report.film import film_trial

            film_trial(world, evaluation, paint, out)
        fidelity = None
        if recorded is not None and figures is not None and isinstance(who, Controller):
            fidelity = _compared(world, who, evaluation, figures, recorded, out)
    _summarise(evaluation, fidelity, recorded, out)


def _check_recorded(runs: int | None, recordings: Path | None) -> None:
    """Refuse what recordings cannot give, before anything is driven.

    Raises:
        RoadproofError: traffic, or renders to compare with, are asked for.
    """
    from roadproof.errors import RoadproofError

    if runs:
        raise RoadproofError(f"--runs is {runs}, but recordings hold no others on the road; expected 0")
    if recordings is not None:
        raise RoadproofError("--recordings compares with what a simulator renders; nothing is rendered in recordings")


def _compared(
    world: Simulator, who: Controller, evaluation: Evaluation, figures: Pattern, recorded: RecordingSet, out: Path
) -> Fidelity | None:
    """The surrogate's frames beside the simulator's, where the set was recorded on this clean drive."""
    from roadproof.driving.rollout import rollout
    from roadproof.pipeline.fidelity import compare_with_rendered, is_drive_of, rendered_frames

    clean = rollout(world, who, evaluation.scenario, weather=evaluation.weathers[0])
    drive = next((each for each in recorded.recordings if each.push == "clean"), None)
    if drive is None or not is_drive_of(drive, clean):
        return None
    rendered = rendered_frames(world, evaluation.scenario, clean, figures, drive.frame_number)
    fidelity = compare_with_rendered(figures, recorded, who, rendered, drive=drive.name)
    fidelity.save(out / "fidelity.npz")
    return fidelity


def _infractions(row: Row) -> list[str]:
    from roadproof.report.words import mean_in_words

    return [mean_in_words(row.points, 1), mean_in_words(row.clean_points, 1)]


def _summarise(evaluation: Evaluation, fidelity: Fidelity | None, recorded: RecordingSet | None, out: Path) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from roadproof.report.words import UNKNOWN, mean_in_words

    console = Console(soft_wrap=True, highlight=False, markup=False)
    foreseen = evaluation.predicted
    title = "Predicted: composited into recorded frames, nothing was driven for real" if foreseen else None
    table = Table(
        "pattern",
        "weather",
        "with",
        box=box.SIMPLE,
        title=title,
        title_justify="left",
        caption="deviation: median (least–most); aside: furthest; clean: points on the bare road",
        caption_justify="left",
    )
    driven = ("deviation m", "aside m", "left lane", "points", "clean")
    predicted = ("predicted m", "aside m", "left lane", "infractions")
    for column in ("drives", *(predicted if foreseen else driven)):
        table.add_column(column, justify="right", no_wrap=True)
    for row in evaluation.rows():
        traffic = "traffic" if row.traffic else "nobody"
        table.add_row(
            row.pattern,
            row.weather or "all",
            traffic,
            str(row.count),
            f"{row.median_m:.2f} ({row.least_m:.2f}–{row.most_m:.2f})",
            mean_in_words(row.lateral_m, 2),
            f"{row.left_lane:.0%}",
            *([UNKNOWN] if row.failed is None else _infractions(row)),
        )
    console.print(table)
    if fidelity is not None:
        found = fidelity.agreement
        console.print(
            f"Surrogate on {found.frames} frames of {fidelity.drive}: {found.paint_error:.1f} of 255 levels off in the "
            f"paint, steering shift {found.predicted_shift:+.3f} predicted, {found.rendered_shift:+.3f} rendered"
        )
    elif recorded is not None:
        console.print("The recordings are not of this clean drive, so composites were not compared with renders")
    console.print(
        f"{evaluation.drives} {'predicted ' if foreseen else ''}drives, paint {evaluation.paint}, "
        f"{evaluation.seconds:.0f} s; "
        f"results in {out}: evaluation.json, episodes"
    )
