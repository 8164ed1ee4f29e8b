"""Numbers out of range are refused in one line, before any work, with the range in the line and in the help."""

import pytest

from command import roadproof

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
    ((*EVALUATE, "--processes", "-3"), "--processes is -3, expected 1 to 256"),
    (("drive", "--cars", "1000000"), "--cars is 1000000, expected 0 to 500"),
    (("demo", "--rounds", "-1"), "--rounds is -1, expected 0 to"),
    (("record", "left-03", "--frames", "0"), "--frames is 0, expected 1 to"),
    (("record", "left-03", "--horizon-m", "inf"), "--horizon-m is inf, expected 1.0 to"),
    (("carla", "serve", "--port", "-1"), "--port is -1, expected 0 to 65,534"),
    (("carla", "serve", "--port", "65535"), "--port is 65535, expected 0 to 65,534"),
    (("train", "--learning-rate", "nan"), "--learning-rate is nan, expected 1e-09 to"),
    (("study", "run", "nowhere.toml", "--workers", "0"), "--workers is 0, expected 1 to 256"),
]


@pytest.mark.parametrize(("words", "said"), REFUSED, ids=[" ".join(words[-2:])[:40] for words, _ in REFUSED])
def test_a_number_out_of_range_is_one_line(invoke, words, said):
    code, printed = invoke(*words)
    assert code == 2
    assert printed.err.startswith(f"roadproof: {said}")
    assert printed.err.count("\n") == 1
    assert printed.out == ""


def test_the_help_states_the_range(invoke):
    code, printed = invoke("attack", "--help")
    assert code == 0
    assert "[1 to 64]" in printed.out


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
