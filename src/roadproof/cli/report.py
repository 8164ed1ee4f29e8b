"""`roadproof report`: a run folder in, one page that shows it out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def report(
    folder: Annotated[
        Path, typer.Argument(help="Of a run: record, recordings, attack, evaluation.", show_default=False)
    ],
) -> None:
    """Show a run as one self-contained page, report.html, and its numbers as result.json."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from rich.console import Console

    from roadproof.report.page import write_report
    from roadproof.report.run import read_run
    from roadproof.report.verdict import verdict

    page = write_report(folder)
    console = Console(soft_wrap=True, highlight=False, markup=False)
    console.print(verdict(read_run(folder)).sentence)
    console.print(f"The report is {page}, its numbers are in {page.with_name('result.json')}")
