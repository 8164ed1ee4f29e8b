"""Poses and the canvas' size from homographies: the inverse of `homography_from_pose`, and what real drives say."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from roadproof.datatypes import Obstacle, VehicleState
from roadproof.errors import RecordingError
from roadproof.geometry import CIL_CAMERA, CameraModel, CanvasPlacement, CropResize, homography_from_pose
from roadproof.homographies import apply_homography
from roadproof.recorded.poses import placed
from roadproof.recordings import Recording, RecordingSet, Side
from scenes import PLAIN

DT_S = 0.1
TINY = CropResize(left_px=0, top_px=0, right_px=8, bottom_px=8, width_px=2, height_px=2)


def drive(name, image_from_canvas, *, speed_mps=6.0, first=10):
    count = len(image_from_canvas)
    return Recording(
        name=name,
        side=Side(name),
        frames=np.zeros((count, 2, 2, 3), np.uint8),
        frame_number=np.arange(first, first + count),
        image_from_canvas=image_from_canvas,
        speed_mps=np.broadcast_to(np.asarray(speed_mps, float), (count,)).copy(),
        command=np.full(count, 2),
        steer=np.linspace(-0.2, 0.1, count),
    )


def recording_set(*drives, camera=CIL_CAMERA):
    return RecordingSet(camera=camera, view=TINY, colour=PLAIN, recordings=drives)


def random_path(rng, canvas, count=12):
    """States towards a canvas, wherever it lies, at 3 to 9 m/s on a bend."""
    speed, bend = rng.uniform(3, 9), rng.uniform(-0.08, 0.08)
    yaw = canvas.yaw_rad + rng.uniform(-0.4, 0.4) + bend * speed * DT_S * np.arange(count)
    steps = speed * DT_S * np.stack([np.cos(yaw), np.sin(yaw)], 1)
    start = np.array([canvas.x_m, canvas.y_m]) - rng.uniform(8, 14) * np.array(
        [np.cos(canvas.yaw_rad), np.sin(canvas.yaw_rad)]
    )
    xy = start + rng.uniform(-2, 2, 2) + np.concatenate([np.zeros((1, 2)), steps[:-1].cumsum(0)])
    return [
        VehicleState(x, y, canvas.z_m, angle, speed) for (x, y), angle in zip(xy.tolist(), yaw.tolist(), strict=True)
    ]


def homographies(states, canvas, camera=CIL_CAMERA):
    return np.stack([homography_from_pose(camera, state, canvas) for state in states])


def approach(camera=CIL_CAMERA):
    """A straight drive at 6 m/s that meets the canvas at 0.5 rad."""
    states = [VehicleState(-14 + 0.6 * i * np.cos(0.5), -5 + 0.6 * i * np.sin(0.5), 0.0, 0.5, 6.0) for i in range(16)]
    return homographies(states, CanvasPlacement(x_m=0.0, y_m=0.0), camera)


@pytest.mark.parametrize("seed", range(8))
def test_poses_and_canvas_come_back_from_their_homographies(seed):
    rng = np.random.default_rng(seed)
    camera = CameraModel(
        width_px=int(rng.integers(200, 1000)),
        height_px=int(rng.integers(200, 800)),
        fov_deg=rng.uniform(40, 110),
        forward_m=rng.uniform(-1, 2),
        left_m=rng.uniform(-1, 1),
        up_m=rng.uniform(1, 3),
        pitch_deg=rng.uniform(-30, 5),
    )
    canvas = CanvasPlacement(
        x_m=rng.uniform(-200, 200),
        y_m=rng.uniform(-200, 200),
        z_m=rng.uniform(-5, 5),
        yaw_rad=rng.uniform(-np.pi, np.pi),
        width_m=rng.uniform(2, 9),
        length_m=rng.uniform(2, 12),
    )
    paths = [random_path(rng, canvas), random_path(rng, canvas, count=7)]
    drives = [
        drive(name, homographies(path, canvas, camera) * rng.uniform(0.001, 100, (len(path), 1, 1)),
              speed_mps=path[0].speed_mps)
        for name, path in zip(("clean", "right"), paths, strict=True)
    ]  # fmt: skip
    made = placed(recording_set(*drives, camera=camera), dt_s=DT_S)
    found = made.canvas
    assert (found.x_m, found.y_m, found.z_m, found.yaw_rad) == (0, 0, 0, 0)
    assert found.width_m == pytest.approx(canvas.width_m, rel=1e-9)
    assert found.length_m == pytest.approx(canvas.length_m, rel=1e-9)
    c, s = np.cos(canvas.yaw_rad), np.sin(canvas.yaw_rad)
    for recording, path in zip(made.recordings, paths, strict=True):
        track = recording.track
        offset = np.array([[state.x_m - canvas.x_m, state.y_m - canvas.y_m] for state in path])
        wanted = offset @ np.array([[c, -s], [s, c]])
        np.testing.assert_allclose(np.stack([track.x_m, track.y_m], 1), wanted, atol=1e-6)
        turned = track.yaw_rad - np.array([state.yaw_rad - canvas.yaw_rad for state in path])
        np.testing.assert_allclose(np.remainder(turned + 1, 2 * np.pi) - 1, 0, atol=1e-8)


def test_what_is_placed_makes_the_same_homographies_again():
    made = placed(recording_set(drive("clean", approach())), dt_s=DT_S)
    (one,) = made.recordings
    corners = np.array([[0.0, 0.0], [399, 0], [399, 200], [0, 200]])
    for row, measured in enumerate(one.image_from_canvas):
        again = homography_from_pose(CIL_CAMERA, one.track.state(row), made.canvas)
        np.testing.assert_allclose(apply_homography(again, corners), apply_homography(measured, corners), atol=1e-6)


def test_tracks_are_numbered_as_the_frames_and_hold_what_is_known():
    bare = drive("clean", approach(), speed_mps=np.linspace(5.5, 6.5, 16))
    controls = np.column_stack([np.linspace(-1, 1, 16), np.linspace(0, 1, 16), np.linspace(0.5, 0, 16)])
    made = placed(recording_set(bare, drive("left", approach(), first=3)), dt_s=DT_S, controls={"clean": controls})
    told, untold = (recording.track for recording in made.recordings)
    assert told.dt_s == DT_S
    assert told.step.tolist() == bare.frame_number.tolist()
    assert untold.step.tolist() == list(range(3, 19))
    np.testing.assert_array_equal(told.speed_mps, bare.speed_mps)
    np.testing.assert_array_equal(np.column_stack([told.steer, told.throttle, told.brake]), controls)
    np.testing.assert_array_equal(untold.steer, bare.steer)
    assert not untold.throttle.any()
    assert not untold.brake.any()
    np.testing.assert_array_equal(made.recordings[0].image_from_canvas, bare.image_from_canvas)


def tilted(image_from_canvas, degrees):
    """Views of a car that leans to the left."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    intrinsics = CIL_CAMERA.intrinsics
    return intrinsics @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ np.linalg.inv(intrinsics) @ image_from_canvas


def test_a_car_that_leans_in_its_bend_is_placed_all_the_same():
    views = approach()
    views[8:] = tilted(views[8:], 4.0)
    made = placed(recording_set(drive("clean", views)), dt_s=DT_S)
    upright = placed(recording_set(drive("clean", approach())), dt_s=DT_S)
    assert made.canvas.width_m == pytest.approx(7.6, rel=1e-6)
    ours, theirs = made.recordings[0].track, upright.recordings[0].track
    # The camera stays where it was. Its mount of 1.4 m leans, about a lens that looks down, so yaw turns a little.
    assert np.hypot(ours.x_m - theirs.x_m, ours.y_m - theirs.y_m).max() < 0.2
    assert np.abs(ours.yaw_rad - theirs.yaw_rad).max() < np.radians(1.5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fov_deg": 85.0}, "of another camera: .* check its field of view"),
        ({"pitch_deg": -8.0}, r"of another camera: .* tilts by 7\.\d°"),
        ({"up_m": 2.8}, r"poses move 2\.00 times as fast .* the camera's height"),
        ({"up_m": 0.0}, r"0\.0 m above the road"),
    ],
)
def test_another_camera_is_refused_in_one_line(change, message):
    views = recording_set(drive("clean", approach()), camera=replace(CIL_CAMERA, **change))
    with pytest.raises(RecordingError, match=message) as caught:
        placed(views, dt_s=DT_S)
    assert "\n" not in str(caught.value)


def test_another_time_step_or_unit_of_speed_is_refused():
    with pytest.raises(RecordingError, match=r"poses move 2\.00 times .* dt_s"):
        placed(recording_set(drive("clean", approach())), dt_s=DT_S / 2)
    with pytest.raises(RecordingError, match=r"poses move 0\.28 times .* unit of speed_mps"):
        placed(recording_set(drive("clean", approach(), speed_mps=21.6)), dt_s=DT_S)
    # So far off that the car seems to stand.
    for given in (0.0, 0.3):
        with pytest.raises(RecordingError, match=r"poses move \d+\.\d\d times as fast as the recorded speed"):
            placed(recording_set(drive("clean", approach(), speed_mps=given)), dt_s=DT_S)


def test_what_lies_in_another_world_does_not_come_along():
    there = Obstacle(x_m=200.0, y_m=3.0, yaw_rad=0.0, half_length_m=5.0, half_width_m=0.1)
    one = replace(recording_set(drive("clean", approach())), obstacles=(there,), marks=())
    assert (placed(one, dt_s=DT_S).obstacles, placed(one, dt_s=DT_S).marks) == (None, None)


def test_a_frame_that_sees_another_canvas_is_named():
    bent, tall = approach(), approach()
    bent[5] = bent[5] @ np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    tall[5] = tall[5] @ np.diag([1.0, 1.3, 1.0])
    with pytest.raises(RecordingError, match=r"drive clean, frame 15: .* cosine of 0\.\d.*drop the frame"):
        placed(recording_set(drive("clean", bent)), dt_s=DT_S)
    with pytest.raises(RecordingError, match=r"drive right, frame 15: .* canvas 30% off"):
        placed(recording_set(drive("clean", approach()), drive("right", tall)), dt_s=DT_S)


def test_a_pose_that_jumps_is_named():
    views = approach()
    there = np.eye(3)
    there[1, 2] = 100.0  # px, further along the road
    views[8:] = views[8:] @ there
    with pytest.raises(
        RecordingError, match=r"drive clean: the pose jumps by \d\.\d m from frame 17 to 18, expected 0.6"
    ):
        placed(recording_set(drive("clean", views)), dt_s=DT_S)


def test_controls_that_do_not_fit_are_refused():
    one = recording_set(drive("clean", approach()))
    with pytest.raises(RecordingError, match="controls for right, which is no drive"):
        placed(one, dt_s=DT_S, controls={"right": np.zeros((16, 3))})
    with pytest.raises(RecordingError, match=r"controls of drive clean have shape \(15, 3\), expected \(16, 3\)"):
        placed(one, dt_s=DT_S, controls={"clean": np.zeros((15, 3))})
    with pytest.raises(RecordingError, match="drive clean: throttle of the track"):
        placed(one, dt_s=DT_S, controls={"clean": np.full((16, 3), -0.5)})
    with pytest.raises(RecordingError, match="drive clean: dt_s"):
        placed(one, dt_s=0.0)


@pytest.fixture(scope="module")
def real(carla_data):
    """Three drives of CARLA 0.8.2 round a bend, placed."""
    drives = []
    for folder, side in (("t1", Side.CLEAN), ("t2", Side.RIGHT), ("t3", Side.LEFT)):
        stored = np.load(carla_data / folder / "homographies.npz", allow_pickle=False)
        good = stored["consistent"].astype(bool)
        with (carla_data / folder / "log.csv").open() as file:
            speed = {int(row["frame"]): float(row["speed_mps"]) for row in csv.DictReader(file)}
        numbers = stored["frame"][good].astype(int)
        one = drive(str(side), stored["H"][good], speed_mps=[speed[number] for number in numbers])
        drives.append(replace(one, frame_number=numbers))
    return placed(recording_set(*drives), dt_s=DT_S)


def test_the_published_canvas_has_the_size_estimated_from_its_marks(real):
    assert real.canvas.width_m == pytest.approx(7.56, rel=0.02)
    assert real.canvas.length_m == pytest.approx(9.53, rel=0.02)


def test_real_poses_move_as_fast_as_the_car_did(real):
    for recording in real.recordings:
        track = recording.track
        seconds = np.diff(track.step) * DT_S
        implied = np.hypot(np.diff(track.x_m), np.diff(track.y_m)) / seconds
        recorded = (track.speed_mps[1:] + track.speed_mps[:-1]) / 2
        assert np.median(np.abs(implied / recorded - 1)) < 0.04
        assert np.abs(implied / recorded - 1).max() < 0.2
        assert np.median(implied / recorded) == pytest.approx(1, abs=0.02)


def test_the_real_clean_drive_is_a_smooth_path(real):
    track = real.recordings[0].track
    for values in (track.x_m, track.y_m):
        smooth = np.polynomial.Polynomial.fit(track.step, values, 4)(track.step)
        assert np.abs(values - smooth).max() < 0.12
    # The car goes where it points, but for the slip of its origin ahead of the rear axle.
    way = np.arctan2(track.y_m[2:] - track.y_m[:-2], track.x_m[2:] - track.x_m[:-2])
    assert np.median(np.abs(way - track.yaw_rad[1:-1])) < np.radians(5)


def test_real_drives_begin_together_and_part_to_the_side_they_were_pushed_to(real):
    clean, right, left = (recording.track for recording in real.recordings)
    number = np.array([45])
    (c,), (r,), (le,) = clean.rows(number), right.rows(number), left.rows(number)
    assert abs(clean.x_m[c] - right.x_m[r]) + abs(clean.y_m[c] - right.y_m[r]) < 0.15
    assert abs(clean.x_m[c] - left.x_m[le]) + abs(clean.y_m[c] - left.y_m[le]) < 0.2
    later = np.array([51])
    assert right.yaw_rad[right.rows(later)] < clean.yaw_rad[clean.rows(later)] < left.yaw_rad[left.rows(later)]


def test_the_wrong_lens_is_refused_on_real_drives(real):
    for change in ({"fov_deg": 90.0}, {"fov_deg": 110.0}, {"pitch_deg": -10.0}, {"up_m": 2.0}):
        with pytest.raises(RecordingError):
            placed(replace(real, camera=replace(CIL_CAMERA, **change)), dt_s=DT_S)
