"""`roadproof drive`: one scenario driven; its film and its episode out."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli.options import (
    Device,
    DriverSpec,
    ScenarioFile,
    ScenarioName,
    SimulatorSpec,
    WeatherName,
    choice,
    driver_of,
)

if TYPE_CHECKING:
    from roadproof.datatypes import Control, Observation
    from roadproof.report.video import DriveVideo
    from roadproof.rollout import Episode, OnStep
    from roadproof.simulators.loading import MappedSimulator


def drive(
    scenario: ScenarioName = "left-03",
    scenarios: ScenarioFile = None,
    driver: DriverSpec = "expert",
    weather: WeatherName = "clear-noon",
    pattern: Annotated[
        Path | None,
        typer.Option(help="pattern.json of an attack, or a 400×400 picture, painted on the road.", show_default=False),
    ] = None,
    cars: Annotated[int, typer.Option(help="Other cars on the road.")] = 0,
    pedestrians: Annotated[int, typer.Option(help="People about.")] = 0,
    seed: Annotated[int, typer.Option(help="Of the other cars and the people.")] = 0,
    simulator: SimulatorSpec = "town",
    device: Device = "cpu",
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/drive"),
) -> None:
    """Drive a scenario and film it."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from roadproof.datatypes import Weather
    from roadproof.files import check_writable
    from roadproof.patterns import read_paint
    from roadproof.rollout import rollout
    from roadproof.scenarios import BUILTIN_FILE, find_scenario, load_scenarios
    from roadproof.simulators.loading import open_simulator
    from roadproof.simulators.town.maps import scenario_route

    driven = find_scenario(scenario, load_scenarios(scenarios or BUILTIN_FILE))
    sky = Weather(choice(weather, "weather", tuple(Weather)))
    paint = None if pattern is None else read_paint(pattern)
    check_writable(out)
    who = driver_of(driver, device)

    # PyAV is an extra.
    from roadproof.report.video import DriveVideo

    with ExitStack() as stack:
        world = stack.enter_context(open_simulator(simulator))
        roads = world.road_map(driven.map_name)
        route = scenario_route(driven, roads)
        film = stack.enter_context(
            DriveVideo(
                out / "drive.mp4", roads=roads, route=route, canvas=driven.canvas, pattern=paint, dt_s=world.dt_s
            )
        )
        on_step = stack.enter_context(_watched(world, film, f"Driving {driven.name}", route.length_m))
        episode = rollout(
            world,
            who,
            driven,
            weather=sky,
            pattern=paint,
            cars=cars,
            pedestrians=pedestrians,
            seed=seed,
            full_pictures=True,
            on_step=on_step,
        )
    episode.save(out / "episode.npz")
    _summarise(episode, out)


@contextmanager
def _watched(world: MappedSimulator, film: DriveVideo, title: str, length_m: float) -> Generator[OnStep]:
    """Films every step and shows how far the car is."""
    import numpy as np

    from roadproof.cli.progress import progress
    from roadproof.datatypes import Control

    at_m = 0.0

    def on_step(seen: Observation, control: Control | None) -> None:
        nonlocal at_m
        others, people = (np.column_stack([agents.x_m, agents.y_m]) for agents in (world.cars, world.pedestrians))
        film.add(seen, Control(0.0) if control is None else control, cars=others, people=people)
        at_m = world.route.locate(seen.state.x_m, seen.state.y_m, at_m).arclength_m
        show(round(at_m), 3.6 * seen.state.speed_mps)

    with progress(title, round(length_m), "m, {:.0f} km/h") as show:
        yield on_step


def _summarise(episode: Episode, out: Path) -> None:
    from rich.console import Console

    say = Console(soft_wrap=True, highlight=False, markup=False).print
    road = f"painted road ({episode.paint})" if episode.painted else "bare road"
    say(
        f"{episode.scenario}, {episode.weather}, {road}, {episode.cars} cars, {episode.pedestrians} pedestrians: "
        f"{episode.ending} after {episode.time_s[-1]:.1f} s, {len(episode.events) or 'no'} event"
        f"{'' if len(episode.events) == 1 else 's'}"
    )
    for event in episode.events:
        say(f"  {event.time_s:5.1f} s  {event.kind}  {event.detail}")
    say(f"Results in {out}: drive.mp4, episode.npz")
