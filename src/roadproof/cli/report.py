"""`roadproof report`: a run folder in, one page that shows it out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from roadproof.cli.options import argument
from roadproof.cli.output import answer, say, stored


def report(
    folder: Annotated[Path, argument("Of a run: record, recordings, attack, evaluation.")],
) -> None:
    """Show a run as one self-contained page, report.html, and its numbers as result.json."""
    # Torch takes seconds to import; `--help` and mistakes in the options should not.
    from roadproof.report.page import write_report
    from roadproof.report.run import read_run
    from roadproof.report.verdict import verdict

    page = write_report(folder)
    say(verdict(read_run(folder)).sentence)
    say(f"The report is {page}, its numbers are in {page.with_name('result.json')}")
    answer(stored(page.with_name("result.json")))
