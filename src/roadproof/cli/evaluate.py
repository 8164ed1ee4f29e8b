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
    ScenarioName,
    SimulatorSpec,
    check_processes,
    driver_of,
    weathers_of,
)

if TYPE_CHECKING:
    from roadproof.controllers import Controller
    from roadproof.evaluation import Evaluation, Fidelity
    from roadproof.patterns import Pattern
    from roadproof.recordings import RecordingSet
    from roadproof.simulators.protocol import Simulator


def evaluate(
    pattern: Annotated[
        Path, typer.Argument(help="pattern.json of an attack, or a 400×400 picture.", show_default=False)
    ],
    controller: DriverSpec = "cil",
    scenario: ScenarioName = "left-03",
    scenarios: ScenarioFile = None,
    weathers: Annotated[
        str, typer.Option(help="Weathers, with commas between; the paper's four by default.")
    ] = "clear-noon,cloudy-noon,rainy-noon,clear-sunset",
    runs: Annotated[int, typer.Option(help="Drives with traffic in each weather, besides the one alone.")] = 10,
    cars: Annotated[int, typer.Option(help="Other cars in those.")] = 20,
    pedestrians: Annotated[int, typer.Option(help="People about in those.")] = 20,
    random: Annotated[int, typer.Option(help="Random patterns to compare with.")] = 0,
    recordings: Annotated[
        Path | None,
        typer.Option(help="The set attacked, to compare composites with what is rendered.", show_default=False),
    ] = None,
    film: Annotated[bool, typer.Option(help="Film the first weather's drive without and with paint.")] = True,
    processes: Processes = 1,
    simulator: SimulatorSpec = "town",
    seed: Annotated[int, typer.Option(help="Of the first run with traffic; the others count on.")] = 0,
    device: Device = "cpu",
    out: Annotated[Path, typer.Option(help="Folder for the results; the same folder goes on where it was.")] = Path(
        "out/evaluation"
    ),
) -> None:
    """Drive over a pattern, alone and in traffic, and say how bad it is."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from roadproof.cli.progress import progress
    from roadproof.controllers import Controller
    from roadproof.errors import PatternError
    from roadproof.evaluation import evaluate as run
    from roadproof.evaluation import random_patterns
    from roadproof.files import check_writable
    from roadproof.patterns import load_pattern, read_paint
    from roadproof.recordings import load_recordings
    from roadproof.scenarios import BUILTIN_FILE, find_scenario, load_scenarios
    from roadproof.simulators.loading import open_simulator

    driven = find_scenario(scenario, load_scenarios(scenarios or BUILTIN_FILE))
    skies = weathers_of(weathers, "weathers")
    check_processes(processes, simulator)
    figures = load_pattern(pattern) if pattern.suffix == ".json" else None
    paint = read_paint(pattern)
    if figures is None and (random or recordings):
        raise PatternError(f"{pattern} is a picture; --random and --recordings need the pattern.json of an attack")
    recorded = None if recordings is None else load_recordings(recordings)
    check_writable(out)
    who = driver_of(controller, device)
    with open_simulator(simulator) as world:
        with progress(f"Driving {driven.name}", 100, "%, {:.0f} drives") as show:
            evaluation = run(
                partial(open_simulator, simulator) if processes > 1 else world,
                who,
                driven,
                paint if figures is None else figures,
                folder=out,
                driver_name=controller,
                weathers=skies,
                runs=runs,
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


def _compared(
    world: Simulator, who: Controller, evaluation: Evaluation, figures: Pattern, recorded: RecordingSet, out: Path
) -> Fidelity | None:
    """The surrogate's frames beside the simulator's, where the set was recorded on this clean drive."""
    from roadproof.evaluation import compare_with_rendered, is_drive_of, rendered_frames
    from roadproof.evaluation.episodes import load_episodes

    (clean,) = load_episodes(out, [evaluation.shown().clean])
    drive = next((each for each in recorded.recordings if each.push == "clean"), None)
    if drive is None or not is_drive_of(drive, clean):
        return None
    rendered = rendered_frames(world, evaluation.scenario, clean, figures, drive.frame_number)
    fidelity = compare_with_rendered(figures, recorded, who, rendered, drive=drive.name)
    fidelity.save(out / "fidelity.npz")
    return fidelity


def _summarise(evaluation: Evaluation, fidelity: Fidelity | None, recorded: RecordingSet | None, out: Path) -> None:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from roadproof.report.words import mean_in_words

    console = Console(soft_wrap=True, highlight=False, markup=False)
    table = Table("pattern", "weather", "with", box=box.SIMPLE)
    for column in ("drives", "deviation m", "furthest m", "points", "clean points", "with events"):
        table.add_column(column, justify="right")
    for row in evaluation.rows():
        traffic = f"{evaluation.cars} cars, {evaluation.pedestrians} people" if row.traffic else "nobody"
        table.add_row(
            row.pattern,
            row.weather or "all",
            traffic,
            str(row.points.count),
            mean_in_words(row.deviation_m, 2),
            mean_in_words(row.lateral_m, 2),
            mean_in_words(row.points, 1),
            mean_in_words(row.clean_points, 1),
            f"{row.failed:.0%}",
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
        f"{evaluation.simulator_calls} drives, paint {evaluation.paint}, {evaluation.seconds:.0f} s; "
        f"results in {out}: evaluation.json, episodes"
    )
