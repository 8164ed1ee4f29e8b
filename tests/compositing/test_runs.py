"""Runs of pixels: none is missed that a figure touches."""

import pytest
import torch

from references import approach
from roadproof.compositing import view_canvas
from roadproof.compositing.rectangles import _edge_rows
from roadproof.compositing.runs import RUN
from roadproof.coverage import Shape, coverage
from roadproof.geometry import CIL_INPUT
from roadproof.search_space import SearchSpace
from scenes import PLAIN, road_frames


@pytest.fixture(scope="module")
def view():
    return view_canvas(road_frames(3, 0), approach(3, first_m=40.0), CIL_INPUT, PLAIN)


def test_runs_hold_every_pixel_once_and_paint_nothing_on_what_fills_the_last(view):
    count = len(view.clean)
    assert len(view.runs) == -(-count // RUN)
    assert torch.equal(view.runs.features[0].flatten(1)[:, :count], view.footprints.features)
    assert torch.equal(view.runs.gain[0].T[:count], view.gain)
    assert not view.runs.gain[..., count:].any()
    assert not view.runs.bias[..., count:].any()


def test_a_run_of_no_relation_to_a_figure_is_uncovered_and_one_inside_is_covered(view):
    space = SearchSpace(figures=40, family="free")
    boxes = space.pattern(space.random((), torch.Generator().manual_seed(0))).boxes
    (inside,), (crossed,) = view.runs.relation(_edge_rows(boxes[None]))
    masks = coverage(Shape.RECTANGLE, boxes, view.footprints)
    whole = len(view.clean) // RUN
    by_run = masks[:, : whole * RUN].view(len(boxes), whole, RUN)
    inside, crossed = inside[:, :whole], crossed[:, :whole]
    assert not (inside & crossed).any()
    assert (by_run[inside] == 1).all()
    assert (by_run[~inside & ~crossed] == 0).all()
    # The test is worth its cost only where it leaves little to do.
    assert 0.0 < crossed.float().mean() < 0.25
    assert inside.any()
