"""`roadproof convert-cil`: the published CIL checkpoint, as weights that every verb loads."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def convert_cil(
    checkpoint: Annotated[
        Path,
        typer.Argument(
            help="An .npz file with one array a TensorFlow variable, or, with TensorFlow, a checkpoint's name without "
            ".index.",
            show_default=False,
        ),
    ],
    out: Annotated[Path, typer.Argument(help=".safetensors file to write.", show_default=False)],
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")] = False,
) -> None:
    """Convert the checkpoint of CARLA's imitation learning agent, which the paper attacks, to weights."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from roadproof.controllers import convert_cil as convert

    convert(checkpoint, out, overwrite=overwrite)
    typer.echo(f"Controller in {out}; see whether it keeps its promises with: roadproof check-controller {out}")
