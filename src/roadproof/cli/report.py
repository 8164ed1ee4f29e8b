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
    from roadproof.report.page import write_report

    page = write_report(folder)
    numbers = page.with_name("result.json")
    result = stored(numbers)
    say(result["verdict"]["sentence"])
    say(f"The report is {page}, its numbers are in {numbers}")
    answer(result)
