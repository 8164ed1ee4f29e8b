"""Numbers out of range are refused in one line, before any work, with the range in the line and in the help."""

import re

import pytest
from rich.markup import render
from typer.main import get_command

from command import roadproof
from roadproof.cli import app
from roadproof.cli.group import SEVERAL

ATTACK = ("attack", "nowhere", "--controller", "pilotnet")
EVALUATE = ("evaluate", "nowhere.json", "--controller", "pilotnet")
REFUSED = [
    ((*ATTACK, "--seed", "-1"), "--seed is -1, expected 0 to 4,294,967,295"),
    ((*ATTACK, "--seed", "1" + 23 * "0"), "--seed is 1"),
    ((*ATTACK, "--figures", "1000000"), "--figures is 1000000, expected 1 to 64"),
    ((*ATTACK, "--random-patterns", "-5"), "--random-patterns is -5, expected 0 to 100,000"),
    ((*ATTACK, "--calls", "-1"), "--calls is -1, expected 1 to"),
    ((*ATTACK, "--max-painted-share", "nan"), "--max-painted-share is nan, expected 0.0 to 1.0"),
    ((*EVALUATE, "--random", "-1"), "--random is -1, expected 0 to"),
    ((*EVALUATE, "--runs", "-1"), "--runs is -1, expected 0 to"),
    ((*EVALUATE, "--processes", "-3"), "--processes is -3, expected 0 to 256"),
    (("drive", "--cars", "1000000"), "--cars is 1000000, expected 0 to 500"),
    (("demo", "--rounds", "-1"), "--rounds is -1, expected 0 to"),
    (("record", "left-03", "--frames", "0"), "--frames is 0, expected 1 to"),
    (("record", "left-03", "--horizon-m", "inf"), "--horizon-m is inf, expected 1.0 to"),
    (("carla", "serve", "--port", "-1"), "--port is -1, expected 0 to 65,534"),
    (("carla", "serve", "--port", "65535"), "--port is 65535, expected 0 to 65,534"),
    (("train", "--learning-rate", "nan"), "--learning-rate is nan, expected 1e-09 to"),
    (("study", "run", "nowhere.toml", "--workers", "0"), "--workers is 0, expected 1 to 256"),
]


@pytest.mark.parametrize(
    ("word", "said"),
    [("", "is empty"), ("o\udcff", r"is 'o\udcff'"), ("a\nb", r"is 'a\nb'")],
    ids=["none", "raw", "line"],
)
def test_a_word_that_cannot_be_shown_again_is_refused_before_any_work(invoke, word, said):
    code, printed = invoke("record", "left-03", "--out", word)
    assert code == 2
    assert f"a word of the command {said}, expected text in one line" in printed.err


@pytest.mark.parametrize(("words", "said"), REFUSED, ids=[" ".join(words[-2:])[:40] for words, _ in REFUSED])
def test_a_number_out_of_range_is_one_line(invoke, words, said):
    code, printed = invoke(*words)
    assert code == 2
    assert printed.err.startswith(f"roadproof: {said}")
    assert printed.err.count("\n") == 1
    assert printed.out == ""


def every_verb():
    """The words and the options of every verb."""

    def verbs(group, words):
        for name, each in group.commands.items():
            yield from verbs(each, (*words, name)) if hasattr(each, "commands") else [((*words, name), each.params)]

    return list(verbs(get_command(app), ()))


def test_the_help_states_ranges_and_defaults_and_plain_types(invoke, monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")
    for words in ((), *(words for words, _ in every_verb())):
        code, printed = invoke(*words, "--help")
        assert code == 0
        assert "<bool>" not in printed.out
        # Neither `<float,float>...` nor `<list[str]>`: several values are named.
        assert re.findall(r"<\w*[^\w>][^>]*>", printed.out) == []
        if words == ("attack",):
            assert "[1 to 64] [default: 5]" in printed.out
            assert "[default: (100; 32 for a deviation or a speed)]" in printed.out
            assert "DARKEST BRIGHTEST" in printed.out


def test_what_an_option_of_several_values_takes_is_named():
    several = {option.name for _, options in every_verb() for option in options if option.nargs > 1 or option.multiple}
    assert several == set(SEVERAL)


def test_the_help_is_shown_as_it_is_written():
    """Square brackets around words would be read as markup, and be gone."""
    for words, options in every_verb():
        for option in options:
            assert render(option.help or "").plain == option.help, words


SAME = ("scenarios", "simulator", "device", "processes", "seed", "trust")
WORLDS = "Where it is driven: town, town:egl, carla://HOST:PORT, or recorded:FOLDER to predict it in recordings."


@pytest.mark.parametrize("name", SAME)
def test_an_option_means_the_same_in_every_verb(name):
    found = [option for _, options in every_verb() for option in options if option.name == name]
    assert len(found) > 1
    assert {tuple(option.opts) for option in found} == {(f"--{name}",)}
    assert len({option.help for option in found} - {WORLDS}) == 1


@pytest.mark.parametrize(("verb", "words"), [("train", []), ("drive", []), ("record", ["left-03"])])
def test_a_device_that_is_not_there_is_refused_before_any_work(invoke, tmp_path, verb, words):
    code, printed = invoke(verb, *words, "--device", "tpu", "--out", tmp_path / "out")
    assert (code, printed.out) == (2, "")
    assert printed.err.startswith("roadproof: device 'tpu' is unknown")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("roadproof comp", ["compare"]),
        ("roadproof demo --scenario straight-0", [f"straight-0{k}" for k in range(1, 10)]),
        ("roadproof evaluate --weathers clear-noon,rai", ["clear-noon,rainy-noon"]),
    ],
)
def test_the_shell_completes_commands_scenarios_and_weathers(words, expected):
    asked = {"_ROADPROOF_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
    done = roadproof(before=f"import os; os.environ.update({asked!r})")
    assert sorted(done.stdout.split()) == expected
