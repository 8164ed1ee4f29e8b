"""README and the tutorials, done as a reader does them: their commands and their Python, as written."""

from __future__ import annotations

import re
import sysconfig
import tomllib
from pathlib import Path

import pytest

import needs
import shown

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "tutorials").glob("*.md"))]
MODULES = {"blackbox": "optuna", "carla": "carla", "cil": "roadproof_cil", "study": "pandas", "video": "av"}
PROGRAMS = Path(sysconfig.get_path("scripts"))


def page(tmp_path, text):
    path = tmp_path / "page.md"
    path.write_text(text, encoding="utf-8")
    return path


def run(path, tmp_path):
    folder = tmp_path / "reader"
    folder.mkdir()
    shown.run(path, folder, PROGRAMS, root=ROOT)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_what_a_page_shows_happens(path, tmp_path):
    asked = shown.extras(path)
    if "town" in asked:
        needs.town()
    for extra in sorted(asked - {"town"}):
        pytest.importorskip(MODULES[extra], reason=f"the page installs the extra {extra}")
    run(path, tmp_path)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.stem)
def test_a_page_shows_something_and_says_why_it_is_not_run(path):
    found = shown.blocks(path)
    assert any(block.language == "sh" and not block.mark for block in found)
    assert all(len(block.said) > 10 for block in found if block.mark in ("dry run", "not run"))
    assert len(found) == path.read_text(encoding="utf-8").count("\n```") / 2
    offered = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert shown.extras(path) <= set(offered)
    assert not re.search(r"<!--(?! (?:file|dry run|not run): .+ -->)", path.read_text(encoding="utf-8"))


def test_every_tutorial_is_linked_from_the_first_page_and_the_index():
    for name in ("README.md", "docs/index.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert [path.stem for path in PAGES[1:] if f"tutorials/{path.stem}" not in text] == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("```sh\nroadproof controllers --jason\n```", "No such option.*--jason"),
        ("```sh\nroadproof controllers\n```\n\n```text\nno such line\n```", "line 5: not printed: no such line"),
        ("```sh\nroadproof controllers nobody\n```", "ends with 2"),
        ("<!-- not run: long -->\n```sh\nroadproof demo --figure 3\n```", "No such option.*--figure"),
        ("<!-- not run: long -->\n```sh\nroadproof study walk\n```", "no command walk"),
        ("<!-- dry run: long -->\n```sh\nroadproof demo --scenario left-99\n```", "left-99"),
        ("<!-- dry run: long -->\n```sh\nroadproof record left-99\n```", "left-99"),
        ("<!-- dry run: long -->\n```sh\nroadproof study run no.toml\n```", "no.toml"),
        ("<!-- not run: long -->\n```python\nimport import\n```", "invalid syntax"),
        ("```python\nimport roadproof\nroadproof.nothing\n```", "no attribute 'nothing'"),
    ],
)
def test_what_does_not_happen_is_told(text, message, tmp_path):
    with pytest.raises(shown.ShownError) as told:
        run(page(tmp_path, text), tmp_path)
    assert re.search(message, str(told.value), re.DOTALL), told.value


def test_files_are_saved_python_is_run_and_numbers_may_differ(tmp_path):
    text = (
        "<!-- file: own/a.py -->\n```python\nprint('1.30 m in 12 of 14')\n```\n\n```sh\npython own/a.py\n```\n\n"
        "```text\n...\n2.5 m  in 3 of 4\n```\n\n```python\nopen('b.txt', 'w').close()\n```\n"
    )
    folder = run(page(tmp_path, text), tmp_path)
    assert {path.relative_to(folder).as_posix() for path in folder.rglob("*.*")} == {"own/a.py", "b.txt"}
