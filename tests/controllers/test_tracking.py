"""Tracking laws: what geometry says of circles and parabolas, gradients, and a car that follows its route."""

import math

import pytest
import torch

from roadproof.controllers import LinearMPC, PurePursuit
from roadproof.controllers.tracking import point_along
from roadproof.datatypes import Control
from roadproof.driving.rollout import rollout
from roadproof.errors import ControllerError
from roadproof.scenarios import find_scenario
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.collection import path_ahead
from roadproof.training.expert import expert

AHEAD = torch.linspace(0.1, 20.0, 400, dtype=torch.float64)
SPEED = torch.tensor([6.0, 6.0], dtype=torch.float64)


def circles(*radii: float) -> torch.Tensor:
    """Arcs that begin at the rear axle in the car's direction, to the left for a positive radius."""
    r = torch.tensor(radii, dtype=torch.float64)[:, None]
    return torch.stack([r.abs() * torch.sin(AHEAD / r.abs()) - 1.4, r * (1 - torch.cos(AHEAD / r))], 2)


def test_pure_pursuit_stays_on_a_circle_of_the_rear_axle():
    law = PurePursuit()
    steer = law.steer(circles(12.0, -30.0), SPEED)
    expected = [-math.atan(2.8 / 12) / 0.65, math.atan(2.8 / 30) / 0.65]
    assert steer.tolist() == pytest.approx(expected, rel=1e-3)


def test_pure_pursuit_looks_further_ahead_at_speed():
    paths = torch.stack([AHEAD, (AHEAD - 6).clamp_min(0.0)], 1)[None]
    law = PurePursuit(sight_s=1.0, sight_m=3.0)
    slow, fast = (law.steer(paths, torch.tensor([v], dtype=torch.float64)).item() for v in (2.0, 12.0))
    assert slow == pytest.approx(0.0, abs=1e-9)
    assert fast < -0.1


def test_linear_mpc_finds_the_curvature_of_a_parabola():
    curvature = torch.tensor([0.02, -0.05], dtype=torch.float64)
    paths = torch.stack([AHEAD.expand(2, -1), 0.5 * curvature[:, None] * AHEAD.square()], 2)
    law = LinearMPC(horizon_m=10.0)
    # Points beyond the horizon hardly count, and a parabola of constant curvature costs no change of it.
    assert law.curvature(paths, SPEED).tolist() == pytest.approx(curvature.tolist(), rel=1e-3)


@pytest.mark.parametrize("law", [PurePursuit(), LinearMPC()])
def test_a_straight_way_needs_no_steering_and_a_standing_car_none(law):
    straight = torch.stack([AHEAD, torch.zeros_like(AHEAD)], 1)[None]
    assert law.steer(straight, SPEED[:1]).item() == pytest.approx(0.0, abs=1e-9)
    assert law.steer(torch.zeros(1, 8, 2, dtype=torch.float64), SPEED[:1]).item() == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("law", [PurePursuit(), LinearMPC()])
def test_left_is_negative_and_mirrors_right(law):
    left = circles(15.0)
    steer = law.steer(torch.cat([left, left * torch.tensor([1.0, -1.0])]), SPEED)
    assert steer[0] < -0.1
    torch.testing.assert_close(steer[0], -steer[1])


@pytest.mark.parametrize("law", [PurePursuit(), LinearMPC(), LinearMPC(pieces=1)])
def test_gradients_are_those_of_central_differences(law):
    path = circles(15.0, -9.0)[:, 24::50].contiguous().requires_grad_()
    assert torch.autograd.gradcheck(lambda p: law.steer(p, SPEED), path, eps=1e-6, atol=1e-6)


def test_a_path_that_ends_goes_on_straight():
    path = torch.tensor([[[3.0, 4.0]]], dtype=torch.float64)
    found = [point_along(path, torch.tensor([d], dtype=torch.float64))[0].tolist() for d in (2.5, 5.0, 10.0)]
    assert found == [pytest.approx([1.5, 2.0]), pytest.approx([3.0, 4.0]), pytest.approx([6.0, 8.0])]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: PurePursuit(wheelbase_m=0.0), "wheelbase_m of the tracking law is 0.0, expected above 0, below 100"),
        (lambda: PurePursuit(sight_m=math.nan), "sight_m of the tracking law is nan"),
        (lambda: PurePursuit(sight_m=1.4), "sight_m of the tracking law is 1.4, expected above 1.4"),
        (lambda: LinearMPC(pieces=1000), "pieces of the tracking law is 1000, expected above 0, below 33"),
        (lambda: LinearMPC(smooth_m4=0.0), "smooth_m4"),
    ],
)
def test_numbers_out_of_range_are_refused(make, message):
    with pytest.raises(ControllerError, match=message):
        make()


@pytest.mark.parametrize(("law", "most_m"), [(PurePursuit(), 0.3), (LinearMPC(), 0.6)])
def test_a_car_in_the_town_that_follows_its_route_stays_on_it(law, most_m):
    """The pedals are the expert's; the points are the route's, seen from the car."""
    aside: list[float] = []

    def driver(town):
        drives = expert(town)

        def drive(seen):
            here = seen.state
            path = torch.tensor(path_ahead(town, here))[None]
            aside.append(abs(town.place.lateral_m))
            steer = float(law.steer(path, torch.tensor([here.speed_mps], dtype=torch.float64)))
            control = drives(seen)
            return Control(steer=min(max(steer, -1.0), 1.0), throttle=control.throttle, brake=control.brake)

        return drive

    with TownSimulator(dt_s=0.1) as town:
        episode = rollout(town, driver, find_scenario("left-03"))
    assert not episode.events
    assert max(aside) < most_m
