"""Verbs and groups of verbs whose help says in words what an option takes, and which know the words given."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from roadproof.errors import RoadproofError

SEVERAL = {
    "albedo": "DARKEST BRIGHTEST",
    "contrast": "LEAST MOST",
    "map_file": "FILE",
    "noise_deg": "LEAST MOST",
    "start_range": "METRES RADIANS M/S",
    "swerve_m": "METRES",
}
"""What stands in the help for the values of an option that takes several."""

_words: tuple[str, ...] = ()  # one command a process


def words_given() -> tuple[str, ...]:
    """The command that is being carried out, word for word."""
    return _words


def _plain(options: list[Any]) -> list[Any]:
    for option in options:
        if getattr(option, "is_flag", False):
            option.metavar = ""
        elif option.name in SEVERAL:
            option.metavar = SEVERAL[option.name]
        elif option.param_type_name == "argument" and option.nargs < 0:
            # The dots behind its name say that it may be given several times.
            option.display_type_rich = _no_type
    return options


class _Verb(TyperCommand):
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401  # as below
        global _words
        for word in args:
            # Commands are kept as text, one a line; a byte that is no text is a surrogate.
            if word.splitlines() != [word] or any("\ud800" <= sign <= "\udfff" for sign in word):
                what = f"{word!r:.60}" if word else "empty"
                raise RoadproofError(f"a word of the command is {what}, expected text in one line")
        _words = ("roadproof", *ctx.command_path.split()[1:], *args)
        return super().parse_args(ctx, args)

    def get_params(self, ctx: Any) -> list[Any]:  # noqa: ANN401  # typer brings click along, in a place that changes
        return _plain(super().get_params(ctx))


class _Group(TyperGroup):
    def get_params(self, ctx: Any) -> list[Any]:  # noqa: ANN401
        return _plain(super().get_params(ctx))


class Verbs(typer.Typer):
    """A group of verbs, which says its help where no verb is given.

    Args:
        about: what the verbs are for, for the help.
    """

    def __init__(self, about: str) -> None:
        super().__init__(cls=_Group, no_args_is_help=True, help=about, pretty_exceptions_enable=False)

    def command(self, name: str | None = None, **more: Any) -> Any:  # noqa: ANN401
        """What makes a function a verb of the group, as `typer.Typer.command` does."""
        return super().command(name, cls=_Verb, **more)


def _no_type(**_: object) -> None:
    """What stands for the type beside a name that says enough."""
