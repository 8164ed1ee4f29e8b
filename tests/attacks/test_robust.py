"""Searches in expectation over what varies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from recorded_drives import VEHICLE, drivable_set
from roadproof.attacks import GradOpt, PathDeviation, Published, SteeringShift, Surrogate, attack, method_of
from roadproof.attacks.gradopt import Rung, gradopt
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP
from roadproof.compositing import Variation
from roadproof.errors import RoadproofError
from roadproof.recorded.vehicle import Vehicle
from roadproof.search_space import SearchSpace

SHORT = GradOpt(iterations=2, restarts=1, halving=False)
SPACE = SearchSpace(figures=2)


class PullsToBrightPaint(torch.nn.Module):
    input_size = (88, 200)

    def steer(self, frames, speed_mps, command):
        return 1e-5 * (frames[..., 100:] - frames[..., :100]).sum((1, 2, 3))

    def act(self, frame, speed_mps, command):
        raise NotImplementedError


@pytest.fixture(autouse=True)
def known_vehicle(monkeypatch):
    monkeypatch.setattr(Vehicle, "identified", staticmethod(lambda tracks: VEHICLE))


@pytest.fixture(scope="module")
def road():
    whole = drivable_set(12.0)
    return replace(whole, recordings=tuple(each.thinned(8) for each in whole.recordings))


def units(count=2, groups=1):
    return SPACE.random((groups, count), torch.Generator().manual_seed(3))


@pytest.mark.parametrize("objective", [SteeringShift, lambda **more: PathDeviation(every=16, **more)])
def test_the_value_is_the_mean_over_looks_and_the_gradient_is_its_own(road, objective):
    variation = Variation(draws=3)
    measure = objective(variation=variation).measure(road, PullsToBrightPaint(), [RIGHT_GROUP], device="cpu")
    measure.redraw(11)
    unit = units()
    value, gradient = measure.values_and_gradients(SPACE, unit)
    torch.testing.assert_close(value, measure.values(SPACE, unit))
    again, _ = measure.values_and_gradients(SPACE, unit)
    assert torch.equal(value, again)
    # One look after another, each as the only one.
    looks, alone = measure._looks, []
    for k in range(3):
        one = {
            name: getattr(looks, name)[k : k + 1]
            for name in ("gain", "blur", "shift_m", "turn_deg", "wear", "wave", "phase")
        }
        measure._looks, measure._bare = replace(looks, noise=0.0, **one), {}
        alone.append(measure.values(SPACE, unit))
    if not isinstance(measure, Surrogate):
        measure._looks, measure._bare = replace(looks, noise=0.0), {}
        torch.testing.assert_close(measure.values(SPACE, unit), torch.stack(alone).mean(0), atol=1e-5, rtol=1e-3)
        return
    # The steering shift of this linear controller is checked against finite differences instead.
    measure.redraw(11)
    step = torch.zeros_like(unit)
    step[0, 0, 0, 1] = 2e-3
    slope = (measure.values(SPACE, unit + step) - measure.values(SPACE, unit - step))[0, 0] / 4e-3
    torch.testing.assert_close(slope, gradient[0, 0, 0, 1], rtol=0.1, atol=1e-6)


def test_what_looks_do_to_the_bare_road_is_not_the_paints(road):
    nothing = SearchSpace(figures=2, max_painted_share=1e-12)
    for groups in ([RIGHT_GROUP], [LEFT_GROUP]):
        measure = PathDeviation(variation=Variation(draws=3)).measure(road, PullsToBrightPaint(), groups, device="cpu")
        measure.redraw(11)
        assert float(measure.values(nothing, units()).abs().max()) < 1e-3


def test_every_step_has_looks_of_its_own_from_the_seed_and_an_interrupted_search_goes_on_to_the_same(road, tmp_path):
    def once(**options):
        objective = PathDeviation(every=16, variation=Variation(draws=2))
        return attack(road, PullsToBrightPaint(), SPACE, method=SHORT, objective=objective, seed=5, **options)

    whole = once()

    def interrupt(step, _):
        if step == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        once(checkpoint=tmp_path / "search", on_step=interrupt)
    resumed = once(checkpoint=tmp_path / "search")
    np.testing.assert_array_equal(resumed.history, whole.history)
    assert torch.equal(resumed.pattern.boxes, whole.pattern.boxes)
    assert whole.objective == "path deviation over variations"
    assert all(check.passed for check in whole.checks if check.name == "deterministic controller")


def test_a_search_begun_once_more_compares_in_the_same_looks_whenever_it_was_interrupted(road, monkeypatch, tmp_path):
    monkeypatch.setattr("roadproof.attacks.gradopt.DRAWN", 24)
    climbed = (Rung(2, 1, 1e-3, every=2, screened=2), Rung(2, 1, 1e-3, every=3, offspring=12))
    ladder = (*climbed, Rung(4, 1, needs=1e9))
    objective = SteeringShift(variation=Variation(draws=1, exposure_stops=2.0, wear=0.9, shift_m=1.0))

    def once(stop=0, checkpoint=None):
        told = []

        def interrupt(step, _):
            told.append(step)
            if len(told) == stop:
                raise KeyboardInterrupt

        measure = objective.measure(road, PullsToBrightPaint(), [RIGHT_GROUP], device="cpu")
        running = {"seed": 3, "checkpoint": checkpoint, "on_step": interrupt}
        found = gradopt(measure, SPACE, ladder, **running)
        return found.history, measure.frames_evaluated

    whole, frames = once()
    for stop in (3, 4):  # before and after the first step of those that are climbed once more
        with pytest.raises(KeyboardInterrupt):
            once(stop, tmp_path / f"{stop}.safetensors")
        resumed, resumed_frames = once(0, tmp_path / f"{stop}.safetensors")
        assert torch.equal(resumed, whole)
        assert resumed_frames == frames


def test_black_boxes_compare_patterns_in_the_same_looks(road):
    objective = SteeringShift(variation=Variation(draws=2))
    one, again = (
        attack(road, PullsToBrightPaint(), SPACE, method=method_of("random", calls=4), objective=objective)
        for _ in range(2)
    )
    np.testing.assert_array_equal(one.history, again.history)
    plain = attack(road, PullsToBrightPaint(), SPACE, method=method_of("random", calls=4), objective=SteeringShift())
    assert not np.array_equal(plain.history, one.history)


def test_the_published_search_knows_no_variation(road):
    with pytest.raises(RoadproofError, match="the published search knows no variation"):
        attack(road, PullsToBrightPaint(), SPACE, method=Published(), objective=SteeringShift(variation=Variation()))


def test_runs_without_variation_are_known_as_before():
    assert repr(SteeringShift()) == "SteeringShift()"
    assert "variation" not in repr(PathDeviation())
