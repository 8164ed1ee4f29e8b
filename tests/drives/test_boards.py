"""Chessboards are found in pictures of them, and what shows none is named."""

import shutil

import numpy as np
import pytest
from PIL import Image

from chessboards import CORNERS, poses, shown, write_boards
from command import roadproof
from own_drives import write_own
from roadproof.drives.own.boards import boards_in
from roadproof.drives.own.plan import Chessboard
from roadproof.errors import RecordingError
from roadproof.geometry import CameraModel

cv2 = pytest.importorskip("cv2", reason="chessboards need the extra roadproof[chessboard]")

CAMERA = CameraModel(width_px=320, height_px=240, fov_deg=70.0)
BOARDS = poses(CAMERA, 7, seed=2, width=(0.4, 0.6))


@pytest.fixture
def folder(tmp_path, drawn):
    shutil.copytree(drawn, tmp_path / "boards")
    return tmp_path


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    return write_boards(tmp_path_factory.mktemp("drawn") / "boards", CAMERA, BOARDS)


def found_in(folder, pictures="boards", corners=CORNERS):
    return boards_in(folder, CAMERA, Chessboard(pictures=pictures, corners=corners))


@pytest.mark.parametrize(
    ("how", "most_px"), [({}, 0.15), ({"blur_px": 1.2, "noise": 5.0}, 0.5)], ids=["sharp", "noisy"]
)
def test_corners_are_found_where_they_were_drawn(tmp_path, how, most_px):
    write_boards(tmp_path / "boards", CAMERA, BOARDS, **how)
    found = found_in(tmp_path)
    assert found.names == tuple(f"{k:02}.png" for k in range(len(BOARDS)))
    assert found.left_out == ""
    for seen, pose in zip(found.seen_px, BOARDS, strict=True):
        true = shown(CAMERA, pose)
        # A board looks the same upside down.
        assert min(np.abs(seen - true).max(), np.abs(seen[::-1] - true).max()) < most_px
    first, last = found.grid[[0, -1]]
    np.testing.assert_array_equal(first, [-4.0, -2.5])
    np.testing.assert_array_equal(last, [4.0, 2.5])
    np.testing.assert_array_equal(found.grid[1] - first, [1.0, 0.0])


def test_a_pale_board_is_found_too(tmp_path, monkeypatch):
    monkeypatch.setattr("chessboards.GREYS", {"black": 100.0, "white": 125.0, "behind": 112.0})
    write_boards(tmp_path / "boards", CAMERA, BOARDS, noise=1.0)
    grey = np.asarray(Image.open(tmp_path / "boards" / "00.png"))[..., 0]
    assert not cv2.findChessboardCornersSB(np.ascontiguousarray(grey), CORNERS)[0]
    assert len(found_in(tmp_path).names) >= 5


def test_pictures_that_show_no_board_or_the_same_again_are_left_out_by_name(folder):
    boards = folder / "boards"
    shutil.copyfile(boards / "00.png", boards / "07.png")
    Image.fromarray(np.full((240, 320, 3), 120, np.uint8)).save(boards / "08.png")
    Image.open(boards / "01.png").crop((160, 0, 320, 240)).resize((320, 240)).save(boards / "01.png")
    found = found_in(folder)
    assert found.names == ("00.png", "02.png", "03.png", "04.png", "05.png", "06.png")
    assert found.left_out == (
        "no board of 9 × 6 inner corners found in 01.png, 08.png; the board where it was before in 07.png"
    )


def test_too_few_boards_are_refused_with_what_was_wrong_with_the_others(folder):
    with pytest.raises(
        RecordingError, match=r"^0 of 7 pictures show .* no board of 10 × 7 inner .* four squares meet, leave"
    ):
        found_in(folder, corners=(10, 7))
    for name in ("05.png", "06.png"):
        shutil.copyfile(folder / "boards" / "00.png", folder / "boards" / name)
    (folder / "boards" / "04.png").unlink()
    with pytest.raises(RecordingError, match=r"^4 of 6 pictures .* the board where it was before in 05\.png, 06\.png"):
        found_in(folder)


def test_pictures_of_another_size_are_refused_by_name(folder):
    Image.new("RGB", (321, 240)).save(folder / "boards" / "03.png")
    with pytest.raises(RecordingError, match=r"03\.png has 321×240 pixels, expected 320×240 as the camera"):
        found_in(folder)


@pytest.mark.parametrize(
    ("pictures", "message"),
    [
        ("../boards", r"'\.\./boards' '\.\.' is not a plain name"),
        ("/etc", "'/' is not a plain name"),
        ("boards/*.png", r"'\*\.png' is not a plain name"),
        ("nowhere", "cannot read the folder .*nowhere: No such file or directory"),
        ("boards/00.png", "cannot read the folder .*: Not a directory"),
        (".", r"has 0 pictures \(PNG or JPEG\), expected 5 to 50"),
        ("link", "is a link that leads out of"),
    ],
)
def test_a_folder_that_is_none_or_lies_elsewhere_is_refused(folder, tmp_path_factory, pictures, message):
    (folder / "link").symlink_to(tmp_path_factory.mktemp("elsewhere"))
    with pytest.raises(RecordingError, match=message):
        found_in(folder, pictures)


def test_more_pictures_than_anyone_needs_are_refused_before_any_is_read(folder):
    for k in range(60):
        (folder / "boards" / f"many{k}.JPG").write_text("no picture")
    with pytest.raises(RecordingError, match=r"has 67 pictures \(PNG or JPEG\), expected 5 to 50; 20 are plenty"):
        found_in(folder)


def test_without_opencv_it_is_said_what_to_install(tmp_path):
    own = write_own(tmp_path / "own", ["clean"])
    plan = (own / "drives.toml").read_text()
    (own / "drives.toml").write_text(plan + '\n[chessboard]\npictures = "boards"\ncorners = [9, 6]\n')
    told = roadproof("import", own, "--out", tmp_path / "set", before="import sys; sys.modules['cv2'] = None")
    assert (told.returncode, told.stdout) == (2, "")
    assert told.stderr.count("\n") == 1
    assert "pip install 'roadproof[chessboard]'" in told.stderr
    assert not (tmp_path / "set").exists()
