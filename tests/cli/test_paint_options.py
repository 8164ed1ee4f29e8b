"""The options on paint, as every searching verb has them."""

from __future__ import annotations

import textwrap
from dataclasses import replace
from pathlib import Path

import pytest

from recorded_drives import drivable_set
from roadproof.attacks import AttackResult
from roadproof.cli.paint import OPTIONS, with_paint
from roadproof.compositing import Variation
from roadproof.paint import LaneMark, Site
from roadproof.paint.limits import area_m2
from roadproof.recordings import save_recordings
from roadproof.search_space import SearchSpace

CONTROLLER = textwrap.dedent(
    """
    import torch

    class Linear(torch.nn.Module):
        input_size = (88, 200)

        def __init__(self):
            super().__init__()
            weight = torch.zeros(3, 88, 200)
            weight[:, :, 100:], weight[:, :, :100] = 1e-3, -1e-3
            self.register_buffer("weight", weight)

        def steer(self, frames, speed_mps, command):
            return (frames * self.weight).sum((1, 2, 3))

        def act(self, frame, speed_mps, command):
            raise NotImplementedError
    """
)
FILE = textwrap.dedent(
    """
    [paint]
    keep_out_m = 0.3
    max_area_m2 = 9.0

    [[paint.marks]]
    points_m = [[3.8, -5.0], [3.8, 14.0]]
    width_m = 0.15

    [variation]
    draws = 2
    wear = 0.1
    """
)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("workplace")
    road = drivable_set(marks=(LaneMark(points_m=((0.1, -5.0), (0.1, 14.0))),))
    few = replace(road, recordings=tuple(each.thinned(10) for each in road.recordings))
    save_recordings(few, folder / "set", compact=True)
    (folder / "own_controller.py").write_text(CONTROLLER)
    (folder / "paint.toml").write_text(FILE)
    return folder


@pytest.fixture
def here(workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    return workplace


def command(*options):
    quick = ["--figures", "2", "--method", "random", "--calls", "3", "--random-patterns", "0"]
    return ["attack", "set", "--controller", "own_controller:Linear", "--objective", "steering", *quick, *options]


def test_limits_of_the_options_come_before_those_of_the_file(here, tmp_path, invoke):
    given = ["--paint", "paint.toml", "--max-area", "1.2", "--colours", "#dededa,#303030", "--out", tmp_path / "out"]
    code, printed = invoke(*command(*given))
    assert code == 0, printed.err
    assert "How conspicuous it is: 2 figures, " in printed.out
    result = AttackResult.load(tmp_path / "out")
    limits, told = result.space.limits, result.conspicuousness
    assert (limits.max_area_m2, limits.keep_out_m, limits.colours) == (1.2, 0.3, ("#dededa", "#303030"))
    assert limits.marks[0].width_m == 0.15
    assert result.objective == "steering shift over variations"
    assert told.area_m2 <= 1.2
    assert told.mark_distance_m >= 0.3
    names = {"#" + "".join(f"{round(255 * float(c)):02x}" for c in rgb) for rgb in result.pattern.colours}
    assert names <= {"#dededa", "#303030"}


def test_the_file_that_the_documentation_shows_leaves_paint(tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "plausible-paint.md").read_text(encoding="utf-8")
    (tmp_path / "paint.toml").write_text(text.split("```toml\n")[1].split("```")[0], encoding="utf-8")
    asked = with_paint(dict.fromkeys(OPTIONS) | {"paint": tmp_path / "paint.toml"})["paint"]
    space = SearchSpace(figures=5, limits=asked.limits).on(Site(size_m=(6.8, 9.5)))
    assert float(area_m2(space.drawn(8, 0), (6.8, 9.5)).max()) > 1.0
    assert asked.variation == Variation(), "the page says that these are the defaults"


def test_robust_comes_before_the_variation_of_the_file(here):
    asked = dict.fromkeys(OPTIONS) | {"paint": here / "paint.toml"}
    assert with_paint(asked)["paint"].variation == Variation(draws=2, wear=0.1)
    assert with_paint(asked | {"robust": True})["paint"].variation == Variation()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--max-area", "0"], "--max-area is 0.0, expected 0.01 to 10,000"),
        (["--keep-out", "9"], "leaves no place for paint on the canvas"),
        (["--contrast", "0.97", "0.99"], "no paint has a contrast of 0.97 to 0.99"),
        (["--contrast", "0.5", "0.4"], "contrast is (0.5, 0.4)"),
        (["--colours", "white"], "colour is 'white'"),
        (["--black", "--colours", "#ffffff"], "only black paint is searched"),
        (["--method", "published", "--printable"], "without limits on paint"),
        (["--paint", "none.toml"], "none.toml"),
    ],
)
def test_what_leaves_no_pattern_is_one_line_and_writes_nothing(here, tmp_path, invoke, options, message):
    words = command(*options, "--out", tmp_path / "out")
    if "published" in options:
        at = words.index("--method")
        del words[at : at + 4]
    code, printed = invoke(*words)
    assert code == 2
    assert message in printed.err
    assert len(printed.err.strip().splitlines()) == 1
    assert not (tmp_path / "out" / "result.json").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[paint]\nmax_area = 2.0\n", "did you mean 'max_area_m2'?"),
        ("[pant]\n", "expected [paint] and [variation]"),
        ("[[paint.marks]]\npoints = [[1.0, 2.0]]\n", "did you mean 'points_m'?"),
        ("[variation]\nwear = 1.5\n", "wear is 1.5, expected 0 to 0.9"),
        ("[paint]\ncontrast = 0.2\n", "contrast"),
    ],
)
def test_a_file_that_makes_no_sense_is_one_line(here, tmp_path, invoke, text, message):
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    code, printed = invoke(*command("--paint", file, "--out", tmp_path / "out"))
    assert code == 2
    assert message in printed.err
    assert "wrong.toml" in printed.err
    assert len(printed.err.strip().splitlines()) == 1


@pytest.mark.parametrize("verb", ["attack", "demo", "harden"])
def test_every_searching_verb_has_the_same_options(verb, invoke):
    code, printed = invoke(verb, "--help")
    assert code == 0
    for option in ("--max-area", "--colours", "--printable", "--contrast", "--keep-out", "--robust", "--paint"):
        assert option in printed.out
