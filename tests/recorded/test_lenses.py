"""Pictures at any pose through a lens: the recorded ones bit for bit, others close to what is there."""

import dataclasses

import numpy as np
import pytest
import torch

from lenses import BARREL, LENSES, behind
from painted_ground import CANVAS, VIEW, RampFollower, picture, pose, recorded_road
from roadproof.attacks import GradOpt, PathDeviation, SteeringShift, attack
from roadproof.attacks.attack import kept_attack
from roadproof.compositing import composite, view_canvas
from roadproof.compositing.composite import composite_own
from roadproof.errors import RoadproofError
from roadproof.geometry import CIL_CAMERA, homography_from_pose
from roadproof.lens import Lens
from roadproof.patterns import Pattern
from roadproof.photometry import PixelMaps
from roadproof.recorded.light import Light
from roadproof.recorded.nearest import Poses
from roadproof.recorded.pictures import FrameBank
from roadproof.search_space import SearchSpace
from scenes import PLAIN

FLAT = Lens(model="brown-conrady", coefficients=(0.0,) * 5)


@pytest.fixture(scope="module", params=LENSES, ids=str)
def bank(request):
    return FrameBank(recorded_road(camera=behind(request.param)))


def seen_from(bank, states):
    numbers = [(state.x_m - CANVAS.x_m, state.y_m - CANVAS.y_m, state.yaw_rad) for state in states]
    poses = Poses(*torch.tensor(numbers, dtype=torch.float64).T)
    return bank.show(poses, bank.nearest(poses))


def levels(frames):
    return frames.mul(255).round().permute(0, 2, 3, 1).numpy().astype(np.uint8)


def patterns(count):
    space = SearchSpace(figures=3)
    return space.drawn(count, 4)


def test_at_a_recorded_pose_the_picture_is_the_frame_bit_for_bit(bank):
    views = bank.show(bank.poses, bank.nearest(bank.poses))
    assert torch.equal(views.frames.mul(255).round(), bank.levels)
    painted = composite_own(patterns(len(views.frames)), views.frames, views.canvas)
    outside = torch.ones(len(painted), 88 * 200, dtype=torch.bool).scatter_(1, views.canvas.pixel, value=False)
    same = (painted == views.frames).all(1).flatten(1)
    assert same[outside].all()
    assert not same.all()


@pytest.mark.parametrize(
    ("state", "most"), [(pose(-15.3), 0.6), (pose(-15.0, 0.5), 1.2), (pose(-12.2, -0.7, 0.1), 1.5)]
)
def test_between_recorded_poses_it_is_close_to_what_is_there(bank, state, most):
    there = picture(state, bank.camera).astype(float)
    error = np.abs(levels(seen_from(bank, [state]).frames)[0] - there)
    assert error[:, 25:-25].mean() < most


def test_paint_is_composited_for_the_pose_itself(bank):
    states = [pose(-20.0, 0.3), pose(-9.0, -0.4, 0.05), pose(-6.1, 0.2, -0.1)]
    views, painted = seen_from(bank, states), patterns(3)
    found, bare = composite_own(painted, views.frames, views.canvas), levels(views.frames)
    for k, state in enumerate(states):
        homography = homography_from_pose(bank.camera, state, CANVAS)[None]
        alone = view_canvas(bare[k : k + 1], homography, VIEW, PLAIN, camera=bank.camera)
        assert torch.allclose(found[k], composite(painted[k], alone)[0], atol=2e-4)


def test_a_lens_that_bends_nothing_shows_what_a_pinhole_does():
    states = [pose(-20.0, 0.3), pose(-9.0, -0.4, 0.05), pose(-14.0, 0.1, 0.3), pose(4.0)]
    straight, through = (
        seen_from(FrameBank(recorded_road(camera=camera)), states) for camera in (CIL_CAMERA, behind(FLAT))
    )
    off = (straight.frames - through.frames).abs() * 255
    assert off.max() < 1.01
    assert off.mean() < 1e-3
    for one, other in zip(straight.canvas.valid, through.canvas.valid, strict=True):
        assert int(one.sum()) == int(other.sum())


def test_a_pinhole_that_looks_at_a_bent_picture_is_further_off():
    camera, state = behind(BARREL), pose(-15.0, 0.7)
    road = recorded_road(camera=camera)
    there = picture(state, camera).astype(float)
    through, straight = (
        np.abs(levels(seen_from(FrameBank(each), [state]).frames)[0] - there)[:, 25:-25].mean()
        for each in (road, dataclasses.replace(road, camera=CIL_CAMERA))
    )
    assert through < 0.8 * straight


def test_what_hides_the_canvas_is_measured_through_the_lens():
    road = recorded_road(every=8, camera=behind(BARREL))
    drive = road.recordings[0]
    view = view_canvas(drive.frames, drive.image_from_canvas, VIEW, PLAIN, camera=road.camera)
    visible = torch.zeros(drive.frames.shape[:3])
    visible.view(-1)[view.index] = view.gain[:, 0]
    shape = drive.frames.shape
    maps = PixelMaps(torch.ones(shape), torch.zeros(shape), visible)
    seen = dataclasses.replace(road, recordings=(dataclasses.replace(drive, maps=maps),))
    free = Light(seen, torch.device("cpu")).values[:, 6]
    # Nothing hides it, so all of it is seen: through a pinhole, its outline would seem hidden.
    assert torch.allclose(free, torch.ones(()), atol=1e-5)
    straight = Light(dataclasses.replace(seen, camera=CIL_CAMERA), torch.device("cpu")).values[:, 6]
    assert straight.min() < 0.5


def test_a_path_is_searched_through_the_lens():
    road = recorded_road(every=2, camera=behind(BARREL))
    method = GradOpt(iterations=2, restarts=1, halving=False)
    found = attack(road, RampFollower(), SearchSpace(figures=1), objective=PathDeviation(), method=method)
    assert found.predicted_m is not None
    assert found.predicted_m > 0.0


def test_a_search_through_a_lens_is_not_taken_for_that_of_a_pinhole(tmp_path):
    road, space = recorded_road(every=8, camera=behind(BARREL)), SearchSpace(figures=1)
    given = {"objective": SteeringShift(), "method": GradOpt(iterations=2, restarts=1, halving=False)}
    found = kept_attack(tmp_path, road, RampFollower(), space, **given)
    assert found.surrogate_shift != 0.0
    assert kept_attack(tmp_path, road, RampFollower(), space, **given).surrogate_shift == found.surrogate_shift
    with pytest.raises(RoadproofError, match="with drives"):
        kept_attack(tmp_path, dataclasses.replace(road, camera=CIL_CAMERA), RampFollower(), space, **given)


def test_the_gradient_flows_to_the_paint_of_every_pose(bank):
    states, painted = [pose(-9.0, -0.4, 0.05), pose(-6.1, 0.2, -0.1)], patterns(2)
    views = seen_from(bank, states)
    boxes, colours = painted.boxes.clone().requires_grad_(), painted.colours.clone().requires_grad_()
    frames = composite_own(Pattern(painted.shapes, boxes, colours), views.frames, views.canvas)
    weight = torch.randn(frames.shape, generator=torch.Generator().manual_seed(1))
    for slope in torch.autograd.grad((frames * weight).sum(), (boxes, colours)):
        assert torch.isfinite(slope).all()
        assert (slope.abs().sum((1, 2)) > 0).all()
