"""Self-checks: every way to disappoint is noticed and comes with advice."""

import pytest
import torch

from roadproof.attacks import GradOpt, RandomSearch, attack
from roadproof.search_space import SearchSpace
from scenes import LinearController, recording_set

QUICK = GradOpt(iterations=8, restarts=2, halving=False)


def linear():
    weight = torch.zeros(3, 88, 200)
    weight[:, :, 100:] = 1e-3
    return LinearController(weight)


class Noisy(LinearController):
    def steer(self, frames, speed_mps, command):
        return super().steer(frames, speed_mps, command) + torch.rand(len(frames)) * 5


class Rounded(LinearController):
    def steer(self, frames, speed_mps, command):
        return super().steer((frames * 255).round() / 255, speed_mps, command)


def checks(controller, random_patterns=0, method=QUICK):
    space = SearchSpace(figures=1)
    result = attack(recording_set(), controller, space, method=method, random_patterns=random_patterns)
    return {check.name: check for check in result.checks}


def test_a_sound_controller_passes():
    found = checks(linear(), random_patterns=5)
    assert len(found) == 4
    assert found["deterministic controller"].passed
    assert found["non-zero gradients"].passed
    assert found["better than random search"].passed


def test_a_controller_that_answers_by_chance_is_noticed():
    torch.manual_seed(0)
    check = checks(Noisy(linear().weight))["deterministic controller"]
    assert not check.passed
    assert "eval mode" in check.advice


def test_a_controller_without_gradients_is_noticed():
    check = checks(Rounded(linear().weight))["non-zero gradients"]
    assert not check.passed
    assert "differentiable" in check.advice


def test_random_patterns_that_beat_the_search_are_noticed(monkeypatch):
    by_chance = (torch.zeros(2, 1, 7), torch.full((2,), 1e6))
    monkeypatch.setattr("roadproof.attacks.checks.random_search", lambda *args, **kwargs: by_chance)
    check = checks(linear(), random_patterns=5)["better than random search"]
    assert not check.passed
    assert "restarts" in check.advice


def test_what_a_search_without_gradients_found_is_not_told_as_theirs():
    finding = checks(linear(), random_patterns=2, method=RandomSearch(calls=2))["better than random search"].finding
    assert finding.startswith("the search found ")


def test_parameters_on_their_bounds_are_noticed(monkeypatch):
    monkeypatch.setattr(SearchSpace, "project", lambda self, unit: torch.ones_like(unit))
    monkeypatch.setattr(SearchSpace, "random", lambda self, batch, generator: torch.ones(*batch, 1, 7))
    check = checks(linear())["parameters inside their bounds"]
    assert not check.passed
    assert "widen" in check.advice


@pytest.mark.parametrize("name", ["non-zero gradients", "parameters inside their bounds"])
def test_a_check_that_passes_needs_no_advice(name):
    assert checks(linear())[name].advice == ""
