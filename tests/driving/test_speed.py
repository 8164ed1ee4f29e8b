"""How much slower or faster a drive was than another, against what is known of both."""

from dataclasses import replace

import numpy as np
import pytest

from roadproof.datatypes import Ending, VehicleState
from roadproof.driving.deviation import passage, path_of
from roadproof.driving.speed import speed_difference, speed_in_words, speeds_in_words
from roadproof.scenarios import find_scenario
from roadproof.simulators.protocol import PaintKind
from runs import driven

SCENARIO = find_scenario("left-03")
CLEAN = driven(SCENARIO)
SEEN = passage(path_of(CLEAN), SCENARIO.canvas)


def cut(episode, rows, **changes):
    """A part of a drive."""
    seen = {name: getattr(episode, name)[rows] for name in (*VehicleState.__slots__, "time_s", "command")}
    last = None if rows.stop is None else rows.stop - 1
    given = {name: getattr(episode, name)[rows.start : last] for name in ("steer", "throttle", "brake")}
    return replace(episode, **seen, **given, **changes)


def with_speed(change_mps):
    return replace(CLEAN, speed_mps=CLEAN.speed_mps + change_mps)


def test_a_drive_that_is_slower_by_so_much_differs_by_so_much():
    found = speed_difference(CLEAN, with_speed(-1.5), SCENARIO.canvas)
    assert (found.mean_mps, found.most_mps) == pytest.approx((-1.5, -1.5))
    assert speed_difference(CLEAN, CLEAN, SCENARIO.canvas).mean_mps == 0.0


def test_only_the_passage_counts():
    change = np.full(len(CLEAN), -3.0)
    change[SEEN] = np.linspace(0.0, 2.0, SEEN.stop - SEEN.start)
    found = speed_difference(CLEAN, with_speed(change), SCENARIO.canvas)
    assert (found.mean_mps, found.most_mps) == pytest.approx((1.0, 2.0))


def test_a_car_that_stands_goes_on_standing_and_one_that_ended_counts_while_it_drove():
    middle = (SEEN.start + SEEN.stop) // 2
    speed = CLEAN.speed_mps.copy()
    speed[middle - 1 :] = 0.0
    stood = cut(replace(CLEAN, speed_mps=speed), slice(0, middle), ending=Ending.STANDS)
    share = (SEEN.stop - middle + 1) / (SEEN.stop - SEEN.start)
    assert speed_difference(CLEAN, stood, SCENARIO.canvas).mean_mps == pytest.approx(-7.0 * share)
    ended = cut(with_speed(-0.5), slice(0, middle))
    assert speed_difference(CLEAN, ended, SCENARIO.canvas).mean_mps == pytest.approx(-0.5)


def test_predicted_drives_count_as_equal_before_they_begin():
    late = slice(passage(path_of(CLEAN), SCENARIO.canvas, horizon_m=15.0).start, None)
    clean, painted = (cut(each, late, paint=PaintKind.COMPOSITED) for each in (CLEAN, with_speed(-1.0)))
    share = (SEEN.stop - late.start) / (SEEN.stop - SEEN.start)
    painted.speed_mps[0] = clean.speed_mps[0]
    assert speed_difference(clean, painted, SCENARIO.canvas).mean_mps == pytest.approx(-share, abs=0.05)


def test_words_say_the_unit_and_the_side():
    assert (speed_in_words(-0.851), speed_in_words(0.2)) == ("0.85 m/s slower", "0.20 m/s faster")
    assert speeds_in_words(-0.78, -0.74) == "0.74 to 0.78 m/s slower"
    assert speeds_in_words(-0.3, 0.1) == "0.10 m/s faster to 0.30 m/s slower"
