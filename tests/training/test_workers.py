"""Work for several processes: every piece is done once, and none of the processes is left behind."""

import multiprocessing
import os

import pytest

from roadproof.errors import TrainingError
from roadproof.training.workers import Worker, spread

WORKER = Worker(None, 0.1)


def squared(worker, number):
    del worker
    return number**2, os.getpid()


def refused(worker, number):
    del worker
    raise TrainingError(f"{number} is refused")


def test_pieces_are_spread_and_nobody_is_left():
    done = dict(spread(squared, [1, 2, 3, 4], WORKER, processes=2))
    assert {work: result for work, (result, _) in done.items()} == {1: 1, 2: 4, 3: 9, 4: 16}
    assert os.getpid() not in {process for _, process in done.values()}
    # Waited for: a pool that is not may complain when Python ends.
    assert multiprocessing.active_children() == []


def test_one_process_is_this_one():
    assert dict(spread(squared, [3], WORKER, processes=4)) == {3: (9, os.getpid())}


def test_what_a_piece_raises_comes_through():
    with pytest.raises(TrainingError, match="is refused"):
        list(spread(refused, [1, 2], WORKER, processes=2))
