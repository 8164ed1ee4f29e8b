"""Which drives are recorded, and refusals of what makes no sense."""

import pytest

from roadproof.drives import Scheme, SteeringNoise, Swerve, Trajectories, Window
from roadproof.errors import RecordingError


def test_a_group_is_the_clean_drive_and_pairs_to_both_sides_of_the_sizes_in_turn():
    plans = Trajectories(count=5, perturbation=Swerve((0.7, 1.5))).plans()
    assert [plan.name for plan in plans] == ["clean", "right", "left", "right-2", "left-2"]
    assert [plan.offset_m for plan in plans] == [0.0, 0.7, 0.7, 1.5, 1.5]
    assert [str(plan.side) for plan in plans] == ["clean", "right", "left", "right", "left"]
    assert [plan.name for plan in Trajectories(count=1).plans()] == ["clean"]
    assert len({plan.name for plan in Trajectories(count=7).plans()}) == 7


def test_a_weaving_pair_comes_after_the_swerves():
    plans = Trajectories(count=5, perturbation=Swerve((1.5,), weaves_m=(0.5,))).plans()
    assert [(plan.offset_m, plan.weaves) for plan in plans[1:]] == [(1.5, False)] * 2 + [(0.5, True)] * 2


def test_random_drives_are_perturbed_at_random_each_with_draws_of_its_own():
    plans = Trajectories(count=5, scheme=Scheme.RANDOM).plans()
    assert [str(plan.side) for plan in plans] == ["clean", *["random"] * 4]
    assert len({plan.stream for plan in plans}) == 5


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Trajectories(count=2), "T is 2 trajectories, expected one of 1, 3, 5, 7"),
        (lambda: Swerve(()), "expected one or more"),
        (lambda: Swerve((float("nan"),)), "between 0.1 and 5"),
        (lambda: Swerve((1.5,), weaves_m=(0.0,)), "between 0.1 and 5"),
        (lambda: Swerve((9.0,)), "between 0.1 and 5"),
        (lambda: SteeringNoise(5, 4), "steering noise is 5…4°"),
        (lambda: SteeringNoise(0, 0), "high > 0"),
        (lambda: Window(horizon_m=float("nan")), "expected all above 0"),
        (lambda: Window(frames=0), "0 frames"),
    ],
)
def test_what_makes_no_sense_is_refused(make, message):
    with pytest.raises(RecordingError, match=message):
        make()
