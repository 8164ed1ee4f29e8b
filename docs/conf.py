"""How `make docs` builds the documentation: README first, the pages of this folder, a reference from the docstrings."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import roadproof

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"

project = "roadproof"
release = roadproof.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["results/**"]
default_role = "code"
html_theme = "furo"
html_title = f"roadproof {release}"
html_show_copyright = False

myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings say in words what annotations say
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False


def write_reference(_app: object) -> None:
    """The pages of the reference, from the lists of public names and of rooms."""
    listed = Path(roadproof.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    names = re.findall(r"^from \S+ import (\w+) as \1$", listed, re.MULTILINE)
    rooms = re.findall(r"^\| `(roadproof\.[\w.]+)` \|", (DOCS / "conventions.md").read_text(), re.MULTILINE)
    pages = {"roadproof": "What ``import roadproof`` gives.\n\n" + "\n".join(map(_entry, names))}
    pages |= {room: f".. automodule:: {room}\n   :members:\n   :imported-members:\n   :no-index:\n" for room in rooms}
    pages["command-line"] = "\n".join(map(_help, [(), *_commands(import_module("roadproof.cli").app)]))
    out = DOCS / "api"
    out.mkdir(exist_ok=True)
    for old in out.glob("*.rst"):
        old.unlink()
    for name, text in pages.items():
        (out / f"{name}.rst").write_text(f"{name}\n{'=' * len(name)}\n\n{text}", encoding="utf-8")


def _entry(name: str) -> str:
    kind = "class" if isinstance(getattr(roadproof, name), type) else "function"
    return f".. auto{kind}:: roadproof.{name}\n" + ("   :members:\n" if kind == "class" else "")


def _commands(app: Any) -> list[tuple[str, ...]]:  # noqa: ANN401
    """The words of every command."""
    own = [(each.name or each.callback.__name__,) for each in app.registered_commands]
    return own + [(each.name, *words) for each in app.registered_groups for words in _commands(each.typer_instance)]


def _help(words: tuple[str, ...]) -> str:
    """What `--help` says, as it stands in a terminal."""
    command = [sys.executable, "-c", "from roadproof.cli import main; main()", *words, "--help"]
    plain = {**os.environ, "COLUMNS": "84", "NO_COLOR": "1", "TERM": "dumb"}
    said = subprocess.run(command, capture_output=True, text=True, check=True, env=plain).stdout
    shown = "\n".join(f"   {line}".rstrip() for line in said.splitlines())
    name = " ".join(("roadproof", *words))
    return f"{name}\n{'-' * len(name)}\n\n.. code-block:: text\n\n{shown}\n"


def read_source(_app: object, name: str, source: list[str]) -> None:
    """README before the index; links to what is no page of the site become words."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8") if name == "index" else ""
    source[0] = _linked(readme, ROOT) + _linked(source[0], (DOCS / name).parent)


def _linked(text: str, folder: Path) -> str:
    def link(found: re.Match[str]) -> str:
        mark, words, target = found.groups()
        path, _, anchor = target.partition("#")
        if "://" in target or not path:
            return found[0]
        whole = (folder / path).resolve()
        page = whole.is_relative_to(DOCS) and whole.is_file() and (mark or not whole.is_relative_to(DOCS / "results"))
        return f"{mark}[{words}](/{whole.relative_to(DOCS)}{'#' * bool(anchor)}{anchor})" if page else words

    return re.sub(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)", link, text)


def plain_stars(_app: object, _what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
    """A star in a docstring is a shape's, `(*b, 3)`, not emphasis."""
    lines[:] = [re.sub(r"(?<![*\w`\\])\*(?=\S)", r"\\*", line) for line in lines]


def skip_foreign(_app: object, _what: str, _name: str, obj: Any, skip: bool, _options: object) -> bool:  # noqa: ANN401
    """What a room only imports is not its own."""
    return skip or not str(getattr(obj, "__module__", "roadproof")).startswith("roadproof")


def setup(app: Any) -> None:  # noqa: ANN401
    """What Sphinx calls first."""
    app.connect("builder-inited", write_reference)
    app.connect("source-read", read_source)
    app.connect("autodoc-process-docstring", plain_stars)
    app.connect("autodoc-skip-member", skip_foreign)
