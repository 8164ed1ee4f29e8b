"""Streets for training and judging are disjoint; budgets search where hardening can."""

import dataclasses

import pytest
import torch

from roadproof.attacks import RandomSearch, SteeringShift
from roadproof.coverage import Shape
from roadproof.datatypes import Weather
from roadproof.errors import TrainingError
from roadproof.hardening.budget import HARDENING_BUDGETS, HardeningBudget, by_street, check_streets
from roadproof.paint import LaneMark, PaintLimits, Site
from roadproof.pipeline.budget import QUICK
from roadproof.scenarios import find_scenario
from roadproof.search_space import SearchSpace


def named(*names):
    return [find_scenario(name) for name in names]


def test_streets_that_share_no_canvas_and_no_approach_are_accepted():
    check_streets(named("left-07", "right-05"), named("straight-04"))
    # The same place of another map is another street.
    elsewhere = [dataclasses.replace(each, map_name="second") for each in named("left-07")]
    check_streets(named("left-07"), elsewhere)


def test_scenarios_that_lie_near_each_other_are_one_street():
    judged = named("left-02", "left-04", "right-04", "straight-09", "straight-12")
    # straight-09 is near right-04 alone, which is near left-04.
    assert by_street(judged) == (("left-02",), ("left-04", "right-04", "straight-09"), ("straight-12",))
    assert by_street([judged[1], dataclasses.replace(judged[1], map_name="second", name="other")]) == (
        ("left-04",),
        ("other",),
    )


@pytest.mark.parametrize(
    ("training", "judging", "message"),
    [
        (["left-07"], ["straight-04", "left-07"], "left-07 is trained on and left-07 judged on, .* 0 m apart"),
        (["left-08"], ["right-07"], "left-08 is trained on and right-07 judged on, .* 6 m apart"),
        ([], ["left-07"], "no scenario to train on"),
        (["left-07", "left-07"], [], "name one twice"),
    ],
)
def test_streets_that_overlap_are_refused(training, judging, message):
    with pytest.raises(TrainingError, match=message):
        check_streets(named(*training), named(*judging))


def test_budgets_judge_by_kinds_that_training_did_not_use():
    for budget in HARDENING_BUDGETS.values():
        (unseen, same), (method, shapes) = budget.kinds(SearchSpace(figures=3)).values()
        assert type(unseen) is not type(budget.attack.method)
        assert same == SearchSpace(figures=3)
        assert method == budget.judge.method
        assert (shapes.figures, shapes.shape) == (3, Shape.ELLIPSE)


@pytest.mark.parametrize("family", ["published", "free"])
def test_training_can_paint_what_attacks_find_clear_of_lane_marks(family):
    marks = (LaneMark(points_m=((3.0, -5.0), (3.0, 15.0)), width_m=0.15, colour="#ffffff"),)
    site = Site(size_m=(6.6, 9.5), marks=marks)
    limited = SearchSpace(figures=3, family=family, limits=PaintLimits(keep_out_m=0.3)).on(site)
    found = limited.drawn(40, 0)
    learnt, *others = HardeningBudget().learnt(limited)
    again = learnt.pattern(learnt.point(found))
    # Not where next to nothing is left of a figure, nor where its middle lies beyond the canvas.
    x, y, width, length, _ = found.boxes.unbind(-1)
    paints = (width > 5) & (length > 20) & (torch.stack([x, y]) >= 0).all(0) & (torch.stack([x, y]) <= 400).all(0)
    assert paints.float().mean() > 0.7
    torch.testing.assert_close(again.boxes[paints], found.boxes[paints], atol=0.01, rtol=1e-4)
    assert not learnt.is_limited
    assert learnt not in others


def test_weathers_are_those_of_attacks_and_of_what_judges_them():
    noon, rain = Weather.CLEAR_NOON, Weather.RAINY_NOON
    for budget in HARDENING_BUDGETS.values():
        assert budget.in_weathers((noon,)) == budget
        both = budget.in_weathers((noon, rain))
        assert both.attack.recorded_in == both.judge.recorded_in == both.attack.weathers == (noon, rain)
        assert set(both.judge.weathers) == {noon, rain, *budget.judge.weathers}
        wet = budget.in_weathers((rain,))
        assert wet.attack.recorded_in == wet.judge.recorded_in == wet.judge.weathers[:1] == (rain,)


def test_judging_paints_in_other_shapes_what_else_the_space_allows():
    asked = SearchSpace(figures=2, colour=False, albedo=(0.1, 0.8), max_painted_share=0.1)
    for _, space in HardeningBudget().kinds(asked).values():
        assert dataclasses.replace(space, family=asked.family, shape=asked.shape) == asked


def test_kinds_of_attack_are_called_what_they_are():
    space, usual = SearchSpace(figures=1), HardeningBudget()
    assert usual.searched == "by gradient, as in training"
    assert list(usual.kinds(space)) == ["tpe, 100 patterns tried", "ellipses by gradient"]
    driven = dataclasses.replace(usual, judge=dataclasses.replace(usual.judge, method=RandomSearch(calls=4)))
    assert driven.searched == "by random"
    assert list(driven.kinds(space))[1] == "ellipses by random"


def test_budgets_that_make_no_sense_are_refused():
    with pytest.raises(TrainingError, match="give attack and judge a path deviation"):
        HardeningBudget(attack=dataclasses.replace(QUICK, objective=SteeringShift()))
    with pytest.raises(TrainingError, match="-1 drives through the town"):
        HardeningBudget(town_drives=-1)
    with pytest.raises(TrainingError, match="unseen is gradopt, by which training attacks"):
        HardeningBudget(unseen=HardeningBudget().attack.method)
    for family in ("free", "published"):
        with pytest.raises(TrainingError, match="rectangles are painted in training"):
            HardeningBudget(unseen_shape=Shape.RECTANGLE).require_unseen(SearchSpace(figures=5, family=family))
