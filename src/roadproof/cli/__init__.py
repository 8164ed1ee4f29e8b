"""The command line: thin verbs over the public functions, one file a verb.

Verbs import what they work with when they are called: torch takes seconds, which `--help` and mistakes in the options
should not. Where a verb is long, its options are many: each is read, checked and handed on. A `RoadproofError` is one
line on standard error and exit code 2, a traceback only with `--debug`; whatever else is raised is a fault of ours, and
shows both.
"""

from __future__ import annotations

import atexit
import io
import math
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer

from roadproof import __version__
from roadproof.cli.attack import attack
from roadproof.cli.calibrate import calibrate
from roadproof.cli.carla import carla
from roadproof.cli.check import check
from roadproof.cli.check_controller import check_controller
from roadproof.cli.compare import compare
from roadproof.cli.controllers import controllers
from roadproof.cli.convert_cil import convert_cil
from roadproof.cli.demo import demo
from roadproof.cli.drive import drive
from roadproof.cli.evaluate import evaluate
from roadproof.cli.group import Verbs
from roadproof.cli.harden import harden
from roadproof.cli.import_ import import_
from roadproof.cli.open_ import open_
from roadproof.cli.progress import tell
from roadproof.cli.record import record
from roadproof.cli.report import report
from roadproof.cli.scenarios import scenarios
from roadproof.cli.select import select
from roadproof.cli.study import study
from roadproof.cli.train import train
from roadproof.cli.verbs import verb
from roadproof.errors import RoadproofError
from roadproof.foreign import LIMIT_S, end_calls_after, in_one_line
from roadproof.io.files import printable
from roadproof.machine import keep_freed_memory, sleep_while_waiting

app = Verbs("Find the paint on a road that makes a camera-driven controller leave its lane, in simulation.")
VERBS = (
    verb(demo, estimates=True),
    verb(import_, works=False),
    verb(record, estimates=True),
    verb(calibrate),
    verb(attack, estimates=True),
    verb(select),
    verb(evaluate, estimates=True),
    verb(report, works=False),
    verb(compare, works=False),
    open_,
    verb(check, estimates=True),
    verb(drive),
    verb(scenarios, works=False),
    verb(controllers, works=False),
    verb(check_controller),
    convert_cil,
    verb(train, answers=False),
    verb(harden, estimates=True),
)
for each in VERBS:
    app.command(each.__name__.rstrip("_").replace("_", "-"))(each)
app.add_typer(carla, name="carla")
app.add_typer(study, name="study")


_debug = False
_INTERRUPTED = 130
_UsageError: Any = typer.BadParameter.__base__  # typer brings click along, in a place that changes


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
    # Where nobody listens (`>&-`) Python has no streams at all.
    if sys.stdout is None or sys.stderr is None:  # pyright: ignore[reportUnnecessaryComparison]
        nobody = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115  # until the process ends
        sys.stdout, sys.stderr = sys.stdout or nobody, sys.stderr or nobody
    try:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _interrupt)
        keep_freed_memory()
        sleep_while_waiting()
        for stream in (sys.stdout, sys.stderr):
            # A terminal or pipe of another encoding gets ä as \xe4 instead of an error.
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
        code = app(prog_name="roadproof", standalone_mode=False)
        sys.stdout.flush()
        # All is done: the end of the process has nothing to interrupt. What is registered last is called first.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    except _UsageError as error:
        # Where no words were given, the help was shown instead, and there is nothing to say.
        if said := error.format_message().rstrip("."):
            _complain(f"{said}; see: {error.ctx.command_path if error.ctx else 'roadproof'} --help")
        sys.exit(2)
    except RoadproofError as error:
        _fail(str(error))
    except OSError as error:
        # The system's own words: of a path that no file can have, or a disk that fails.
        if error.filename is None:
            # What is still to be printed would fail again when the process ends.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        where = "the output" if error.filename is None else repr(str(error.filename)[:200])
        _fail(f"{where}: {error.strerror}; check the path" if error.strerror else str(error))
    except (typer.Abort, KeyboardInterrupt):
        # The latter while the command is still put together.
        code = _INTERRUPTED
    except Exception as error:
        # Python would end with 1, which says of a check that the controller failed.
        traceback.print_exc()
        _complain(f"{in_one_line(error)}; that is a fault of roadproof, or of this machine: please report it")
        code = 2
    if code == _INTERRUPTED:
        _complain("interrupted; give the same command again to go on")
        _end_soon(code)
    sys.exit(code)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Interrupt the command, and end what works beside it at once.

    Its processes have nothing to save, and one that has only just begun would complain that what it waits for is gone.
    """
    for process in multiprocessing.active_children():
        process.kill()
    signal.default_int_handler(number, frame)


def _end_soon(code: int) -> None:
    """Let this process end in two seconds, whatever it would wait for."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    late = threading.Timer(2.0, os._exit, (code,))
    late.daemon = True
    late.start()


def _fail(message: str) -> NoReturn:
    """End with a line on the exception that is being handled."""
    if _debug:
        traceback.print_exc()
    _complain(message)
    sys.exit(2)


def _complain(message: str) -> None:
    """One line on standard error; what a message quotes may be long, or hold line ends and a terminal's commands."""
    tell(f"roadproof: {printable(message):.1000}")
