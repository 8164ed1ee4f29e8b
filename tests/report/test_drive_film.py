import dataclasses

import numpy as np
import pytest

from roadproof.datatypes import Command, Control, Event, EventKind, Observation, VehicleState
from roadproof.errors import OutputError
from roadproof.scenarios import builtin_scenarios

pytest.importorskip("av", reason="films need the extra roadproof[video]")
import av

from roadproof.io.video import film_file
from roadproof.report.drive_film import ABOVE_PX, SIZE, DriveView
from roadproof.roads.maps import load_map, scenario_route

SCENARIO = builtin_scenarios()[0]


@pytest.fixture(scope="module")
def parts():
    roads = load_map(SCENARIO.map_name)
    return {"roads": roads, "way": scenario_route(SCENARIO, roads).points[:, :2], "canvas": SCENARIO.canvas}


def observation(time_s=0.0, x_m=None, picture=True, events=()):
    start = SCENARIO.start
    state = VehicleState(start.x_m if x_m is None else x_m, start.y_m, 0.0, start.yaw_rad, 5.0)
    return Observation(
        frame=np.full((88, 200, 3), 90, np.uint8),
        state=state,
        command=Command.FOLLOW,
        time_s=time_s,
        events=events,
        picture=np.full((600, 800, 3), (10, 20, 200), np.uint8) if picture else None,
    )


def test_a_film_has_as_many_frames_as_observations_and_their_speed(tmp_path, parts):
    path = tmp_path / "drive.mp4"
    view = DriveView(**parts)
    with film_file(path, SIZE, 0.05) as add:
        for i in range(12):
            add(view.compose(observation(0.05 * i, SCENARIO.start.x_m + 0.3 * i), Control(0.1, throttle=0.4)))
        assert not path.exists()
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert float(stream.average_rate) == pytest.approx(20.0)
    assert len(frames) == 12
    assert frames[0].shape == (720, 1280, 3)
    assert np.abs(frames[5][100:500, 100:700].astype(int) - (10, 20, 200)).mean() < 6
    assert [p.name for p in tmp_path.iterdir()] == ["drive.mp4"]


def test_a_film_that_would_take_the_place_of_a_folder_is_one_line(tmp_path):
    (tmp_path / "drive.mp4").mkdir()
    with (
        pytest.raises(OutputError, match=r"cannot write .*drive\.mp4"),
        film_file(tmp_path / "drive.mp4", SIZE, 0.05) as add,
    ):
        add(np.zeros((SIZE[1], SIZE[0], 3), np.uint8))
    assert [p.name for p in tmp_path.iterdir()] == ["drive.mp4"]


def test_the_frame_is_shown_where_there_is_no_picture(parts):
    film = DriveView(**parts)
    page = film.compose(observation(picture=False), Control(0.0))
    assert np.abs(page[100:500, 100:700].astype(int) - 90).max() <= 1


def test_the_bars_follow_the_controls(parts):
    film = DriveView(**parts)

    def blue(steer):
        page = film.compose(observation(), Control(steer)).astype(int)
        strip = page[616 + 10, 90:390]
        columns = np.flatnonzero(np.abs(strip - (40, 110, 190)).max(axis=-1) < 5)
        return columns.min() if len(columns) > 1 else 150, columns.max() if len(columns) > 1 else 150

    assert blue(0.5)[0] >= 149
    assert blue(0.5)[1] == pytest.approx(225, abs=2)
    assert blue(-1.0)[0] <= 1


def test_the_map_shows_the_pattern_where_the_canvas_lies(parts):
    pattern = np.zeros((400, 400, 4), np.uint8)
    pattern[:200] = (255, 0, 255, 255)  # the far half
    canvas = SCENARIO.canvas
    film = DriveView(**parts, pattern=pattern)
    page = film.compose(dataclasses.replace(observation(), state=VehicleState(
        canvas.x_m, canvas.y_m - 20.0, 0.0, 0.0, 0.0)), Control(0.0)).astype(int)  # fmt: skip
    magenta = np.argwhere(np.abs(page[:ABOVE_PX, 800:] - (255, 0, 255)).max(axis=-1) < 40)
    # North is up, 6 px a metre: the canvas' middle is 120 px above the car, its far half a quarter of its length on.
    row, column = magenta.mean(axis=0)
    ahead = 6 * canvas.length_m / 4
    assert row == pytest.approx(240 - 120 - ahead * np.sin(canvas.yaw_rad), abs=3)
    assert column == pytest.approx(240 + ahead * np.cos(canvas.yaw_rad), abs=3)
    assert len(magenta) == pytest.approx(36 * canvas.width_m * canvas.length_m / 2, rel=0.12)


def test_events_are_written_out(parts):
    plain, eventful = (DriveView(**parts) for _ in range(2))
    event = Event(EventKind.SIDEWALK, 0.0, "a wheel on the sidewalk")
    difference = eventful.compose(observation(events=(event,)), Control(0.0)) != plain.compose(
        observation(), Control(0.0)
    )
    rows, columns = np.nonzero(difference.any(axis=-1))
    assert rows.min() > ABOVE_PX
    assert columns.min() > 800


def test_an_error_leaves_no_film(tmp_path, parts):
    with pytest.raises(ZeroDivisionError), film_file(tmp_path / "x.mp4", SIZE, 0.05) as add:
        add(DriveView(**parts).compose(observation(), Control(0.0)))
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_name_is_refused(tmp_path):
    refused = pytest.raises(OutputError, match=r"expected a name that ends in \.mp4")
    with refused, film_file(tmp_path / "x.avi", SIZE, 0.05):
        pass


def test_a_film_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    refused = pytest.raises(OutputError, match=r"cannot write .*; choose a folder that can be written")
    with refused, film_file(tmp_path / "file" / "x.mp4", SIZE, 0.05):
        pass
