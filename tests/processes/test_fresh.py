"""Processes beside this one end with it, also when it is killed, and a terminal's Ctrl-C is not theirs."""

import os
import signal
import subprocess
import sys
import threading
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


INTERRUPTED = """
import signal, sys
from contextlib import nullcontext
from roadproof.processes import processes_beside
if __name__ == "__main__":
    signal.signal(signal.SIGINT, lambda *_: None)  # a parent that is not interrupted itself
    with processes_beside(1) as pool:
        work = pool.submit(sum, [1, 2])
        print("begins", flush=True)
        print(work.result(), flush=True)
        print(pool.submit(signal.getsignal, signal.SIGINT).result() is signal.default_int_handler, flush=True)
"""


def test_ctrl_c_in_a_terminal_reaches_the_parent_alone():
    asked = [sys.executable, "-c", INTERRUPTED]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(asked, **pipes, text=True, start_new_session=True) as parent:
        assert parent.stdout.readline() == "begins\n"
        for _ in range(20):
            os.killpg(parent.pid, signal.SIGINT)
            time.sleep(0.05)
        assert parent.communicate() == ("3\nTrue\n", "")


def test_ctrl_c_while_one_begins_comes_when_it_has_begun(monkeypatch):
    """What minds the processes is known before it is started; an interruption between the two cannot end it."""
    starts = threading.Thread.start

    def interrupted(thread):
        monkeypatch.undo()  # the one that minds the processes alone: it begins another itself
        os.kill(os.getpid(), signal.SIGINT)
        starts(thread)

    with processes_beside(1) as pool:
        monkeypatch.setattr(threading.Thread, "start", interrupted)
        with pytest.raises(KeyboardInterrupt):
            pool.submit(sum, [1, 2])
        assert pool.submit(sum, [3, 4]).result() == 7


def test_what_one_prints_is_none_of_the_results(capfd):
    with processes_beside(1) as pool:
        pool.submit(print, "loud", flush=True).result()
    assert tuple(capfd.readouterr()) == ("", "loud\n")


def test_each_begins_as_told():
    with processes_beside(2, os.putenv, "ROADPROOF_TOLD", "yes") as pool:
        assert pool.submit(subprocess.getoutput, "echo $ROADPROOF_TOLD").result() == "yes"
        assert pool.submit(os.getpid).result() != os.getpid()
