"""What README and docs name is there: files, headings, commands and their options."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer

from roadproof.cli import app

ROOT = Path(__file__).parents[1]
TEXTS = [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "tutorials").glob("*.md")]
FILE = re.compile(r"\b(?:tests|benchmarks|studies|examples|docs)/[\w/.-]+\.(?:py|toml|md|json|png|jpg|parquet)\b")


def commands(text):
    """Words of the calls of the command in blocks of code."""
    found, fenced = [], False
    for line in re.sub(r"\\\n\s*", " ", text).splitlines():
        fenced ^= line.startswith("```")
        if (fenced or line.startswith("    ")) and line.lstrip().startswith("roadproof "):
            found += [shlex.split(call, comments=True) for call in line.split(" && ")]
    return found


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_the_files_that_a_text_names_are_there(path):
    assert [name for name in FILE.findall(path.read_text(encoding="utf-8")) if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_the_commands_that_a_text_shows_are_there_with_their_options(path):
    unknown = []
    for words in commands(path.read_text(encoding="utf-8")):
        command = typer.main.get_command(app)
        rest = words[1:]
        while rest and hasattr(command, "commands") and not rest[0].startswith("-"):
            command = command.commands.get(rest.pop(0))
            if command is None:
                break
        known = {name for each in command.params for name in (*each.opts, *each.secondary_opts)} if command else set()
        used = {word.split("=")[0] for word in rest if re.match(r"--?[a-z]", word)}
        if command is None or used - known - {"--help"}:
            unknown.append((" ".join(words), sorted(used - known)))
    assert unknown == []


def anchors(path):
    """The headings of a text as links name them."""
    headings = re.findall(r"^#+ (.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_the_headings_that_a_text_links_to_are_there(path):
    links = re.findall(r"\]\(([\w/.-]*\.md|)#([\w-]+)\)", path.read_text(encoding="utf-8"))
    assert [link for link in links if link[1] not in anchors(path.parent / link[0] if link[0] else path)] == []


def test_commands_are_found_at_all():
    assert sum(len(commands(path.read_text(encoding="utf-8"))) for path in TEXTS) > 50
