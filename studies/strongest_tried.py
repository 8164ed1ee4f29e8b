"""What a study's black-box searches drove over, against what their own measure chose: the strongest pattern of each.

python studies/strongest_tried.py out/small --json OUT

Bayesian optimisation chooses by the published objective, the steering's change; a deviation in metres is what is
reported. Here is the largest deviation among all the patterns that a job tried, each driven once, alone, in the first
weather: what the same drives would have shown to who looks at metres. Read from the jobs' work folders; nothing is
driven.
"""

from __future__ import annotations

import argparse
import json
from collections import defaultdict
from pathlib import Path
from statistics import fmean
from typing import Any

from roadproof.io.files import write_atomically


def main() -> None:
    """Print a line for each K and method, and write a row for each job."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("folder", type=Path, help="of the study")
    arguments.add_argument("--json", type=Path, required=True, help="where the rows go")
    asked = arguments.parse_args()
    rows = [row for path in sorted((asked.folder / "jobs").glob("*/job.json")) if (row := _row(path, asked.folder))]
    rows.sort(key=lambda row: (row["figures"], row["method"], row["scenario"], row["seed"]))
    write_atomically(asked.json, lambda part: part.write_text(json.dumps(rows, indent=1) + "\n"))
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[row["figures"], row["method"]].append(row)
    print("| K | method | jobs | chosen by its own measure | strongest it tried |\n|---|---|---|---|---|")
    for (figures, method), jobs in groups.items():
        chosen, strongest = (fmean(row[name] for row in jobs) for name in ("chosen_m", "strongest_m"))
        print(f"| {figures} | {method} | {len(jobs)} | {chosen:.2f} m | {strongest:.2f} m |")


def _row(path: Path, folder: Path) -> dict[str, Any] | None:
    """A job's; None where it was no black-box search or is not done."""
    job = json.loads(path.read_text())
    driven = folder / "work" / path.parent.name / "driven.json"
    course = path.with_name("history.json")
    if not driven.exists() or not course.exists():
        return None
    drives = json.loads(driven.read_text())["drives"]
    history = json.loads(course.read_text())
    return {
        "scenario": job["scenario"]["name"],
        "figures": str(job["figures"]),
        "method": job["method"]["name"],
        "objective": job["method"]["objective"],
        "seed": job["seed"],
        "tried": len(drives),
        "chosen_m": history["deviation_m"][-1],
        "strongest_m": max(deviation_m for _, _, deviation_m in drives),
    }


if __name__ == "__main__":
    main()
