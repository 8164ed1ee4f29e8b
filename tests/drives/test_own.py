from __future__ import annotations

import csv
import math
import re
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from lenses import BARREL, LENSES, behind
from own_drives import CORNER_NAMES, PLAN, changed_table, through, write_own, write_table
from paint_shy import PaintShy
from recorded_drives import CANVAS, track
from roadproof.attacks import GradOpt, PathDeviation, attack
from roadproof.drives.own import import_drives, preview
from roadproof.drives.own.place import fitted_camera
from roadproof.drives.own.plan import GroundPoint, read_plan
from roadproof.drives.record import in_view
from roadproof.errors import RecordingError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, homography_from_pose
from roadproof.io.pictures import read_picture
from roadproof.recorded import RecordedWorld
from roadproof.recordings import Side
from roadproof.search_space import SearchSpace

CHESSBOARD = '\n[chessboard]\npictures = "boards"\ncorners = [9, 6]\n'


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    return write_own(tmp_path_factory.mktemp("own") / "street")


def test_poses_place_the_canvas_in_every_frame(own):
    recordings = import_drives(own)
    assert [each.side for each in recordings.recordings] == [Side.CLEAN, Side.RIGHT, Side.LEFT]
    assert recordings.is_placed
    assert recordings.canvas == CANVAS
    clean, driven = recordings.recordings[0], track()
    for number, seen in zip(clean.frame_number.tolist(), clean.image_from_canvas, strict=True):
        np.testing.assert_allclose(seen, homography_from_pose(CIL_CAMERA, driven.state(number), CANVAS), rtol=1e-12)
    first = int(clean.frame_number[0])
    picture = read_picture(own / "clean" / f"{first}.png", RecordingError, "")
    assert np.array_equal(clean.frames[0], CIL_INPUT(picture))
    np.testing.assert_array_equal(clean.track.steer, driven.steer)
    assert preview(recordings).size == (3 * 400, 3 * 176)


def test_they_can_be_attacked_and_driven_in(own):
    recordings = import_drives(own)
    method = GradOpt(iterations=2, restarts=1, halving=False)
    found = attack(recordings, PaintShy(), SearchSpace(figures=1), objective=PathDeviation(), method=method)
    assert found.predicted_m is not None
    assert found.predicted_m >= 0.0


def test_speed_and_yaw_rate_give_poses(tmp_path):
    plan = PLAN.replace("x_m = 130.0\ny_m = -40.0\nyaw_rad = 0.6", "ahead_m = 36.0")
    folder = write_own(tmp_path / "own", ["clean"], ["yaw_rate_rad_s"], plan)
    recordings, driven = import_drives(folder), track()
    summed = recordings.recordings[0].track
    c, s = np.cos(driven.yaw_rad[0]), np.sin(driven.yaw_rad[0])
    x_m, y_m = driven.x_m - driven.x_m[0], driven.y_m - driven.y_m[0]
    np.testing.assert_allclose(summed.x_m, c * x_m + s * y_m, atol=0.1)
    np.testing.assert_allclose(summed.y_m, c * y_m - s * x_m, atol=0.1)
    assert recordings.canvas.x_m == pytest.approx(36.0, abs=0.2)
    assert recordings.canvas.yaw_rad == pytest.approx(0.0, abs=0.05)
    twice = write_own(tmp_path / "two", ["clean", "left"], ["yaw_rate_rad_s"], plan)
    with pytest.raises(RecordingError, match="do not say how drives lie to each other"):
        import_drives(twice)


def test_corners_of_the_canvas_give_poses_and_its_size(tmp_path):
    plan = PLAN[: PLAN.index("[canvas]")]
    folder = write_own(tmp_path / "own", columns=CORNER_NAMES, plan=plan, every=1)
    recordings = import_drives(folder)
    assert recordings.is_placed
    assert recordings.canvas.width_m == pytest.approx(CANVAS.width_m, rel=0.01)
    assert recordings.canvas.length_m == pytest.approx(CANVAS.length_m, rel=0.01)
    clean = recordings.recordings[0]
    assert len(clean.frames) == 40
    assert np.diff(clean.track.step).tolist() == [1] * 71  # of all rows, though not all frames are kept
    assert RecordedWorld(recordings).course.count > 60


@pytest.mark.parametrize(
    ("columns", "plan"),
    [(CORNER_NAMES, PLAN), ((*CORNER_NAMES, "x_m", "y_m", "yaw_rad"), PLAN[: PLAN.index("[canvas]")])],
)
def test_what_says_twice_where_the_canvas_or_the_car_is_is_refused(tmp_path, columns, plan):
    folder = write_own(tmp_path / "own", ["clean"], columns, plan)
    with pytest.raises(RecordingError, match=r"corners in the tables say .* leave out \[canvas\]"):
        import_drives(folder)


def test_a_speed_in_another_unit_than_the_poses_is_refused(tmp_path):
    folder = write_own(tmp_path / "own", ["clean"])
    table = folder / "clean.csv"
    rows = list(csv.DictReader(table.read_text().splitlines()))
    # Poses may be logged at half the rate.
    held = [row | {name: rows[k - k % 2][name] for name in ("x_m", "y_m")} for k, row in enumerate(rows)]
    write_table(table, held)
    assert import_drives(folder).is_placed
    write_table(table, [row | {"speed_mps": 3.6 * float(row["speed_mps"])} for row in rows])
    with pytest.raises(RecordingError, match=r"clean.csv: poses move 0\.28 times as fast as speed_mps says"):
        import_drives(folder)


@pytest.mark.parametrize(
    ("name", "changed", "message"),
    [
        ("yaw_rad", lambda yaw: math.degrees(yaw), r"the car moves \d\.\d\d rad beside its yaw_rad .* give radians"),
        ("yaw_rad", lambda yaw: math.pi / 2 - yaw, "rad beside its yaw_rad"),
        ("yaw_rad", lambda yaw: yaw + math.pi, r"moves 3\.\d\d rad beside"),
    ],
)
def test_headings_that_are_not_the_way_the_car_goes_are_refused(tmp_path, name, changed, message):
    folder = write_own(tmp_path / "own", ["clean"])
    rows = list(csv.DictReader((folder / "clean.csv").read_text().splitlines()))
    write_table(folder / "clean.csv", [row | {name: changed(float(row[name]))} for row in rows])
    with pytest.raises(RecordingError, match=message):
        import_drives(folder)


def test_poses_that_wait_and_jump_give_no_speed(tmp_path):
    folder = write_own(tmp_path / "own", ["clean"])
    rows = list(csv.DictReader((folder / "clean.csv").read_text().splitlines()))
    held = [row | {name: rows[k - k % 5][name] for name in ("x_m", "y_m")} for k, row in enumerate(rows)]
    write_table(folder / "clean.csv", held)
    assert import_drives(folder).is_placed, "its speed is stated"
    bare = [{name: value for name, value in row.items() if name != "speed_mps"} for row in held]
    write_table(folder / "clean.csv", bare)
    with pytest.raises(RecordingError, match=r"poses change in \d+ of \d+ steps, now and then"):
        import_drives(folder)


def test_poses_may_jitter_where_the_car_stands(tmp_path):
    folder = write_own(tmp_path / "own", ["clean"])
    rows = list(csv.DictReader((folder / "clean.csv").read_text().splitlines()))
    draw, first = np.random.default_rng(0), rows[0] | {"speed_mps": 0.0}
    stands = [first | {name: float(first[name]) + draw.normal(0, 0.15) for name in ("x_m", "y_m")} for _ in range(200)]
    write_table(folder / "clean.csv", [*stands, *rows])
    assert import_drives(folder).is_placed


def test_a_yaw_rate_in_degrees_is_refused(tmp_path):
    plan = PLAN.replace("x_m = 130.0\ny_m = -40.0\nyaw_rad = 0.6", "ahead_m = 36.0")
    folder = write_own(tmp_path / "own", ["clean"], ["yaw_rate_rad_s"], plan)
    rows = list(csv.DictReader((folder / "clean.csv").read_text().splitlines()))
    quick = [row | {"yaw_rate_rad_s": 3.0} for row in rows]
    write_table(folder / "clean.csv", quick)
    with pytest.raises(RecordingError, match=r"the car turns on circles of \d\.\d m, expected 3 m or more"):
        import_drives(folder)


def test_a_log_that_ends_before_the_canvas_is_refused(tmp_path):
    folder = write_own(tmp_path / "own", ["clean", "right"])
    rows = {name: (folder / f"{name}.csv").read_text().splitlines()[:61] for name in ("clean", "right")}
    (folder / "right.csv").write_text("\n".join(rows["right"]))
    assert len(import_drives(folder).recordings) == 2  # what is perturbed may end where it likes
    (folder / "clean.csv").write_text("\n".join(rows["clean"]))
    with pytest.raises(
        RecordingError, match=r"drive clean ends 13\.\d m before the canvas; give the rows of clean.csv"
    ):
        import_drives(folder)


def test_known_points_of_the_ground_give_height_pitch_and_field_of_view():
    true = replace(CIL_CAMERA, up_m=1.62, pitch_deg=-11.0, fov_deg=88.0)
    places = np.array([[6.0, -1.5], [6.0, 1.5], [14.0, -3.0], [25.0, 2.0]])
    state = replace(track().state(0), x_m=0.0, y_m=0.0, yaw_rad=0.0)
    x, y, depth = true.image_from_world(state) @ np.column_stack([places, np.zeros(4), np.ones(4)]).T
    seen = zip(x / depth, y / depth, places, strict=True)
    ground = [GroundPoint(x_px=a, y_px=b, ahead_m=p, left_m=q) for a, b, (p, q) in seen]
    found = fitted_camera(CIL_CAMERA, ground)
    assert (found.up_m, found.pitch_deg, found.fov_deg) == pytest.approx((1.62, -11.0, 88.0), abs=1e-3)
    assert fitted_camera(CIL_CAMERA, ()) == CIL_CAMERA
    known = fitted_camera(replace(true, up_m=1.3, pitch_deg=-5.0), ground, fov_known=True)
    assert (known.up_m, known.pitch_deg) == pytest.approx((1.62, -11.0), abs=1e-3)
    assert known.fov_deg == true.fov_deg
    with pytest.raises(RecordingError, match="expected 3 or more"):
        fitted_camera(CIL_CAMERA, ground[:2])
    with pytest.raises(RecordingError, match=r"missed by up to \d+\.\d px"):
        fitted_camera(CIL_CAMERA, [*ground[:3], replace(ground[3], y_px=ground[3].y_px + 200)])
    middle = replace(ground[0], x_px=(ground[0].x_px + ground[1].x_px) / 2, left_m=0.0)
    for few in ([ground[0]] * 3, [*ground[:2], middle]):
        with pytest.raises(RecordingError, match="known points of the ground leave up_m of the camera open: a pixel"):
            fitted_camera(true, few)


def test_the_known_points_that_the_docs_show_fit_the_camera_that_they_show(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text(encoding="utf-8")
    plan, ground = (
        next(block for block in re.findall(r"```toml\n(.*?)```", page, re.DOTALL) if word in block)
        for word in ("[camera] ", "ground = ")
    )
    (tmp_path / "drives.toml").write_text(f"{ground}\n{plan}")
    own = read_plan(tmp_path)
    found = fitted_camera(own.camera, own.ground)
    assert found.up_m == pytest.approx(own.camera.up_m, abs=0.1)
    assert (found.pitch_deg, found.fov_deg) == pytest.approx((own.camera.pitch_deg, own.camera.fov_deg), abs=1.0)


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_corners_seen_through_a_lens_give_the_same_canvas(tmp_path, lens):
    plan, camera = through(lens, PLAN[: PLAN.index("[canvas]")]), behind(lens)
    folder = write_own(tmp_path / "own", ["clean"], CORNER_NAMES, plan, every=1, camera=camera)
    recordings = import_drives(folder)
    assert recordings.camera == camera
    assert recordings.canvas.width_m == pytest.approx(CANVAS.width_m, rel=1e-6)
    assert recordings.canvas.length_m == pytest.approx(CANVAS.length_m, rel=1e-6)


def test_poses_place_the_canvas_behind_a_lens_too(tmp_path):
    folder = write_own(tmp_path / "own", plan=through(BARREL))
    recordings, straight = import_drives(folder), import_drives(write_own(tmp_path / "straight"))
    clean = recordings.recordings[0]
    assert recordings.camera == behind(BARREL)
    for number, seen in zip(clean.frame_number.tolist(), clean.image_from_canvas, strict=True):
        np.testing.assert_allclose(seen, homography_from_pose(CIL_CAMERA, track().state(number), CANVAS), rtol=1e-12)
    off = np.abs(np.asarray(preview(recordings)).astype(int) - np.asarray(preview(straight)))
    assert (off.max(-1) > 50).sum() > 200  # the outline is drawn where the lens shows it


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_known_points_seen_through_a_lens_give_height_pitch_and_field_of_view(lens):
    true = replace(behind(lens), up_m=1.62, pitch_deg=-11.0, fov_deg=88.0)
    places = np.array([[6.0, -1.5, 0.0, 1.0], [6.0, 1.5, 0.0, 1.0], [14.0, -3.0, 0.0, 1.0], [25.0, 2.0, 0.0, 1.0]])
    state = replace(track().state(0), x_m=0.0, y_m=0.0, yaw_rad=0.0)
    seen = true.distorted(places @ true.image_from_world(state).T)
    ground = [
        GroundPoint(x_px=x, y_px=y, ahead_m=ahead, left_m=left)
        for (x, y), (ahead, left, _, _) in zip(seen, places, strict=True)
    ]
    found = fitted_camera(behind(lens), ground)
    assert (found.up_m, found.pitch_deg, found.fov_deg) == pytest.approx((1.62, -11.0, 88.0), abs=1e-3)
    assert found.lens == lens


def test_long_logs_take_no_more_memory_to_see_where_the_canvas_is():
    driven = track()
    states = [driven.state(row) for row in range(len(driven))]
    tracemalloc.start()
    shows = in_view(states, CANVAS, CIL_CAMERA, CIL_INPUT, 8)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 * 3 * 8 * 200 * 88  # some ten copies of one input's pixels, not one of all
    assert not shows[-1]
    assert shows[:100].all()
    assert not in_view([], CANVAS, CIL_CAMERA, CIL_INPUT, 8).size


def test_black_and_white_are_seen_as_stated(tmp_path):
    plan = PLAN + "\n[colour]\nblack = [0.1, 0.1, 0.2]\nwhite = [0.8, 0.7, 0.9]\n"
    response = import_drives(write_own(tmp_path / "own", ["clean"], plan=plan)).colour.response
    two = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(response(two), torch.tensor([[0.1, 0.1, 0.2], [0.8, 0.7, 0.9]], dtype=torch.float64))


@pytest.mark.parametrize(
    ("plan", "message"),
    [
        (PLAN.replace("dt_s", "dt"), "unknown key 'dt'"),
        (PLAN.replace("dt_s = 0.05", "dt_s = -1"), "dt_s is -1"),
        (PLAN.replace("fov_deg = 100.0", "fov_deg = 400.0"), "fov_deg is 400"),
        (PLAN.replace("up_m = 1.4", "up_m = 0.0"), "camera has up_m 0"),
        (PLAN.replace("width_px = 800", "width_px = 810"), "has 800×600 pixels, expected 810×600"),
        (
            PLAN.replace("width_px = 800", "width_px = 640"),
            "up to column 800 and row 510 of camera pictures of 640×600",
        ),
        (PLAN.replace("x_m = 130.0", "x_m = 900.0"), "never sees 8 pixels of the canvas at x_m 900.0"),
        (PLAN.replace("x_m = 130.0\n", ""), "neither ahead_m nor"),
        (PLAN + "ahead_m = 3\n", "both ahead_m and a place"),
        (PLAN.replace("x_m = 130.0\ny_m = -40.0\nyaw_rad = 0.6", "ahead_m = 1e4"), "expected 0 to 4"),
        (
            PLAN.replace("yaw_rad = 0.6", "yaw_rad = inf"),
            r"\[canvas\] of drives.toml: canvas yaw_rad is inf, expected",
        ),
        (PLAN.replace("x_m = 130.0", "x_m = 1e300"), r"canvas x_m is 1e\+300, expected a finite number below 1e9"),
        (PLAN + "width_m = nan\n", "canvas width_m is nan, expected a finite number"),
        (
            f"ground = [{{ x_px = nan, y_px = 1, ahead_m = 6, left_m = 1 }}]\n{PLAN}",
            "x_px of a known point of the ground is nan",
        ),
        (PLAN[: PLAN.index("[canvas]")], r"no table \[canvas\]"),
        (PLAN + "\n[colour]\nblack = [0.9, 0, 0]\nwhite = [0.8, 1, 1]\n", "0 ≤ black < white ≤ 1"),
        (PLAN.replace("[camera]", "[camera]\nzoom = 3"), "camera has an unknown key 'zoom'; did you mean"),
        (PLAN.replace("[camera]", "[camera]\nlens = 3"), "camera.lens is 3, expected table"),
        (through(BARREL).replace("brown-conrady", "tessar"), "camera.lens.model is 'tessar', expected one of brown"),
        (through(BARREL).replace("model", "modle"), "camera.lens has an unknown key 'modle'; did you mean 'model'"),
        (through(BARREL).replace(", -0.0009]", "]"), "brown-conrady lens has 4 coefficients, expected 5: k1, k2, p1"),
        (through(BARREL).replace("-0.12", "nan"), "brown-conrady lens has k1 nan, expected −1000 to 1000"),
        (through(BARREL).replace("-0.12", "-0.9"), "camera lens folds the picture 1"),
        (PLAN.replace("fov_deg = 100.0", 'fov_deg = "wide"'), "camera.fov_deg is 'wide', expected float"),
        (PLAN.replace("fov_deg = 100.0\n", ""), "camera lacks fov_deg"),
        (PLAN + CHESSBOARD.replace("[9, 6]", "[9, 2]"), r"has corners \[9, 2\], expected 3 to 25 in a row and 3 to 25"),
        (PLAN + CHESSBOARD.replace("[9, 6]", "[900, 6]"), r"has corners \[900, 6\], expected 3 to 25"),
        (PLAN + CHESSBOARD.replace("[9, 6]", "9"), r"chessboard.corners is 9, expected array"),
        (PLAN + CHESSBOARD + 'lens = "tessar"', "chessboard.lens is 'tessar', expected one of brown-conrady, fisheye"),
        (PLAN + CHESSBOARD + "square_m = 0.03", "chessboard has an unknown key 'square_m'"),
        (through(BARREL) + CHESSBOARD, r"\[camera.lens\] and \[chessboard\] both tell the lens"),
        (PLAN + CHESSBOARD.replace("boards", "nowhere"), "cannot read the folder"),
    ],
)
def test_a_plan_that_makes_no_sense_is_refused(tmp_path, own, plan, message):
    text = (own / "drives.toml").read_text()
    folder = tmp_path / "changed"
    folder.symlink_to(own)
    try:
        (own / "drives.toml").write_text(plan + text[len(PLAN) :])
        with pytest.raises(RecordingError, match=message):
            import_drives(folder)
    finally:
        (own / "drives.toml").write_text(text)


@pytest.mark.parametrize(
    ("row", "values", "message"),
    [
        (0, {"picture": "../../secret.png"}, "is not a plain name"),
        (0, {"picture": "/etc/passwd.png"}, "is not a plain name"),
        (0, {"picture": "clean/none.png"}, "none.png is missing"),
        (3, {"x_m": "1e9"}, "the pose jumps by"),
        (3, {"x_m": "twelve"}, r"row 4: x_m is 'twelve'"),
        (3, {"yaw_rad": "inf"}, r"row 4: yaw_rad is 'inf', expected a finite number"),
        (3, {"steer": "7"}, r"steer of the track goes from"),
    ],
)
def test_a_table_that_makes_no_sense_is_refused(tmp_path, row, values, message):
    folder = write_own(tmp_path / "own", ["clean"])
    text = (folder / "clean.csv").read_text().splitlines()
    shown = [k for k, line in enumerate(text[1:]) if ".png" in line]
    changed_table(folder / "clean.csv", shown[0] if row == 0 else row, **values)
    with pytest.raises(RecordingError, match=message):
        import_drives(folder)


def test_a_table_may_begin_with_a_byte_order_mark(tmp_path):
    table = write_own(tmp_path / "own", ["clean"]) / "clean.csv"
    table.write_text(table.read_text(), encoding="utf-8-sig")
    assert import_drives(tmp_path / "own").is_placed


def test_columns_are_known_or_named(tmp_path):
    folder = write_own(tmp_path / "own", ["clean"], columns=["x_m", "y_m"])
    with pytest.raises(RecordingError, match="does not say where the car was"):
        import_drives(folder)
    table = folder / "clean.csv"
    table.write_text(table.read_text().replace("x_m", "east_m", 1))
    with pytest.raises(RecordingError, match="column 'east_m', expected picture, x_m"):
        import_drives(folder)
    table.write_text(table.read_text().replace("throttle", "steer", 1))
    with pytest.raises(RecordingError, match=r"clean.csv has two columns 'steer', expected one of each name"):
        import_drives(folder)
    table.write_text("")
    with pytest.raises(RecordingError, match="has 0 rows"):
        import_drives(folder)
    table.unlink()
    with pytest.raises(RecordingError, match="cannot read"):
        import_drives(folder)
    (folder / "drives.toml").rename(tmp_path / "drives.toml")
    (folder / "drives.toml").symlink_to(tmp_path / "drives.toml")
    with pytest.raises(RecordingError, match=r"drives\.toml is a link that leads out of"):
        import_drives(folder)


def test_a_table_needs_a_picture_and_corners_that_are_the_canvas(tmp_path):
    folder = write_own(tmp_path / "own", ["clean"], CORNER_NAMES, PLAN[: PLAN.index("[canvas]")])
    changed_table(folder / "clean.csv", 2, **dict.fromkeys(CORNER_NAMES, "100.0"))
    with pytest.raises(RecordingError, match=r"clean.csv, row 3, corners of the canvas: "):
        import_drives(folder)
    for row in range(len((folder / "clean.csv").read_text().splitlines()) - 1):
        changed_table(folder / "clean.csv", row, picture="")
    with pytest.raises(RecordingError, match=r"clean.csv names no picture in \d+ rows"):
        import_drives(folder)
