"""`roadproof train`: a controller from nothing, or from another one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from roadproof.cli.options import Device, Out, Processes, Seed, number, unset
from roadproof.cli.output import say
from roadproof.limits import LEAST_WIDTH, MANY, MOST_WIDTH


def train(
    out: Out = Path("out/train"),
    network: Annotated[str, typer.Option(help="cil, pilotnet, waypoint or temporal.")] = "cil",
    width: Annotated[float, number("CIL: factor on channels and units.", LEAST_WIDTH, MOST_WIDTH)] = 1.0,
    start: Annotated[
        str | None, unset("Weights file or shipped controller to go on from.", default="fresh weights")
    ] = None,
    drives: Annotated[int, number("Drives of the expert.", 1, MANY)] = 260,
    painted_drives: Annotated[
        int, number("Drives of the expert besides, four in five over random paint.", 0, MANY)
    ] = 0,
    pasted: Annotated[float, number("Share of the pictures with rectangles pasted on the road.", 0.0, 1.0)] = 0.0,
    samples: Annotated[int, number("Frames seen in the first training.", 1, 10**9)] = 200_000,
    learning_rate: Annotated[float, number("The largest of the first training.", 1e-9, 10.0)] = 1.2e-3,
    rounds: Annotated[int, number("Rounds in which the network drives and the expert answers.", 0, 1000)] = 0,
    round_drives: Annotated[int, number("Drives of each round.", 1, MANY)] = 100,
    round_samples: Annotated[int, number("Frames seen in the training after each round.", 1, 10**9)] = 100_000,
    seed: Seed = 0,
    device: Device = "cpu",
    processes: Processes = 0,
    collect_only: Annotated[bool, typer.Option("--collect-only", help="Stop before learning.")] = False,
) -> None:
    """Collect drives, learn from them, let the network drive, learn from that; goes on where it was interrupted."""
    from roadproof.cli.progress import stages
    from roadproof.io.locks import hold
    from roadproof.training.recipe import Recipe, follow, gather

    recipe = Recipe(
        network=network,
        width=width,
        seed=seed,
        start=start,
        drives=drives,
        painted_drives=painted_drives,
        pasted=pasted,
        samples=samples,
        learning_rate=learning_rate,
        rounds=rounds,
        round_drives=round_drives,
        round_samples=round_samples,
    )
    hold(out)
    with stages() as on_stage:
        if collect_only:
            shards = gather(recipe, out, processes=processes, on_stage=on_stage)
            say(f"{len(shards)} drives in {out / 'drives'}; give the same command without --collect-only to learn")
            return
        weights = follow(recipe, out, processes=processes, device=device, on_stage=on_stage)
    say(f"Controller in {weights}; see how it drives with: roadproof check-controller {weights}")
