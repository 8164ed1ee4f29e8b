"""What verbs can be told besides: how loud they are, to print JSON, to only estimate; and the options on paint."""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args, get_type_hints

import typer

from roadproof.cli.group import words_given
from roadproof.cli.output import answer, in_json, say
from roadproof.cli.paint import OPTIONS, with_paint
from roadproof.cli.progress import Loudness, duration_in_words, is_quiet, speak, tell
from roadproof.errors import RoadproofError
from roadproof.io.commands import write_command
from roadproof.io.locks import hold
from roadproof.io.text import count_of

if TYPE_CHECKING:
    from roadproof.pipeline.workload import Workload

SHORT_S = 180.0
"""What takes longer is said before it begins."""

_Quiet = Annotated[bool, typer.Option("--quiet", help="Say nothing but results and errors.")]
_Verbose = Annotated[bool, typer.Option("--verbose", help="A line for every step.")]
_DryRun = Annotated[
    bool, typer.Option("--dry-run", help="Only estimate drives, time and disk; nothing is driven or written.")
]
_Json = Annotated[
    bool, typer.Option("--json", help="Print the results as one JSON document, all else on standard error.")
]
_LOUD = frozenset({"--quiet", "--verbose", "--json"})
_dry_run = False  # one command a process


def verb(
    function: Callable[..., None], *, works: bool = True, estimates: bool = False, answers: bool = True
) -> Callable[..., None]:
    """A verb with the options that its kind of work asks for; those on paint come where it takes `paint`.

    Args:
        function: the function that does the verb's work.
        works: whether the verb works long, and so takes --quiet and --verbose.
        estimates: whether the verb calls `begin`, and so takes --dry-run.
        answers: whether the verb calls `answer`, and so takes --json.
    """
    own = inspect.signature(function)
    searches = "paint" in own.parameters

    @functools.wraps(function)
    def called(
        *,
        quiet: bool = False,
        verbose: bool = False,
        dry_run: bool = False,
        json: bool = False,
        **given: Any,  # noqa: ANN401
    ) -> None:
        global _dry_run
        if quiet and verbose:
            raise RoadproofError("both --quiet and --verbose are given; choose one")
        # What only lists its results has nothing else to say.
        quiet = quiet or (json and not works)
        speak(Loudness.QUIET if quiet else Loudness.VERBOSE if verbose else Loudness.USUAL)
        _dry_run = dry_run
        try:
            with in_json() if json else nullcontext():
                function(**(with_paint(given) if searches else given))
        finally:
            _dry_run = False
            speak(Loudness.USUAL)

    more = dict(OPTIONS) if searches else {}
    more |= {"quiet": _Quiet, "verbose": _Verbose} if works else {}
    more |= ({"dry_run": _DryRun} if estimates else {}) | ({"json": _Json} if answers else {})
    hints = get_type_hints(function, include_extras=True) | more
    parameters = [each.replace(annotation=hints[name]) for name, each in own.parameters.items() if name not in more]
    parameters += [
        inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=False if get_args(kind)[0] is bool else None,
            annotation=kind,
        )
        for name, kind in more.items()
    ]
    called.__annotations__ = hints
    called.__dict__["__signature__"] = own.replace(parameters=parameters)
    return called


def is_dry_run() -> bool:
    """Whether nothing is to be driven or written."""
    return _dry_run


def begin(work: Workload, *folders: Path) -> None:
    """Work in folders until the command ends, and say what that takes where it takes long; a dry run ends here.

    Args:
        work: all the work, also what the folders may hold already.
        folders: the folders for results.

    Raises:
        OutputError: a folder cannot be written, or another process works in it.
    """
    parts = [count_of(work.drives, "drive")] if work.drives else []
    told = f"{', '.join((*parts, f'about {duration_in_words(work.seconds)}', f'{work.megabytes:.0f} MB on the disk'))}"
    if _dry_run:
        say(f"{told}; less where the folder holds some of it already ({work.basis})")
        answer(asdict(work))
        raise typer.Exit
    for folder in folders:
        hold(folder)
    if work.seconds > SHORT_S and not is_quiet():
        less = ", less what is done already" if any(any(folder.iterdir()) for folder in folders) else ""
        tell(f"This takes {told}{less}; when it is interrupted, the same command goes on")


def keep_command(folder: Path) -> None:
    """Keep the command that is being carried out beside what it made, for the report.

    How much it said is left out, and so is where a server stood, which is nobody's to keep.
    """
    kept = [
        re.sub(r"^((?:--simulator=)?)carla://[^?]*", r"\1carla://HOST:PORT", word)
        for word in words_given()
        if word not in _LOUD
    ]
    write_command(folder, kept)
