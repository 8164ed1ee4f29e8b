"""`roadproof carla`: the town for CARLA's clients, and what is good to know about a CARLA server."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from roadproof.cli.group import Verbs
from roadproof.cli.options import number, unset
from roadproof.cli.output import answer, say
from roadproof.cli.verbs import verb

carla = Verbs("CARLA: serve the town as one, examine a server.")

Host = Annotated[str, typer.Option(help="Address of the server.")]
Port = Annotated[int, number("Port of its calls; sensor data goes through the next.", 1, 65534)]


@carla.command()
def serve(
    port: Annotated[
        int, number("Port of its calls; sensor data goes through the next. 0 takes any two that are free.", 0, 65534)
    ] = 2000,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    allow_remote: Annotated[
        bool,
        typer.Option(
            "--allow-remote",
            help="Listen on other addresses than this machine's loopback. There is no password: anyone who reaches the "
            "ports can drive, spawn and destroy actors, and load maps.",
        ),
    ] = False,
    map_file: Annotated[
        list[Path] | None, typer.Option("--map", help="OpenDRIVE file to offer besides town and second.")
    ] = None,
    first: Annotated[str | None, unset("Map at the start; else the first of --map, or town.")] = None,
) -> None:
    """Serve the embedded town to unmodified CARLA 0.9.16 clients, without a GPU."""
    # Panda3D and msgpack are extras.
    from roadproof.simulators.carla_server.server import serve as run

    maps = map_file or []
    chosen = first or (maps[0].stem if maps else "town")
    typer.echo(f"Building {chosen} …")
    run(
        host=host,
        port=port,
        maps=maps,
        first=chosen,
        allow_remote=allow_remote,
        ready=lambda opened: typer.echo(
            f"Serving CARLA's protocol on {host}:{opened} and {opened + 1}; end with Ctrl+C"
        ),
    )
    typer.echo("Ended; all connections and the town are closed")


def doctor(host: Host = "127.0.0.1", port: Port = 2000) -> None:
    """Examine a CARLA server: one page of what works on it and what does not."""
    # CARLA's client is an extra.
    from roadproof.simulators.carla.doctor import examine
    from roadproof.simulators.carla.simulator import CarlaSimulator

    say(f"CARLA server at {host}:{port}")
    report = examine(CarlaSimulator(host, port), lambda check: say(str(check)))
    answer({"server": f"{host}:{port}", "passed": report.passed, "checks": report.checks})
    if not report.passed:
        raise typer.Exit(1)


carla.command()(verb(doctor, works=False))


@carla.command()
def scenario(
    start: Annotated[int, typer.Argument(help="Number of the spawn point where the drive starts.")],
    goal: Annotated[int, typer.Argument(help="Number of the spawn point it leads to.")],
    out: Annotated[Path, typer.Option(help="TOML file for the scenarios.")] = Path("carla.toml"),
    canvas_at_m: Annotated[float, number("From the start to the middle of the canvas.", 0.0, 10_000.0)] = 25.0,
    name: Annotated[str | None, unset("Of the scenario; else MAP-START-GOAL.")] = None,
    map_name: Annotated[
        str | None, typer.Option("--map", help="Map of the server; else the one it has loaded.", show_default=False)
    ] = None,
    host: Host = "127.0.0.1",
    port: Port = 2000,
) -> None:
    """Add a scenario between two spawn points of a CARLA server's map to a list."""
    # CARLA's client is an extra.
    from roadproof.errors import ScenarioError
    from roadproof.scenarios import load_scenarios, save_scenarios
    from roadproof.simulators.carla.places import scenario_between, spawn_places
    from roadproof.simulators.carla.simulator import CarlaSimulator

    for place in (start, goal):
        if place < 0:
            raise ScenarioError(f"spawn point {place} has a number below 0, expected one that the server has")
    listed = load_scenarios(out) if out.exists() else ()
    with CarlaSimulator(host, port) as simulator:
        where = map_name or simulator.session.map_name()
        roads = simulator.road_map(where)
        places = spawn_places(simulator.session)
    for place in (start, goal):
        if not 0 <= place < len(places):
            raise ScenarioError(f"{where} has no spawn point {place}, expected 0 to {len(places) - 1}")
    made = scenario_between(
        roads, where, places[start], places[goal], canvas_at_m=canvas_at_m, name=name or f"{where}-{start}-{goal}"
    )
    save_scenarios([*(known for known in listed if known.name != made.name), made], out)
    typer.echo(f"{made.name}, {made.kind}, in {out}")
