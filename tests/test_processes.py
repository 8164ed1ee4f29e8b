"""Processes beside this one end with it, also when it is killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from roadproof.processes import processes_beside

SCRIPT = """
import os, time
from roadproof.processes import processes_beside
if __name__ == "__main__":
    with processes_beside(1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 120).result()
"""


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().split(")")[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks processes up in Linux's /proc")
@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGTERM])
def test_a_process_at_work_ends_when_its_parent_is_killed(blow):
    with subprocess.Popen([sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, text=True) as parent:
        child = int(parent.stdout.readline())
        assert alive(child)
        parent.send_signal(blow)
        parent.wait()
    deadline = time.monotonic() + 20
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(child)


def test_what_one_prints_is_none_of_the_results(capfd):
    with processes_beside(1) as pool:
        pool.submit(print, "loud", flush=True).result()
    assert tuple(capfd.readouterr()) == ("", "loud\n")


def test_each_begins_as_told():
    with processes_beside(2, os.putenv, "ROADPROOF_TOLD", "yes") as pool:
        assert pool.submit(subprocess.getoutput, "echo $ROADPROOF_TOLD").result() == "yes"
        assert pool.submit(os.getpid).result() != os.getpid()
