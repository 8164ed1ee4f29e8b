"""Pieces of work are done once, in processes that stay open, and nobody is left."""

import ctypes
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

import pytest
import torch

from roadproof.errors import ControllerError, OutputError, SimulatorError, TrainingError
from roadproof.processes import Pool, spread, stopping
from roadproof.processes.pool import _Left

KILLED_WITH_A_FILE = """
import sys
from contextlib import nullcontext
from roadproof.processes import Pool
if __name__ == "__main__":
    with Pool(nullcontext, 2) as pool:
        print([number for number, _ in pool.each(pool.settle(print), [1, 2])] and pool._folder.name, flush=True)
        sys.stdin.read()
"""


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGTERM])
def test_what_travelled_in_a_file_is_gone_when_the_parent_is_killed(blow):
    asked = [sys.executable, "-c", KILLED_WITH_A_FILE]
    with subprocess.Popen(asked, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        folder = Path(parent.stdout.readline().strip())
        assert list(folder.iterdir())
        parent.send_signal(blow)
        parent.wait()
    deadline = time.monotonic() + 20
    while folder.exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not folder.exists()


ENDED_AT_ONCE = """
import operator, threading, time
from contextlib import nullcontext
from multiprocessing import synchronize
from roadproof.processes import Pool

unlink = synchronize.sem_unlink

def unlink_slowly(name):
    unlink(name)
    if threading.current_thread() is not threading.main_thread():
        time.sleep(0.3)  # Python ends meanwhile, where it does not wait for the thread

if __name__ == "__main__":
    synchronize.sem_unlink = unlink_slowly
    try:
        with Pool(nullcontext, 2) as pool:
            pool.begin(operator.is_)
            raise ValueError("refused")
    except ValueError:
        pass
"""


def test_processes_that_have_only_just_begun_have_nothing_to_say_when_all_is_refused():
    ended = subprocess.run([sys.executable, "-c", ENDED_AT_ONCE], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")


def squared(inside, number):
    del inside
    return number**2, os.getpid()


def refused_or_endless(inside, number):
    """The second of two is at work for a minute unless it hears that the first one failed."""
    del inside
    if number == 1:
        raise TrainingError(f"{number} is refused")
    begun = time.monotonic()
    while not stopping() and time.monotonic() < begun + 60:
        time.sleep(0.05)


def test_pieces_are_spread_and_nobody_is_left():
    done = dict(spread(squared, [1, 2, 3, 4], nullcontext, processes=2))
    assert {work: result for work, (result, _) in done.items()} == {1: 1, 2: 4, 3: 9, 4: 16}
    assert os.getpid() not in {process for _, process in done.values()}
    # Waited for: a pool that is not may complain when Python ends.
    assert multiprocessing.active_children() == []


def test_one_process_is_this_one():
    assert dict(spread(squared, [3], nullcontext, processes=4)) == {3: (9, os.getpid())}
    assert not stopping()


def threads_of(inside, _):
    del inside
    return torch.get_num_threads()


def test_no_process_computes_with_more_threads_than_this_one(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    assert dict(spread(threads_of, [1, 2], nullcontext, processes=2)) == {1: 1, 2: 1}


def digits(inside, _):
    del inside
    return torch.backends.cudnn.allow_tf32, torch.get_float32_matmul_precision()


@pytest.mark.parametrize("tf32", [True, False])
def test_a_gpu_multiplies_beside_this_process_as_in_it(tf32):
    before = torch.backends.cudnn.allow_tf32, torch.get_float32_matmul_precision()
    try:
        torch.backends.cudnn.allow_tf32 = tf32
        torch.set_float32_matmul_precision("high" if tf32 else "highest")
        here = digits(None, 0)
        assert dict(spread(digits, [1, 2], nullcontext, processes=2)) == {1: here, 2: here}
    finally:
        torch.backends.cudnn.allow_tf32 = before[0]
        torch.set_float32_matmul_precision(before[1])


def place_of(layer, inside, _):
    del inside
    return layer.weight.device.type, layer.place.type, layer.weight.sum().item()


@pytest.mark.parametrize(
    "device",
    [
        "cpu",
        pytest.param(
            "cuda",
            marks=[
                pytest.mark.gpu,
                pytest.mark.skipif(not torch.cuda.is_available(), reason="this torch sees no CUDA device"),
            ],
        ),
    ],
)
def test_what_is_on_a_gpu_is_on_the_processor_beside_this_one(device):
    layer = torch.nn.Linear(2, 3).to(device)
    layer.place = torch.device("cuda", 0)
    expected = "cpu", "cpu", pytest.approx(layer.weight.sum().item(), abs=1e-6)
    assert dict(spread(partial(place_of, layer), [1, 2], nullcontext, processes=2)) == {1: expected, 2: expected}
    assert layer.weight.device.type == device


def test_what_a_piece_raises_comes_through_and_ends_the_others():
    begun = time.monotonic()
    with pytest.raises(TrainingError, match="is refused"):
        list(spread(refused_or_endless, [1, 2], nullcontext, processes=2))
    assert time.monotonic() < begun + 45


def test_what_cannot_travel_is_a_line_about_controllers():
    with Pool(nullcontext, 2) as pool:
        for travel in (lambda what: list(pool.each(what, [1])), pool.begin):
            with pytest.raises(ControllerError, match="cannot travel to another process"):
                travel(lambda _inside, number: number)


def large_tensor(inside, number):
    del inside
    return torch.full((number,), 1.0)


def test_results_are_not_in_shared_memory_of_which_a_container_may_have_little():
    before = shutil.disk_usage("/dev/shm").used
    ((_, found),) = list(spread(large_tensor, [5_000_000], nullcontext, processes=2))
    ((_, other),) = list(Pool(nullcontext, 1).each(large_tensor, [5_000_000]))
    assert torch.equal(found, other)
    with Pool(nullcontext, 2) as pool:
        kept = [result for _, result in pool.each(large_tensor, [5_000_000, 5_000_000])]
        assert len(kept) == 2
        assert shutil.disk_usage("/dev/shm").used < before + 10_000_000


@contextmanager
def place(folder):
    """A simulator that takes note of who opens it."""
    (folder / f"{os.getpid()}").touch()
    yield folder


def test_a_process_goes_on_with_the_kind_of_work_that_it_had():
    one, other = ProcessPoolExecutor(1), ProcessPoolExecutor(1)

    def taken(left, *processes):
        return [piece for _, piece in left.taken_by(processes)]

    left = _Left(["a1", "a2", "b1", "b2", "a3", "b3", "c1"], alike=lambda piece: piece[0])
    assert taken(left, one, other) == ["a1", "b1"]
    assert taken(left, other) == ["b2"]
    assert taken(left, one, other) == ["a2", "b3"]
    assert taken(left, other) == ["c1"], "of a kind that none has"
    assert taken(left, other) == ["a3"], "or else the first"
    assert taken(left, one, other) == []
    left = _Left([3, 1, 2], alike=lambda _: None)
    assert taken(left, one, other) + taken(left, other) == [3, 1, 2]


def begin(folder, _):
    (folder / f"begun-{os.getpid()}").touch()
    raise AssertionError("not told")


class Tally:
    """A controller that counts how often it was asked, and how often it travelled."""

    def __init__(self):
        self.asked = 0

    def __call__(self, inside, number):
        assert inside.exists()
        self.asked += 1
        return self.asked, os.getpid()


class Lost:
    """A controller that cannot be read where it arrives."""

    def __call__(self, inside, number):
        raise AssertionError

    def __reduce__(self):
        return int, ("none",)


class ToldTwiceError(Exception):
    """It cannot be made again from its message alone."""

    def __init__(self, what, where):
        super().__init__(f"{what} in {where}")


def raises(inside, number):
    raise ToldTwiceError("no grip", "the bend")


def test_an_exception_that_cannot_travel_back_is_told_all_the_same():
    with pytest.raises(SimulatorError, match=r"a process raised ToldTwiceError.*: no grip in the bend"):
        list(spread(raises, [1, 2], nullcontext, processes=2))


def test_processes_stay_open_from_one_round_of_work_to_the_next(tmp_path):
    with Pool(partial(place, tmp_path), 2) as pool:
        pool.begin(begin)
        deadline = time.monotonic() + 60
        while len(list(tmp_path.glob("begun-*"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert len(list(tmp_path.glob("begun-*"))) == 2, "opened before there is any work"
        first, second = ([result for _, result in pool.each(Tally(), range(8))] for _ in range(2))
        assert {process for _, process in first + second} <= {
            process.pid for process in multiprocessing.active_children()
        }
        for process in {process for _, process in first + second}:
            counts = sorted(asked for asked, there in first + second if there == process)
            assert counts == list(range(1, len(counts) + 1)), "it travels to a process once"
        settled = pool.settle(Tally())
        rounds = [dict(pool.each(settled, range(2))) for _ in range(3)]
        assert len({process for _, process in rounds[0].values()}) == 2
        for piece in range(2):
            assert [found[piece] for found in rounds] == [(k, rounds[0][piece][1]) for k in (1, 2, 3)], "it stays there"
        assert pool.settle(settled.function) is settled
        pool.settle(Tally())
        assert not settled.file.exists(), "only the last one is kept"
        for cannot in (lambda: 0, ctypes.pointer(ctypes.c_int(0))):
            with pytest.raises(ControllerError, match="a controller that can be pickled"):
                pool.settle(partial(sum, key=cannot))
        assert len(list(Path(pool._folder.name).iterdir())) == 1, "nothing half written"
        shutil.rmtree(pool._folder.name)
        with pytest.raises(OutputError, match="TMPDIR"):
            pool.settle(Tally())
        with pytest.raises(ControllerError, match="a controller that travelled"):
            list(pool.each(Lost(), [1]))
    opened = {int(each.name) for each in tmp_path.glob("[0-9]*")}
    assert len(opened) == 2
    assert os.getpid() not in opened
    assert multiprocessing.active_children() == []
