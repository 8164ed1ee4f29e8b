"""Runs what a Markdown page shows, as a reader would: its commands, its Python and its files, in an empty folder.

    python tests/support/shown.py README.md .venv/bin

runs a page with the programs of that folder, and needs nothing but Python. Comments before blocks say how they are
taken:

    <!-- file: NAME -->        the block is what the page has its reader save under this name
    <!-- dry run: REASON -->   commands that have `--dry-run` only estimate; the others only have their words read
    <!-- not run: REASON -->   the words of commands are read by the command line, Python is compiled

Of a block marked `text` behind one that was run, every line must have been printed, numbers and widths aside.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

LIMIT_S = 900.0
MARK = re.compile(r"<!-- (file|dry run|not run): (.+) -->")
# Reads the words of one command as the command line does, without doing anything, and prints what options it has.
READ = """
import sys, typer
from roadproof.cli import app
command, words = typer.main.get_command(app), sys.argv[1:]
while hasattr(command, "commands") and words and not words[0].startswith("-"):
    name = words.pop(0)
    command = command.commands.get(name) or sys.exit(f"no command {name}")
try:
    command.make_context("roadproof", words)
except Exception as error:
    if getattr(error, "exit_code", 1):  # 0: it only asked for the version or for help
        sys.exit(getattr(error, "message", str(error)))
print(*(name for option in command.params for name in option.opts))
"""


class ShownError(Exception):
    """What a page shows is not what happens; the message names page and line."""


@dataclass(frozen=True)
class Block:
    """A fenced block of a page: its language, its text, the line it begins at, and the comment before it."""

    language: str
    text: str
    line: int
    mark: str = ""
    said: str = ""


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    found, mark, opened = [], ("", ""), None
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        if opened is not None and line.startswith("```"):
            language, first, lines = opened
            found.append(Block(language, "\n".join(lines) + "\n", first, *mark))
            mark, opened = ("", ""), None
        elif opened is not None:
            opened[2].append(line)
        elif line.startswith("```"):
            opened = (line[3:].strip(), number, [])
        elif marked := MARK.fullmatch(line.strip()):
            mark = marked[1], marked[2]
        elif line.strip():
            mark = ("", "")
    return found


def commands(block: Block) -> list[list[str]]:
    """The words of every command of a block."""
    whole = block.text.replace("\\\n", " ").replace(" && ", "\n")
    return [words for line in whole.splitlines() if (words := shlex.split(line, comments=True))]


def extras(page: Path) -> set[str]:
    """What the page has its reader install besides roadproof itself."""
    asked = re.findall(r"pip install '?roadproof\[([\w,]+)\]", page.read_text(encoding="utf-8"))
    return {name for names in asked for name in names.split(",")}


def run(page: Path, folder: Path, programs: Path, *, root: Path) -> None:
    """Do what a page shows in a folder.

    Args:
        page: Markdown.
        folder: an empty folder.
        programs: where `roadproof` and `python` are.
        root: the repository, whose Makefile has the targets that the page names.

    Raises:
        ShownError: a command fails, something shown is not printed, an option is not there.
    """
    reader = _Reader(page, folder, programs, root)
    try:
        for block in blocks(page):
            reader.take(block)
    finally:
        reader.stop()


class _Reader:
    def __init__(self, page: Path, folder: Path, programs: Path, root: Path) -> None:
        self.page, self.folder, self.root = page, folder, root
        self.programs = programs.absolute()
        self.python = str(self.programs / "python")
        # As wide on every machine, without colours, and with a browser that shows nothing.
        plain = {"COLUMNS": "100", "LINES": "40", "TERM": "dumb", "NO_COLOR": "1", "BROWSER": "true"}
        kept = {name: value for name, value in os.environ.items() if name not in ("FORCE_COLOR", "PYTHONHOME")}
        path = os.pathsep.join((str(self.programs), os.environ.get("PATH", os.defpath)))
        self.environment = kept | plain | {"PATH": path, "PYTHONIOENCODING": "utf-8"}
        self.printed: str | None = None
        self.server: subprocess.Popen[str] | None = None
        self.ports: dict[str, str] = {}

    def take(self, block: Block) -> None:
        if block.mark == "file":
            (self.folder / block.said).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / block.said).write_text(block.text, encoding="utf-8")
        elif block.language == "text":
            self._compare(block)
        elif block.language == "python":
            self._take_python(block)
        elif block.language == "sh":
            self._take_commands(block)

    def _take_python(self, block: Block) -> None:
        try:
            compile(block.text, f"{self.page.name}:{block.line}", "exec")
        except SyntaxError as error:
            raise self._error(block, str(error)) from None
        self.printed = None if block.mark else self._call(block, [self.python, "-c", block.text])

    def _take_commands(self, block: Block) -> None:
        self.printed = None
        first = commands(block)[0]
        serves = first[:3] == ["roadproof", "carla", "serve"]
        is_run = not block.mark and first[0] not in ("make", "pip")
        for words in commands(block):
            if words[0] == "make":
                self._call(block, ["make", "--dry-run", *words[1:]], self.root)
            elif words[0] == "roadproof" and (serves or not is_run):
                # The words of what is run are read there.
                options = self._call(block, [self.python, "-c", READ, *words[1:]]).split()
                if block.mark == "dry run" and "--dry-run" in options:
                    self._call(block, [*words, "--dry-run"])
        if not is_run:
            return
        if serves:
            self._serve(block, first)
        else:
            self.printed = self._call(block, ["sh", "-ec", self._with_ports(block.text)])

    def _with_ports(self, text: str) -> str:
        for shown, real in self.ports.items():
            text = re.sub(rf"(--port |:){shown}\b", rf"\g<1>{real}", text)
        return text

    def _serve(self, block: Block, words: list[str]) -> None:
        """Serve in the background on ports that are free, which stand for those of the page from now on."""
        shown = words[words.index("--port") + 1]
        words[words.index("--port") + 1] = "0"
        log = self.folder / "serving.log"
        with log.open("w") as out:
            self.server = subprocess.Popen(
                words,
                cwd=self.folder,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=out,
                text=True,
            )
        until = time.monotonic() + LIMIT_S
        while not (said := re.search(r"Serving .*:(\d+) and \d+;", log.read_text())):
            if self.server.poll() is not None or time.monotonic() > until:
                raise self._error(block, f"does not serve: {log.read_text()}")
            time.sleep(0.1)
        self.printed = log.read_text()
        self.ports[shown] = said[1]

    def stop(self) -> None:
        """End the server, if there is one."""
        if self.server is None:
            return
        self.server.send_signal(signal.SIGTERM)
        try:
            self.server.wait(30)
        except subprocess.TimeoutExpired:
            self.server.kill()
            self.server.wait()

    def _call(self, block: Block, words: list[str], folder: Path | None = None) -> str:
        done = subprocess.run(
            words,
            cwd=folder or self.folder,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            encoding="utf-8",
            timeout=LIMIT_S,
        )
        if done.returncode:
            raise self._error(block, f"{shlex.join(words)} ends with {done.returncode}\n{done.stdout}{done.stderr}")
        return done.stdout

    def _compare(self, block: Block) -> None:
        """Each line must have been printed, where the block before it was run."""
        if self.printed is None:
            return
        printed = {_words(line) for line in self.printed.splitlines()}
        for line in block.text.splitlines():
            if line.strip() not in ("", "...") and _words(line) not in printed:
                raise self._error(block, f"not printed: {line}\nbut\n{self.printed}")

    def _error(self, block: Block, message: str) -> ShownError:
        return ShownError(f"{self.page.name}, line {block.line}: {message}")


def _words(line: str) -> str:
    """A line without its numbers and widths."""
    return " ".join(re.sub(r"─+", "─", re.sub(r"[+−-]?\d[\d,.]*(?: (?:s|min|h)\b)?", "0", line)).split())


@contextmanager
def empty_folder() -> Iterator[Path]:
    """A folder for a page, removed afterwards."""
    with tempfile.TemporaryDirectory(prefix="shown-") as folder:
        yield Path(folder).resolve()


if __name__ == "__main__":
    with empty_folder() as place:
        try:
            run(Path(sys.argv[1]), place, Path(sys.argv[2]), root=Path(__file__).resolve().parents[2])
        except ShownError as failure:
            sys.exit(str(failure))
