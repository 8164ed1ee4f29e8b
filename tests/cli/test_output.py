"""Tables on terminals and in files: nothing is cut off."""

import io
import re

import pytest
from rich.console import Console

from roadproof.cli import output
from roadproof.cli.output import say, table

NAMES, NUMBERS = ("clear-sunset", "traffic"), ("0.83", "(0.81–0.85)", "120", "3.89", "±", "0.06")


def printed(monkeypatch, *, width: int, terminal: bool) -> str:
    shown = table(("weather", "with"), ("deviation m", "drives", "aside m"))
    shown.add_row(*NAMES, "0.83 (0.81–0.85)", "120", "3.89 ± 0.06")
    file = io.StringIO()
    monkeypatch.setattr(
        output,
        "Console",
        lambda **given: Console(**{"file": file, "width": width, "force_terminal": terminal} | given),
    )
    say(shown)
    return re.sub(r"\x1b\[[0-9;]*m", "", file.getvalue())


def test_a_table_in_a_file_is_as_wide_as_it_needs_to_be(monkeypatch):
    text = printed(monkeypatch, width=30, terminal=False)
    assert [line.split() for line in text.splitlines() if "clear" in line] == [[*NAMES, *NUMBERS]]


def test_a_name_that_would_steer_a_terminal_is_shown_by_its_code(monkeypatch):
    file, evil = io.StringIO(), "cil\x1b]0;pwned\x07\x1b[2J\u202e\x9b2J"
    monkeypatch.setattr(output, "Console", lambda **given: Console(**{"file": file, "width": 300} | given))
    shown = table(("controller",))
    shown.add_row(evil)
    say(f"one {evil}\n  two, 1\u202f000 m²", shown)
    text = file.getvalue()
    assert not re.findall(r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u202e]", text)
    assert text.count(r"cil\x1b]0;pwned\x07\x1b[2J\u202e\x9b2J") == 2
    assert "\n  two, 1\u202f000 m²\n" in text


@pytest.mark.parametrize("width", [53, 60, 100])
def test_a_table_on_a_narrow_terminal_loses_nothing(monkeypatch, width):
    text = printed(monkeypatch, width=width, terminal=True)
    assert set(NAMES + NUMBERS) <= set(text.split())
    assert max(map(len, text.splitlines())) <= width
