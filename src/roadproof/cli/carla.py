"""`roadproof carla`: the town for CARLA's clients."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

carla = typer.Typer(no_args_is_help=True, add_completion=False, help="Serve the town to CARLA's clients.")


@carla.callback()
def _root() -> None: ...  # pyright: ignore[reportUnusedFunction]


@carla.command()
def serve(
    port: Annotated[int, typer.Option(help="Port of the calls; sensor data goes through the next.")] = 2000,
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    map_file: Annotated[
        list[Path] | None, typer.Option("--map", help="OpenDRIVE file to offer besides town and second.")
    ] = None,
    first: Annotated[
        str | None, typer.Option(help="Map at the start; else the first of --map, or town.", show_default=False)
    ] = None,
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
        ready=lambda: typer.echo(f"Serving CARLA's protocol on {host}:{port} and {port + 1}; end with Ctrl+C"),
    )
