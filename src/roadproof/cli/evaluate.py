"""`roadproof evaluate`: a pattern driven over in many conditions; how bad it is, as a table, and a film."""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli import options
from roadproof.cli.options import argument, number, unset
from roadproof.cli.output import answer, say, stored, table
from roadproof.cli.verbs import begin, keep_command
from roadproof.cli.worlds import world_asked
from roadproof.errors import PatternError, RoadproofError
from roadproof.limits import MAX_CROWD

if TYPE_CHECKING:
    from roadproof.datatypes import Weather
    from roadproof.driving.evaluation import Evaluation
    from roadproof.patterns import Pattern
    from roadproof.pipeline.fidelity import Fidelity
    from roadproof.pipeline.worlds import Recorded
    from roadproof.recordings import RecordingSet

_TOLD_MPS = 0.3
"""A mean change of the speed, m/s, that is worth a column: one kilometre an hour."""


def evaluate(
    pattern: Annotated[Path, argument("pattern.json of an attack, or a 400×400 picture.")],
    controller: options.DriverSpec = "pilotnet",
    scenario: options.ScenarioOrRecorded = None,
    scenarios: options.ScenarioFile = None,
    weathers: Annotated[
        str | None,
        unset(
            "Weathers, with commas between.",
            options.weather_names,
            default="the paper's four, or that of the recordings",
        ),
    ] = None,
    starts: Annotated[
        int,
        number("Drives alone in each weather, each from a start of its own; 0 for one from the scenario's.", 0, 1000),
    ] = 5,
    start_range: Annotated[
        tuple[float, float, float],
        typer.Option(
            help="Those starts: at most so many metres aside, radians turned and m/s faster.  [0 to 1, 0.3 and 5]"
        ),
    ] = (0.3, 0.05, 2.0),
    runs: Annotated[
        int | None,
        number(
            "Drives with traffic in each weather, besides those alone; the seed counts on from one to the next.",
            0,
            10_000,
            default="10, or 0 in recordings",
        ),
    ] = None,
    cars: Annotated[int | None, number("Other cars in those.", 0, MAX_CROWD, default="20")] = None,
    pedestrians: Annotated[int | None, number("People about in those.", 0, MAX_CROWD, default="20")] = None,
    random: Annotated[int, number("Random patterns to compare with.", 0, 1000)] = 0,
    recordings: Annotated[Path | None, unset("The set attacked, to compare composites with what is rendered.")] = None,
    film: Annotated[bool, typer.Option(help="Film the first weather's drive without and with paint.")] = True,
    processes: options.Processes = 1,
    simulator: options.WorldSpec = "town",
    seed: options.Seed = 0,
    device: options.Device = "cpu",
    out: options.Out = Path("out/evaluation"),
) -> None:
    """Drive over a pattern, alone and in traffic, and say how bad it is."""
    from roadproof.cli.progress import stages
    from roadproof.controllers import Controller
    from roadproof.datatypes import PAPER_WEATHERS
    from roadproof.driving.evaluate import evaluate as run
    from roadproof.driving.evaluate import random_patterns
    from roadproof.driving.starts import StartRange
    from roadproof.patterns import read_paint
    from roadproof.pipeline.fidelity import measure_fidelity
    from roadproof.pipeline.film import film_drives
    from roadproof.pipeline.workload import of_evaluation
    from roadproof.pipeline.worlds import open_world
    from roadproof.recorded.simulator import check_recorded_canvas
    from roadproof.recordings import load_recordings

    where = world_asked(simulator, device, controller, scenario, scenarios)
    skies = PAPER_WEATHERS if where.recorded is None else (where.recorded.weather,)
    if weathers is not None:
        skies = options.weathers_of(weathers, "weathers")
    if where.recorded is not None:
        _check_recorded(where.recorded, skies, recordings, runs=runs, cars=cars, pedestrians=pedestrians)
        runs = cars = pedestrians = 0
    else:
        options.check_processes(simulator, processes)
    begun = StartRange(**dict(zip(StartRange.__slots__, start_range, strict=True)))
    figures, paint = _figures(pattern, needed=bool(random or recordings)), read_paint(pattern)
    recorded = None if recordings is None else load_recordings(recordings)
    if recorded is not None and recorded.canvas is not None and where.scenario is not None:
        check_recorded_canvas(where.scenario.canvas, recorded.canvas)
    who = options.driver_of(controller, device)
    if recorded is not None and not isinstance(who, Controller):
        raise RoadproofError(f"--recordings compares answers to pictures, but {controller} looks at none; leave it out")
    runs = 10 if runs is None else runs
    cars, pedestrians = (20 if each is None else each for each in (cars, pedestrians))
    if runs and not cars + pedestrians:
        raise RoadproofError(f"--runs is {runs}, but --cars and --pedestrians are 0; ask for some, or for 0 runs")
    spent = of_evaluation(len(skies), starts, runs, random=random, film=film, processes=processes)
    begin(replace(spent, drives=0) if where.recorded is not None else spent, out)
    before = _shown_in(out)
    of_other_paint = before[1:] != (paint.tobytes(),)
    with where.open() as (world, driven):
        with stages() as show:

            def tell(done: int, total: int) -> None:
                if of_other_paint:
                    # Not before anything is refused, and not after the drives: an interruption would leave them beside
                    # the results of this paint.
                    _forget_pictures(out)
                show(f"Driving {driven.name}", done, total, "drives")

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
                runs=runs,
                cars=cars,
                pedestrians=pedestrians,
                seed=seed,
                baseline=random_patterns(figures, random, seed=seed) if figures is not None and random else (),
                processes=processes,
                on_drive=tell,
            )
        if _shown_in(out) != before:
            _forget_pictures(out)
        if film:
            shown = evaluation.shown()
            film_drives(world, shown.start.of(driven), (shown.clean, shown.painted), paint, out)
        fidelity = None
        if recorded is not None and figures is not None and isinstance(who, Controller):
            light = _light_of(recorded, skies[0])
            fidelity = measure_fidelity(world, who, driven, figures, recorded, out, weather=light, device=device)
    keep_command(out)
    _summarise(evaluation, fidelity, out, compared=recorded is not None)
    surrogate = {} if fidelity is None else {"surrogate": {"agreement": asdict(fidelity.agreement)}}
    answer(stored(out / "evaluation.json") | surrogate)


def _light_of(recorded: RecordingSet, otherwise: Weather) -> Weather:
    """The weather that a set's clean drive was recorded in; another where it does not say."""
    from roadproof.datatypes import Weather

    drive = recorded.clean
    return Weather(drive.weather) if drive is not None and drive.weather in {*Weather} else otherwise


def _shown_in(out: Path) -> tuple[object, ...]:
    """The drives and the paint of an evaluation, which the pictures beside it show; nothing without one."""
    from roadproof.driving.evaluation import Evaluation, load_paint

    try:
        return Evaluation.load(out).trials, load_paint(out).tobytes()
    except RoadproofError:
        return ()


def _forget_pictures(out: Path) -> None:
    """Take away the film and the composites beside an evaluation, which are of other drives."""
    from roadproof.pipeline.fidelity import FIDELITY
    from roadproof.pipeline.film import forget_film

    forget_film(out)
    (out / FIDELITY).unlink(missing_ok=True)


def _figures(pattern: Path, *, needed: bool) -> Pattern | None:
    """The figures of a pattern; None of a picture, which is refused where figures are needed."""
    from roadproof.patterns import load_pattern

    if pattern.suffix == ".json":
        return load_pattern(pattern)
    if needed:
        raise PatternError(f"{pattern} is a picture; --random and --recordings need the pattern.json of an attack")
    return None


def _check_recorded(
    recorded: Recorded, weathers: tuple[Weather, ...], recordings: Path | None, **others: int | None
) -> None:
    """Refuse what recordings cannot give, before anything is driven: other weathers, traffic, renders."""
    if other := [weather for weather in weathers if weather != recorded.weather]:
        raise RoadproofError(
            f"--weathers has {other[0]}, but the recordings have the light of {recorded.weather}; leave it out"
        )
    for name, count in others.items():
        if count:
            raise RoadproofError(f"--{name} is {count}, but recordings hold no others on the road; expected 0")
    if recordings is not None:
        raise RoadproofError("--recordings compares with what a simulator renders; nothing is rendered in recordings")


def _summarise(evaluation: Evaluation, fidelity: Fidelity | None, out: Path, *, compared: bool) -> None:
    from roadproof.report.formatting import UNKNOWN, mean_in_words

    rows = evaluation.rows()
    several = len({row.pattern for row in rows}) > 1
    # Most paint turns a car and leaves its speed alone: then there is nothing to say of it.
    faster = any(abs(row.speed_change_mps.value) > _TOLD_MPS for row in rows if row.speed_change_mps is not None)
    columns, title = ("drives", "deviation m", "aside m", "left lane", "points", "clean"), None
    if evaluation.predicted:
        columns = ("drives", "predicted m", "aside m", "left lane", "infractions")
        title = "Predicted: composited into recorded frames, nothing was driven for real"
    note = "deviation: median (least–most); aside: furthest; clean: points on the bare road"
    if faster:
        speed = "predicted m/s" if evaluation.predicted else "speed m/s"
        columns, note = (*columns[:3], speed, *columns[3:]), f"{note}; m/s: mean change of speed, negative = slower"
    if evaluation.left_out:
        note = f"{note}; {evaluation.left_out} left out: without paint the car did not come to the canvas"
    shown = table((*(["pattern"] if several else []), "weather", "with"), columns, title=title, note=note)
    for row in rows:
        points = [
            mean_in_words(row.points, 1),
            UNKNOWN if row.clean_points is None else f"{row.clean_points.value:.1f}",
        ]
        shown.add_row(
            *([row.pattern] if several else []),
            row.weather or "all",
            "traffic" if row.traffic else "nobody",
            str(row.count),
            row.metres,
            mean_in_words(row.lateral_m, 2),
            *([mean_in_words(row.speed_change_mps, 2)] if faster else []),
            f"{row.left_lane:.0%}",
            *([UNKNOWN] if row.failed is None else points),
        )
    say(shown)
    if fidelity is not None:
        found = fidelity.agreement
        say(
            f"Surrogate on {found.frames} frames of {fidelity.drive}: {found.paint_error:.1f} of 255 levels off in the "
            f"paint, steering shift {found.predicted_shift:+.3f} composited, {found.rendered_shift:+.3f} rendered"
        )
    elif compared:
        say("Composites were not compared with renders: the recordings are of another drive, or show none of the paint")
    say(
        f"{evaluation.drives} {'predicted ' if evaluation.predicted else ''}drives, paint {evaluation.paint}, "
        f"{evaluation.seconds:.0f} s; results in {out}: evaluation.json, episodes"
    )
