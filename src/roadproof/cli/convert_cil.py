"""`roadproof convert-cil`: the published CIL checkpoint, as weights that every verb loads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from roadproof.cli.options import argument


def convert_cil(
    checkpoint: Annotated[
        Path,
        argument(
            "An .npz file with one array a TensorFlow variable, or, with TensorFlow, a checkpoint's name without "
            ".index."
        ),
    ],
    out: Annotated[Path, argument(".safetensors file to write.")],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")] = False,
) -> None:
    """Convert the checkpoint of CARLA's imitation learning agent, which the paper attacks, to weights."""
    from roadproof.controllers import convert_cil as convert

    convert(checkpoint, out, overwrite=overwrite)
    typer.echo(f"Controller in {out}; see whether it keeps its promises with: roadproof check-controller {out}")
