"""The film of two drives."""

import dataclasses

import numpy as np
import pytest

import needs
from paint_shy import along_a_street, magenta

needs.town()
av = pytest.importorskip("av", reason="films need the extra roadproof[video]")
from roadproof.datatypes import Control, Weather
from roadproof.driving.drive_store import load_episodes
from roadproof.driving.evaluate import evaluate
from roadproof.pipeline.film import EVENT_SHOWN_S, film_drives, last_event

PATTERN = magenta(380.0)


def stops_for_good(_):
    """Drives over the canvas, and then stands until its time is up."""
    return lambda seen: Control(steer=0.0, throttle=0.6) if seen.time_s < 1.0 else Control(steer=0.0, brake=1.0)


def test_a_car_that_stands_until_its_time_is_up_is_filmed_for_a_moment_only(town, tmp_path):
    street = along_a_street(tmp_path, 7.0)
    scenario = dataclasses.replace(street, start=dataclasses.replace(street.start, x_m=24.0))
    done = evaluate(
        town, stops_for_good, scenario, PATTERN, folder=tmp_path, weathers=(Weather.CLEAR_NOON,), starts=0, runs=0
    )
    files = done.shown().clean, done.shown().painted
    _, drive = load_episodes(tmp_path, files)
    assert film_drives(town, scenario, files, np.zeros((400, 400, 4), np.uint8), tmp_path)
    with av.open(str(tmp_path / "film.mp4")) as film:
        pictures = sum(1 for _ in film.decode(video=0))
        assert film.streams.video[0].average_rate == 10
    frames = 2 * pictures  # of steps of 0.05 s, one picture in 0.1 s
    stood_at = int(np.flatnonzero(drive.speed_mps > 0.1)[-1])
    assert stood_at + EVENT_SHOWN_S / drive.dt_s <= frames <= stood_at + EVENT_SHOWN_S / drive.dt_s + 3
    assert frames < len(drive) - 20
    assert last_event(drive, frames - 2, frames) == ("", False)
    assert last_event(drive, frames - 1, frames) == ("stands: time limit after 7 s", False)
    assert last_event(drive, len(drive) - 1, len(drive)) == ("time limit", False)
