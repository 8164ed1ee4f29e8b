"""Calls into code that is not ours: a user's module, factory, controller.

Whatever it raises becomes one line with the user's file and line. A thread beside says when a call has not come back
for `NOTICE_S`. The command line also ends such a call, after `LIMIT_S`: by the exception of Ctrl-C where that reaches
it, else with the process. In Python nothing is ended: the process is its author's, and may stand in a debugger.
"""

from __future__ import annotations

import _thread
import logging
import math
import os
import sys
import sysconfig
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import ParamSpec, TypeVar

from roadproof.errors import ControllerError, RoadproofError

NOTICE_S = 30.0
"""After so long a line says that a call has not come back; again at each doubling of the time."""

LIMIT_S = 600.0
"""After so long the command line ends it."""

GRACE_S = 10.0
"""So long Ctrl-C's exception has to end it before the process ends."""

LONGEST = 300
"""Characters of a foreign message that are shown."""

Arguments = ParamSpec("Arguments")
Answer = TypeVar("Answer")

_LOOK_S, _MOST_LOOKS = 1.0, 3
_OURS = f"{Path(__file__).parent}{os.sep}"
_STANDARD = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib")})
_INSTALLED = ("site-packages", "dist-packages")
_TYPED = ("<stdin>", "<python-input", "<ipython-input")

_log = logging.getLogger("roadproof")


@dataclass(slots=True, eq=False)
class _Call:
    """A call that has not come back yet; `waited_s` counts the time since then in which the watch ran."""

    what: str
    thread: int = field(default_factory=threading.get_ident)
    seen_s: float = field(default_factory=time.monotonic)
    waited_s: float = 0.0
    notice_s: float = field(default_factory=lambda: NOTICE_S)
    interrupted_s: float = math.inf


_calls: dict[int, _Call] = {}
_watch: threading.Thread | None = None
_limit_s = math.inf


def call(what: str, function: Callable[Arguments, Answer], *args: Arguments.args, **kwargs: Arguments.kwargs) -> Answer:
    """Call a foreign function and return what it returns.

    Args:
        what: name of the function in words, for messages.
        function: function to call with the other arguments.
        args: positional arguments of the function.
        kwargs: keyword arguments of the function.

    Raises:
        ControllerError: the function raised something, or was ended for its time. A `RoadproofError` of ours to which
            no line of the user's led passes as it is; so does `KeyboardInterrupt`.
    """
    this = _Call(what)
    _calls[id(this)] = this
    _begin_watch()
    try:
        return function(*args, **kwargs)
    except RoadproofError as error:
        place = place_of(error)
        if place is None:
            raise
        raise ControllerError(f"{what} failed at {place}: {error}") from error
    except KeyboardInterrupt:
        if math.isfinite(this.interrupted_s):
            raise ControllerError(
                f"{what} has not answered for {_limit_s:g} s and was ended; look for what it waits for"
            ) from None
        raise
    except GeneratorExit:
        raise
    except BaseException as error:  # whatever its author made up
        raise ControllerError(f"{what} raised {in_one_line(error, place_of(error))}") from error
    finally:
        del _calls[id(this)]


def in_one_line(error: BaseException, place: str | None = None) -> str:
    """The type of an exception, the line that led to it where that is given, and its message."""
    try:
        message = " ".join(str(error.msg if isinstance(error, SyntaxError) else error).split())
    except Exception:  # a message is computed by its author's code
        message = ""
    said = message if len(message) <= LONGEST else f"{message[:LONGEST]} …"
    return f"{type(error).__name__}{f' at {place}' if place else ''}{f': {said}' if said else ''}"


def place_of(error: BaseException) -> str | None:
    """The user's line that led to an exception, as FILE:LINE; None where none did."""
    frames = [(frame.f_code.co_filename, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    if isinstance(error, SyntaxError) and error.filename:
        frames.append((error.filename, error.lineno or 0))
    return _place(frames)


def end_calls_after(limit_s: float) -> None:
    """End foreign calls of this process after some seconds (infinite for never); for a command, not for a library."""
    global _limit_s  # one process, one limit
    _limit_s = limit_s


def limit_s() -> float:
    """After how many seconds foreign calls of this process are ended; infinite by default."""
    return _limit_s


def _place(frames: list[tuple[str, int]]) -> str | None:
    """The last frame of the user's own files; where there is none, the first of a package that they installed."""
    own = [frame for frame in frames if _is_foreign(frame[0]) and not _is_installed(frame[0])]
    installed = [frame for frame in frames if _is_foreign(frame[0]) and not _is_torch(frame[0])]
    chosen = own[-1:] or installed[:1]
    if not chosen:
        return None
    file, line = chosen[0]
    path = Path(file)
    return f"{path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path}:{line}"


def _is_foreign(file: str) -> bool:
    if file.startswith("<"):
        return file.startswith(_TYPED)
    return not file.startswith(_OURS) and (_is_installed(file) or not file.startswith(_STANDARD))


def _is_installed(file: str) -> bool:
    return any(folder in file for folder in _INSTALLED)


def _is_torch(file: str) -> bool:
    return _is_installed(file) and any(f"{os.sep}{name}{os.sep}" in file for name in ("torch", "numpy"))


def _begin_watch() -> None:
    global _watch  # one thread a process; a fork leaves it behind
    if _watch is None or not _watch.is_alive():
        _watch = threading.Thread(target=_look, name="roadproof-watch", daemon=True)
        _watch.start()


def _look() -> None:
    while True:
        time.sleep(_LOOK_S)
        now_s = time.monotonic()
        for each in list(_calls.values()):
            # While the process, or its machine, stood still, the call could not come back either.
            each.waited_s += min(now_s - each.seen_s, _MOST_LOOKS * _LOOK_S)
            each.seen_s = now_s
            _judge(each)


def _judge(this: _Call) -> None:
    waited_s = this.waited_s
    if waited_s >= this.notice_s:
        ended = f"; it is ended after {_limit_s:g} s" if math.isfinite(_limit_s) else ""
        _log.warning("%s has not answered for %.0f s%s%s", this.what, waited_s, _where(this), ended)
        this.notice_s = 2 * waited_s
    if waited_s >= _limit_s and this.interrupted_s == math.inf:
        this.interrupted_s = waited_s
        if this.thread == threading.main_thread().ident:
            _thread.interrupt_main()
    if waited_s >= this.interrupted_s + GRACE_S:
        _log.error("roadproof: %s has not answered for %.0f s%s; ended", this.what, waited_s, _where(this))
        os._exit(2)


def _where(this: _Call) -> str:
    """Where the user's code stands, as " (FILE:LINE)"."""
    frame: FrameType | None = sys._current_frames().get(this.thread)  # noqa: SLF001  # pyright: ignore[reportPrivateUsage]  # documented
    frames: list[tuple[str, int]] = []
    while frame is not None and frame.f_code is not call.__code__:
        frames.insert(0, (frame.f_code.co_filename, frame.f_lineno))
        frame = frame.f_back
    place = _place(frames)
    return f" ({place})" if place else ""
