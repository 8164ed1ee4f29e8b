from __future__ import annotations

import re

import pytest

from chessboards import poses, write_boards
from command import answered, roadproof, stored
from lenses import BARREL, behind
from own_drives import PLAN, write_own
from roadproof.errors import RecordingError
from roadproof.io.pictures import read_picture
from roadproof.recordings import load_recordings


def test_pictures_and_tables_become_recordings(tmp_path, invoke):
    folder, out = write_own(tmp_path / "mine"), tmp_path / "set"
    code, printed = invoke("import", folder, "--out", tmp_path / "told", "--json")
    assert (code, printed.err) == (0, "")
    assert answered(printed.out) == stored(tmp_path / "told" / "recordings.json")
    said = roadproof("import", folder, "--out", out).stdout
    assert "canvas 7.60 m across the road, 9.50 m along it" in said
    assert f"next: roadproof attack {out}" in said
    assert [drive.name for drive in load_recordings(out).recordings] == ["clean", "right", "left"]
    assert read_picture(out / "preview.png", RecordingError, "").shape == (3 * 176, 3 * 400, 3)


def test_what_is_there_already_is_kept_and_nothing_is_read(tmp_path):
    folder, out = tmp_path / "not there", tmp_path / "set"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    done = roadproof("import", folder, "--out", out)
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert [path.name for path in out.iterdir()] == ["mine.txt"]


def test_chessboards_tell_the_camera_and_how_well(tmp_path, invoke):
    pytest.importorskip("cv2", reason="chessboards need the extra roadproof[chessboard]")
    plan = PLAN.replace("fov_deg = 100.0", "fov_deg = 70.0") + '\n[chessboard]\npictures = "boards"\ncorners = [9, 6]\n'
    folder, true = write_own(tmp_path / "mine", ["clean"], plan=plan), behind(BARREL)
    write_boards(folder / "boards", true, poses(true, 12))
    code, printed = invoke("import", folder, "--out", tmp_path / "set")
    assert (code, printed.err) == (0, "")
    camera = load_recordings(tmp_path / "set").camera
    assert camera.fov_deg == pytest.approx(100.0, abs=0.1)
    assert camera.lens.coefficients == pytest.approx(BARREL.coefficients, abs=0.02)
    assert (camera.up_m, camera.pitch_deg) == (true.up_m, true.pitch_deg)
    told = re.search(
        r"field of view (\S+)° ± (\S+)° \(95 %\) and lens from 12 pictures .* missed by (\S+) px", printed.out
    )
    fov_deg, error_deg, missed_px = map(float, told.groups())
    assert fov_deg == pytest.approx(camera.fov_deg, abs=0.006)
    assert 0.0 < error_deg < 0.1
    assert 0.0 < missed_px < 0.3
    assert "behind a brown-conrady lens" in printed.out
