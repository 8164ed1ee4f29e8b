"""`roadproof check-controller`: does a controller keep its promises, and does it drive?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from roadproof.cli import options
from roadproof.cli.options import argument
from roadproof.cli.output import answer, say

if TYPE_CHECKING:
    from roadproof.datatypes import Weather
    from roadproof.scenarios import Scenario
    from roadproof.training.scores import BareDrive, DrivingScore


def check_controller(
    spec: Annotated[str, argument(f"What is checked: {options.CONTROLLERS}")],
    scenarios: options.ScenarioFile = None,
    weather: options.WeatherName = "clear-noon",
    cars: options.Cars = 0,
    pedestrians: options.Pedestrians = 0,
    processes: options.Processes = 0,
    drive: Annotated[bool, typer.Option(help="Also drive the scenarios.")] = True,
) -> None:
    """Check what attacks rely on, then drive every scenario and count those without any event."""
    from roadproof.controllers import check_controller as check
    from roadproof.controllers import load_controller
    from roadproof.controllers.checks import DRIVES

    sky, driven = options.weather_of(weather), options.scenarios_of(scenarios)
    controller = load_controller(spec)
    report = check(controller, size=controller.input_size or (88, 200))
    say(*map(str, report.checks))
    acts = any(check.name == DRIVES and check.passed for check in report.checks)
    if drive and not acts:
        typer.echo("not driven: act does not answer as a drive needs it", err=True)
    found: dict[str, Any] = {"controller": spec, "passed": report.passed, "checks": report.checks, "drives": None}
    if drive and acts:
        found["drives"] = _driven(spec, driven, sky, cars, pedestrians, processes)
    answer(found)
    if not report.passed:
        raise typer.Exit(1)


def _driven(
    spec: str, scenarios: Sequence[Scenario], sky: Weather, cars: int, pedestrians: int, processes: int
) -> list[dict[str, Any]]:
    """Drive, say how it went, and tell what came of each scenario."""
    from roadproof.cli.progress import progress
    from roadproof.training.scores import BareDrive, score_drives  # needs Panda3D, which is an extra

    wanted = [BareDrive(scenario=s, weather=sky, cars=cars, pedestrians=pedestrians) for s in scenarios]
    scored: list[tuple[BareDrive, DrivingScore]] = []
    with progress("Driving", len(wanted), "{:.0f} clean") as show:
        for done in score_drives(wanted, spec, processes=processes):
            scored.append(done)
            show(len(scored), sum(score.clean for _, score in scored))
    scored.sort(key=lambda pair: pair[0].scenario.name)
    _say_scores(scored)
    told = {"weather": sky, "cars": cars, "pedestrians": pedestrians}
    return [{"scenario": each.scenario.name, **told, "clean": s.clean, **asdict(s)} for each, s in scored]


def _say_scores(scored: list[tuple[BareDrive, DrivingScore]]) -> None:
    scores = [score for _, score in scored]
    clean, turns = sum(score.clean for score in scores), sum(score.turns for score in scores)
    say(
        f"{clean} of {len(scores)} scenarios clean; {sum(s.collisions for s in scores)} collisions; "
        f"{sum(s.mean_lateral_m for s in scores) / len(scores):.2f} m off the lane's middle on average; "
        f"steering changes by {sum(s.steer_change for s in scores) / len(scores):.4f} a step; "
        f"{sum(s.turns_taken for s in scores)} of {turns} junctions left as commanded"
    )
    for drive, score in scored:
        if not score.clean:
            what = ", ".join(f"{e.kind} at {e.time_s:.1f} s" for e in score.events) or "did not arrive"
            x, y = score.failed_at_m or (0.0, 0.0)
            say(f"  {drive.scenario.name}: {what}, near ({x:.0f}, {y:.0f})")
