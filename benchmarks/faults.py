"""What happens to those who give roadproof bad input, change its files, kill it, or let it work for long?

    python benchmarks/faults.py --json OUT [--part files|inputs|kills|memory] [--count N] [--seed 0]

files: a small run folder is made by the real stages, as the tests make it. One file of it is changed at a time: a value
in its JSON for an odd one, bytes flipped, cut, doubled, zeroed. Then it is read as a run, as recordings and as recorded
drives, and for every fifth change a report is made of it. Counted: opened as if nothing were, refused in one line, and
what went wrong: any other exception, a message of several lines, more than 30 s, a file written elsewhere.

inputs: every option of every command with every odd value of its kind, and damaged plans, scenario files, patterns,
recordings and weights. Expected of each: exit code 2 and one line on standard error, which names the option where a
number is out of its range. What is damaged and still makes sense may be taken.

kills: demo, alone and with two processes, attack, check, study with two workers, training and hardening, tiny, each
killed at a random time by SIGKILL, SIGTERM or SIGINT; half the times the file written last loses its end. The same
command is given again, where need be after the file that it names was removed. Expected: all files as without a kill,
byte for byte but for times.

memory: what the process holds after each tenth of 50 evaluations and of 200 searches in the recorded world; wrong is
more in the second half than in the first, by more than two parts of a hundred (medians).

Without --part all of them. A part's counts replace the old ones in OUT; the others stay.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from itertools import chain
from pathlib import Path
from typing import Any

from roadproof.io.files import write_json
from roadproof.machine import made_with

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from bad_inputs import attempt, command_lines, damaged_files
from killable import EXPECTED, kill_and_resume, starter
from long_work import evaluations, searches
from mutations import DOORS, REPORT, open_changed
from runs import write_run


def files(count: int, seed: int, place: Path) -> dict[str, Any]:
    """Change, open, count."""
    run = place / "run"
    write_run(run)
    read, unread = open_changed(run, DOORS, count, seed)
    made, unmade = open_changed(run, REPORT, count // 5, seed + 1)
    return {"changed_files": count + count // 5, "read": read, "reported": made, "wrong": unread + unmade}


def inputs(count: int, seed: int, place: Path) -> dict[str, Any]:
    """Every command line, and so many damaged files."""
    counted, wrong = Counter[str](), list[str]()
    # One by one: a file is damaged only while it is tried.
    for bad in chain(command_lines(), damaged_files(place, count, seed)):
        happened = attempt(bad)
        counted[f"{bad.kind}, {'taken' if happened == 'taken' else 'wrong' if happened else 'refused'}"] += 1
        if happened not in ("", "taken"):
            wrong.append(f"{' '.join(bad.words):.200}: {happened}")
    return {"inputs": sum(counted.values()), "counted": counted, "wrong": wrong}


def kills(count: int, seed: int, place: Path) -> dict[str, Any]:
    """So many kills, dealt out to the commands in turn."""
    begin, counted, wrong = starter(), Counter[str](), list[str]()
    for k, name in enumerate(EXPECTED):
        began, straight = time.perf_counter(), place / f"straight-{name}"
        whole = begin(name, straight)
        whole.join()
        whole_s = time.perf_counter() - began
        if whole.exitcode != EXPECTED[name]:
            wrong.append(f"{name} alone ended with {whole.exitcode}")
            continue
        rng = random.Random(f"{seed} {name}")
        for _ in range(count // len(EXPECTED) + (k < count % len(EXPECTED))):
            lost = kill_and_resume(begin, name, straight, whole_s, rng)
            counted[f"{name}, {'lost' if lost else 'the same'}"] += 1
            wrong += [lost] if lost else []
            print(f"kill {sum(counted.values())} of {count}: {lost or name}", flush=True)
    return {"kills": sum(counted.values()), "counted": counted, "wrong": wrong}


def memory(count: int, seed: int, place: Path) -> dict[str, Any]:
    """What the process held after each tenth of the work, in MiB."""
    del seed
    told: dict[str, Any] = {}
    for name, work, times in (("evaluations", evaluations, count // 4), ("searches", searches, count)):
        steps, held = work(place / name), list[float]()
        ends = {max(round(tenth * times / 10), 1) for tenth in range(1, 11)}
        for k in range(times):
            next(steps)
            if k + 1 in ends:
                held.append(round(_held_mib(), 1))
        told[name] = {"count": times, "mib_after_each_tenth": held}
    grown = [name for name, each in told.items() if _grows(each["mib_after_each_tenth"])]
    return told | {"wrong": [f"{name} grow" for name in grown]}


def _grows(held: list[float]) -> bool:
    """Whether the second half holds more than the first, by more than two parts of a hundred.

    Medians, since an allocator takes and gives back tens of MiB; what leaks goes on growing.
    """
    half = len(held) // 2
    return statistics.median(held[half:]) > 1.02 * statistics.median(held[:half])


def _held_mib() -> float:
    """Resident memory, as Linux counts it."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


PARTS: dict[str, tuple[Callable[[int, int, Path], dict[str, Any]], int]] = {
    "files": (files, 1000),
    "inputs": (inputs, 500),
    "kills": (kills, 100),
    "memory": (memory, 200),
}


def main() -> None:
    """One part, or all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--part", choices=PARTS)
    parser.add_argument("--count", type=int, help="of the part; by default 1000, 500, 100 and 200")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    content: dict[str, Any] = json.loads(given.json.read_text()) if given.json.exists() else {}
    content["made_with"] = made_with()
    for name in [given.part] if given.part else PARTS:
        part, usual = PARTS[name]
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as place:
            done = part(given.count or usual, given.seed, Path(place))
        content[name] = done | {"seconds": time.perf_counter() - began}
        write_json(given.json, content)
        print(json.dumps({name: content[name]}, indent=1))


if __name__ == "__main__":
    main()
