"""The installed command in a process of its own, where nothing checks types."""

import json
import os
import subprocess
import sys

PROGRAM = "from roadproof.cli import main\nif __name__ == '__main__': main()"


def roadproof(*words, folder=None, before=""):
    """Run `roadproof WORDS` in a folder, after the Python of `before`, which says how this process differs."""
    return subprocess.run(
        [sys.executable, "-c", f"{before}\n{PROGRAM}", *map(str, words)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=600,
    )


def answered(printed):
    """What --json printed: one document, and no number in it that is none."""

    def refuse(word):
        raise AssertionError(f"{word} is not JSON")

    assert printed.count("\n") == 1
    return json.loads(printed, parse_constant=refuse)


def stored(path):
    """What a results file holds."""
    return json.loads(path.read_text(encoding="utf-8"))
