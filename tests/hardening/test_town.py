"""Frames of any drive can be painted: the canvas lies on the road where its homography puts it, and nowhere else."""

import numpy as np
import pytest
import torch

from hardening_road import SPACE, RampNet
from painted_ground import VIEW, RampFollower, picture, pose
from roadproof.compositing import composite, view_canvas
from roadproof.datatypes import VehicleState
from roadproof.geometry import CIL_CAMERA, CanvasPlacement, homography_from_pose
from roadproof.hardening import Tuning
from roadproof.hardening import town as town_module
from roadproof.hardening.town import Town
from roadproof.hardening.tuning import training_step, tune
from roadproof.photometry import AffineResponse, ColourTransform
from roadproof.training.dataset import Dataset

GREY = 0.45  # as bright as paint is taken to be lit fully on


def town_of(frames):
    count = len(frames)
    speed, command = np.full(count, 6.0, np.float32), np.full(count, 2, np.int8)
    expert, path = np.zeros((count, 3), np.float32), np.zeros((count, 4, 2), np.float32)
    drives = Dataset(np.stack(frames), speed, command, expert, path, np.zeros(count, np.int64))
    return Town(drives, CIL_CAMERA, VIEW)


@pytest.fixture(scope="module")
def grey():
    return town_of([np.full((88, 200, 3), round(255 * GREY), np.uint8)])


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def patterns(count, seed=1):
    return SPACE.pattern(SPACE.random((count,), seeded(seed)))


def test_paint_lies_where_the_homography_of_the_canvas_puts_it(grey, monkeypatch):
    monkeypatch.setattr(town_module, "AHEAD_M", (9.0, 9.0))
    monkeypatch.setattr(town_module, "ASIDE_M", 0.0)
    monkeypatch.setattr(town_module, "TURNED_RAD", 0.0)
    views = grey.draw(6, seeded())
    canvas = CanvasPlacement(x_m=9.0, y_m=0.0)
    seen = homography_from_pose(CIL_CAMERA, VehicleState(0.0, 0.0, 0.0, 0.0, 0.0), canvas)
    plain = ColourTransform(AffineResponse.identity())
    view = view_canvas(np.full((1, 88, 200, 3), round(255 * GREY), np.uint8), seen[None], VIEW, plain)
    torch.testing.assert_close(
        views.painted(patterns(6)), composite(patterns(6), view)[:, 0], rtol=0.0, atol=0.01, check_stride=False
    )


def test_paint_is_as_bright_as_the_road_and_never_in_the_sky():
    light, dark = (town_of([np.full((88, 200, 3), level, np.uint8)]) for level in (110, 55))
    bright, dim = (town.draw(40, seeded()).painted(patterns(40)) for town in (light, dark))
    changed = (bright - light.draw(40, seeded()).frames).abs().amax(1) > 1e-6
    # The nearest canvases show a corner at most.
    assert changed.flatten(1).any(1).float().mean() > 0.7
    assert not changed[:, :14].any()
    assert (bright >= dim - 1e-6).all()


def test_canvases_are_at_places_of_their_own_and_the_same_seed_draws_the_same(grey):
    one, same, other = (grey.draw(8, seeded(seed)) for seed in (0, 0, 1))
    paint = patterns(1).mapped(lambda part: part.expand(8, -1, -1))
    assert torch.equal(one.painted(paint), same.painted(paint))
    assert not torch.equal(one.painted(paint), other.painted(paint))
    assert len({tuple(frame.flatten().tolist()) for frame in one.painted(paint)}) > 4


def test_patterns_on_frames_of_the_town_climb_too_and_what_they_teach_holds_there(street):
    town = town_of([picture(pose(-20.0 + k)) for k in range(8)])
    seen = []

    def step(model, batch):
        seen.append(batch)
        return training_step(model, batch)

    network = RampNet()
    tuning = Tuning(steps=20, repeats=3, batch=16, learning_rate=0.3)
    tune(network, RampFollower(), [street], [SPACE], SPACE.random((0,), seeded()), town, tuning, seed=0, step=step)
    first, again = (torch.cat([batch.frames[-8:] for batch in seen[k::3]]) for k in (0, 1))
    changed = (first != again).flatten(1).any(1)
    assert changed.any()
    assert not changed.all(), "what is bare stays bare"
    views = town.draw(64, seeded(9))
    teacher = RampFollower().steer(views.frames, None, None)
    errors = []
    for driver in (RampNet().eval(), network):
        with torch.no_grad():
            errors.append((driver.steer(views.painted(patterns(64, 8)), None, None) - teacher).abs().mean())
    assert errors[1] < 0.7 * errors[0]
