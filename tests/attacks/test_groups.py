"""Divergence: signs, pooling, groups from words."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from roadproof.attacks import GradOpt, RandomSearch, SteeringShift, attack, kept_attack
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP, Direction, Group, divergence, parse_groups
from roadproof.errors import RecordingError, RoadproofError
from roadproof.recordings import Side
from roadproof.search_space import SearchSpace
from scenes import LinearController, recording_set

SHIFT = torch.tensor([0.3, 0.1, -0.2, -0.6])


def test_right_counts_right_as_positive_and_left_left():
    assert float(divergence(SHIFT, [2, 2], Direction.RIGHT)) == pytest.approx(-0.1)
    assert float(divergence(SHIFT, [2, 2], Direction.LEFT)) == pytest.approx(0.1)


def test_pooled_drives_may_give_way_to_different_sides():
    assert float(divergence(SHIFT, [2, 2], Direction.EITHER)) == pytest.approx((0.4 + 0.8) / 4)
    assert float(divergence(SHIFT, [4], Direction.EITHER)) == pytest.approx(0.1)


@given(st.integers(0, 1000))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_mirrored_steering_swaps_the_sides(seed):
    shift = torch.randn(3, 8, generator=torch.Generator().manual_seed(seed))
    torch.testing.assert_close(divergence(shift, [8], Direction.RIGHT), divergence(-shift, [8], Direction.LEFT))
    pooled = divergence(shift, [3, 5], Direction.EITHER)
    assert (pooled >= divergence(shift, [8], Direction.EITHER) - 1e-6).all()
    torch.testing.assert_close(pooled, divergence(-shift, [3, 5], Direction.EITHER))


def test_the_paper_s_groups_share_the_clean_drive():
    recordings = recording_set()
    assert [drive.side for drive in RIGHT_GROUP.select(recordings)] == [Side.CLEAN, Side.RIGHT]
    assert [drive.side for drive in LEFT_GROUP.select(recordings)] == [Side.CLEAN, Side.LEFT]


def test_groups_are_read_from_words():
    recordings = recording_set()
    assert parse_groups("clean+right,clean+left", recordings) == (RIGHT_GROUP, LEFT_GROUP)
    (pooled,) = parse_groups("all", recordings)
    assert pooled.direction is Direction.EITHER
    assert len(pooled.select(recordings)) == 3


@pytest.mark.parametrize("words", ["clean+up", "clean", "left+right", "clean+random", ""])
def test_groups_that_make_no_sense_are_refused(words):
    with pytest.raises(RecordingError, match="group"):
        parse_groups(words, recording_set())


def test_groups_of_one_name_are_told_apart_or_refused(tmp_path):
    controller = LinearController(torch.full((3, 88, 200), 1e-4))
    recordings, space = recording_set(frames=2), SearchSpace(figures=1)
    asked = {"objective": SteeringShift(), "method": RandomSearch(calls=2)}
    right, left = (Group((Side.CLEAN,), direction) for direction in (Direction.RIGHT, Direction.LEFT))
    for kept, other in ((right, left), (Group((Side.CLEAN,), Direction.EITHER), *parse_groups("all", recordings))):
        folder = tmp_path / str(kept)
        kept_attack(folder, recordings, controller, space, groups=[kept], **asked)
        with pytest.raises(RoadproofError, match=r"holds a search with groups \['?"):
            kept_attack(folder, recordings, controller, space, groups=[other], **asked)
    named = attack(recordings, controller, space, groups=(RIGHT_GROUP, LEFT_GROUP), **asked)
    assert named.made_of["groups"] == ["clean+right", "clean+left"]
    with pytest.raises(RecordingError, match="groups are clean, clean, expected each name once"):
        attack(recordings, controller, space, groups=(right, left), **asked)


def test_a_group_without_its_drive_is_named():
    import dataclasses

    only_clean = dataclasses.replace(recording_set(), recordings=recording_set().recordings[:1])
    with pytest.raises(RecordingError, match="needs a right drive, the set has clean"):
        RIGHT_GROUP.select(only_clean)


def test_a_method_takes_the_two_sides_where_drives_were_pushed_to_both_and_else_all_drives():
    import dataclasses

    whole = recording_set()
    only_clean = dataclasses.replace(whole, recordings=whole.recordings[:1])
    assert GradOpt().groups(whole) == (RIGHT_GROUP, LEFT_GROUP)
    assert GradOpt().groups(only_clean) == parse_groups("all", only_clean)
