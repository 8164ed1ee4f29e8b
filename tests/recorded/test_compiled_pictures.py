"""Compiled kernels make the pictures that tensor operations make, and know the same of their canvas' pixels."""

import copy
import dataclasses

import pytest
import torch

from painted_ground import CANVAS, pose, recorded, recorded_road
from roadproof.compositing.composite import composite_own
from roadproof.coverage import Shape
from roadproof.photometry import PixelMaps
from roadproof.recorded.nearest import Poses
from roadproof.recorded.pictures import FrameBank
from roadproof.recordings import Side
from roadproof.search_space import SearchSpace

STATES = [
    pose(-25.0, 0.4),
    pose(-14.0, 0.1, 0.3),
    pose(-7.0, -0.6, -0.1),
    pose(0.0),
    pose(4.0, 0.2),
    pose(14.0),
]


class Plain(FrameBank):
    """A bank whose pictures tensor operations make, without what makes them replayable."""

    _compiles = False


def both_banks(road):
    compiled = FrameBank(road)
    plain = copy.copy(compiled)
    plain.__class__ = Plain
    return compiled, plain


@pytest.fixture(scope="module")
def banks():
    road = recorded_road()
    turned = recorded(Side.LEFT, 0.6, yaw_rad=0.3, name="left-2")
    return both_banks(dataclasses.replace(road, recordings=(*road.recordings, turned)))


@pytest.fixture(scope="module")
def lit_banks():
    """Frames with a light of their own in every pixel, and one that something stands before."""
    road = recorded_road()
    generator = torch.Generator().manual_seed(2)
    drives = [
        dataclasses.replace(
            drive,
            maps=PixelMaps(
                torch.rand(drive.frames.shape, generator=generator),
                0.1 * torch.rand(drive.frames.shape, generator=generator),
                torch.rand(drive.frames.shape[:3], generator=generator),
            ),
        )
        for drive in road.recordings
    ]
    return both_banks(dataclasses.replace(road, recordings=tuple(drives)))


@pytest.fixture(scope="module")
def large_banks():
    """Frames twice as large as their crop, in which paint reaches further beside the canvas."""
    road = recorded_road()
    view = dataclasses.replace(road.view, width_px=2 * road.view.width_px, height_px=2 * road.view.height_px)
    drives = [dataclasses.replace(each, frames=each.frames.repeat(2, 1).repeat(2, 2)) for each in road.recordings]
    return both_banks(dataclasses.replace(road, view=view, recordings=tuple(drives)))


def poses_of(states):
    rows = [(state.x_m - CANVAS.x_m, state.y_m - CANVAS.y_m, state.yaw_rad) for state in states]
    return Poses(*torch.tensor(rows, dtype=torch.float64).T)


def shown(bank, states, **options):
    poses = poses_of(states)
    return bank.show(poses, bank.nearest(poses), **options)


def painted(views, shape):
    space = SearchSpace(figures=3, family="published" if shape is Shape.RECTANGLE else "free", shape=shape)
    return composite_own(space.drawn(len(views.frames), 4), views.frames, views.canvas)


def test_pictures_are_the_same_but_for_a_level_in_a_pixel_of_many(banks):
    compiled, plain = (shown(bank, STATES, to_paint=False) for bank in banks)
    assert compiled.canvas is None
    apart = (compiled.frames - plain.frames).abs()
    assert apart.max() < 1.01 / 255
    assert (apart > 0).float().mean() < 1e-4


@pytest.mark.parametrize("which", ["banks", "lit_banks", "large_banks"])
@pytest.mark.parametrize("shape", [Shape.RECTANGLE, Shape.TRIANGLE])
def test_paint_is_the_same(which, shape, request):
    # Painted in the same pictures: a level that differs is no matter here.
    compiled, plain = (shown(bank, STATES) for bank in request.getfixturevalue(which))
    assert torch.equal(compiled.canvas.valid.sum(1), plain.canvas.valid.sum(1))
    assert torch.equal(compiled.canvas.pixel[compiled.canvas.valid], plain.canvas.pixel[plain.canvas.valid])
    assert not compiled.canvas.valid[-1].any()
    apart = (painted(compiled, shape) - painted(plain, shape)).abs()
    assert apart.max() < 1.1 / 255
    assert apart.mean() < 2e-6


def test_where_no_picture_shows_the_canvas_there_is_nothing_to_paint(banks):
    for bank in banks:
        assert shown(bank, [pose(14.0)]).canvas is None


def test_pictures_are_the_same_with_any_number_of_threads(lit_banks):
    bank, found, before = lit_banks[0], [], torch.get_num_threads()
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            views = shown(bank, STATES)
            found.append((views.frames, views.canvas.gain, views.canvas.bias, views.canvas.footprints.features))
    finally:
        torch.set_num_threads(before)
    for one, many in zip(*found, strict=True):
        assert torch.equal(one, many)
