"""Files as someone may have changed them, by accident or to do harm."""

from __future__ import annotations

import json
import random
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from roadproof.drives import Drives
from roadproof.errors import RoadproofError
from roadproof.recordings import load_recordings
from roadproof.report.page import write_report
from roadproof.report.run import read_run

SLOW_S = 30.0
DOORS: dict[str, Callable[[Path], object]] = {
    "run": read_run,
    "recordings": lambda folder: load_recordings(folder / "recordings"),
    "record": lambda folder: Drives.load(folder / "record"),
}
REPORT: dict[str, Callable[[Path], object]] = {"report": write_report}

ODD: tuple[Any, ...] = (
    None, True, -1, 0, 1e39, 1e308, float("nan"), float("inf"), 10**400, -(10**25), "", "x" * 5000, "../../x", "/etc",
    "a\x00b", "<script>", [], {}, [[]], [None], {"a": {}}, "NaN", "1e999", "\ud800",
)  # fmt: skip
"""Values that no file of ours has where they are put."""


def mutated(content: bytes, suffix: str, rng: random.Random) -> bytes:
    """One change: a value of JSON for an odd one, or bytes flipped, cut, doubled, filled with zeros."""
    if suffix == ".json" and rng.random() < 0.7:
        return _with_odd_value(content, rng)
    changed = bytearray(content)
    first = rng.randrange(len(changed))
    length = min(rng.choice((1, 1, 1, 2, 8, 100)), len(changed) - first)
    match rng.randrange(5):
        case 0:
            for place in range(first, first + length):
                changed[place] ^= rng.randrange(1, 256)
        case 1:
            del changed[first:]
        case 2:
            del changed[first : first + length]
        case 3:
            changed[first:first] = changed[first : first + length]
        case _:
            changed[first : first + length] = bytes(length)
    return bytes(changed)


def _with_odd_value(content: bytes, rng: random.Random) -> bytes:
    whole: Any = json.loads(content)
    places = list(places_in(whole))
    if not places:
        return b"[" * 100_000
    box, key = rng.choice(places)
    if rng.random() < 0.15:
        del box[key]
    else:
        box[key] = rng.choice(ODD)
    return json.dumps(whole).encode("utf-8", "surrogatepass")


def places_in(value: Any) -> Any:
    """Every key of every object and every index of every list."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in list(inner):
        yield value, key
        yield from places_in(each)


def open_changed(
    run: Path, doors: dict[str, Callable[[Path], object]], count: int, seed: int
) -> tuple[Counter[str], list[str]]:
    """Change a file of a run folder, open it by every door, put the file back; so many times.

    Returns:
        How often it was opened as if nothing were, or refused in one line; and what went wrong, each in a few words.
    """
    paths, rng = files_of(run, ".json", ".npz", ".png", ".jpg", ".npy"), random.Random(seed)
    before, counted, wrong = set(run.parent.rglob("*")), Counter[str](), list[str]()
    for _ in range(count):
        path = rng.choice(paths)
        kept = path.read_bytes()
        path.write_bytes(mutated(kept, path.suffix, rng))
        for name, door in doors.items():
            began = time.perf_counter()
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    door(run)
                counted["opened"] += 1
            except RoadproofError as error:
                counted["refused"] += 1
                if "\n" in str(error):
                    wrong.append(f"{name}, {path.name}: {str(error)!r:.200} is not one line")
            except Exception as error:
                wrong.append(f"{name}, {path.name}: {type(error).__name__}: {error!s:.200}")
            if time.perf_counter() - began > SLOW_S:
                wrong.append(f"{name}, {path.name}: {time.perf_counter() - began:.0f} s")
        path.write_bytes(kept)
    made = {path.name for path in set(run.parent.rglob("*")) - before}
    wrong += [f"wrote {name}" for name in sorted(made - {"report.html", "result.json", "commands.txt"})]
    return counted, wrong


def files_of(folder: Path, *suffixes: str) -> list[Path]:
    """Every file of some kinds, in one order."""
    return sorted(path for path in folder.rglob("*") if path.is_file() and path.suffix in suffixes)
