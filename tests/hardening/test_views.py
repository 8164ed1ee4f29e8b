"""Pictures to learn from: bare ones are the road's, painted ones differ on the canvas alone, labels lead back."""

import math

import torch

from hardening_road import SPACE
from painted_ground import CANVAS, RampFollower, picture
from roadproof.datatypes import VehicleState
from roadproof.recorded.course import Place


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def test_the_same_seed_draws_the_same_pictures(street):
    one, same, other = (street.draw(8, seeded(seed)) for seed in (0, 0, 1))
    assert torch.equal(one.frames, same.frames)
    assert one.frames.shape != other.frames.shape or not torch.equal(one.frames, other.frames)
    assert one.frames.shape[1:] == (3, 88, 200)
    assert len(one.frames) == len(one.speed_mps) == len(one.command) == len(one.place.right_m)


def test_pictures_are_what_is_seen_from_where_the_car_is(street):
    views = street.draw(12, seeded(2))
    assert views.place.right_m.std() > 0.15
    for k, frame in enumerate(views.frames):
        # The road runs along the world's x axis, so a place beside the clean path is a pose.
        ahead_m, right_m = float(views.place.s_m[k]) - 32.0, float(views.place.right_m[k])
        pose = VehicleState(CANVAS.x_m + ahead_m, CANVAS.y_m - right_m, 0.0, float(views.place.turned_rad[k]), 6.0)
        seen = torch.tensor(picture(pose)).permute(2, 0, 1) / 255
        assert (frame - seen).abs().mean() < 0.012


def test_paint_changes_the_canvas_alone(street):
    views = street.draw(12, seeded(3))
    painted = views.painted(SPACE.pattern(SPACE.random((len(views.frames),), seeded(4))))
    changed = (painted - views.frames).abs().amax(1) > 1e-6
    assert changed.any()
    assert not changed[:, : street.world.bank.horizon_row].any()


def test_pictures_to_paint_are_those_where_the_canvas_is_large(street):
    painted, bare = (street.draw(200, seeded(5), to_paint=to_paint) for to_paint in (True, False))
    assert bare.canvas is None
    # Its shares of the picture fall with the square of the distance; 10 m and more before it, it is a strip.
    near = [float((32.0 - views.place.s_m < 10.0).double().mean()) for views in (painted, bare)]
    assert near[0] > 1.5 * near[1]
    assert 1.0 - near[0] > 0.02, "what is far is painted too"


def test_labels_are_the_teachers_near_the_path_and_lead_back_far_from_it(street):
    right = torch.tensor([-3.0, -0.5, 0.0, 0.5, 3.0], dtype=torch.float64)
    place = Place(torch.full((5,), 20.0).double(), right, torch.zeros(5).double())
    answer = torch.tensor([9.0, 0.1, 0.0, -0.1, 9.0])
    label = street.returning(place, answer)
    assert label[1:4].tolist() == answer[1:4].tolist()
    # The teacher steers left, towards the path, where it is to the right of it; what it said of a poor picture is gone.
    assert -1.0 < label[4] < -0.02
    assert 0.02 < label[0] < 1.0
    assert math.isclose(float(label[4]), float(RampFollower().steer(_seen(1.5), None, None)[0]), abs_tol=0.1)


def _seen(right_m):
    pose = VehicleState(CANVAS.x_m - 12.0, CANVAS.y_m - right_m, 0.0, 0.0, 6.0)
    return torch.tensor(picture(pose)).permute(2, 0, 1)[None] / 255
