"""The command line: thin verbs over the public functions, one file a verb.

A `RoadproofError` is one line on standard error and exit code 2, a traceback only with `--debug`.
"""

from __future__ import annotations

import math
import sys
import traceback
from typing import Annotated

import typer
from rich.console import Console

from roadproof import __version__
from roadproof.cli.attack import attack
from roadproof.cli.calibrate import calibrate
from roadproof.cli.carla import carla
from roadproof.cli.check import check
from roadproof.cli.check_controller import check_controller
from roadproof.cli.controllers import controllers
from roadproof.cli.convert_cil import convert_cil
from roadproof.cli.demo import demo
from roadproof.cli.drive import drive
from roadproof.cli.evaluate import evaluate
from roadproof.cli.harden import harden
from roadproof.cli.record import record
from roadproof.cli.report import report
from roadproof.cli.scenarios import scenarios
from roadproof.cli.select import select
from roadproof.cli.study import study
from roadproof.cli.train import train
from roadproof.errors import RoadproofError
from roadproof.foreign import LIMIT_S, end_calls_after
from roadproof.memory import keep_freed_memory

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Find the paint on a road that makes a camera-driven controller leave its lane, in simulation.",
)
VERBS = (
    demo,
    record,
    calibrate,
    attack,
    select,
    evaluate,
    report,
    check,
    drive,
    scenarios,
    controllers,
    check_controller,
    convert_cil,
    train,
    harden,
)
for verb in VERBS:
    app.command()(verb)
app.add_typer(carla, name="carla")
app.add_typer(study, name="study")


_debug = False


def _version(wanted: bool | None) -> None:
    if wanted:
        typer.echo(f"roadproof {__version__}")
        raise typer.Exit


@app.callback()
def _root(  # pyright: ignore[reportUnusedFunction]
    version: Annotated[
        bool | None, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = None,
    debug: Annotated[
        bool,
        typer.Option("--debug", help="Show the traceback of what goes wrong, and wait for controllers without end."),
    ] = False,
) -> None:
    global _debug  # one command a process
    del version
    _debug = debug
    end_calls_after(math.inf if debug else LIMIT_S)


def main() -> None:
    """Entry point of the `roadproof` command."""
    keep_freed_memory()
    complain = Console(stderr=True, soft_wrap=True, highlight=False, markup=False).print
    try:
        app()
    except RoadproofError as error:
        if _debug:
            traceback.print_exc()
        complain(f"roadproof: {error!s:.1000}")  # what a message quotes may be long
        sys.exit(2)
    except KeyboardInterrupt:
        complain("roadproof: interrupted; give the same command again to go on")
        sys.exit(130)
