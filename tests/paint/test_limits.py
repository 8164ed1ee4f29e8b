"""Limits on paint: every point of a search space is a pattern that obeys."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from roadproof.coverage import Shape
from roadproof.errors import PatternError
from roadproof.geometry import CANVAS_SIZE_PX
from roadproof.paint import LaneMark, PaintLimits, Site, conspicuousness
from roadproof.paint import limits as paint_limits
from roadproof.paint.colours import PRINT, _hull
from roadproof.paint.site import rgb_of
from roadproof.search_space import SearchSpace

SIZE_M = (7.6, 9.5)
MIDDLE = LaneMark(points_m=((3.8, -4.0), (3.8, 14.0)), width_m=0.15, colour="#d6a83d")
CURVED = LaneMark(points_m=((0.1, -4.0), (0.3, 3.0), (0.9, 9.5), (2.0, 14.0)), width_m=0.12)
EDGE = LaneMark(points_m=((7.5, -4.0), (7.5, 14.0)), width_m=0.2)
SITE = Site(size_m=SIZE_M, asphalt=(0.36, 0.35, 0.34), marks=(MIDDLE, CURVED, EDGE))
FAMILIES = [
    ("published", Shape.RECTANGLE),
    ("published-canvas-centre", Shape.RECTANGLE),
    ("published-bo", Shape.RECTANGLE),
    *(("free", shape) for shape in Shape),
]
LIMITS = PaintLimits(max_area_m2=3.0, printable=True, contrast=(0.1, 0.3), keep_out_m=0.4)


def space(limits, family="published", shape=Shape.RECTANGLE, **more):
    return SearchSpace(figures=4, family=family, shape=shape, limits=limits, **more).on(SITE)


def cube(some, seed, count=32):
    """Points all over the cube, its faces and corners among them."""
    unit = 1.4 * torch.rand(count, some.figures, len(some.names), generator=torch.Generator().manual_seed(seed)) - 0.2
    return unit.clamp(0, 1)


def outline_px(shape, box):
    """Points all along the edge of a figure, canvas px: by hand, unlike the code."""
    share = np.linspace(0, 1, 60)
    if shape is Shape.ELLIPSE:
        local = np.stack([np.cos(2 * np.pi * share), np.sin(2 * np.pi * share)], 1) / 2
    else:
        corners = {
            Shape.RECTANGLE: [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)],
            Shape.TRIANGLE: [(0, -0.5), (0.5, 0.5), (-0.5, 0.5)],
            Shape.DIAMOND: [(0, -0.5), (0.5, 0), (0, 0.5), (-0.5, 0)],
        }[shape]
        ends = zip(corners, corners[1:] + corners[:1], strict=True)
        local = np.concatenate([np.outer(1 - share, a) + np.outer(share, b) for a, b in ends])
    x, y, width, length, turned = box
    c, s = np.cos(np.radians(turned)), np.sin(np.radians(turned))
    u, v = local[:, 0] * width, local[:, 1] * length
    return np.stack([x + c * u - s * v, y + s * u + c * v], 1)


def nearest_mark_m(pattern):
    """The least distance of any edge from any mark's paint, by dense points on both."""
    least = np.inf
    for mark in SITE.marks:
        points = np.array(mark.points_m)
        line = np.concatenate([np.linspace(a, b, 400) for a, b in pairwise(points)])
        for shape, box in zip(pattern.shapes, pattern.boxes.tolist(), strict=True):
            edge = (outline_px(shape, box) + 0.5) * np.array(SIZE_M) / CANVAS_SIZE_PX
            gap = np.linalg.norm(edge[:, None] - line, axis=2).min() - mark.width_m / 2
            least = min(least, gap)
    return least


@pytest.mark.parametrize(("family", "shape"), FAMILIES)
def test_every_point_of_the_cube_obeys_all_limits(family, shape):
    limited = space(LIMITS, family, shape)
    planes, bounds = _hull(np.array([rgb_of(each) for each in PRINT]))
    for unit in (cube(limited, 1), limited.random((32,), torch.Generator().manual_seed(2))):
        patterns = limited.pattern(unit)
        area = patterns.boxes[..., 2] * patterns.boxes[..., 3] * np.prod(SIZE_M) / CANVAS_SIZE_PX**2
        fill = {Shape.RECTANGLE: 1, Shape.ELLIPSE: np.pi / 4}.get(shape, 0.5)
        assert float((fill * area.double()).sum(-1).max()) <= 3.0
        colours = patterns.colours.double().numpy()
        assert (colours.reshape(-1, 3) @ planes.T <= bounds + 1e-6).all()
        far = np.linalg.norm(colours - np.array(SITE.asphalt), axis=-1) / np.sqrt(3)
        assert far.min() >= 0.1
        assert far.max() <= 0.3
        assert min(nearest_mark_m(patterns[k]) for k in range(0, 32, 4)) >= 0.4


@given(
    seed=st.integers(0, 10**6),
    keep_out_m=st.floats(0.0, 1.2),
    area=st.floats(0.05, 20.0),
    least=st.floats(0.0, 0.25),
    band=st.floats(0.02, 0.5),
    printable=st.booleans(),
)
@settings(max_examples=15, deadline=None, derandomize=True)
def test_limits_hold_whatever_they_are(seed, keep_out_m, area, least, band, printable):
    limits = PaintLimits(
        max_area_m2=area, keep_out_m=keep_out_m, contrast=(least, min(least + band, 1.0)), printable=printable
    )
    limited = space(limits)
    patterns = limited.pattern(cube(limited, seed, 4))
    for k in range(4):
        told = conspicuousness(patterns[k], SITE)
        assert told.area_m2 <= area * (1 + 1e-6)
        assert told.mark_distance_m >= keep_out_m
        far = (patterns.colours[k].double() - torch.tensor(SITE.asphalt).double()).norm(dim=-1) / 3**0.5
        assert float(far.min()) >= least
        assert float(far.max()) <= min(least + band, 1.0)


def test_only_listed_colours_are_painted_and_their_gradient_is_that_of_all_colours():
    listed = ("#dededa", "#d6a83d", "#202020")
    limited = space(PaintLimits(colours=listed))
    unit = cube(limited, 3).requires_grad_()
    colours = limited.pattern(unit).colours
    known = torch.tensor([rgb_of(each) for each in listed])
    assert torch.equal((colours[..., None, :] == known).all(-1).any(-1), torch.ones(32, 4, dtype=torch.bool))
    nearest = known[(unit.detach()[..., 4:, None].mT - known).square().sum(-1).argmin(-1)]
    torch.testing.assert_close(colours, nearest)
    (gradient,) = torch.autograd.grad(colours.sum(), unit)
    torch.testing.assert_close(gradient[..., 4:], torch.ones(32, 4, 3))


def test_what_obeys_already_is_left_as_it_is():
    free = SearchSpace(figures=1, family="free")
    box = torch.tensor([[100.0, 200.0, 20.0, 60.0, 30.0]])
    colour = torch.tensor([[0.5, 0.5, 0.5]])
    from roadproof.patterns import Pattern

    pattern = Pattern((Shape.RECTANGLE,), box, colour)
    limited = SearchSpace(figures=1, family="free", limits=LIMITS).on(SITE)
    kept = limited.pattern(limited.point(pattern))
    torch.testing.assert_close(kept.boxes, box)
    torch.testing.assert_close(kept.colours, colour)
    torch.testing.assert_close(free.pattern(free.point(pattern)).boxes, box)


def test_marks_that_are_far_from_the_canvas_leave_all_of_it_free():
    beside = LaneMark(points_m=((-1.0, -4.0), (-1.0, 14.0)))
    some = SearchSpace(figures=2, family="free", limits=PaintLimits(keep_out_m=0.3))
    unit = torch.full((2, 8), 0.5)
    boxes = some.on(Site(size_m=SIZE_M, marks=(beside,))).pattern(unit).boxes
    torch.testing.assert_close(boxes, some.unlimited.pattern(unit).boxes)


def test_gradients_of_limited_patterns_are_exact_where_figures_shrink():
    limited = space(PaintLimits(max_area_m2=3.0, keep_out_m=0.4, contrast=(0.1, 0.3), printable=True), "free")
    unit = (0.1 + 0.8 * torch.rand(2, 4, 8, generator=torch.Generator().manual_seed(5))).double()
    unit[..., 0] = 0.25  # in the middle of a lane: moved nowhere

    def widths_and_colours(point):
        pattern = limited.pattern(point)
        return pattern.boxes[..., 2:], pattern.colours

    assert torch.autograd.gradcheck(widths_and_colours, (unit.requires_grad_(),), atol=1e-4)


@pytest.mark.parametrize(
    ("limits", "site", "message"),
    [
        ({"keep_out_m": 3.0}, SITE, "leaves no place for paint on the canvas; expected at most 1."),
        ({"contrast": (0.8, 0.9)}, SITE, "no paint has a contrast of 0.8 to 0.9"),
        ({"contrast": (0.55, 0.6), "printable": True}, Site(asphalt=(0.5, 0.5, 0.5)), "no paint has a contrast"),
        ({"contrast": (0.3, 0.4), "colours": ("#5c5957",)}, SITE, "no colour listed has a contrast of 0.3 to 0.4"),
        ({"contrast": (0.1, 0.2)}, Site(size_m=SIZE_M), "needs the colour of the asphalt"),
        ({"keep_out_m": 0.1}, Site(size_m=(1e8, 9.5), marks=(MIDDLE,)), r"1e\+08 m × 9\.5 m, expected 100"),
        ({"keep_out_m": 0.1}, Site(size_m=SIZE_M), "needs the lane marks, which are not known"),
        ({"max_area_m2": 1.0}, Site(), "size of the canvas"),
    ],
)
def test_limits_that_leave_no_pattern_or_lack_something_are_one_line(limits, site, message):
    with pytest.raises(PatternError, match=message) as refused:
        SearchSpace(figures=2, limits=PaintLimits(**limits)).on(site)
    assert "\n" not in str(refused.value)


def test_a_narrow_albedo_is_refused_for_print_alone():
    narrow = SearchSpace(figures=2, albedo=(0.5, 0.5005), limits=PaintLimits(max_area_m2=2.0)).on(SITE)
    colours = narrow.drawn(8, 0).colours
    assert 0.5 <= float(colours.min()) <= float(colours.max()) <= 0.5005 + 1e-6
    with pytest.raises(PatternError, match="can be printed; widen it"):
        replace(narrow, limits=PaintLimits(printable=True)).on(SITE)


def test_black_that_no_limit_leaves_is_refused():
    with pytest.raises(PatternError, match="only black paint is searched"):
        SearchSpace(figures=2, colour=False, limits=PaintLimits(colours=("#ffffff",))).on(SITE)
    with pytest.raises(PatternError, match=r"by space\.on\(site\)"):
        SearchSpace(figures=1, limits=LIMITS).pattern(torch.rand(1, 7))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"max_area_m2": 0.001}, "max_area_m2 is 0.001, expected 0.01 to 10,000 m²"),
        ({"marks": (LaneMark(points_m=tuple((float(k), 0.0) for k in range(2001))),)}, "marks have 2001 points"),
        ({"keep_out_m": 11.0}, "keep_out_m is 11.0"),
        ({"contrast": (0.5, 0.5)}, "contrast is"),
        ({"contrast": (0.5, 0.505)}, "at least 0.01 apart"),
        ({"colours": ("white",)}, "colour is 'white'"),
        ({"asphalt": "#12345"}, "colour is '#12345'"),
    ],
)
def test_limits_out_of_their_range_are_refused(value, message):
    with pytest.raises(PatternError, match=message):
        PaintLimits(**value)


def test_lists_in_place_of_tuples_are_refused():
    unchecked = PaintLimits.__init__.__wrapped__  # as it is without the tests' checks of types
    with pytest.raises(PatternError, match=r"colours is \['#dededa'\], expected tuples in place of lists"):
        unchecked(object.__new__(PaintLimits), colours=["#dededa"])
    with pytest.raises(PatternError, match=r"contrast is \[0, 0\.25\], expected tuples"):
        unchecked(object.__new__(PaintLimits), contrast=[0, 0.25])


@pytest.mark.parametrize("points", [(), ((3.0, 3.0),), ((3.0, 3.0), (3.0, 3.0))])
def test_a_lane_mark_without_length_is_refused(points):
    with pytest.raises(PatternError, match="expected two different ones or more, in metres on the canvas"):
        LaneMark(points_m=points)


def test_a_space_without_limits_is_stated_as_before_there_were_any():
    assert "limits" not in SearchSpace(figures=2).stated
    assert space(LIMITS).stated["limits"]["max_area_m2"] == 3.0
    assert "site" not in space(LIMITS).stated


def test_conspicuousness_of_a_strip_is_as_measured_by_hand():
    from roadproof.patterns import Pattern

    # 0.19 m wide, 4.75 m long, 1.9 m from the left edge: 1.9 m from the middle line's middle.
    strip = Pattern(
        (Shape.RECTANGLE,), torch.tensor([[99.5, 199.5, 10.0, 200.0, 0.0]]), torch.tensor([[1.0, 1.0, 1.0]])
    )
    site = Site(size_m=SIZE_M, asphalt=(0.5, 0.5, 0.5), marks=(MIDDLE,))
    told = conspicuousness(strip, site)
    assert told.area_m2 == pytest.approx(0.19 * 4.75)
    assert told.contrast == pytest.approx(0.5)
    assert told.mark_distance_m == pytest.approx(1.9 - 0.095 - 0.075)
    fake = Pattern((Shape.RECTANGLE,), strip.boxes, torch.tensor([rgb_of("#d6a83d")]))
    assert conspicuousness(fake, site).mark_likeness == pytest.approx(0.15 / 0.19)
    turned = Pattern((Shape.RECTANGLE,), torch.tensor([[99.5, 199.5, 10.0, 200.0, 90.0]]), fake.colours)
    assert conspicuousness(turned, site).mark_likeness == 0.0
    over = Pattern((Shape.RECTANGLE,), torch.tensor([[199.5, 199.5, 10.0, 200.0, 20.0]]), fake.colours)
    assert conspicuousness(over, site).mark_distance_m == 0.0
    assert conspicuousness(strip, Site()).sentence == "1 figure"


def test_limits_without_each_of_them():
    known = {"asphalt": "#5a5a5b", "marks": (MIDDLE,)}
    several = PaintLimits(max_area_m2=4.0, contrast=(0.0, 0.25), keep_out_m=0.3, **known)
    assert several.relaxed == {
        "area": PaintLimits(contrast=(0.0, 0.25), keep_out_m=0.3, **known),
        "contrast": PaintLimits(max_area_m2=4.0, keep_out_m=0.3, **known),
        "distance from marks": PaintLimits(max_area_m2=4.0, contrast=(0.0, 0.25), **known),
        "any": PaintLimits(**known),
    }
    assert PaintLimits(printable=True).relaxed == {"print": PaintLimits()}
    assert PaintLimits(**known).relaxed == {}
    assert set(paint_limits.LIMITS) | set(known) == {each.name for each in fields(PaintLimits)}
