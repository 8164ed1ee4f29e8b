"""Search spaces: bounds, starts, limits on paint."""

import dataclasses

import pytest
import torch

from references import rectangles_from_published
from roadproof.coverage import Shape
from roadproof.errors import PatternError
from roadproof.patterns import Pattern
from roadproof.search_space import SearchSpace


def starts(space, seed=0, count=64):
    return space.random((count,), torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("colour", "count"), [(True, 7), (False, 4)])
def test_published_rectangles_have_seven_parameters_or_four_in_black(colour, count):
    space = SearchSpace(figures=3, colour=colour)
    assert len(space.names) == count
    assert starts(space).shape == (64, 3, count)


def test_the_unit_cube_spans_the_published_ranges():
    space = SearchSpace(figures=1)
    unit = torch.tensor([[154.4 / 180, 276.0 / 380, 44.0 / 100, 0.8 / 70, 8.4 / 255, 150.4 / 255, 193.1 / 255]])
    expected = rectangles_from_published([[154.4, 276.0, 44.0, 0.8, 8.4, 150.4, 193.1]])
    torch.testing.assert_close(space.pattern(unit).boxes, expected.boxes)
    torch.testing.assert_close(space.pattern(unit).colours, expected.colours)


def test_starts_are_drawn_as_the_authors_draw_them():
    unit = starts(SearchSpace(figures=4), count=500)
    rotation_deg, _, width_px = unit[..., 0] * 180, unit[..., 1], unit[..., 2] * 100
    assert rotation_deg.min() >= 20
    assert width_px.min() >= 20
    assert unit.max() <= 1
    assert unit[..., 3].min() < 0.01


def test_the_same_seed_gives_the_same_starts():
    space = SearchSpace(figures=2)
    assert torch.equal(starts(space, 7), starts(space, 7))
    assert not torch.equal(starts(space, 7), starts(space, 8))


def test_projection_clips_but_a_free_rotation_wraps():
    published = SearchSpace(figures=1).project(torch.full((1, 7), 1.25))
    assert published.max() == 1.0
    free = SearchSpace(figures=1, family="free").project(torch.full((1, 8), 1.25))
    assert free[0, 4] == 0.25
    assert free[0, :4].tolist() == [1.0] * 4


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (
            {"family": "Free"},
            "family is 'Free', expected one of published, published-canvas-centre, published-bo, free",
        ),
        ({"family": "free", "shape": "triangle"}, "shape is 'triangle', expected one of rectangle, .* as a Shape"),
    ],
)
def test_words_that_name_no_family_or_shape_are_refused(kwargs, message):
    # As it is without the tests' checks of types.
    unchecked = SearchSpace.__init__.__wrapped__
    with pytest.raises(PatternError, match=message):
        unchecked(object.__new__(SearchSpace), figures=2, **kwargs)


@pytest.mark.parametrize("shape", list(Shape))
def test_a_wrapped_rotation_is_the_same_figure(shape):
    space = SearchSpace(figures=1, family="free", shape=shape)
    point = torch.full((1, 8), 0.4)
    turned = point + torch.eye(8)[4]
    before, after = space.pattern(point).boxes, space.pattern(space.project(turned)).boxes
    torch.testing.assert_close(before, after, atol=1e-3, rtol=0)
    whole_deg = torch.tensor([0.0, 0.0, 0.0, 0.0, 360.0])
    again = space.point(Pattern((shape,), before - whole_deg, torch.full((1, 3), 0.4)))
    torch.testing.assert_close(again, point, atol=1e-5, rtol=0)


def test_paint_is_neither_darker_nor_brighter_than_its_albedo():
    space = SearchSpace(figures=2, albedo=(0.1, 0.7))
    colours = space.pattern(torch.rand(50, 2, 7, generator=torch.Generator().manual_seed(1))).colours
    assert colours.min() >= 0.1
    assert colours.max() <= 0.7


@pytest.mark.parametrize("shape", list(Shape))
def test_no_more_than_the_allowed_share_is_painted(shape):
    space = SearchSpace(figures=5, family="free", shape=shape, max_painted_share=0.2)
    share = space.pattern(starts(space)).painted_share
    assert share.max() <= 0.2 + 1e-6
    unlimited = SearchSpace(figures=5, family="free", shape=shape)
    assert unlimited.pattern(starts(unlimited)).painted_share.max() > 0.2


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"figures": 0}, "figures is 0"),
        ({"figures": 1, "shape": Shape.ELLIPSE}, "free family"),
        ({"figures": 1, "albedo": (0.9, 0.2)}, "albedo"),
        ({"figures": 1, "albedo": (float("nan"), 1.0)}, "albedo"),
        ({"figures": 1, "max_painted_share": 0.0}, "max_painted_share"),
    ],
)
def test_bounds_that_make_no_sense_are_refused(kwargs, message):
    with pytest.raises(PatternError, match=message):
        SearchSpace(**kwargs)


@pytest.mark.parametrize(
    "space",
    [
        SearchSpace(figures=3),
        SearchSpace(figures=2, family="published-canvas-centre", albedo=(0.1, 0.8)),
        SearchSpace(figures=1, family="published-bo", colour=False),
        SearchSpace(figures=2, family="free", shape=Shape.TRIANGLE),
        SearchSpace(figures=2, family="free", shape=Shape.ELLIPSE),
    ],
    ids=str,
)
def test_the_point_of_a_pattern_makes_it_again(space):
    pattern = space.pattern(starts(space))
    point = space.point(pattern)
    assert point.shape == starts(space).shape
    again = space.pattern(point)
    torch.testing.assert_close(again.boxes, pattern.boxes, rtol=0, atol=1e-3)
    torch.testing.assert_close(again.colours, pattern.colours, rtol=0, atol=1e-5)
    torch.testing.assert_close(point, starts(space), rtol=0, atol=1e-4)


def test_colours_of_the_authors_bayesian_optimisation_end_at_250_of_255_levels():
    space = SearchSpace(figures=2, family="published-bo")
    brightest = space.pattern(torch.ones(2, len(space.names)))
    torch.testing.assert_close(255 * brightest.colours, torch.full((2, 3), 250.0))
    assert (space.point(brightest)[..., 4:] == 1).all()
    # What a file says of the space tells it from one of another bound.
    assert "albedo=(0.0, 0.98" in repr(space)
    assert space.stated["albedo"] == space.albedo
    narrower = SearchSpace(figures=1, family="published-bo", albedo=(0.2, 0.9)).pattern(torch.ones(1, 7))
    torch.testing.assert_close(narrower.colours, torch.full((1, 3), 0.9))
    with pytest.raises(PatternError, match=r"albedo begins at 0.99, expected less than 0.980, where colours"):
        SearchSpace(figures=1, family="published-bo", albedo=(0.99, 1.0))


def test_a_pattern_outside_has_the_nearest_point():
    # Figures made narrow to keep to the share lie outside the published bounds.
    space = SearchSpace(figures=3, max_painted_share=0.1)
    pattern = space.pattern(starts(space))
    point = space.point(pattern)
    assert point.min() >= 0
    assert point.max() <= 1
    again = space.pattern(point)
    assert again.painted_share.max() <= 0.1 + 1e-5
    assert (again.boxes - pattern.boxes).abs().median() < 1.0


@pytest.mark.parametrize("family", ["published", "published-canvas-centre", "published-bo"])
def test_a_rectangle_is_the_same_after_half_a_turn(family):
    space = SearchSpace(figures=2, family=family)
    unit = space.random((), torch.Generator().manual_seed(2))
    pattern = space.pattern(unit)
    for turn in (-180.0, 180.0, 360.0):
        boxes = pattern.boxes + torch.tensor([0.0, 0.0, 0.0, 0.0, turn])
        torch.testing.assert_close(space.point(dataclasses.replace(pattern, boxes=boxes)), unit, atol=1e-4, rtol=0.0)


def test_a_pattern_of_other_figures_has_no_point():
    pattern = SearchSpace(figures=2).pattern(torch.full((2, 7), 0.5))
    with pytest.raises(PatternError, match="expected 3 of shape rectangle"):
        SearchSpace(figures=3).point(pattern)
