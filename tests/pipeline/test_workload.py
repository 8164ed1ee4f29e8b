from __future__ import annotations

import time

import pytest
import torch

from roadproof.attacks import (
    CMAES,
    TPE,
    BayesianOptimisation,
    GaussianProcess,
    GradOpt,
    PathDeviation,
    RandomSearch,
    SteeringShift,
)
from roadproof.compositing import Variation
from roadproof.pipeline import workload
from roadproof.pipeline.workload import frame_seconds, of_proposals, of_search


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


def test_a_guided_proposal_takes_the_longer_the_more_was_tried():
    few, many = (of_proposals(BayesianOptimisation(calls=calls, random_calls=56)).seconds for calls in (140, 1000))
    each_s, later_s = workload.PUBLISHED_S
    assert few == pytest.approx(sum(each_s + later_s * n**2 for n in range(56, 140)), rel=0.02)
    assert many > 20 * few
    assert not of_proposals(BayesianOptimisation(calls=1)).seconds


MEASURED_S = [
    (GaussianProcess, 140, 1, 0.35),
    (GaussianProcess, 140, 16, 3.5),
    (GaussianProcess, 400, 1, 1.3),
    (GaussianProcess, 400, 8, 6.3),
    (GaussianProcess, 400, 16, 9.9),
    (GaussianProcess, 1000, 1, 10.6),
    (TPE, 1000, 1, 0.56),
    (TPE, 1000, 16, 1.03),
]
"""A batch of proposals in 45 dimensions on one thread: after so many trials, so many, in so many seconds."""


@pytest.mark.parametrize(("kind", "trials", "at_once", "took_s"), MEASURED_S)
def test_a_batch_of_proposals_takes_what_was_measured_within_a_factor_of_two(kind, trials, at_once, took_s):
    before, after = (of_proposals(kind(calls=calls), at_once=at_once).seconds for calls in (trials, trials + at_once))
    assert 0.5 * took_s < after - before < 2 * took_s


def test_a_search_on_recordings_is_estimated_with_its_proposals(monkeypatch):
    monkeypatch.setattr(workload, "frame_seconds", lambda *_, **__: 0.0)
    for method in (GaussianProcess(calls=400), TPE(calls=400)):
        told = of_search(method, SteeringShift(), 40, Waits(0.0)).seconds
        assert told == of_proposals(method, at_once=16).seconds > 0
    for method in (RandomSearch(calls=400), CMAES(calls=400)):
        assert not of_search(method, SteeringShift(), 40, Waits(0.0)).seconds
