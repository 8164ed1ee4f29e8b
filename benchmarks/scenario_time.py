"""How long does a default scenario take from the command to the report, and in which stage does the time go?

    python benchmarks/scenario_time.py --json OUT [--scenario left-03] [--controllers pilotnet cil] [--times 3]
        [--processes 1]

`roadproof demo` with its defaults in a fresh process and a new folder, so many times for each controller, in turn. The
first time is cold where this process may tell Linux to forget the files that it has read, and as it was otherwise;
the others find everything in memory. Beside the clock stands what each stage took, by the run's own account; the rest
is in no stage: start of Python, torch and the town, and the page. Nothing else may run meanwhile.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from roadproof.io.files import write_json
from roadproof.machine import made_with

GOALS_S = {"pilotnet": 75.0, "cil": 120.0}


def forget_files() -> bool:
    """Whether Linux has let go of what it keeps of files; only root may ask."""
    with suppress(OSError):
        os.sync()
        Path("/proc/sys/vm/drop_caches").write_text("3")
        return True
    return False


def timed(scenario: str, controller: str, processes: int, folder: Path) -> dict[str, Any]:
    """One run: seconds by the clock, by stage, and in none."""
    line = ["demo", "--scenario", scenario, "--controller", controller, "--processes", str(processes)]
    line += ["--out", str(folder), "--quiet"]
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", "from roadproof.cli import main; main()", *line], check=True)
    whole_s = time.perf_counter() - began
    cost = json.loads((folder / "run.json").read_text())["cost"]
    stages = {name: each["seconds"] for name, each in cost.items()}
    return {"whole_s": whole_s, "stages_s": stages, "in_no_stage_s": whole_s - sum(stages.values())}


def main() -> None:
    """Run, sum up, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--scenario", default="left-03")
    parser.add_argument("--controllers", nargs="+", default=list(GOALS_S))
    parser.add_argument("--times", type=int, default=3)
    parser.add_argument("--processes", type=int, default=1, help="as of `roadproof demo`; 0 for one a core")
    given = parser.parse_args()
    records: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as place:
        for k in range(given.times):
            for controller in given.controllers:
                cold = k == 0 and forget_files()
                run = timed(given.scenario, controller, given.processes, Path(place) / f"{controller}-{k}")
                records.append({"controller": controller, "first": k == 0, "cold": cold} | run)
                print(json.dumps(records[-1]), flush=True)
    warm = {
        controller: statistics.median(
            each["whole_s"] for each in records if each["controller"] == controller and not each["first"]
        )
        for controller in given.controllers
        if any(each["controller"] == controller and not each["first"] for each in records)
    }
    content = {
        "made_with": made_with(),
        "scenario": given.scenario,
        "processes": given.processes,
        "goals_s": GOALS_S,
        "warm_median_s": warm,
        "records": records,
    }
    write_json(given.json, content)


if __name__ == "__main__":
    main()
