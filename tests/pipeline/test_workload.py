from __future__ import annotations

import time

import pytest
import torch

from roadproof.attacks import GradOpt, PathDeviation, SteeringShift
from roadproof.compositing import Variation
from roadproof.pipeline import workload
from roadproof.pipeline.workload import frame_seconds, of_search


class Waits(torch.nn.Module):
    """Takes longer with several threads than with one, as threads do that share a core with other work."""

    input_size = (20, 40)

    def __init__(self, wait_s):
        super().__init__()
        self.weight, self.wait_s = torch.nn.Parameter(torch.ones(())), wait_s

    def steer(self, frames, speed_mps, command):
        time.sleep(self.wait_s * (10 if torch.get_num_threads() > 1 else 1))
        return self.weight * frames.mean((1, 2, 3))

    def act(self, frame, speed_mps, command):
        raise NotImplementedError


def test_threads_that_wait_for_each_other_do_not_count():
    threads = torch.get_num_threads()
    torch.set_num_threads(4)
    try:
        took_s = frame_seconds(Waits(0.02))
        assert torch.get_num_threads() == 4
    finally:
        torch.set_num_threads(threads)
    assert 0.02 <= 8 * took_s < 0.1


@pytest.mark.parametrize("objective", [PathDeviation, SteeringShift])
def test_a_search_over_looks_shows_every_frame_in_each(monkeypatch, objective):
    monkeypatch.setattr(workload, "frame_seconds", lambda *_, **__: 0.002)
    one, four = (
        of_search(GradOpt(), objective(variation=variation), 40, Waits(0.0)).seconds
        for variation in (None, Variation(draws=4))
    )
    assert four == pytest.approx(4 * one)
