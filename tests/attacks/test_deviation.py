"""Searching where the car goes: what is found moves it further than chance, and the result says how far."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from painted_ground import RampFollower, known_vehicle, recorded_road
from roadproof.attacks import (
    CMAES,
    BayesianOptimisation,
    GradOpt,
    PathDeviation,
    Published,
    RandomSearch,
    SteeringShift,
    attack,
    methods,
    usual_objective,
)
from roadproof.attacks.gradopt import BEHIND, MUTATION, Rung, gradopt
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP, parse_groups
from roadproof.attacks.result import AttackResult
from roadproof.controllers import pilotnet_controller
from roadproof.errors import RecordingError, RoadproofError
from roadproof.recorded import BiasedStart, RecordedWorld
from roadproof.recorded.world import UNSURE
from roadproof.recordings import pooled
from roadproof.search_space import SearchSpace, derived_seed
from scenes import recording_set

SPACE = SearchSpace(figures=1)
SHORT = GradOpt(iterations=8, restarts=2, halving=False)
ONE_STEP = GradOpt(iterations=1, restarts=1, halving=False)
GOAL = PathDeviation(every=4)
DRAWN = 32
"""Of how many random points screened starts are the best here."""


@pytest.fixture(scope="module", autouse=True)
def vehicle():
    with known_vehicle():
        yield


@pytest.fixture(autouse=True)
def few_are_drawn(monkeypatch):
    monkeypatch.setattr("roadproof.attacks.gradopt.DRAWN", DRAWN)


@pytest.fixture(scope="module")
def road():
    return recorded_road(every=2, from_m=-17.0)


def search(road, **options):
    return attack(road, RampFollower(), SPACE, **{"objective": GOAL, "method": SHORT, **options})


@pytest.fixture(scope="module")
def whole(road):
    """What a search finds that is not interrupted."""
    return search(road)


def test_a_search_in_the_recorded_world_beats_chance_and_its_own_start(road, whole, tmp_path):
    result = whole
    world = RecordedWorld(road)
    world.fit(RampFollower())
    by_chance = SPACE.pattern(SPACE.random((6,), torch.Generator().manual_seed(9)))
    assert result.predicted_m > 1.2 * np.mean(world.predict(RampFollower(), by_chance).deviation_m)
    assert (result.history[-1] >= result.history[0] - 1e-3).all()
    found = [candidate.predicted_m for candidate in result.candidates]
    least = [candidate.predicted_range_m[0] for candidate in result.candidates]
    assert least == sorted(least, reverse=True)
    assert all(each.predicted_range_m[0] <= each.predicted_m <= each.predicted_range_m[1] for each in result.candidates)
    assert result.predicted_m == found[0]
    again = world.predict(RampFollower(), SPACE.pattern(SPACE.point(result.pattern)[None]), UNSURE).deviation_m[0]
    assert again.mean() == pytest.approx(found[0], abs=0.02)
    assert result.predicted_range_m == pytest.approx((again.min(), again.max()), abs=0.02)
    result.save(tmp_path)
    loaded = AttackResult.load(tmp_path)
    assert (loaded.objective, loaded.predicted_m) == ("path deviation", result.predicted_m)
    assert [each.predicted_m for each in loaded.candidates] == found
    assert [each.predicted_range_m for each in loaded.candidates] == [c.predicted_range_m for c in result.candidates]


def test_a_search_drives_in_every_weather_that_was_recorded(road):
    dim = tuple(dataclasses.replace(drive, frames=(drive.frames * 0.6).astype(np.uint8)) for drive in road.recordings)
    dark = dataclasses.replace(road, recordings=dim)
    both = pooled({"clear-noon": road, "rainy-noon": dark})
    unit = SPACE.random((2, 3), torch.Generator().manual_seed(4))
    values = [
        GOAL.measure(each, RampFollower(), (RIGHT_GROUP, LEFT_GROUP), device="cpu").values(SPACE, unit)
        for each in (road, dark, both)
    ]
    assert (values[0] - values[1]).abs().max() > 0.01
    assert torch.allclose(values[2], (values[0] + values[1]) / 2, atol=1e-5)
    result = attack(both, RampFollower(), SPACE, objective=GOAL, method=ONE_STEP)
    apart = [
        RecordedWorld(each)
        .predict(RampFollower(), SPACE.pattern(SPACE.point(result.pattern)[None]), UNSURE)
        .deviation_m
        for each in both.by_weather()
    ]
    assert result.predicted_range_m == pytest.approx((np.min(apart), np.max(apart)), abs=0.05)
    with pytest.raises(RecordingError, match="drives in clear-noon, rainy-noon, a recorded world has one light"):
        RecordedWorld(both)


def test_a_search_doubts_a_controller_that_was_not_recorded(road, whole):
    class Stray(RampFollower):
        def steer(self, frames, speed_mps, command):
            return super().steer(frames, speed_mps, command) + 0.15

    found = {check.name: check for check in whole.checks}
    assert found["keeps to the recorded road without paint"].passed
    stray = attack(road, Stray(), SPACE, objective=GOAL, method=ONE_STEP)
    (doubt,) = (check for check in stray.checks if check.name == "keeps to the recorded road without paint")
    assert not doubt.passed
    assert "record with it" in doubt.advice


def test_the_same_seed_finds_the_same_and_an_interrupted_search_goes_on_to_it(road, whole, tmp_path):
    stopped = tmp_path / "search.safetensors"

    def interrupt(step, _):
        if step == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search(road, checkpoint=stopped, on_step=interrupt)
    gone_on = search(road, checkpoint=stopped)
    assert torch.equal(gone_on.pattern.boxes, whole.pattern.boxes)
    assert gone_on.predicted_m == whole.predicted_m
    assert np.array_equal(gone_on.history, whole.history)


def test_several_starts_are_valued_by_their_mean(road):
    unit = SPACE.random((2, 1), torch.Generator().manual_seed(2))
    starts = (BiasedStart(right_m=0.3), BiasedStart(right_m=-0.3))

    def value(*chosen):
        goal = dataclasses.replace(GOAL, starts=chosen)
        return goal.measure(road, RampFollower(), (RIGHT_GROUP, LEFT_GROUP), device="cpu").values(SPACE, unit)

    apart = (value(starts[0]) + value(starts[1])) / 2
    assert torch.allclose(value(*starts), apart, atol=2e-3)
    # What goes to the right for one group counts against the other.
    right, left = value(BiasedStart())[:, 0].tolist()
    same = GOAL.measure(road, RampFollower(), (RIGHT_GROUP, LEFT_GROUP), device="cpu")
    both = same.values(SPACE, unit[:1].expand(2, -1, -1, -1))[:, 0]
    assert float(both[0]) == pytest.approx(-float(both[1]))
    assert right == pytest.approx(float(both[0]), abs=1e-4)
    assert left != right


def test_a_search_can_begin_with_the_steering_shift(road, tmp_path):
    rungs = (Rung(4, 6, every=2, open_loop=True), Rung(4, 2, every=6), Rung(2, 1))
    measure = GOAL.measure(road, RampFollower(), (RIGHT_GROUP, LEFT_GROUP), device="cpu")
    seen: list[float] = []
    found = gradopt(measure, SPACE, rungs, seed=0, on_step=lambda _, best: seen.append(best))
    alone = SteeringShift().measure(road, RampFollower(), (RIGHT_GROUP, LEFT_GROUP), device="cpu").thinned(2)
    climbed = gradopt(alone, SPACE, (Rung(4, 6),), seed=0)
    # The first rung is the open loop's own search, step by step.
    best = [float(value) for value in climbed.history.amax((1, 2)).cummax(0).values]
    assert seen[:6] == pytest.approx(best, abs=1e-6)
    assert float(found.best.max()) > 0
    # The same again after an interruption inside that rung.
    stopped = tmp_path / "search.safetensors"

    def interrupt(step, _):
        if step == 3:
            raise KeyboardInterrupt

    def once(**options):
        return gradopt(measure, SPACE, rungs, seed=0, checkpoint=stopped, **options)

    with pytest.raises(KeyboardInterrupt):
        once(on_step=interrupt)
    assert torch.equal(once().best_unit, found.best_unit)


class OneSided(RampFollower):
    """Gives way to the left only: paint cannot steer it to the right."""

    def steer(self, frames, speed_mps, command):
        return -torch.relu(-super().steer(frames, speed_mps, command))


def test_a_side_far_behind_gives_its_places_to_the_other(road, tmp_path):
    rungs = (
        Rung(4, 1, open_loop=True, screened=2),
        Rung(4, 2, every=4),
        Rung(2, 3, groups_compete=True, offspring=8),
        Rung(2, 2, 0.01),
    )
    groups = (RIGHT_GROUP, LEFT_GROUP)
    measure = GOAL.measure(road, OneSided(), groups, device="cpu")
    found = gradopt(measure, SPACE, rungs, seed=0)
    assert list(found.gave_way) == [0]
    assert found.best.shape == (1, 4), "the places of both sides, all to the left"
    assert found.history.shape == (5, 1, 4)
    assert found.gave_way[0] < BEHIND * float(found.best.max())
    left = measure.of_groups([1])
    assert left.groups == (LEFT_GROUP,)
    assert torch.allclose(left.values(SPACE, found.best_unit), found.best)
    # Where nobody is far behind, nothing changes hands.
    equal = GOAL.measure(road, RampFollower(), groups, device="cpu")
    assert gradopt(equal, SPACE, rungs, seed=0).gave_way == {}
    stopped = tmp_path / "search.safetensors"

    def interrupt(step, _):
        if step == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        gradopt(measure, SPACE, rungs, seed=0, checkpoint=stopped, on_step=interrupt)
    gone_on = gradopt(measure, SPACE, rungs, seed=0, checkpoint=stopped)
    assert torch.equal(gone_on.best_unit, found.best_unit)
    assert gone_on.gave_way == found.gave_way


NEVER = 3.0
"""Metres that no car goes aside on average, since the value saturates there."""


def test_where_nothing_is_found_the_first_rungs_are_climbed_once_more(road, tmp_path):
    first = (Rung(3, 2, every=4, open_loop=True, screened=2), Rung(2, 2, every=4))
    measure = GOAL.measure(road, RampFollower(), (RIGHT_GROUP, LEFT_GROUP), device="cpu")
    seen: list[int] = []

    def search(needs, **running):
        running = {"on_step": lambda step, _: seen.append(step)} | running
        return gradopt(measure, SPACE, (*first, Rung(2, 1, needs=needs)), seed=0, **running)

    found = search(NEVER)
    assert seen == [1, 2, 3, 4, 4, 4, 4, 4, 5], "what is climbed once more counts no further"
    other = gradopt(measure, SPACE, first, seed=derived_seed(0, 3 * 10**6))
    once = gradopt(measure, SPACE, first, seed=0)
    points = torch.cat([once.best_unit, other.best_unit], 1)
    best = torch.cat([once.best, other.best], 1).topk(2, 1).indices
    assert torch.equal(found.best_unit, points[torch.arange(2)[:, None], best]), "the best of both go on"
    # So do they where the next rung would go on from the same starts.
    rungs = (Rung(2, 1, every=4), Rung(2, 1, learning_rate=0.01, every=4, needs=NEVER))
    assert gradopt(measure, SPACE, rungs, seed=0).best.shape == (2, 2)
    # Where something is found nothing is climbed again.
    seen.clear()
    search(float(once.best.max()))
    assert seen == [1, 2, 3, 4, 5]
    begun = measure.frames_evaluated
    search(NEVER)
    straight = measure.frames_evaluated - begun
    # The same again after an interruption in the second time.
    stopped = tmp_path / "search.safetensors"

    def interrupt(step, _):
        seen.append(step)
        if len(seen) == 7:
            raise KeyboardInterrupt

    seen.clear()
    begun = measure.frames_evaluated
    with pytest.raises(KeyboardInterrupt):
        search(NEVER, checkpoint=stopped, on_step=interrupt)
    seen.clear()
    gone_on = search(NEVER, checkpoint=stopped)
    assert seen == [4, 4, 5]
    assert measure.frames_evaluated - begun == straight, "every picture counts once"
    assert torch.equal(gone_on.best_unit, found.best_unit)
    assert [each.name for each in tmp_path.iterdir()] == [stopped.name]


def test_a_search_that_begins_at_given_patterns_is_not_begun_again(road):
    ladder = GradOpt(iterations=2, restarts=2, halving=False).ladder(GOAL)
    assert not any(math.isfinite(rung.needs) for rung in ladder)
    assert [rung.needs for rung in GradOpt().ladder(GOAL) if math.isfinite(rung.needs)] == [methods.NOWHERE]


def test_a_result_says_which_side_gave_way(road, monkeypatch):
    monkeypatch.setattr(methods, "PATH_RUNGS", (Rung(4, 1, open_loop=True, screened=2), Rung(4, 2, every=4)))
    method = GradOpt(iterations=2, restarts=2)
    result = attack(road, OneSided(), SPACE, objective=GOAL, method=method)
    assert list(result.by_group) == [str(LEFT_GROUP)]
    assert {each.group for each in result.candidates} == {str(LEFT_GROUP)}
    assert len(result.candidates) == 4
    (said,) = (check for check in result.checks if check.name == "places given to the better side")
    assert "clean+right reached" in said.finding


def test_some_starts_are_the_best_of_many_and_the_others_at_random(road):
    measure = GOAL.measure(road, RampFollower(), (RIGHT_GROUP, LEFT_GROUP), device="cpu")
    plain = gradopt(measure, SPACE, (Rung(3, 1),), seed=4).history[0]
    found = gradopt(measure, SPACE, (Rung(3, 1, screened=2),), seed=4).history[0]
    assert torch.allclose(found[:, 0], plain[:, 0], atol=1e-3), "at random as before"
    drawn = SPACE.random((2, DRAWN), torch.Generator().manual_seed(derived_seed(4, 10**6)))
    assert torch.allclose(found[:, 1:], measure.values(SPACE, drawn).topk(2, 1).values, atol=1e-3)
    # Starts that were given stay.
    given = [SPACE.random((3,), torch.Generator().manual_seed(k)) for k in (1, 2)]
    kept = gradopt(measure, SPACE, (Rung(3, 1, screened=2),), seed=4, starts=given).history[0]
    assert torch.allclose(kept, measure.values(SPACE, torch.stack(given)), atol=1e-3)


def test_offspring_with_figures_of_two_of_the_best_compete_with_them(road):
    measure = GOAL.measure(road, RampFollower(), (RIGHT_GROUP, LEFT_GROUP), device="cpu")
    first = Rung(4, 1)
    alone = gradopt(measure, SPACE, (first, Rung(4, 1, every=4)), seed=1)
    found = gradopt(measure, SPACE, (first, Rung(4, 1, every=4, offspring=64)), seed=1)
    ranked, before = (each.history[0].sort(1).values for each in (found, alone))
    assert (ranked >= before - 1e-6).all()
    assert (ranked > before + 0.01).any(), "some are better than what they come from"
    # One figure of a pattern comes whole from one parent, but for a little.
    parents = gradopt(measure, SPACE, (first,), seed=1).best_unit
    apart = (found.best_unit[:, :, None] - parents[:, None]).abs().amax(-1).amin(2)
    assert (apart < 6 * MUTATION).all()


def test_a_search_without_gradients_drives_in_the_recorded_world_too(road, tmp_path):
    pytest.importorskip("cmaes", reason="cmaes is not installed")
    result = search(road, method=CMAES(calls=40), seed=1)
    assert list(result.by_group) == ["all"], "to whichever side the car gives way"
    assert result.history.shape == (40, 1, 1)
    assert (np.diff(result.history[:, 0, 0]) >= 0).all()
    assert result.history[-1, 0, 0] > result.history[0, 0, 0]
    assert len(result.candidates) == 6
    assert result.predicted_m > 0
    assert "non-zero gradients" not in {check.name for check in result.checks}
    assert torch.equal(search(road, method=CMAES(calls=40), seed=1).pattern.boxes, result.pattern.boxes)
    result.save(tmp_path)
    assert AttackResult.load(tmp_path).method == CMAES(calls=40)


def test_objectives_that_make_no_sense_are_one_clear_line(road):
    with pytest.raises(RoadproofError, match="0 starts, a picture every 2 steps"):
        PathDeviation(starts=())
    with pytest.raises(RoadproofError, match="saturation 0"):
        PathDeviation(saturation_m=0.0)
    with pytest.raises(RoadproofError, match="saturation inf m; expected above 0 and finite"):
        PathDeviation(saturation_m=float("inf"))
    with pytest.raises(RecordingError, match="where its canvas lies"):
        search(dataclasses.replace(road, canvas=None))
    assert (SteeringShift().name, PathDeviation().name) == ("steering shift", "path deviation")


def test_the_deviation_is_searched_for_where_it_can_be_driven_and_nobody_asks_for_another(road):
    assert isinstance(usual_objective(road, GradOpt()), PathDeviation)
    assert isinstance(usual_objective(road, CMAES(calls=4)), PathDeviation)
    one_side = dataclasses.replace(road, recordings=road.recordings[:1])
    for recordings, method in ((recording_set(), GradOpt()), (one_side, GradOpt()), (road, Published())):
        assert isinstance(usual_objective(recordings, method), SteeringShift)
    assert isinstance(usual_objective(road, BayesianOptimisation(calls=4, random_calls=2)), SteeringShift)
    assert attack(road, RampFollower(), SPACE, method=SHORT).objective == PathDeviation().name


@pytest.mark.parametrize("words", ["clean+right,clean+left", "clean+left,clean+right"])
def test_without_gradients_a_pattern_stands_for_the_group_that_it_is_best_for(road, words):
    found = search(road, method=RandomSearch(calls=3), groups=parse_groups(words, road))
    assert list(found.by_group) == words.split(",")
    assert len(found.candidates) == 3, "each pattern once"
    assert found.by_group[found.group] == max(found.by_group.values()) > 0
    assert all(each.surrogate_shift > 0 for each in found.candidates)


def test_what_is_found_with_fewer_digits_is_valued_with_all(road, monkeypatch, tmp_path):
    monkeypatch.setattr("roadproof.controllers.precision.multiplies_bfloat16", lambda _: True)
    controller = pilotnet_controller(seed=0).eval().requires_grad_(False)
    measure = GOAL.measure(road, controller, (RIGHT_GROUP, LEFT_GROUP), device="cpu")
    rungs = (Rung(2, 2, every=8, open_loop=True), Rung(2, 2))
    found = gradopt(measure, SPACE, rungs, seed=0)
    assert torch.equal(found.best, measure.values(SPACE, found.best_unit))
    whole = gradopt(measure, SPACE, rungs, seed=0, all_digits=True)
    # Begun with few digits and gone on with where there are none of these: from the beginning, with all of them.
    kept, steps = tmp_path / "search.safetensors", list[int]()
    gradopt(measure, SPACE, rungs, seed=0, checkpoint=kept)
    monkeypatch.setattr("roadproof.controllers.precision.multiplies_bfloat16", lambda _: False)
    other = gradopt(measure, SPACE, rungs, seed=0, checkpoint=kept, on_step=lambda step, _: steps.append(step))
    assert steps == [1, 2, 3, 4]
    assert torch.equal(other.best, whole.best)
    assert not torch.equal(found.history, whole.history)
    assert torch.allclose(found.history[0], whole.history[0], rtol=0.1, atol=1e-3)


@pytest.mark.parametrize("goal", [GOAL, SteeringShift()])
def test_a_measure_of_another_controller_is_the_measure_made_for_it(goal, road):
    networks = [pilotnet_controller(seed=seed).eval().requires_grad_(False) for seed in (0, 1)]
    other, same = (goal.measure(road, each, (RIGHT_GROUP, LEFT_GROUP), device="cpu") for each in networks)
    unit = SPACE.random((2, 2), torch.Generator().manual_seed(0))
    found = other.of_controller(networks[1])
    # The bare road's law of steering stays that of the first.
    for each in getattr(found, "worlds", ()):
        each.fit(networks[1])
    assert torch.equal(found.values(SPACE, unit), same.values(SPACE, unit))
    assert not torch.equal(other.values(SPACE, unit), same.values(SPACE, unit)) or goal is GOAL
