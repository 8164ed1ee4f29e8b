"""Foreign code that does not come back is noticed, and ended by commands alone."""

import logging
import math
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest

from roadproof import foreign
from roadproof.errors import ControllerError
from roadproof.processes import processes_beside


@pytest.fixture
def hasty(monkeypatch):
    """Everything happens within a second or two."""
    monkeypatch.setattr(foreign, "NOTICE_S", 0.1)
    monkeypatch.setattr(foreign, "_LOOK_S", 0.05)
    # The process is that of the tests, and is not to end.
    monkeypatch.setattr(foreign, "GRACE_S", math.inf)
    foreign.end_calls_after(math.inf)
    yield foreign.end_calls_after
    foreign.end_calls_after(math.inf)


def spin(seconds):
    """Python code that does not come back for some time."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.01)
    return "done"


def test_a_slow_call_is_told_with_its_line_and_comes_back(hasty, caplog):
    with caplog.at_level(logging.WARNING, "roadproof"):
        assert foreign.call("the driver", spin, 2.5) == "done"
    said = [record.getMessage() for record in caplog.records]
    assert said
    assert said[0].startswith("the driver has not answered for ")
    assert "test_foreign.py:" in said[0]
    assert "ended" not in said[0]
    # Each time is at least twice the one before.
    assert len(said) <= 6


def test_a_quick_call_is_not_told(hasty, caplog):
    for _ in range(100):
        foreign.call("the driver", spin, 0.001)
    time.sleep(1.2)
    assert not caplog.records
    assert not foreign._calls


def test_a_call_in_a_thread_is_told_and_left(hasty, caplog):
    hasty(0.2)
    answers = []
    worker = threading.Thread(target=lambda: answers.append(foreign.call("the driver", spin, 2.0)))
    worker.start()
    worker.join(timeout=20)
    assert answers == ["done"]
    assert any("it is ended after 0.2 s" in record.getMessage() for record in caplog.records)


def test_a_call_on_the_main_thread_is_ended_after_the_limit(hasty):
    hasty(0.3)
    began = time.monotonic()
    with pytest.raises(ControllerError, match=r"^the driver has not answered for 0\.3 s and was ended"):
        foreign.call("the driver", spin, 60)
    assert time.monotonic() - began < 20


def test_ctrl_c_of_the_user_passes(hasty):
    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        foreign.call("the driver", interrupted)


STUCK = """
    import time
    from roadproof import foreign
    from roadproof.processes import processes_beside

    def deaf():
        while True:
            try:
                time.sleep(0.02)
            except KeyboardInterrupt:
                pass

    def hang():
        foreign.NOTICE_S, foreign.GRACE_S = 0.2, 0.2
        foreign.call("the driver", deaf)

    if __name__ == "__main__":
        foreign.end_calls_after(0.5)
        {how}
"""


def child(tmp_path, how):
    (tmp_path / "stuck.py").write_text(textwrap.dedent(STUCK).format(how=how))
    return subprocess.run(
        [sys.executable, "stuck.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=100,
    )


def test_what_is_deaf_to_ctrl_c_ends_with_its_process(tmp_path):
    done = child(tmp_path, "hang()")
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("roadproof: the driver has not answered for ")
    assert "stuck.py:" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_a_worker_that_hangs_ends(tmp_path):
    done = child(tmp_path, "processes_beside(1).submit(hang).result()")
    assert "roadproof: the driver has not answered for " in done.stderr
    assert "BrokenProcessPool" in done.stderr


SUSPENDED = """
    import time
    from roadproof import foreign

    def healthy():
        print("begun", flush=True)
        until = time.process_time() + 0.1
        while time.process_time() < until:
            pass
        return "done"

    foreign.NOTICE_S, foreign._LOOK_S, foreign.GRACE_S = 1.0, 0.05, 0.2
    foreign.end_calls_after(2.0)
    print(foreign.call("the driver", healthy), flush=True)
"""


def test_a_process_that_was_stopped_goes_on(tmp_path):
    (tmp_path / "suspended.py").write_text(textwrap.dedent(SUSPENDED))
    process = subprocess.Popen(
        [sys.executable, "suspended.py"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "begun\n"
    process.send_signal(signal.SIGSTOP)
    time.sleep(3.0)
    process.send_signal(signal.SIGCONT)
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out, err) == (0, "done\n", "")


def test_workers_have_the_limit_of_the_process_that_began_them(hasty):
    hasty(123.0)
    with processes_beside(1) as pool:
        assert pool.submit(foreign.limit_s).result() == 123.0


def test_what_is_in_the_current_directory_travels_to_workers(tmp_path, monkeypatch):
    (tmp_path / "own_thing.py").write_text("def answer():\n    return 42\n")
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    sys.path.append(str(tmp_path))
    import own_thing

    sys.path[:] = before
    with processes_beside(1) as pool:
        assert pool.submit(own_thing.answer).result() == 42
