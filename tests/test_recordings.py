"""Recordings: what is written is what is read, and damage is named."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from roadproof.errors import OutputError, RecordingError
from roadproof.photometry import AffineResponse, ColourTransform, PixelMaps
from roadproof.recordings import Push, RecordingSet, load_recordings, pooled, save_recordings
from scenes import PLAIN, recording, recording_set

PER_FRAME = ("frames", "frame_number", "image_from_canvas", "speed_mps", "command", "steer")


@pytest.fixture
def saved(tmp_path):
    save_recordings(recording_set(frames=3), tmp_path / "set")
    return tmp_path / "set"


@pytest.mark.parametrize("compact", [False, True])
def test_a_saved_set_is_the_same_when_loaded(tmp_path, compact):
    original = recording_set(frames=3)
    save_recordings(original, tmp_path / "set", compact=compact)
    loaded = load_recordings(tmp_path / "set")
    assert loaded.camera == original.camera
    assert loaded.view == original.view
    assert loaded.colour.to_dict() == original.colour.to_dict()
    for ours, theirs in zip(loaded.recordings, original.recordings, strict=True):
        assert (ours.name, ours.push) == (theirs.name, theirs.push)
        for field in PER_FRAME:
            np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_pixel_maps_travel_with_their_drive(tmp_path):
    drive = recording(Push.CLEAN, frames=2)
    maps = PixelMaps(torch.rand(2, 88, 200, 3), torch.rand(2, 88, 200, 3), torch.rand(2, 88, 200), PLAIN.response)
    one = replace(recording_set(), recordings=(replace(drive, maps=maps),))
    save_recordings(one, tmp_path / "set")
    loaded = load_recordings(tmp_path / "set").recordings[0].maps
    assert torch.equal(loaded.gain, maps.gain)
    assert torch.equal(loaded.visible, maps.visible)


def test_a_thinned_drive_ends_with_the_same_frame_and_keeps_what_belongs_to_each():
    maps = PixelMaps(torch.rand(8, 88, 200, 3), torch.zeros(8, 88, 200, 3), torch.ones(8, 88, 200), PLAIN.response)
    drive = replace(recording(Push.CLEAN, frames=8), maps=maps)
    few = drive.thinned(3)
    assert few.frame_number.tolist() == [11, 14, 17]
    for field in PER_FRAME:
        np.testing.assert_array_equal(getattr(few, field), getattr(drive, field)[[1, 4, 7]])
    assert torch.equal(few.maps.gain, maps.gain[[1, 4, 7]])
    assert drive.thinned(100).frame_number.tolist() == [17]
    assert recording(Push.CLEAN).thinned(2).maps is None


def test_the_manifest_says_formats_units_and_drives(saved):
    manifest = json.loads((saved / "recordings.json").read_text())
    assert (manifest["format"], manifest["version"]) == ("roadproof-recordings", 1)
    assert "positive = right" in manifest["units"]["steer"]
    assert [drive["push"] for drive in manifest["drives"]] == ["clean", "right", "left"]


def edit_manifest(folder, change):
    manifest = json.loads((folder / "recordings.json").read_text())
    change(manifest)
    (folder / "recordings.json").write_text(json.dumps(manifest))


def edit_drive(folder, **fields):
    stored = dict(np.load(folder / "drive.npz"))
    np.savez(folder / "drive.npz", **(stored | fields))


def cut(path):
    path.write_bytes(path.read_bytes()[:60])


DAMAGE = {
    "manifest missing": (lambda s: (s / "recordings.json").unlink(), "no recordings.json"),
    "manifest cut": (lambda s: cut(s / "recordings.json"), "not valid JSON"),
    "newer version": (lambda s: edit_manifest(s, lambda m: m.update(version=9)), "version 9"),
    "unknown camera field": (lambda s: edit_manifest(s, lambda m: m["camera"].update(zoom=2)), "zoom"),
    "no camera": (lambda s: edit_manifest(s, lambda m: m.pop("camera")), "camera"),
    "path out of the folder": (
        lambda s: edit_manifest(s, lambda m: m["drives"][0].update(name="../x")),
        "plain folder",
    ),
    "drive missing": (lambda s: edit_manifest(s, lambda m: m["drives"][0].update(name="gone")), "gone"),
    "unknown push": (lambda s: edit_manifest(s, lambda m: m["drives"][0].update(push="up")), "expected one of clean"),
    "no drives": (lambda s: edit_manifest(s, lambda m: m.update(drives=[])), "no drives"),
    "frame missing": (lambda s: (s / "clean" / "frames" / "11.png").unlink(), "11.png is missing"),
    "frame cut": (lambda s: cut(s / "clean" / "frames" / "11.png"), "11.png cannot be read"),
    "arrays cut": (lambda s: cut(s / "clean" / "drive.npz"), "damaged"),
    "arrays missing": (lambda s: (s / "clean" / "drive.npz").unlink(), "drive.npz is missing"),
    "NaN homography": (
        lambda s: edit_drive(s / "clean", image_from_canvas=np.full((3, 3, 3), np.nan)),
        "image_from_canvas of frame 10 is NaN",
    ),
    "wrong sign": (
        lambda s: edit_drive(s / "clean", image_from_canvas=-recording(Push.CLEAN, frames=3).image_from_canvas),
        "frame 10: homography has the wrong sign",
    ),
    "rank": (
        lambda s: edit_drive(s / "clean", image_from_canvas=np.ones((3, 3, 3))),
        "rank below 3",
    ),
    "unequal lengths": (lambda s: edit_drive(s / "clean", speed_mps=np.ones(2)), "speed_mps has shape"),
    "NaN speed": (lambda s: edit_drive(s / "clean", speed_mps=np.array([1, np.nan, 1])), "speed_mps of frame 11"),
    "other size": (lambda s: edit_manifest(s, lambda m: m["crop_resize"].update(width_px=100)), "expected 100×88"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named_in_one_line(saved, name):
    damage, message = DAMAGE[name]
    damage(saved)
    with pytest.raises(RecordingError, match=message) as caught:
        load_recordings(saved)
    assert "\n" not in str(caught.value)


def test_folders_that_are_missing_or_empty_are_named(tmp_path):
    with pytest.raises(RecordingError, match="no folder"):
        load_recordings(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match=r"no recordings\.json"):
        load_recordings(tmp_path / "empty")


def test_nothing_is_overwritten_and_nothing_is_left_half_written(saved, monkeypatch):
    with pytest.raises(OutputError, match="exists already"):
        save_recordings(recording_set(frames=3), saved)

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("roadproof.recordings.np.savez_compressed", full)
    with pytest.raises(OutputError, match="No space left"):
        save_recordings(recording_set(frames=3), saved.parent / "second")
    assert [path.name for path in saved.parent.iterdir()] == ["set"]


def test_two_drives_need_two_names():
    drive = recording(Push.CLEAN)
    with pytest.raises(RecordingError, match="same name"):
        replace(recording_set(), recordings=(drive, drive))


def test_a_set_keeps_its_type():
    assert isinstance(recording_set(), RecordingSet)


def test_sets_are_pooled_and_all_their_drives_keep_a_name():
    dry, wet = recording_set(frames=3), recording_set(frames=2)
    both = pooled({"noon": dry, "rain": wet})
    assert [drive.name for drive in both.recordings] == [
        "clean", "right", "left", "rain-clean", "rain-right", "rain-left"
    ]  # fmt: skip
    assert [len(drive.frames) for drive in both.recordings] == [3, 3, 3, 2, 2, 2]
    assert pooled({"noon": dry}).recordings == dry.recordings
    darker = replace(wet, colour=ColourTransform(AffineResponse(0.5 * torch.eye(3), torch.zeros(3))))
    with pytest.raises(RecordingError, match="the recordings rain have another camera, crop or colour"):
        pooled({"noon": dry, "rain": darker})
    with pytest.raises(RecordingError, match="at least one set"):
        pooled({})
