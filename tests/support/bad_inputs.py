"""What someone may give `roadproof` by mistake or to do harm: command lines, plans, scenarios, patterns, recordings,
weights. Made by code, so that no option that is added is forgotten."""

from __future__ import annotations

import inspect
import io
import random
import shutil
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import typer
from typer.models import ArgumentInfo

from killable import STUDY
from mutations import files_of, mutated
from paint_shy import along_a_street
from recorded_drives import drivable_set
from roadproof.controllers.shipped import shipped_weights
from roadproof.patterns import save_pattern
from roadproof.recordings import save_recordings
from roadproof.scenarios import save_scenarios
from team_folder import BAR, PLAN, write_team

KINDS = (".json", ".npz", ".png", ".npy")
ODD_TOML = (
    "nan", "-inf", "-1", "0", "1e39", "1" + 23 * "0", "1.5", "true", '""', "[]", "{}", "[[]]", "[1, 1]", "1979-05-27",
    "'x'", f"'{'x' * 5000}'", "'../../x'", "'/etc/passwd'", "'a\u0000b'", "['left-03', 'left-03']", "[nan, nan]",
    "1000000000", "{ x_m = nan }", "[" * 5000, "'",
)  # fmt: skip
"""Values that no plan has where they are put."""

NOWHERE = "/dev/null/nowhere"
"""A folder that nobody can write: where all else is well, a command is refused here, before any work."""

NUMBERS = ("-1", "-9" + 22 * "9", "1" + 23 * "0", "nan", "inf", "-inf", "1e999", "-0.5", "abc", "", " ", "0x10", "1;2")
"""Out of the range of every number that is asked for, or no number at all."""

WORDS = ("", " ", "nosuch", "x" * 5000, "../../x", "a\nb", "\x1b[31mred", "<script>", "ä", "-", "left-03\\", "{}", ",")
"""Names of nothing."""

PLACES = ("", ".", "nowhere", "/dev/null", "/dev/null/x", "/", "x" * 5000, "a\nb", "~", "nul\tx", "/proc/self/mem")
"""Files and folders that are not there, or are no such thing."""

UNWRITABLE = ("/dev/null", "/dev/null/x", "/proc/self/mem", "/proc/nowhere/x", "x" * 5000, "a/" * 3000)
ADDRESSES = (
    "moon",
    "carla://",
    "carla://x:0",
    "carla://x:65535",
    "carla://x:1e9",
    "carla://[::1",
    "recorded:",
    "carla:",
)
GATES = {
    ("calibrate",): ("nowhere",), ("report",): ("nowhere",), ("select",): ("nowhere", "--controller", "nosuch"),
    ("attack",): ("nowhere", "--controller", "nosuch"), ("evaluate",): ("nowhere.json", "--out", NOWHERE),
    ("check",): ("nowhere.toml",), ("check-controller",): ("nosuch",), ("convert-cil",): ("nowhere.npz", NOWHERE),
    ("harden",): ("nosuch", "--train-on", "nosuch", "--out", NOWHERE), ("record",): ("left-03", "--out", NOWHERE),
    ("study", "run"): ("nowhere.toml",), ("study", "tables"): ("nowhere",), ("controllers",): ("nosuch",),
    ("study", "transfer"): ("nowhere.toml", "--controllers", "nosuch"), ("scenarios",): ("--scenarios", "nowhere.toml"),
    ("carla", "scenario"): ("--port", "0", "0", "1"), ("carla", "doctor"): ("--port", "0"),
    ("carla", "serve"): ("--map", "nowhere.xodr"), ("open",): ("nowhere",),
}  # fmt: skip
"""What ends each command before it works, where nothing else does; by default the folder that cannot be written."""


@dataclass(frozen=True)
class Bad:
    """One bad input.

    Args:
        kind: of input.
        words: of the command line.
        names: what the refusal must name; empty where any refusal will do.
        may_pass: whether it may be harmless: then the command may go on to what ends it, or end well.
    """

    kind: str
    words: tuple[str, ...]
    names: str = ""
    may_pass: bool = False


def command_lines() -> Iterator[Bad]:
    """Every option of every command, with every odd value of its kind."""
    from roadproof.cli import app

    for path, function in _verbs(app):
        gate = GATES.get(path, ("--out", NOWHERE))
        hints = get_type_hints(function, include_extras=True)
        for name in inspect.signature(function).parameters:
            hint = hints[name]
            kind, said = get_args(hint)[0], next(each for each in get_args(hint)[1:] if hasattr(each, "param_decls"))
            if isinstance(said, ArgumentInfo):
                continue
            option = next((word for word in said.param_decls or () if len(word) > 2), f"--{name.replace('_', '-')}")
            # What is tried comes first, since the first mistake is told.
            place = gate.index(option) if option in gate else len(gate)
            rest = (*gate[:place], *gate[place + 2 :])
            if kind is bool:
                yield Bad("command lines", (*path, f"{option}=maybe", *rest))
                continue
            number = any(each in repr(kind) for each in ("int", "float"))
            values = NUMBERS if number else PLACES if "Path" in repr(kind) else WORDS
            if option == "--out":
                values = UNWRITABLE
            for value in (*values, *(ADDRESSES if option == "--simulator" else ())):
                many = len(get_args(kind)) if get_origin(kind) is tuple else 1
                # `=`, since a value may begin with a dash.
                given = (f"{option}={value}",) if many == 1 else (option, *[value] * many)
                yield Bad("command lines", (*path, *given, *rest), option if number and many == 1 else "")
        yield Bad("command lines", (*path, *gate, "--no-such-option"), "--no-such-option")
        yield Bad("command lines", (*path, *gate, *["too-much"] * 9))


def _verbs(group: typer.Typer, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for each in group.registered_commands:
        assert each.callback is not None
        yield (*path, each.name or each.callback.__name__.replace("_", "-")), each.callback
    for inner in group.registered_groups:
        assert inner.typer_instance is not None
        yield from _verbs(inner.typer_instance, (*path, str(inner.name)))


def attempt(bad: Bad, limit_s: float = 60.0) -> str:
    """Call the command in this process: "" where it was refused as it should be, "taken" where that may be; else what
    happened instead, in a few words."""
    from roadproof.cli import main

    out, err, code, began = io.StringIO(), io.StringIO(), None, time.perf_counter()
    before, sys.argv = sys.argv, ["roadproof", *bad.words]
    try:
        with redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("error")
            main()
    except SystemExit as ended:
        code = ended.code or 0
    except BaseException as error:
        return f"{type(error).__name__}: {error!s:.300}"
    finally:
        sys.argv = before
    said, seconds = err.getvalue(), time.perf_counter() - began
    if seconds > limit_s:
        return f"took {seconds:.0f} s"
    if code != 2:
        return "taken" if bad.may_pass and code in (0, 1) else f"exit code {code}: {(said or out.getvalue())[-300:]!r}"
    if said.count("\n") != 1 or not said.startswith("roadproof: "):
        return f"not one line: {said[-300:]!r}"
    if bad.names not in said.replace(NOWHERE, ""):
        return "taken" if bad.may_pass else f"refused for something else: {said:.300}"
    return ""


def damaged_files(place: Path, count: int, seed: int) -> Iterator[Bad]:
    """Plans, scenario files, patterns, recordings and weights, one change in each; the file is put back afterwards."""
    rng, kinds = random.Random(seed), _whole_files(place)
    for k in range(count):
        kind, (words, paths) = list(kinds.items())[k % len(kinds)]
        path = rng.choice(paths)
        kept = path.read_bytes()
        text = path.suffix == ".toml" and rng.random() < 0.8
        path.write_bytes(_with_odd_line(kept, rng) if text else _changed(kept, path.suffix, rng))
        # What is refused names the file, or the folder of it; else the command went on to what ends it.
        yield Bad(kind, words, paths[0].parent.name if len(paths) > 1 else path.name, may_pass=True)
        path.write_bytes(kept)


def _whole_files(place: Path) -> dict[str, tuple[tuple[str, ...], list[Path]]]:
    """What is damaged: by kind the command that reads it, and its files."""
    plan, set_, out = place / "study.toml", place / "damaged-set", str(place / "out")
    save_scenarios([along_a_street(place, 2.0)], place / "scenarios.toml")
    plan.write_text(STUDY)
    pattern, weights = place / "pattern.json", place / "weights.safetensors"
    save_pattern(BAR, pattern)
    shutil.copyfile(shipped_weights("pilotnet"), weights)
    save_recordings(drivable_set(), set_)
    check = write_team(place / "team", plan=PLAN.replace("team_folder:magenta_shy", "nosuch.safetensors"))
    street = ("--scenarios", f"{place}/scenarios.toml", "--scenario", "street", "--out", NOWHERE)
    return {
        "study plans": (("study", "run", str(plan), "--out", NOWHERE), [plan]),
        "check plans": (("check", str(check), "--out", out), [check]),
        "scenario files": (("demo", *street), [place / "scenarios.toml"]),
        "patterns": (("evaluate", str(pattern), "--controller", "expert", "--out", NOWHERE), [pattern]),
        "recordings": (("attack", str(set_), "--controller", "nosuch", "--out", out), files_of(set_, *KINDS)),
        "weights": (("demo", "--controller", str(weights), "--out", NOWHERE), [weights]),
    }


def _with_odd_line(content: bytes, rng: random.Random) -> bytes:
    """One value of a TOML file for an odd one, or a line twice, or gone."""
    lines = content.decode().splitlines()
    k = rng.choice([number for number, line in enumerate(lines) if line.strip()])
    key, equals, _ = lines[k].partition("=")
    if equals and rng.random() < 0.8:
        lines[k] = f"{key}= {rng.choice(ODD_TOML)}"
    else:
        lines[k : k + 1] = rng.choice(([], [lines[k]] * 2))
    return "\n".join(lines).encode()


def _changed(content: bytes, suffix: str, rng: random.Random) -> bytes:
    """As `mutated`; of weights rather what says how they lie."""
    if suffix == ".safetensors" and rng.random() < 0.7:
        return mutated(content[:2000], suffix, rng) + content[2000:]
    return mutated(content, suffix, rng)
