"""The installed command in a process of its own, where nothing checks types."""

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
