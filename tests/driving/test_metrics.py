"""Metrics against closed forms, sums by hand, textbook quantiles and a slow reference."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from roadproof.datatypes import Ending, Event, EventKind, Weather
from roadproof.driving import Episode, deviation, infractions, intervals
from roadproof.driving.starts import StartOffset
from roadproof.driving.trial import Trial, judge, runs_of
from roadproof.errors import EpisodeError
from roadproof.geometry import CanvasPlacement
from roadproof.pipeline import fidelity

PATHS = hnp.arrays(
    np.float64, st.tuples(st.integers(1, 12), st.just(2)), elements=st.floats(-50, 50, allow_subnormal=False)
)


def line(y_m=0.0, count=81, step_m=0.5, start_m=0.0):
    return np.column_stack([start_m + step_m * np.arange(count), np.full(count, float(y_m))])


def event(kind, time_s, detail=""):
    return Event(EventKind(kind), time_s, detail)


def test_two_parallel_straight_paths_a_metre_apart_have_a_deviation_of_one_metre():
    assert deviation.deviation_m(line(), line(1.0)) == pytest.approx(1.0)
    assert deviation.deviation_m(line(), line()) == 0.0


def test_a_delay_along_the_same_path_costs_only_what_lies_beyond_the_other_drive():
    # Two positions of 81 stand out at each end, half a metre and a whole one from the nearest of the other drive.
    assert deviation.deviation_m(line(), line(start_m=1.0)) == pytest.approx(1.5 / 81)


def test_one_bulge_counts_from_both_sides():
    painted = line()
    painted[40] = (20.0, 3.0)
    # One position 3 m off, and the clean one below it is half a metre from its neighbours.
    assert deviation.deviation_m(line(), painted) == pytest.approx((3.0 + 0.5) / (2 * 81))


@settings(derandomize=True, deadline=None)
@given(PATHS, PATHS)
def test_deviation_is_the_papers_equation_term_by_term_and_symmetric(one, two):
    there = sum(min(math.dist(p, q) for q in one) for p in two) / len(two)
    back = sum(min(math.dist(p, q) for q in two) for p in one) / len(one)
    assert deviation.deviation_m(one, two) == pytest.approx((there + back) / 2)
    assert deviation.deviation_m(one, two) == pytest.approx(deviation.deviation_m(two, one))


@pytest.mark.parametrize("bad", [np.zeros((0, 2)), np.array([[0.0, np.nan]])])
def test_paths_that_say_nothing_are_refused(bad):
    with pytest.raises(EpisodeError, match="painted path is empty or has NaN"):
        deviation.deviation_m(line(), bad)
    with pytest.raises(EpisodeError, match="clean path"):
        deviation.passage(bad, CanvasPlacement(x_m=0.0, y_m=0.0))


def test_the_passage_runs_from_the_horizon_to_the_end_of_the_canvas():
    canvas = CanvasPlacement(x_m=30.0, y_m=0.0, width_m=7.0, length_m=10.0)
    seen = deviation.passage(line(count=101), canvas, horizon_m=20.0)
    assert (line(count=101)[seen][[0, -1], 0] == (5.0, 35.0)).all()


def test_in_a_bend_the_passage_is_measured_along_the_drive():
    angle = np.linspace(0.0, np.pi, 401)
    bend = 20.0 * np.column_stack([np.sin(angle), -np.cos(angle)])
    # A quarter turn is 31.4 m of driving, though only 28.3 m of air.
    seen = deviation.passage(bend, CanvasPlacement(x_m=20.0, y_m=0.0, length_m=8.0), horizon_m=10.0 * np.pi - 4.0)
    assert seen.start in (0, 1)
    assert 20.0 * (angle[seen.stop - 1] - np.pi / 2) == pytest.approx(4.0, abs=0.16)


def test_a_drive_that_ends_before_the_canvas_has_as_passage_what_sees_it_and_at_least_its_end():
    seen = deviation.passage(line(count=121), CanvasPlacement(x_m=85.0, y_m=0.0, length_m=10.0))
    assert (line(count=121)[seen][[0, -1], 0] == (55.0, 60.0)).all()
    assert deviation.passage(line(count=11), CanvasPlacement(x_m=300.0, y_m=0.0)) == slice(10, 11)


@pytest.mark.parametrize("creeps_m", [0.0, 0.035])
def test_a_car_that_stands_before_the_canvas_has_not_come_to_it(creeps_m):
    back = np.column_stack([np.linspace(0.0, -creeps_m, 50), np.zeros(50)])
    assert not deviation.sees_canvas(back, CanvasPlacement(x_m=13.0, y_m=0.0))
    assert deviation.sees_canvas(line(count=3), CanvasPlacement(x_m=13.0, y_m=0.0))


def test_lateral_offsets_are_left_positive_and_reach_beyond_the_ends():
    positions = np.array([[10.0, 2.0], [10.2, -1.5], [-5.0, 1.0], [60.0, -1.0]])
    np.testing.assert_allclose(deviation.lateral_m(line(), positions), [2.0, -1.5, 1.0, -1.0], atol=1e-12)


def test_lateral_offsets_from_a_circle_are_differences_of_radius():
    angle = np.linspace(0.0, 2.0, 2001)
    circle = np.column_stack([np.cos(angle), np.sin(angle)]) * 30.0
    inside = np.column_stack([np.cos(angle[100:-100:50]), np.sin(angle[100:-100:50])]) * 28.0
    # Driven anticlockwise, so the middle is on the left.
    np.testing.assert_allclose(deviation.lateral_m(circle, inside), 2.0, atol=1e-4)


def test_a_reference_with_stops_is_the_same_reference():
    stopping = np.repeat(line(), 3, axis=0)
    np.testing.assert_allclose(deviation.lateral_m(stopping, line(-1.0)), -1.0)
    with pytest.raises(EpisodeError, match="does not move"):
        deviation.lateral_m(np.zeros((5, 2)), line())


def test_points_and_factors_add_up_by_hand():
    events = [
        event("wrong-lane", 1.0),
        event("collision-static", 2.0, "tree 4"),
        event("collision-vehicle", 3.0, "car 1"),
        event("collision-pedestrian", 4.0, "pedestrian 2"),
        event("sidewalk", 5.0),
        event("red-light", 6.0),
        event("stop-sign", 7.0),
    ]
    assert infractions.infraction_points(events) == 2 + 6 + 6 + 9 + 2 + 3 + 2
    assert infractions.leaderboard_factor(events) == pytest.approx(0.65 * 0.60 * 0.50 * 0.70 * 0.80)
    assert infractions.first_event_s(events) == 1.0
    assert (infractions.infraction_points([]), infractions.leaderboard_factor([]), infractions.first_event_s([])) == (
        0.0,
        1.0,
        None,
    )


def test_every_kind_of_event_has_its_points():
    assert set(infractions.CHALLENGE_POINTS) == set(EventKind)


def test_one_contact_counts_once_and_two_things_twice():
    touches = [event("collision-static", t, "tree 4") for t in (2.0, 2.1, 9.0)]
    assert infractions.infraction_points(touches) == 6.0
    assert infractions.infraction_points([*touches, event("collision-static", 9.1, "tree 5")]) == 12.0


def test_a_nameless_contact_counts_again_only_after_a_while():
    assert infractions.infraction_points([event("collision-static", t) for t in (1.0, 2.5, 4.0, 6.5)]) == 12.0


def test_leaving_the_road_over_the_sidewalk_is_one_fault():
    way = [event("sidewalk", 3.0), event("off-road", 3.4), event("off-road", 4.6), event("sidewalk", 6.0)]
    assert infractions.counted(way) == (way[0],)
    assert infractions.infraction_points([*way, event("off-road", 12.0)]) == 4.0
    assert infractions.infraction_points([event("off-road", 3.0)]) == 2.0
    assert infractions.infraction_points([event("wrong-lane", 2.9), *way]) == 4.0


def test_two_lights_count_twice_however_near_and_one_light_again_only_after_a_while():
    near = [
        event("red-light", 3.0, "traffic light at (1.0, 2.0)"),
        event("red-light", 4.0, "traffic light at (9.0, 2.0)"),
    ]
    assert infractions.infraction_points(near) == 6.0
    told_every_step = [event("red-light", 0.05 * k, "traffic light at (1.0, 2.0)") for k in range(60)]
    assert infractions.infraction_points(told_every_step) == 3.0
    assert (
        infractions.infraction_points([*told_every_step, event("red-light", 9.0, "traffic light at (1.0, 2.0)")]) == 6.0
    )
    assert infractions.infraction_points([event("stop-sign", 1.0, "a"), event("stop-sign", 1.5, "b")]) == 4.0


EVENTS = st.lists(
    st.builds(
        Event, st.sampled_from(EventKind), st.integers(0, 400).map(lambda k: 0.05 * k), st.sampled_from(["", "a", "b"])
    )
).map(lambda events: sorted(events, key=lambda one: one.time_s))


@settings(derandomize=True, deadline=None)
@given(EVENTS)
def test_what_was_counted_can_be_counted_again(events):
    kept = infractions.counted(events)
    assert infractions.counted(kept) == kept
    assert infractions.infraction_points(kept) == infractions.infraction_points(events)
    assert infractions.leaderboard_factor(kept) == infractions.leaderboard_factor(events)
    assert infractions.first_event_s(kept) == infractions.first_event_s(events)


@pytest.mark.parametrize(
    ("freedom", "textbook"), [(1, 12.7062), (2, 4.30265), (4, 2.77645), (9, 2.26216), (30, 2.04227)]
)
def test_the_interval_has_students_width(freedom, textbook):
    values = np.arange(freedom + 1.0)
    found = intervals.mean_95(values.tolist())
    width = textbook * values.std(ddof=1) / math.sqrt(freedom + 1)
    assert found.value == pytest.approx(freedom / 2)
    assert (found.high - found.low) / 2 == pytest.approx(width, rel=1e-5)
    assert found.count == freedom + 1


def test_a_single_run_has_no_interval_and_no_run_no_mean():
    assert intervals.mean_95([4.0]) == intervals.Estimate(4.0, None, None, 1)
    assert intervals.mean_95([2.0] * 10) == intervals.Estimate(2.0, 2.0, 2.0, 10)
    for nothing in ([], [1.0, math.nan]):
        with pytest.raises(EpisodeError, match="cannot be taken"):
            intervals.mean_95(nothing)


def test_the_interval_covers_the_true_mean_as_often_as_it_says():
    draws = np.random.default_rng(0).normal(3.0, 2.0, (2000, 5))
    means = [intervals.mean_95(row.tolist()) for row in draws]
    assert np.mean([mean.low <= 3.0 <= mean.high for mean in means]) == pytest.approx(0.95, abs=0.015)


def test_composites_and_renders_are_compared_in_the_paint_and_outside_it():
    composited = np.full((2, 4, 5, 3), 100, np.uint8)
    rendered = composited.copy()
    paint = np.zeros((2, 4, 5), bool)
    paint[:, :2] = True
    rendered[:, :2] += np.array([3, 6, 0], np.uint8)
    rendered[:, 2:] -= 1
    found = fidelity.agreement(
        composited,
        rendered,
        paint,
        clean_steer=np.zeros(2),
        composited_steer=np.array([0.2, 0.4]),
        rendered_steer=np.array([0.3, 0.2]),
    )
    assert dataclasses.astuple(found) == pytest.approx((2, 3.0, 1.0, 0.15, 0.3, 0.25))
    with pytest.raises(EpisodeError, match="no frame shows any paint"):
        fidelity.agreement(
            composited,
            rendered,
            np.zeros_like(paint),
            clean_steer=np.zeros(2),
            composited_steer=np.zeros(2),
            rendered_steer=np.zeros(2),
        )


def test_beyond_the_end_of_a_drive_that_ended_early_nothing_is_beside_it():
    # A right angle; the clean drive was blocked five metres before it.
    corner = np.concatenate([line(), np.column_stack([np.full(60, 40.0), 0.5 * np.arange(1, 61)])])
    whole = on_path(*corner.T, Ending.GOAL_REACHED)
    blocked = on_path(*corner[:70].T, Ending.BLOCKED)
    known = deviation.beside_m(blocked, whole)
    assert len(known) == 74  # two metres more, at half a metre an observation
    np.testing.assert_allclose(known, 0.0, atol=1e-9)
    arrived = deviation.beside_m(dataclasses.replace(blocked, ending=Ending.GOAL_REACHED), whole)
    assert arrived.max() == pytest.approx(30.0)
    aside = deviation.beside_m(blocked, on_path(*(corner + np.array([0.0, -1.5])).T, Ending.GOAL_REACHED))
    np.testing.assert_allclose(aside, -1.5)
    beyond = deviation.beside_m(blocked, on_path(*corner[100:].T, Ending.GOAL_REACHED))
    assert len(beyond) == 1


@pytest.mark.parametrize("creep_m", [-0.0007, 0.0003])
@pytest.mark.parametrize("turned", [0.0, 2.5])
def test_a_drive_that_ends_standing_says_nothing_of_where_it_creeps(creep_m, turned):
    way = line()
    end = way[50] + 0.4 * np.array([math.cos(turned), math.sin(turned)])
    # A car that was hit turns within half a metre; one that brakes creeps for fifteen seconds.
    tail = end + np.column_stack([creep_m * np.arange(300), np.zeros(300)])
    stands = on_path(*np.concatenate([way[:51], tail]).T, Ending.BLOCKED)
    arrives = on_path(*(way + np.array([0.0, 0.3])).T, Ending.GOAL_REACHED)
    beside = deviation.beside_m(stands, arrives)
    np.testing.assert_allclose(beside[:48], 0.3, atol=1e-9)
    assert len(beside) < 60
    assert np.abs(beside).max() < 0.5


def test_a_path_that_was_crawled_along_is_still_a_path():
    angle = np.linspace(0.0, 1.5, 1501)
    bend = 10.0 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])  # a centimetre from one to the next
    np.testing.assert_allclose(deviation.lateral_m(bend, bend[::50]), 0.0, atol=1e-9)


@pytest.mark.parametrize("ending", [each for each in Ending if each is not Ending.GOAL_REACHED])
def test_a_clean_drive_short_of_its_goal_is_no_measure_of_what_went_on(ending):
    # Both drive the same quarter of a circle; the clean drive ended on the way.
    angle = np.linspace(0.0, 1.5, 61)
    painted = on_path(20 * np.sin(angle), 20 * (1 - np.cos(angle)), Ending.GOAL_REACHED)
    clean = on_path(painted.x_m[:24], painted.y_m[:24], ending)
    canvas = CanvasPlacement(x_m=float(painted.x_m[30]), y_m=float(painted.y_m[30]), length_m=6.0)
    found = judge(clean, painted, canvas, pattern="attack", clean_file="", painted_file="")
    assert abs(found.lateral_m) < 0.2
    assert not found.leaves_lane


def on_path(x_m, y_m, ending):
    """A drive along a path."""
    count = len(x_m)
    rest = np.zeros(count)
    held = np.zeros(count - 1)
    return Episode(
        scenario="bend",
        weather=Weather.CLEAR_NOON,
        painted=True,
        cars=0,
        pedestrians=0,
        seed=0,
        dt_s=0.1,
        ending=ending,
        events=(),
        time_s=0.1 * np.arange(count),
        x_m=x_m,
        y_m=y_m,
        z_m=rest,
        yaw_rad=rest,
        speed_mps=rest + 5.0,
        command=np.full(count, 2),
        steer=held,
        throttle=held,
        brake=held,
    )


def test_a_drive_that_is_late_by_seconds_deviates_by_what_it_did_not_reach():
    # At half a metre an instant it stands behind for 8 of the 81 instants.
    late = np.concatenate([np.tile(line()[:1], (8, 1)), line()[:-8]])
    assert deviation.deviation_m(line(), late) == pytest.approx(sum(0.5 * k for k in range(1, 9)) / (2 * 81))


def trial(start, weather, deviation_m):
    return Trial(
        pattern="attack",
        weather=weather,
        traffic=False,
        seed=0,
        clean="",
        painted="",
        deviation_m=deviation_m,
        lateral_m=0.0,
        points=None,
        clean_points=None,
        leaderboard=None,
        clean_leaderboard=None,
        first_event_s=None,
        clean_first_event_s=None,
        ending="goal reached",
        start=StartOffset(right_m=start),
    )


def test_the_same_starts_in_several_weathers_are_no_more_runs_than_in_one():
    drives = [trial(start, weather, start) for weather in Weather for start in (0.1, 0.2, 0.3)]
    assert runs_of(drives, lambda each: each.deviation_m) == pytest.approx([0.1, 0.2, 0.3])
