"""`roadproof compare`: run folders in, one page that shows them beside each other out."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from roadproof.cli.options import argument
from roadproof.cli.output import answer, say, table

if TYPE_CHECKING:
    from roadproof.report.comparison import Compared


def compare(
    folders: Annotated[
        list[Path], argument("Two runs or more, such as before and after a fix; the first is compared with.")
    ],
    out: Annotated[Path, typer.Option(help="File for the page.")] = Path("out/compare.html"),
) -> None:
    """Compare runs: one page with their numbers, paths and patterns side by side."""
    from roadproof.report.comparison import write_comparison
    from roadproof.report.formatting import mean_in_words

    runs = write_comparison(folders, out)
    kinds = sorted({each.predicted for each in runs})
    words = ("predicted" if kind else "driven" for kind in kinds)
    names = (name for word in words for name in (f"{word} m", f"leaves lane, {word}"))
    shown = table(("run", "controller", "scenario"), (*names, "change m"))
    for each in runs:
        own = (each.whole.metres, f"{each.whole.left_lane:.0%}")
        numbers = (number for kind in kinds for number in (own if kind == each.predicted else ("", "")))
        evaluation = each.judged.evaluation
        shown.add_row(
            each.name, evaluation.controller, evaluation.scenario.name, *numbers, mean_in_words(each.change, 2)
        )
    say(shown, f"The page is {out}")
    answer({"runs": [_answer(each) for each in runs]})


def _answer(run: Compared) -> dict[str, object]:
    """The verdict of a run, and its drives alone on the road, each weather's and all together, as result.json has
    them: under another key where they are predicted."""  # noqa: D205, D209
    evaluation = run.judged.evaluation
    return {
        "name": run.name,
        "controller": evaluation.controller,
        "scenario": evaluation.scenario.name,
        "verdict": asdict(run.verdict),
        "predicted" if run.predicted else "closed_loop": {
            "rows": [asdict(row) for row in run.alone.values()],
            "change_m": run.change and asdict(run.change),
        },
    }
