"""`roadproof study`: many scenarios, figures and methods compared, and what came of it as tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

study = typer.Typer(no_args_is_help=True, add_completion=False, help="Compare methods over many scenarios.")


@study.callback()
def _root() -> None:  # pyright: ignore[reportUnusedFunction]  # keeps a single command a subcommand
    pass


@study.command()
def tables(
    folder: Annotated[Path, typer.Argument(help="Of the study, with its rows.parquet.", show_default=False)],
    out: Annotated[
        Path | None, typer.Option(help="Where tables and figures go; else DIR/tables.", show_default=False)
    ] = None,
) -> None:
    """Make a study's tables and figures: tables.html, tables.md, a .tex of each table, figures as PNG."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from rich.console import Console

    from roadproof.report.study.page import write_study
    from roadproof.study.rows import read_table, records

    rows, transfer = records(read_table(folder)), []
    if (folder / "transfer.parquet").exists():
        driven = read_table(folder, "transfer.parquet")
        transfer = records(driven.rename(columns={"controller": "driven_by"}))
    page = write_study(rows, folder, out or folder / "tables", transfer)
    console = Console(soft_wrap=True, highlight=False, markup=False)
    console.print(f"The tables are {page}, as Markdown and LaTeX beside it; figures in {page.parent / 'figures'}")
