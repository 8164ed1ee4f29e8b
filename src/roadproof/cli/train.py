"""`roadproof train`: a controller from nothing, or from another one."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer


def train(
    out: Annotated[Path, typer.Option(help="Folder of drives, checkpoints and the controller.")] = Path("out/train"),
    network: Annotated[str, typer.Option(help="cil or pilotnet.")] = "cil",
    width: Annotated[float, typer.Option(help="CIL: factor on channels and units.")] = 1.0,
    start: Annotated[
        str | None,
        typer.Option(help="Weights file or shipped controller to go on from; else fresh weights.", show_default=False),
    ] = None,
    drives: Annotated[int, typer.Option(help="Drives of the expert.")] = 260,
    painted_drives: Annotated[int, typer.Option(help="Drives of the expert over random paint, besides.")] = 0,
    pasted: Annotated[float, typer.Option(help="Share of the pictures with rectangles pasted on the road.")] = 0.0,
    samples: Annotated[int, typer.Option(help="Frames seen in the first training.")] = 200_000,
    learning_rate: Annotated[float, typer.Option(help="The largest of the first training.")] = 1.2e-3,
    rounds: Annotated[int, typer.Option(help="Rounds in which the network drives and the expert answers.")] = 0,
    round_drives: Annotated[int, typer.Option(help="Drives of each round.")] = 100,
    round_samples: Annotated[int, typer.Option(help="Frames seen in the training after each round.")] = 100_000,
    seed: Annotated[int, typer.Option(help="Of everything.")] = 0,
    device: Annotated[str, typer.Option(help="What the network learns on: cpu, cuda or cuda:N.")] = "cpu",
    processes: Annotated[int, typer.Option(help="Simulators that drive at once; 0: one a core.")] = 0,
    collect_only: Annotated[bool, typer.Option("--collect-only", help="Stop before learning.")] = False,
) -> None:
    """Collect drives, learn from them, let the network drive, learn from that; goes on where it was interrupted."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from rich.console import Console

    from roadproof.cli.progress import stages
    from roadproof.files import check_writable
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
    check_writable(out)
    at_once = processes or os.cpu_count() or 1
    say = Console(soft_wrap=True, highlight=False, markup=False).print
    with stages() as on_stage:
        if collect_only:
            shards = gather(recipe, out, processes=at_once, on_stage=on_stage)
            say(f"{len(shards)} drives in {out / 'drives'}; give the same command without --collect-only to learn")
            return
        weights = follow(recipe, out, processes=at_once, device=device, on_stage=on_stage)
    say(f"Controller in {weights}; see how it drives with: roadproof check-controller {weights}")
