"""What values, functions and objects are known by: the same in every process, another after an edit."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from roadproof.io.known import known_by, plain_fields, without_addresses
from roadproof.training.expert import expert

MODULE = """
import math
from functools import partial

GAIN = 2.0
SEEN = []

def bent(x):
    return math.sin(x)

def drive(world, fast=1.0):
    SEEN.append(world)
    return GAIN * bent(world)

def made(gain):
    calls = 0
    def inner(world):
        nonlocal calls
        calls += 1
        return gain * world
    return inner

class Base:
    def aside(self):
        return 0.5

class Follower(Base):
    def __init__(self, gain=1.0):
        self.gain, self.calls = gain, 0
    def act(self):
        return self.gain * GAIN
"""


def loaded(folder: Path, source: str, name: str = "users_own") -> ModuleType:
    """A module of a user's, read from a file of its own, under one and the same name."""
    path = folder / f"m{len(list(folder.iterdir()))}.py"
    path.write_text(source)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[name] = made
    spec.loader.exec_module(made)
    return made


@pytest.fixture
def own(tmp_path: Path) -> Callable[..., Any]:
    def edited(before: str = "", after: str = "") -> ModuleType:
        return loaded(tmp_path, MODULE.replace(before, after) if before else MODULE)

    return edited


EDITS = {
    "the body": ("GAIN * bent(world)", "GAIN + bent(world)"),
    "a constant": ("GAIN = 2.0", "GAIN = 3.0"),
    "a helper": ("math.sin", "math.cos"),
    "a default": ("fast=1.0", "fast=2.0"),
}


@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_function_is_another(own: Callable[..., Any], edit: str) -> None:
    before = own()
    known = known_by(before.drive)
    before.drive(1.0)
    assert known_by(before.drive) == known, "what it remembers of its calls does not count"
    assert known_by(own().drive) == known
    assert known_by(own(*EDITS[edit]).drive) != known


def test_arguments_and_closures_count(own: Callable[..., Any]) -> None:
    module = own()
    assert known_by(partial(module.drive, fast=2.0)) != known_by(partial(module.drive, fast=3.0))
    assert known_by(partial(module.drive, fast=2.0)) == known_by(partial(module.drive, fast=2.0))
    two, three = module.made(2.0), module.made(3.0)
    known = known_by(two)
    assert known != known_by(three)
    two(1.0)
    assert known_by(two) == known == known_by(module.made(2.0)), "nor does a count"
    assert known_by(module.Follower(2.0).act) != known_by(module.Follower(3.0).act)


@pytest.mark.parametrize(
    "how",
    [
        "import users_helper as h\ndef drive(x): return h.bent(x)",
        "from users_helper import bent\ndef drive(x): return bent(x)",
    ],
)
def test_what_it_uses_of_the_users_other_modules_counts(tmp_path: Path, how: str) -> None:
    known: list[Any] = []
    for edit in ("x + 1.0", "x + 1.0", "x + 2.0"):
        loaded(tmp_path, f"def bent(x): return {edit}", "users_helper")
        known.append(known_by(loaded(tmp_path, how).drive))
    assert known[0] == known[1] != known[2]


def test_many_functions_that_call_each_other_are_told_once_each(tmp_path: Path) -> None:
    every = " + ".join(f"f{k}(x)" for k in range(40))
    module = loaded(tmp_path, "\n".join(f"def f{k}(x): return {every}" for k in range(40)))
    assert len(str(known_by(module.f0))) < 400_000


def test_an_object_is_its_class_with_its_source_and_its_settings(own: Callable[..., Any]) -> None:
    module = own()
    known = known_by(module.Follower(2.0))
    called = module.Follower(2.0)
    called.calls = 7
    assert known_by(called) == known
    assert known_by(module.Follower(3.0)) != known
    for edit in (("self.gain * GAIN", "self.gain - GAIN"), ("return 0.5", "return 0.6"), ("GAIN = 2.0", "GAIN = 3.0")):
        assert known_by(own(*edit).Follower(2.0)) != known
    assert plain_fields(called) == {"gain": 2.0, "calls": 7}


def test_a_network_is_its_weights_and_its_settings() -> None:
    def network(bias: float = 0.0, slope: float = 0.01) -> nn.Module:
        made = nn.Sequential(nn.Linear(2, 1), nn.LeakyReLU(slope))
        nn.init.constant_(made[0].weight, 1.0)  # type: ignore[arg-type]
        nn.init.constant_(made[0].bias, bias)  # type: ignore[arg-type]
        return made

    known = known_by(network())
    assert known == known_by(network())
    assert known == known_by(network().eval().requires_grad_(False))
    assert known != known_by(network(bias=1e-6))
    assert known != known_by(network(slope=0.02))
    assert known != known_by(network().to(torch.bfloat16))


@pytest.mark.parametrize("kind", ["", "@staticmethod", "@classmethod", "@property", "@cached_property"])
def test_what_any_member_of_a_class_uses_counts(tmp_path: Path, kind: str) -> None:
    source = f"from functools import cached_property\nGAIN = 1\nclass Own:\n  {kind}\n  def gain(own=0): return GAIN"
    one, same, other = (loaded(tmp_path, text) for text in (source, source, source.replace("GAIN = 1", "GAIN = 2")))
    assert known_by(one.Own()) == known_by(same.Own()) != known_by(other.Own())


@dataclass
class Own:
    gain: float
    place: Path = Path("a")
    table: Any = None


def test_values_are_told_without_the_place_in_memory_or_on_disk() -> None:
    assert known_by(Own(1.0, Path("b"))) == known_by(Own(1.0, Path("a"))) != known_by(Own(2.0))
    numbers = np.arange(6.0).reshape(2, 3)
    assert known_by(numbers.T) == known_by(np.ascontiguousarray(numbers.T)) != known_by(numbers)
    assert known_by(torch.tensor(numbers)) != known_by(torch.tensor(numbers + 1e-9))
    loop = Own(1.0)
    loop.table = {"self": loop, "set": {2, 1}}
    assert known_by(loop) == known_by(loop)
    assert without_addresses(f"Budget({object()!r})") == "Budget(<object object>)"


def test_ours_and_what_has_no_source_are_known_by_name() -> None:
    name = {"function": "roadproof.training.expert:expert"}
    assert known_by(expert) == name


def test_what_is_typed_at_a_prompt_is_known_by_its_code() -> None:
    known: list[Any] = []
    for gain in (1.0, 1.0, 2.0):
        typed: dict[str, Any] = {"__name__": "typed"}
        exec(f"def drive(world): return [{gain} for _ in 'a']", typed)
        known.append(known_by(typed["drive"]))
    assert known[0] == known[1] != known[2]


def test_a_dict_or_list_around_a_function_counts_as_it_was_at_first(tmp_path: Path) -> None:
    source = "SETTINGS = {'gain': 1.0}\nSEEN = []\ndef drive(x):\n    SEEN.append(x)\n    return SETTINGS['gain']"
    module = loaded(tmp_path, source)
    known = known_by(module.drive)
    module.drive(1.0)
    assert known_by(module.drive) == known, "a memory of its calls does not count"
    assert known_by(loaded(tmp_path, source).drive) == known
    assert known_by(loaded(tmp_path, source.replace("1.0}", "2.0}")).drive) != known


def test_another_process_knows_the_same(own: Callable[..., Any], tmp_path: Path) -> None:
    module = own()
    here = known_by(partial(module.drive, table={1, 2, "a"})), known_by(module.Follower())
    code = f"""
import importlib.util, sys
spec = importlib.util.spec_from_file_location("users_own", {str(tmp_path / "m0.py")!r})
m = importlib.util.module_from_spec(spec); sys.modules["users_own"] = m; spec.loader.exec_module(m)
from functools import partial
from roadproof.io.known import known_by
print((known_by(partial(m.drive, table={{1, 2, "a"}})), known_by(m.Follower())))
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == str(here)
