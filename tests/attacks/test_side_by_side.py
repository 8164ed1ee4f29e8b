"""Groups side by side: the same values and counts as one by one, and only where two calls at once do no harm."""

from contextlib import nullcontext
from functools import partial

import pytest
import torch

from painted_ground import RampFollower, known_vehicle, recorded_road
from roadproof.attacks import PathDeviation, SteeringShift
from roadproof.attacks.gradopt import Rung, gradopt
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP
from roadproof.attacks.side_by_side import Beside, Sides
from roadproof.attacks.surrogate import Surrogate
from roadproof.compositing.variation import Variation
from roadproof.controllers import pilotnet_controller
from roadproof.errors import ControllerError
from roadproof.processes import Pool
from roadproof.search_space import SearchSpace

SPACE = SearchSpace(figures=2)
BOTH = (RIGHT_GROUP, LEFT_GROUP)


@pytest.fixture(scope="module")
def road():
    return recorded_road(every=2, from_m=-17.0)


@pytest.fixture(scope="module")
def network(road):
    height, width = road.recordings[0].frames.shape[1:3]
    made = pilotnet_controller(seed=0).eval().requires_grad_(False)
    assert made.input_size in (None, (height, width))
    return made


def measured(objective, road, controller, groups=BOTH):
    with known_vehicle():
        return objective.measure(road, controller, groups, device="cpu")


def side_by_side(measure, pool=None):
    return Sides((measure,), pool).of(0, measure)


def one_by_one(measure, unit):
    """What each group has by itself, or each half of the points of one group, on one thread."""
    torch.set_num_threads(1)
    count = len(measure.groups)
    parts = unit.split(1) if count > 1 else [some for some in unit.tensor_split(2, 1) if some.numel()]
    each = [measure.of_groups([k % count]).values_and_gradients(SPACE, points) for k, points in enumerate(parts)]
    torch.set_num_threads(2)
    return [torch.cat(results, 0 if count > 1 else 1) for results in zip(*each, strict=True)]


@pytest.mark.parametrize(
    ("objective", "groups", "points"),
    [
        (SteeringShift(), BOTH, 3),
        (SteeringShift(), BOTH[:1], 1),
        (PathDeviation(), BOTH, 1),
        (PathDeviation(), BOTH[:1], 3),
    ],
    ids=["steering-2-3", "steering-1-1", "path-2-1", "path-1-3"],
)
def test_values_gradients_and_counts_are_those_of_each_group(road, network, two_threads, objective, groups, points):
    measure = measured(objective, road, network, groups)
    unit = SPACE.random((len(groups), points), torch.Generator().manual_seed(1))
    begun = measure.frames_evaluated
    whole = measure.values(SPACE, unit)
    count, expected = measure.frames_evaluated - begun, one_by_one(measure, unit)
    beside = side_by_side(measure)
    assert isinstance(beside, Beside)
    for _ in range(2):
        begun = measure.frames_evaluated
        found = beside.values_and_gradients(SPACE, unit)
        assert measure.frames_evaluated - begun == count
        assert all(torch.equal(mine, theirs) for mine, theirs in zip(found, expected, strict=True))
    # All groups in one batch differ by rounding, which a closed loop enlarges.
    torch.testing.assert_close(beside.values(SPACE, unit), whole, rtol=2e-2, atol=2e-3)
    assert torch.get_num_threads() == 2


def test_processes_answer_as_threads_do(road, network, two_threads):
    with Pool(partial(nullcontext, None), 2) as pool:
        for objective, groups in ((PathDeviation(), BOTH), (SteeringShift(), BOTH[:1])):
            measure = measured(objective, road, network, groups)
            unit = SPACE.random((len(groups), 3), torch.Generator().manual_seed(1))
            answers, counts = [], []
            for beside in (side_by_side(measure), side_by_side(measure, pool)):
                for _ in range(2):
                    begun = measure.frames_evaluated
                    read = [each for each in beside.readings(SPACE, unit) if each is not None]
                    answers.append((*beside.values_and_gradients(SPACE, unit), beside.values(SPACE, unit), *read))
                    counts.append(measure.frames_evaluated - begun)
            for found in answers[1:]:
                assert all(torch.equal(mine, theirs) for mine, theirs in zip(found, answers[0], strict=True))
            assert len(set(counts)) == 1
    assert torch.get_num_threads() == 2


def test_a_search_in_processes_is_the_search_in_threads(road, network, two_threads):
    measure = measured(PathDeviation(every=4), road, network)
    rungs = (Rung(2, 2, every=8, open_loop=True), Rung(2, 1))
    with Pool(partial(nullcontext, None), 2) as pool:
        found = gradopt(measure, SPACE, rungs, seed=0, pool=pool)
    expected = gradopt(measure, SPACE, rungs, seed=0)
    assert torch.equal(found.best_unit, expected.best_unit)
    assert torch.equal(found.history, expected.history)


def test_a_users_code_a_mean_over_looks_and_one_thread_stay_as_they_are(road, network, two_threads):
    own, varied = measured(PathDeviation(), road, RampFollower()), SteeringShift(variation=Variation())
    for measure in (own, measured(varied, road, network)):
        assert side_by_side(measure) is measure
    torch.set_num_threads(1)
    measure = measured(SteeringShift(), road, network)
    assert side_by_side(measure) is measure


class Twice(Surrogate):
    """A user's own measure, made from one of roadproof's."""

    def valued(self, space, unit):
        return 2 * super().valued(space, unit)


def test_a_measure_derived_from_ours_is_neither_split_nor_had_with_fewer_digits(
    road, network, two_threads, monkeypatch
):
    monkeypatch.setattr("roadproof.controllers.precision.multiplies_bfloat16", lambda _: True)
    derived, usual = Twice(road, network, BOTH), measured(SteeringShift(), road, network)
    sides = Sides((derived, usual))
    assert sides.of(0, derived) is derived
    assert sides.of(1, usual) is usual, "they would travel together"
    found, whole = (
        gradopt(derived, SPACE, (Rung(1, 2),), seed=0, all_digits=all_digits) for all_digits in (False, True)
    )
    assert torch.equal(found.history, whole.history)


def test_only_the_rung_that_is_climbed_keeps_its_frames(road, network, two_threads):
    measure = measured(SteeringShift(), road, network)
    sides = Sides((measure.thinned(2), measure))
    unit = SPACE.random((2, 1), torch.Generator().manual_seed(1))
    for number, each in enumerate((measure.thinned(2), measure)):
        sides.of(number, each).values(SPACE, unit)
        assert {side[0] for side in sides._parts._made} == {number}


def test_an_error_in_one_group_is_raised_and_leaves_the_threads_as_they_were(road, network, two_threads, monkeypatch):
    beside = side_by_side(measured(SteeringShift(), road, network))

    def fails(*_):
        raise ControllerError("the controller answers NaN")

    monkeypatch.setattr(type(beside._whole), "values", fails)
    with pytest.raises(ControllerError, match="answers NaN"):
        beside.values(SPACE, SPACE.random((2, 1), torch.Generator().manual_seed(3)))
    assert torch.get_num_threads() == 2
