"""`roadproof open`: the newest page of a folder, in the browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from roadproof.cli.output import say
from roadproof.errors import RoadproofError

PAGES = ("report.html", "compare.html", "hardening.html", "tables.html")


def open_(
    folder: Annotated[Path, typer.Argument(help="A run, a study, a hardening, or a folder of such.")] = Path("out"),
) -> None:
    """Show the newest page in a folder: of a run, a comparison, a hardening or a study."""
    if not folder.is_dir():
        raise RoadproofError(f"no folder {folder}; expected one in which a command left a page")
    found = [page for name in PAGES for depth in ("", "*/", "*/*/") for page in folder.glob(f"{depth}{name}")]
    if not found:
        raise RoadproofError(f"{folder} has no {', '.join(PAGES)} in it; make one with `roadproof demo` or `report`")
    page = max(found, key=lambda each: each.stat().st_mtime)
    say(str(page))
    webbrowser.open(page.resolve().as_uri())
