"""`roadproof drive`: one scenario driven; its film and its episode out."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli.options import (
    Cars,
    Device,
    DriverSpec,
    Pedestrians,
    ScenarioFile,
    ScenarioOrRecorded,
    WorldSpec,
    choice,
    driver_of,
    number,
)
from roadproof.cli.worlds import check_driver, open_world, recorded_in, scenario_asked, stretch_of
from roadproof.limits import MAX_SEED

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from roadproof.datatypes import Control, Observation
    from roadproof.driving.drive_store import AnyDriver
    from roadproof.driving.episode import Episode
    from roadproof.driving.rollout import OnStep
    from roadproof.recorded.simulator import RecordedSimulator
    from roadproof.report.video import DriveVideo
    from roadproof.roads.roadmap import RoadMap
    from roadproof.scenarios import Scenario
    from roadproof.simulators.loading import MappedSimulator


def drive(
    scenario: ScenarioOrRecorded = None,
    scenarios: ScenarioFile = None,
    driver: DriverSpec = "expert",
    weather: Annotated[
        str | None,
        typer.Option(
            help="One of the eight, for instance rainy-noon; clear-noon by default, or that of the recordings.",
            show_default=False,
        ),
    ] = None,
    pattern: Annotated[
        Path | None,
        typer.Option(help="pattern.json of an attack, or a 400×400 picture, painted on the road.", show_default=False),
    ] = None,
    cars: Cars = 0,
    pedestrians: Pedestrians = 0,
    seed: Annotated[int, number("Of the other cars and the people.", 0, MAX_SEED)] = 0,
    simulator: WorldSpec = "town",
    device: Device = "cpu",
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("out/drive"),
) -> None:
    """Drive a scenario and film it."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from roadproof.datatypes import Weather
    from roadproof.driving.rollout import rollout
    from roadproof.io.locks import hold
    from roadproof.patterns import read_paint

    inside = recorded_in(simulator)
    asked = scenario_asked(inside, scenario, scenarios)
    sky = Weather.CLEAR_NOON if inside is None else inside.weather
    if weather is not None:
        sky = Weather(choice(weather, "weather", tuple(Weather)))
    if inside is not None:
        check_driver(driver)
    paint = None if pattern is None else read_paint(pattern)
    hold(out)
    who: AnyDriver = driver_of(driver, device)

    # PyAV is an extra.
    from roadproof.report.video import DriveVideo

    with ExitStack() as stack:
        world = stack.enter_context(open_world(simulator, device))
        driven = stretch_of(world, asked)
        roads, way = _map_of(world, driven)
        film = stack.enter_context(
            DriveVideo(out / "drive.mp4", roads=roads, way=way, canvas=driven.canvas, pattern=paint, dt_s=world.dt_s)
        )
        on_step = stack.enter_context(_watched(world, film, f"Driving {driven.name}", way))
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


def _map_of(
    world: MappedSimulator | RecordedSimulator, scenario: Scenario
) -> tuple[RoadMap | None, Float[np.ndarray, "n 2"]]:
    """The roads, where they are known, and world x, y of the way from start to goal."""
    from roadproof.recorded.simulator import RecordedSimulator
    from roadproof.roads.maps import scenario_route

    if isinstance(world, RecordedSimulator):
        return None, world.way
    roads = world.road_map(scenario.map_name)
    return roads, scenario_route(scenario, roads).points[:, :2]


@contextmanager
def _watched(
    world: MappedSimulator | RecordedSimulator, film: DriveVideo, title: str, way: Float[np.ndarray, "n 2"]
) -> Generator[OnStep]:
    """Films every step and shows how far the car has driven."""
    import numpy as np

    from roadproof.cli.progress import progress
    from roadproof.datatypes import Control
    from roadproof.recorded.simulator import RecordedSimulator

    driven_m = 0.0

    def on_step(seen: Observation, control: Control | None) -> None:
        nonlocal driven_m
        around = () if isinstance(world, RecordedSimulator) else (world.cars, world.pedestrians)
        others = [np.column_stack([agents.x_m, agents.y_m]) for agents in around]
        film.add(seen, Control(0.0) if control is None else control, *others)
        driven_m += abs(seen.state.speed_mps) * world.dt_s
        show(round(driven_m), 3.6 * seen.state.speed_mps)

    with progress(title, round(np.hypot(*np.diff(way, axis=0).T).sum()), "m, {:.0f} km/h") as show:
        yield on_step


def _summarise(episode: Episode, out: Path) -> None:
    from rich.console import Console

    say = Console(soft_wrap=True, highlight=False, markup=False).print
    road = f"painted road ({episode.paint})" if episode.painted else "bare road"
    events = f"{len(episode.events) or 'no'} event{'' if len(episode.events) == 1 else 's'}"
    if episode.paint.predicted:
        events = "predicted: nothing was driven for real, and infractions are not known"
    say(
        f"{episode.scenario}, {episode.weather}, {road}, {episode.cars} cars, {episode.pedestrians} pedestrians: "
        f"{episode.ending} after {episode.time_s[-1]:.1f} s, {events}"
    )
    for event in episode.events:
        say(f"  {event.time_s:5.1f} s  {event.kind}  {event.detail}")
    say(f"Results in {out}: drive.mp4, episode.npz")
