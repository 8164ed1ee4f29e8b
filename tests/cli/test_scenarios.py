"""`roadproof scenarios` as its users call it."""

import dataclasses
import functools
import tomllib

import numpy as np
import pytest
from PIL import Image

from command import answered
from roadproof.scenarios import builtin_scenarios, save_scenarios


@pytest.fixture
def scenarios(invoke):
    return functools.partial(invoke, "scenarios")


def test_all_40_are_listed_once(scenarios):
    code, printed = scenarios()
    assert code == 0, printed.err
    words = printed.out.split()
    for scenario in builtin_scenarios():
        assert words.count(scenario.name) == 1
    assert len(builtin_scenarios()) == 40


def test_a_list_of_ones_own_is_listed_and_drawn(scenarios, tmp_path):
    first = builtin_scenarios()[0]
    save_scenarios([dataclasses.replace(first, name="my [first]", time_limit_s=77.0)], tmp_path / "own.toml")
    code, printed = scenarios("--scenarios", tmp_path / "own.toml", "--out", tmp_path / "map.png")
    assert code == 0, printed.err
    assert "my [first]" in printed.out
    assert "77" in printed.out
    assert "left-03" not in printed.out
    assert np.asarray(Image.open(tmp_path / "map.png").convert("RGB")).std() > 10


def test_they_are_objects_for_programs(scenarios, tmp_path):
    listed = builtin_scenarios()[:2]
    save_scenarios(listed, tmp_path / "own.toml")
    code, printed = scenarios("--scenarios", tmp_path / "own.toml", "--json")
    assert (code, printed.err) == (0, "")
    told = answered(printed.out)["scenario"]
    kept = tomllib.loads((tmp_path / "own.toml").read_text())["scenario"]
    for one, file in zip(told, kept, strict=True):
        assert {key: one[key] for key in file} == file
        assert 0 < one["to_canvas_m"] < one["route_m"]


def test_mistakes_are_one_clear_line(scenarios, tmp_path):
    first = builtin_scenarios()[0]
    save_scenarios([dataclasses.replace(first, map_name="city")], tmp_path / "city.toml")
    (tmp_path / "file").write_text("")
    for options, message in (
        (["--scenarios", tmp_path / "none.toml"], "cannot read"),
        (["--scenarios", tmp_path / "city.toml"], "has no map 'city'"),
        (["--out", tmp_path / "file" / "map.png"], "cannot write"),
        (["--out", tmp_path / "map.mp3"], "cannot be drawn"),
    ):
        code, printed = scenarios(*options)
        assert code == 2
        assert message in printed.err
        assert printed.err.startswith("roadproof: ")
        assert printed.err.count("\n") == 1
