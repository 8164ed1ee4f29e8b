from __future__ import annotations

import numpy as np
import pytest
import torch

from roadproof.attacks import proposals
from roadproof.attacks.blackbox import BayesianOptimisation, BlackBox, blackbox_search
from roadproof.attacks.methods import METHODS as EVERY
from roadproof.attacks.methods import method_of
from roadproof.errors import RoadproofError
from roadproof.search_space import SearchSpace

BO = SearchSpace(figures=1, family="published-bo", colour=False)
TARGET = torch.tensor([0.3, 0.8, 0.6, 0.2])


@pytest.fixture
def quick(monkeypatch):
    """Fewer starts for the acquisition of the published search: its settings have a test of their own."""
    monkeypatch.setattr(proposals, "PUBLISHED_ACQUISITION", {"drawn": 1000, "climbs": 4})


def bowl(unit):
    return -(unit - TARGET).square().sum((-1, -2))


METHODS = [word for word, kind in EVERY.items() if issubclass(kind, BlackBox)]


def search(word, *, calls=40, random_calls=12, value=bowl, **options):
    more = {"random_calls": random_calls} if word == "published-bo" else {}
    return blackbox_search(value, BO, method_of(word, calls=calls, **more), **options)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_stays_in_the_cube_and_is_the_same_again(method, quick):
    calls = 16 if method in ("published-bo", "gp") else 40
    first, again = (search(method, calls=calls, seed=3) for _ in range(2))
    assert len(first) == calls
    assert torch.equal(first.unit, again.unit)
    assert bool(((first.unit >= 0) & (first.unit <= 1)).all())
    assert torch.equal(first.value, bowl(first.unit.float()).double())
    assert not torch.equal(first.unit, search(method, calls=calls, seed=4).unit)


@pytest.mark.parametrize("method", METHODS)
def test_points_of_another_search_come_first_and_are_gone_on_from(method, quick, tmp_path):
    first = (TARGET + 0.02 * torch.arange(3).view(3, 1, 1)).expand(3, 1, 4)
    options = {"first": first, "seed": 3, "random_calls": 1, "checkpoint": tmp_path / "t"}
    file = tmp_path / "trials.safetensors"
    whole = search(method, calls=12, **options)
    assert torch.equal(whole.unit[:3], first.double())
    assert torch.equal(whole.value[:3], bowl(first).double())
    if method == "cma-es":
        assert float(whole.unit[3:].sub(TARGET).abs().max()) < 0.2, "it looks near what was good"
    # Cut off among the points given, and after them.
    for calls in (2, 7, 12):
        again = search(method, calls=calls, **options | {"checkpoint": file})
    assert torch.equal(again.unit, whole.unit)
    other = search(method, calls=3, **options | {"first": None})
    assert not torch.equal(other.unit, first.double()), "a search that began with others is another search"


@pytest.mark.parametrize(("method", "calls"), [("gp", 30), ("tpe", 120), ("cma-es", 120)])
def test_what_learns_beats_what_draws(method, calls):
    learnt = np.median([float(search(method, calls=calls, seed=seed).value.max()) for seed in range(3)])
    drawn = np.median([float(search("random", calls=calls, seed=seed).value.max()) for seed in range(3)])
    assert learnt > drawn


def test_published_bo_draws_first_and_is_guided_then(quick):
    trials = search("published-bo", calls=20, random_calls=14, seed=42)
    drawn = np.random.RandomState(42).uniform(size=(14, 4))
    assert np.allclose(trials.unit[:14].flatten(1), drawn)
    # Six guided points of a smooth bowl come nearer than any of fourteen random ones.
    assert trials.best >= 14


def test_published_bo_has_its_settings(monkeypatch):
    """FACTS of the released code: EI with ξ = 0, isotropic Matérn-5/2 from 1.0, 25 restarts, 1e5 and 250 starts."""
    seen = {}

    def most_promising(process, ranges, random, drawn, climbs):
        seen.update(process=process, ranges=ranges, drawn=drawn, climbs=climbs)
        return ranges / 2

    monkeypatch.setattr(proposals, "most_promising", most_promising)
    space = SearchSpace(figures=2, family="published-bo")
    propose = proposals.published_bo(proposals.natural_ranges(space), 2, 42)
    tried = np.linspace(0.1, 0.9, 42).reshape(3, 14)
    point = propose(tried, np.array([1.0, 3.0, 2.0]), 1)
    assert np.allclose(point, 0.5)
    assert (seen["drawn"], seen["climbs"]) == (100_000, 250)
    process = seen["process"]
    assert process.kernel.nu == 2.5
    assert process.kernel.length_scale == 1.0
    assert (process.alpha, process.n_restarts_optimizer) == (1e-6, 25)
    assert seen["ranges"].tolist() == [180.0, 400.0, 100.0, 70.0, 250.0, 250.0, 250.0] * 2
    assert np.allclose(process.X_train_, tried * seen["ranges"])
    assert np.allclose(process.y_train_, [-np.sqrt(1.5), np.sqrt(1.5), 0.0])
    assert proposals.natural_ranges(BO).tolist() == [180.0, 400.0, 80.0, 60.0]


@pytest.mark.parametrize("method", METHODS)
def test_a_search_killed_in_the_middle_goes_on_as_it_would_have(method, quick, tmp_path):
    calls, random_calls = (16, 9) if method in ("published-bo", "gp") else (37, 12)

    class KilledError(Exception):
        pass

    def kill(done, _best):
        if done == 11:
            raise KilledError

    straight = search(method, calls=calls, random_calls=random_calls)
    file = tmp_path / "search.safetensors"
    with pytest.raises(KilledError):
        search(method, calls=calls, random_calls=random_calls, checkpoint=file, on_step=kill)
    done = []
    resumed = search(
        method, calls=calls, random_calls=random_calls, checkpoint=file, on_step=lambda n, _: done.append(n)
    )
    assert done[0] == 12
    assert torch.equal(resumed.unit, straight.unit)
    assert torch.equal(resumed.value, straight.value)
    assert bool((resumed.seconds.diff() >= 0).all())


def test_batches_are_measured_together():
    sizes = []

    def objective(unit):
        sizes.append(len(unit))
        return bowl(unit)

    for method in ("random", "tpe", "cma-es"):
        sizes.clear()
        trials = search(method, value=objective, calls=11, at_once=4)
        assert sizes == [4, 4, 3]
        assert len(trials.unit.unique(dim=0)) == 11


def test_best_so_far_never_falls():
    trials = search("random")
    assert trials.best_so_far[-1] == trials.value.max() == trials.value[trials.best]
    assert bool((trials.best_so_far.diff() >= 0).all())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"calls": 0}, "calls is 0"),
        ({"at_once": 0}, "at_once is 0"),
        ({"at_once": 2}, "one point at a time"),
        ({"random_calls": -1}, "random_calls is -1"),
        ({"calls": 12, "random_calls": 12}, "random_calls is 12 of 12 calls; leave some for the model"),
    ],
)
def test_arguments_that_make_no_sense_are_named(options, message):
    with pytest.raises(RoadproofError, match=message):
        search("published-bo", **options)


@pytest.mark.parametrize(("calls", "drawn"), [(1000, 400), (140, 56), (8, 3), (2, 1)])
def test_the_published_search_draws_two_fifths_of_its_calls(calls, drawn):
    assert BayesianOptimisation(calls=calls).random_calls == drawn


def test_a_value_that_is_not_a_number_is_an_error():
    with pytest.raises(RoadproofError, match="NaN or infinite at call 1"):
        search("random", value=lambda unit: torch.full((len(unit),), torch.nan), calls=3)


@pytest.mark.parametrize("method", ["random", "tpe", "cma-es"])
def test_more_calls_go_on_with_a_search_and_fewer_are_its_first(method, tmp_path):
    given = (TARGET + 0.1 * torch.arange(3).view(3, 1, 1)).expand(3, 1, 4)
    for first in (None, given):
        options = {"first": first, "at_once": 16}
        straight = search(method, calls=40, **options)
        for calls in (2, 10, 40, 10):
            again = search(method, calls=calls, checkpoint=tmp_path / "search", **options)
            assert len(again) == calls
            assert torch.equal(again.unit[:calls], search(method, calls=calls, **options).unit)
            if calls == 40:
                assert torch.equal(again.unit, straight.unit)
                assert torch.equal(again.value, straight.value)
