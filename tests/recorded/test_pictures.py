"""Pictures at any pose: the recorded ones bit for bit, others close to what is there, the pattern exactly."""

import dataclasses

import numpy as np
import pytest
import torch

from painted_ground import CANVAS, VIEW, picture, pose, recorded, recorded_road
from roadproof.compositing import composite, view_canvas
from roadproof.compositing.composite import composite_own
from roadproof.coverage import Shape
from roadproof.errors import RecordingError
from roadproof.geometry import CIL_CAMERA, homography_from_pose
from roadproof.patterns import Pattern
from roadproof.recorded.nearest import Poses
from roadproof.recorded.pictures import FrameBank
from roadproof.recordings import RecordingSet, Side
from roadproof.search_space import SearchSpace
from scenes import PLAIN


@pytest.fixture(scope="module")
def bank():
    return FrameBank(recorded_road())


def seen_from(bank, states):
    poses = Poses(
        torch.tensor([state.x_m - CANVAS.x_m for state in states], dtype=torch.float64),
        torch.tensor([state.y_m - CANVAS.y_m for state in states], dtype=torch.float64),
        torch.tensor([state.yaw_rad for state in states], dtype=torch.float64),
    )
    return bank.show(poses, bank.nearest(poses))


def levels(frames):
    return frames.mul(255).round().permute(0, 2, 3, 1).numpy()


def patterns(count, family="published", shape=Shape.RECTANGLE):
    space = SearchSpace(figures=3, family=family, shape=shape)
    return space.drawn(count, 4)


def test_at_a_recorded_pose_the_picture_is_the_frame_bit_for_bit(bank):
    shown = bank.show(bank.poses, bank.nearest(bank.poses))
    assert torch.equal(shown.frames.mul(255).round(), bank.levels)
    bare = bank.show(bank.poses, bank.nearest(bank.poses), to_paint=False)
    assert torch.equal(bare.frames, shown.frames)
    assert shown.canvas is not None and bare.canvas is None


@pytest.mark.parametrize(
    ("state", "most"), [(pose(-15.3), 0.6), (pose(-15.0, 0.5), 1.2), (pose(-12.2, -0.7, 0.1), 1.5)]
)
def test_between_recorded_poses_it_is_close_to_what_is_there(bank, state, most):
    there = picture(state).astype(float)
    error = np.abs(levels(seen_from(bank, [state]).frames)[0] - there)
    # What a turned camera sees beyond the edge of the recorded frame is not known.
    assert error[:, 25:-25].mean() < most


def test_moving_the_nearest_frame_is_closer_than_the_frame_as_it_is(bank):
    state = pose(-15.0, 0.7)
    there, (view,) = picture(state).astype(float), levels(seen_from(bank, [state]).frames)
    poses = Poses(*(torch.tensor([value], dtype=torch.float64) for value in (-15.0, 0.7, 0.0)))
    as_recorded = bank.levels[bank.nearest(poses).frame[0]].permute(1, 2, 0).numpy()
    assert np.abs(view - there).mean() < 0.4 * np.abs(as_recorded - there).mean()


@pytest.mark.parametrize("shape", list(Shape))
def test_paint_is_composited_for_the_pose_itself(bank, shape):
    family = "published" if shape is Shape.RECTANGLE else "free"
    states = [pose(-20.0, 0.3), pose(-9.0, -0.4, 0.05), pose(-6.1, 0.2, -0.1)]
    views, painted = seen_from(bank, states), patterns(3, family, shape)
    found = composite_own(painted, views.frames, views.canvas)
    bare = levels(views.frames).astype(np.uint8)
    for k, state in enumerate(states):
        alone = view_canvas(bare[k : k + 1], homography_from_pose(CIL_CAMERA, state, CANVAS)[None], VIEW, PLAIN)
        assert torch.allclose(found[k], composite(painted[k], alone)[0], atol=2e-4)


def test_gradients_of_own_pictures_are_those_of_shared_ones(bank):
    state, painted = pose(-8.0), patterns(1)
    views = seen_from(bank, [state])
    alone = view_canvas(
        levels(views.frames).astype(np.uint8), homography_from_pose(CIL_CAMERA, state, CANVAS)[None], VIEW, PLAIN
    )
    weight = torch.randn(3, 88, 200, generator=torch.Generator().manual_seed(1))
    gradients = []
    for paint in (
        lambda pattern: composite_own(pattern, views.frames, views.canvas)[0],
        lambda pattern: composite(pattern, alone)[0, 0],
    ):
        boxes, colours = painted.boxes.clone().requires_grad_(), painted.colours.clone().requires_grad_()
        value = (paint(Pattern(painted.shapes, boxes, colours)) * weight).sum()
        gradients.append(torch.autograd.grad(value, (boxes, colours)))
    for own, shared in zip(*gradients, strict=True):
        assert torch.allclose(own, shared, rtol=1e-3, atol=1e-3 * float(shared.abs().max()))


def test_pictures_of_several_poses_are_those_of_each_alone(bank):
    states = [pose(-25.0), pose(-7.0, 0.3), pose(4.0)]
    together, painted = seen_from(bank, states), patterns(3)
    found = composite_own(painted, together.frames, together.canvas)
    for k, state in enumerate(states):
        alone = seen_from(bank, [state])
        one = Pattern(painted.shapes, painted.boxes[k : k + 1], painted.colours[k : k + 1])
        expected = alone.frames if alone.canvas is None else composite_own(one, alone.frames, alone.canvas)
        # Rounded to levels, a pixel in many falls to the other side.
        assert (found[k] - expected[0]).abs().max() < 1.5 / 255
        assert (found[k] - expected[0]).abs().mean() < 1e-4


def test_no_pixel_of_a_picture_depends_on_what_else_is_in_the_batch(bank):
    """Rows of a batch are filled up; what fills them must not paint over the picture's own last pixel."""
    # Both reach the lower edge of the picture, where the last pixel of a row is; the nearer one is cut off there.
    cut, whole = pose(0.0), pose(-8.0)
    alone, together = seen_from(bank, [cut]), seen_from(bank, [cut, whole])
    assert alone.canvas.pixel.shape[1] < together.canvas.pixel.shape[1]
    boxes, colours = torch.tensor([[[199.5, 199.5, 2000.0, 2000.0, 0.0]]]), torch.tensor([[[1.0, 0.0, 0.0]]])
    painted = Pattern((Shape.RECTANGLE,), boxes.repeat(2, 1, 1), colours.repeat(2, 1, 1))
    first = Pattern(painted.shapes, painted.boxes[:1], painted.colours[:1])
    expected = composite_own(first, alone.frames, alone.canvas)[0]
    found = composite_own(painted, together.frames, together.canvas)[0]
    assert torch.allclose(found, expected, atol=1e-4)


def test_light_of_the_recorded_frame_moves_with_the_ground():
    from roadproof.photometry import PixelMaps

    road = recorded_road()
    drive = road.recordings[0]
    shape = drive.frames.shape
    maps = PixelMaps(torch.full(shape, 0.5), torch.full(shape, 0.2), torch.ones(shape[:3]))
    lit = RecordingSet(
        camera=road.camera,
        view=road.view,
        colour=road.colour,
        recordings=(dataclasses.replace(drive, maps=maps),),
        canvas=CANVAS,
    )
    views = seen_from(FrameBank(lit), [pose(-6.3, 0.1)])
    white = Pattern((Shape.RECTANGLE,), torch.tensor([[[199.5, 199.5, 900.0, 900.0, 0.0]]]), torch.ones(1, 1, 3))
    found = composite_own(white, views.frames, views.canvas)[0]
    inside = views.canvas.pixel[0][(views.canvas.gain[0] > 0.499).all(1)]
    assert len(inside) > 500
    assert torch.allclose(found.flatten(1)[:, inside], torch.tensor(0.7), atol=2e-3)


def test_the_nearest_frame_weighs_heading_against_distance(bank):
    poses = Poses(*(torch.tensor([value], dtype=torch.float64) for value in (-15.1, 1.4, 0.0)))
    gap = bank.nearest(poses)
    assert abs(float(gap.left_m[0]) + 0.1) < 1e-6  # of the drive to the left, which is at 1.5 m
    assert abs(float(gap.ahead_m[0])) <= 0.31


def test_what_a_turned_car_sees_comes_from_a_frame_that_looked_that_way(bank):
    road = recorded_road()
    turned = recorded(Side.LEFT, 0.6, yaw_rad=0.3, name="left-2")
    there = picture(pose(-14.0, 0.1, 0.3)).astype(float)
    poses = Poses(*(torch.tensor([value], dtype=torch.float64) for value in (-14.0, 0.1, 0.3)))
    straight_on = bank.nearest(poses)
    more = FrameBank(dataclasses.replace(road, recordings=(*road.recordings, turned)))
    alone, helped = (
        np.abs(levels(each.show(poses, straight_on).frames)[0] - there)[40:].mean((0, 2)) for each in (bank, more)
    )
    # Some 60 columns to the left are beyond the edge of the frame that looked straight on.
    assert np.allclose(alone[60:], helped[60:], atol=0.2)
    assert helped[:40].mean() < 0.3 * alone[:40].mean()


def test_no_sky_is_painted_on_ground_that_lies_behind_the_frame_that_looked_the_same_way():
    road = recorded_road()
    ahead = recorded(Side.LEFT, 0.6, yaw_rad=0.3, name="left-2", from_m=-9.0, every=100)
    bank = FrameBank(dataclasses.replace(road, recordings=(*road.recordings, ahead)))
    shown = levels(seen_from(bank, [pose(-14.0, 0.1, 0.3)]).frames)[0]
    # The sky is at least 170 blue, the ground at most 142.
    assert shown[bank.horizon_row :, :, 2].max() < 147


def test_a_set_that_cannot_be_driven_in_says_what_it_lacks():
    road = recorded_road(every=8)
    with pytest.raises(RecordingError, match="where its canvas lies"):
        FrameBank(dataclasses.replace(road, canvas=None))
    nowhere = dataclasses.replace(recorded(every=8), track=None)
    with pytest.raises(RecordingError, match="drive clean has no track"):
        FrameBank(dataclasses.replace(road, recordings=(nowhere,)))
