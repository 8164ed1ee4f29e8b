"""The public names: all there, all typed, few enough for one screen."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import roadproof

TYPED = re.findall(r"^from \S+ import (\w+) as \1$", Path(roadproof.__file__).with_suffix(".pyi").read_text(), re.M)
TEXTS = [
    path
    for folder in ("README.md", "docs", "docs/tutorials", "examples")
    for place in [Path(__file__).parents[1] / folder]
    for path in ([place] if place.is_file() else [*place.glob("*.md"), *place.glob("*.py")])
    if path.name != "conf.py"  # builds the docs, and is none of them
]
CONVENTIONS = Path(__file__).parents[1] / "docs" / "conventions.md"


def test_every_public_name_can_be_used_and_is_typed():
    assert {name for name in dir(roadproof) if not name.startswith("__")} == set(TYPED)
    every: dict[str, object] = {}
    exec("from roadproof import *", every)
    assert set(every) - {"__builtins__"} == set(TYPED)
    assert all(value is not None for value in every.values())


def test_the_public_names_fit_on_one_screen():
    assert 20 < len(TYPED) <= 30
    assert len(set(TYPED)) == len(TYPED)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        assert roadproof.nothing


def test_importing_roadproof_loads_nothing_of_it():
    code = "import sys, roadproof; dir(roadproof); print([n for n in sys.modules if n.startswith('roadproof.')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "[]\n"


def test_every_name_that_a_documented_room_offers_is_there():
    offered = [
        (room, name)
        for room, holds in re.findall(r"^\| `(roadproof\.[\w.]+)` \| (.+) \|$", CONVENTIONS.read_text(), re.M)
        for name in re.findall(r"`(\w+)`", holds)
    ]
    assert ("roadproof.calibration", "CalibrationMethod") in offered
    assert len(offered) > 50
    assert [each for each in offered if not hasattr(importlib.import_module(each[0]), each[1])] == []


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_readme_docs_and_examples_use_public_names_and_documented_rooms_alone(path):
    rooms = set(re.findall(r"^\| `(roadproof\.[\w.]+)` \|", CONVENTIONS.read_text(), re.M))
    assert "roadproof.geometry" in rooms
    text = path.read_text()
    assert set(re.findall(r"^(?:from|import) (roadproof[\w.]*)", text, re.M)) <= rooms | {"roadproof"}
    for room in re.findall(r"^(?:from|import) (roadproof[\w.]*)", text, re.M):
        # Nothing deeper than a module at the top, or a package.
        assert room.count(".") < 2 or hasattr(importlib.import_module(room), "__path__"), room
    for room, names in re.findall(r"^from (roadproof[\w.]*) import ([\w, ]+)$", text, re.M):
        assert [name for name in names.split(", ") if not hasattr(importlib.import_module(room), name)] == []
    for name in re.findall(r"\broadproof\.(\w[\w.]*\w)", text):
        room = f"roadproof.{name}" in rooms or f"roadproof.{name}".rpartition(".")[0] in rooms
        assert room or name.split(".")[0] in TYPED, f"roadproof.{name}"
