"""`roadproof drive`: one scenario driven; its film and its episode out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from roadproof.cli import options
from roadproof.cli.options import unset
from roadproof.cli.output import answer, say
from roadproof.cli.worlds import world_asked

if TYPE_CHECKING:
    from roadproof.datatypes import Control, Observation
    from roadproof.driving.drive_store import AnyDriver
    from roadproof.driving.episode import Episode


def drive(
    scenario: options.ScenarioOrRecorded = None,
    scenarios: options.ScenarioFile = None,
    driver: options.DriverSpec = "expert",
    weather: Annotated[
        str | None,
        unset(
            "One of the eight, for instance rainy-noon.",
            options.weather_names,
            default="clear-noon, or that of the recordings",
        ),
    ] = None,
    pattern: Annotated[
        Path | None, unset("pattern.json of an attack, or a 400×400 picture, painted on the road.")
    ] = None,
    cars: options.Cars = 0,
    pedestrians: options.Pedestrians = 0,
    seed: options.Seed = 0,
    simulator: options.WorldSpec = "town",
    device: options.Device = "cpu",
    out: options.NewOut = Path("out/drive"),
) -> None:
    """Drive a scenario and film it."""
    from roadproof.cli.progress import progress
    from roadproof.datatypes import Weather
    from roadproof.driving.episode import Episode
    from roadproof.driving.evaluation import kind_of
    from roadproof.driving.rollout import rollout
    from roadproof.io.locks import hold
    from roadproof.patterns import read_paint

    where = world_asked(simulator, device, driver, scenario, scenarios)
    light = Weather.CLEAR_NOON if where.recorded is None else where.recorded.weather
    sky = light if weather is None else options.weather_of(weather)
    paint = None if pattern is None else read_paint(pattern)
    hold(out)
    who: AnyDriver = options.driver_of(driver, device)

    # Matplotlib draws the film's map.
    from roadproof.report.drive_film import film_drive, length_m

    with where.open() as (world, driven), film_drive(out / "drive.mp4", world, driven, paint) as film:
        gone_m, whole_m = 0.0, round(length_m(world, driven))
        with progress(f"Driving {driven.name}", whole_m, "m, {:.0f} km/h") as show:

            def on_step(seen: Observation, control: Control | None) -> None:
                nonlocal gone_m
                film(seen, control)
                gone_m += abs(seen.state.speed_mps) * world.dt_s
                show(round(gone_m), 3.6 * seen.state.speed_mps)

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
    answer(Episode.FILE.document(episode, kind=kind_of(episode.paint)))


def _summarise(episode: Episode, out: Path) -> None:
    road = f"painted road ({episode.paint})" if episode.painted else "bare road"
    events = f"{len(episode.events) or 'no'} event{'' if len(episode.events) == 1 else 's'}"
    if episode.paint.predicted:
        events = "predicted: nothing was driven for real, and infractions are not known"
    say(
        f"{episode.scenario}, {episode.weather}, {road}, {episode.cars} cars, {episode.pedestrians} pedestrians: "
        f"{episode.ending} after {episode.time_s[-1]:.1f} s, {events}",
        *(f"  {event.time_s:5.1f} s  {event.kind}  {event.detail}" for event in episode.events),
        f"Results in {out}: drive.mp4, episode.npz",
    )
