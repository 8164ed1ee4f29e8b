"""What happens to those who open a run folder in which someone changed a file?

    python benchmarks/faults.py --json OUT [--files 1000] [--seed 0]

A small run folder is made by the real stages, as the tests make it. One file of it is changed at a time: a value in its
JSON for an odd one, bytes flipped, cut, doubled, zeroed. Then it is read as a run, as recordings and as recorded
drives, and for every fifth change a report is made of it. Counted: opened as if nothing were, refused in one line, and
what went wrong: any other exception, a message of several lines, more than 30 s, a file written elsewhere.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
import time
from pathlib import Path

import roadproof

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from mutations import DOORS, REPORT, open_changed
from runs import write_run


def main() -> None:
    """Change, open, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--files", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as place:
        run = Path(place) / "run"
        write_run(run)
        read, unread = open_changed(run, DOORS, given.files, given.seed)
        made, unmade = open_changed(run, REPORT, given.files // 5, given.seed + 1)
    content = {
        "roadproof": roadproof.__version__,
        "python": platform.python_version(),
        "changed_files": given.files + given.files // 5,
        "read": dict(read),
        "reported": dict(made),
        "wrong": unread + unmade,
        "seconds": time.perf_counter() - began,
    }
    given.json.write_text(json.dumps(content, indent=1) + "\n")
    print(json.dumps(content, indent=1))


if __name__ == "__main__":
    main()
