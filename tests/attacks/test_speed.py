"""Searching what changes the car's speed: what is found brakes it more than chance, and every number says its unit."""

import json

import numpy as np
import pytest
import torch

from painted_ground import Careful, RampFollower, known_vehicle, recorded_road
from roadproof.attacks import GradOpt, PathDeviation, RandomSearch, SpeedChange, attack, cheapest, kept_attack
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP, parse_groups
from roadproof.attacks.result import AttackResult
from roadproof.compositing import Variation
from roadproof.errors import ControllerError, RecordingError, RoadproofError
from roadproof.recorded import BiasedStart, RecordedWorld
from roadproof.recorded.world import UNSURE
from roadproof.search_space import SearchSpace

SPACE = SearchSpace(figures=1)
SHORT = GradOpt(iterations=4, restarts=2, halving=False)


@pytest.fixture(scope="module", autouse=True)
def vehicle():
    with known_vehicle():
        yield


@pytest.fixture(scope="module")
def road():
    return recorded_road(every=2)


def measure_on(road, words="slower,faster", **options):
    return SpeedChange(**options).measure(road, Careful(), parse_groups(words, road), device="cpu")


def search(road, **options):
    return attack(road, Careful(), SPACE, **{"objective": SpeedChange(), "method": SHORT, **options})


@pytest.fixture(scope="module")
def whole(road):
    """What a search finds that is not interrupted."""
    return search(road)


def predictions(road, patterns, starts):
    world = RecordedWorld(road)
    world.fit(Careful())
    return world.predict(Careful(), patterns, starts)


def test_a_search_for_the_speed_beats_chance_and_says_how_much_in_metres_a_second(road, whole, tmp_path):
    by_chance = predictions(road, SPACE.pattern(SPACE.random((6,), torch.Generator().manual_seed(9))), UNSURE[:1])
    assert abs(whole.predicted_mps) > 1.2 * np.abs(by_chance.speed_change_mps).mean()
    assert (whole.history[-1] >= whole.history[0] - 1e-3).all()
    assert list(whole.by_group) == ["slower", "faster"]
    assert (whole.objective, whole.predicted_m, whole.predicted_range_m) == ("speed change", None, None)
    assert whole.predicted == f"{abs(whole.predicted_mps):.2f} m/s {whole.group}"
    assert (whole.predicted_mps < 0) == (whole.group == "slower")
    ranges = [(each.group, *each.predicted_range_mps) for each in whole.candidates]
    assert all(low <= each.predicted_mps <= high for each, (_, low, high) in zip(whole.candidates, ranges, strict=True))
    least = [-high if group == "slower" else low for group, low, high in ranges]
    assert least == sorted(least, reverse=True)
    again = predictions(road, SPACE.pattern(SPACE.point(whole.pattern)[None]), UNSURE).speed_change_mps[0]
    assert whole.predicted_range_mps == pytest.approx((again.min(), again.max()), abs=0.02)
    whole.save(tmp_path)
    loaded, content = AttackResult.load(tmp_path), json.loads((tmp_path / "result.json").read_text())
    assert [each.predicted_mps for each in loaded.candidates] == [each.predicted_mps for each in whole.candidates]
    assert (loaded.objective, loaded.predicted_mps) == ("speed change", whole.predicted_mps)
    assert (content["objective"], content["predicted_m"]) == ("speed change", None)


def test_a_measure_is_known_by_what_its_controller_does_with_the_pedals(road):
    class Bolder(Careful):
        def controls(self, frames, speed_mps, command):
            return super().controls(frames, speed_mps, command) * torch.tensor([1.0, 0.5, 0.5])

    bolder = SpeedChange().measure(road, Bolder(), parse_groups("slower,faster", road), device="cpu")
    assert measure_on(road).fingerprint() == measure_on(road).fingerprint() != bolder.fingerprint()


def test_paint_is_worth_as_much_to_one_side_as_it_costs_the_other(road):
    unit = SPACE.random((1, 3), torch.Generator().manual_seed(2)).expand(2, -1, -1, -1)
    slower, faster = measure_on(road).values(SPACE, unit)
    assert torch.allclose(slower, -faster, atol=1e-3)
    assert faster.abs().max() > 0.05
    (either,) = measure_on(road, "all").values(SPACE, unit[:1])
    assert torch.allclose(either, faster.abs(), atol=1e-3)
    # The change is from the bare road's drive from the same start, however fast that is.
    quick = measure_on(road, starts=(BiasedStart(faster_mps=1.0),)).values(SPACE, unit)[1]
    assert torch.allclose(quick, faster, atol=0.5 * float(faster.abs().max()))


def test_gradients_of_the_speed_are_central_differences(road):
    """Paint is in view in the second of two pictures alone, so that the pose of neither depends on it."""
    measure = measure_on(road, "slower", every=35)
    unit = SPACE.random((1, 1), torch.Generator().manual_seed(5))
    _, gradient = measure.values_and_gradients(SPACE, unit)
    slopes = torch.zeros_like(unit)
    for name in range(unit.shape[-1]):
        step = torch.zeros_like(unit)
        step[..., name] = 0.01
        ends = [measure.values(SPACE, unit + sign * step) for sign in (1, -1)]
        slopes[..., name] = (ends[0] - ends[1]) / 0.02
    assert slopes.norm() > 1e-4
    assert torch.allclose(gradient, slopes / slopes.norm(), atol=0.05)


def test_gradients_through_the_loop_point_where_the_speed_goes(road):
    measure = measure_on(road, "faster")
    unit = SPACE.random((1, 1), torch.Generator().manual_seed(5))
    _, gradient = measure.values_and_gradients(SPACE, unit)
    with torch.no_grad():
        risen = measure.values(SPACE, unit + 0.01 * gradient) - measure.values(SPACE, unit - 0.01 * gradient)
    assert float(risen) > 0


def test_the_same_seed_finds_the_same_and_an_interrupted_search_goes_on_to_it(road, whole, tmp_path):
    stopped = tmp_path / "search.safetensors"

    def interrupt(step, _):
        if step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        search(road, checkpoint=stopped, on_step=interrupt)
    with pytest.raises(RoadproofError, match="interrupted search for the speed change, this one is for the path dev"):
        search(road, checkpoint=stopped, objective=PathDeviation())
    gone_on = search(road, checkpoint=stopped)
    assert torch.equal(gone_on.pattern.boxes, whole.pattern.boxes)
    assert gone_on.predicted_mps == whole.predicted_mps
    assert np.array_equal(gone_on.history, whole.history)


def test_a_search_for_a_faster_car_does_not_go_on_as_one_for_a_slower(road, tmp_path):
    def interrupt(step, _):
        if step == 3:
            raise KeyboardInterrupt

    faster, slower = (parse_groups(word, road) for word in ("faster", "slower"))
    stopped = tmp_path / "search.safetensors"
    with pytest.raises(KeyboardInterrupt):
        search(road, groups=faster, checkpoint=stopped, on_step=interrupt)
    gone_on, whole = (search(road, groups=slower, checkpoint=path) for path in (stopped, None))
    assert gone_on.by_group == whole.by_group


def test_the_result_of_another_objective_is_not_gone_on_from(road, tmp_path):
    given = {"method": RandomSearch(calls=2)}
    found = kept_attack(tmp_path, road, Careful(), SPACE, objective=SpeedChange(), **given)
    assert (found.group, found.predicted_m) == ("all", None)
    with pytest.raises(RoadproofError, match="a search with objective 'speed change', now it is 'path deviation'"):
        kept_attack(tmp_path, road, Careful(), SPACE, objective=PathDeviation(), **given)
    with pytest.raises(RoadproofError, match=r"with objective_fields\.every 2, now it is 3"):
        kept_attack(tmp_path, road, Careful(), SPACE, objective=SpeedChange(every=3), **given)


def test_every_seed_has_looks_of_its_own_on_the_bare_road_too(road):
    measure = measure_on(road, "slower", variation=Variation(draws=2), every=8)
    unit = SPACE.random((1, 2), torch.Generator().manual_seed(1))
    measure.redraw(3)
    first = measure.values(SPACE, unit)
    measure.redraw(4)
    assert not torch.allclose(measure.values(SPACE, unit), first, atol=1e-4)
    measure.redraw(3)
    assert torch.allclose(measure.values(SPACE, unit), first, atol=1e-5)


def test_what_makes_no_sense_is_one_clear_line(road, whole):
    with pytest.raises(RoadproofError, match="speed change with 0 starts"):
        SpeedChange(starts=())
    with pytest.raises(ControllerError, match="only steers, so in recordings it has the clean drive's speed"):
        attack(road, RampFollower(), SPACE, objective=SpeedChange(), method=SHORT)
    with pytest.raises(RecordingError, match="the speed change knows no group clean"):
        search(road, groups=(RIGHT_GROUP, LEFT_GROUP))
    with pytest.raises(RecordingError, match="the steering shift knows no group slower"):
        search(road, groups=parse_groups("slower", road), objective=PathDeviation())
    with pytest.raises(RoadproofError, match="the search before was for the speed change"):
        cheapest(road, Careful(), whole, 0.1, groups=parse_groups("slower,faster", road))
