"""Recordings: what is written is what is read, and damage is named."""

import json
import zipfile
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from lenses import LENSES, behind
from roadproof.datatypes import Obstacle
from roadproof.errors import OutputError, RecordingError
from roadproof.geometry import CanvasPlacement
from roadproof.paint.site import LaneMark
from roadproof.photometry import AffineResponse, ColourTransform, PixelMaps
from roadproof.recordings import RecordingSet, Side, Track, evenly, load_recordings, pooled, save_recordings
from scenes import recording, recording_set

PER_FRAME = ("frames", "frame_number", "image_from_canvas", "speed_mps", "command", "steer")


CANVAS = CanvasPlacement(x_m=30.5, y_m=-0.1, z_m=0.2, yaw_rad=1 / 3, width_m=7.56, length_m=9.53)


def track(first=8, count=6):
    step = np.arange(first, first + count)
    return Track(
        dt_s=0.1,
        step=step,
        x_m=0.6 * step,
        y_m=np.sin(step),
        yaw_rad=np.cos(step) / 3,
        speed_mps=np.full(count, 6.0),
        steer=np.sin(step),
        throttle=np.linspace(0, 1, count),
        brake=np.linspace(1, 0, count),
    )


def placed_set(frames=3):
    """A set whose canvas is known, and the tracks of two of its three drives."""
    bare = recording_set(frames=frames)
    clean, right, left = bare.recordings
    drives = (replace(clean, track=track()), right, replace(left, track=track(10, 3)))
    return replace(bare, canvas=CANVAS, recordings=drives)


@pytest.fixture
def saved(tmp_path):
    save_recordings(recording_set(frames=3), tmp_path / "set")
    return tmp_path / "set"


@pytest.fixture
def saved_placed(tmp_path):
    save_recordings(placed_set(), tmp_path / "set")
    return tmp_path / "set"


@pytest.mark.parametrize("compact", [False, True])
def test_a_saved_set_is_the_same_when_loaded(tmp_path, compact):
    original = recording_set(frames=3)
    save_recordings(original, tmp_path / "set", compact=compact)
    loaded = load_recordings(tmp_path / "set")
    assert loaded.camera == original.camera
    assert loaded.view == original.view
    assert loaded.colour.to_dict() == original.colour.to_dict()
    assert loaded.digest() == original.digest()
    for ours, theirs in zip(loaded.recordings, original.recordings, strict=True):
        assert (ours.name, ours.side) == (theirs.name, theirs.side)
        for field in PER_FRAME:
            np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_sets_that_differ_in_what_is_driven_over_have_other_digests(saved_placed):
    original, obstacle = placed_set(), Obstacle(x_m=1.0, y_m=2.0, yaw_rad=0.0, half_length_m=1.0, half_width_m=1.0)
    clean, *others = original.recordings
    assert load_recordings(saved_placed).digest() == original.digest()
    slower = replace(clean, track=replace(clean.track, speed_mps=clean.track.speed_mps / 2))
    lens = replace(original.camera, lens=LENSES[0])
    rainy = replace(clean, weather="rainy-noon")
    changed = [{"obstacles": (obstacle,)}, {"canvas": replace(CANVAS, x_m=0.5)}, {"camera": lens}]
    changed += [{"recordings": (one, *others)} for one in (slower, rainy, replace(clean, steer=clean.steer + 0.1))]
    digests = {replace(original, **each).digest() for each in [{}, *changed]}
    assert len(digests) == 1 + len(changed)


def test_marks_have_a_digest_of_their_own(tmp_path):
    original = replace(placed_set(), marks=(LaneMark(points_m=((1.0, 0.0), (1.0, 2.0))),))
    save_recordings(original, tmp_path / "set")
    assert load_recordings(tmp_path / "set").marks_digest() == original.marks_digest()
    moved = replace(original, marks=(LaneMark(points_m=((1.5, 0.0), (1.5, 2.0))),))
    assert len({each.marks_digest() for each in (original, moved, placed_set())}) == 3


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_the_lens_travels_with_the_set(tmp_path, lens):
    original = replace(recording_set(frames=2), camera=behind(lens))
    save_recordings(original, tmp_path / "set")
    assert load_recordings(tmp_path / "set").camera == original.camera
    manifest = json.loads((tmp_path / "set" / "recordings.json").read_text())
    assert manifest["camera"]["lens"] == {"model": lens.model, "coefficients": list(lens.coefficients)}


def test_pinholes_are_kept_as_before_there_were_lenses(saved):
    camera = json.loads((saved / "recordings.json").read_text())["camera"]
    assert set(camera) == {"width_px", "height_px", "fov_deg", "forward_m", "left_m", "up_m", "pitch_deg"}
    assert load_recordings(saved).camera.lens is None


def test_pixel_maps_travel_with_their_drive(tmp_path):
    drive = recording(Side.CLEAN, frames=2)
    maps = PixelMaps(torch.rand(2, 88, 200, 3), torch.rand(2, 88, 200, 3), torch.rand(2, 88, 200))
    one = replace(recording_set(), recordings=(replace(drive, maps=maps),))
    save_recordings(one, tmp_path / "set")
    loaded = load_recordings(tmp_path / "set").recordings[0].maps
    assert torch.equal(loaded.gain, maps.gain)
    assert torch.equal(loaded.visible, maps.visible)


def test_a_set_of_which_some_drives_lost_their_pixel_maps_is_refused(tmp_path):
    maps = PixelMaps(torch.rand(2, 88, 200, 3), torch.rand(2, 88, 200, 3), torch.rand(2, 88, 200))
    bare = recording_set(frames=2)
    save_recordings(replace(bare, recordings=tuple(replace(each, maps=maps) for each in bare.recordings)), tmp_path)
    (tmp_path / "right" / "shading.npz").unlink()
    with pytest.raises(RecordingError, match=r"drive right has no pixel maps \(shading\.npz\), other drives have some"):
        load_recordings(tmp_path)


@pytest.mark.parametrize("kind", [">f4", "longdouble", "uint16", "int64"])
def test_pixel_maps_of_any_kind_of_number_are_read(tmp_path, kind):
    save_recordings(recording_set(frames=2), tmp_path / "set")
    maps = {
        name: np.ones((2, 88, 200, *depth), kind) for name, depth in (("gain", (3,)), ("offset", (3,)), ("visible", ()))
    }
    for drive in (tmp_path / "set").glob("*/"):
        np.savez(drive / "shading.npz", **maps)
    assert load_recordings(tmp_path / "set").recordings[0].maps.gain.dtype == torch.float32


@pytest.mark.parametrize("shape", [(3, 88, 200, 3), (1, 88, 200, 3), (2, 87, 200, 3)])
def test_pixel_maps_of_other_frames_are_refused(tmp_path, shape):
    save_recordings(recording_set(frames=2), tmp_path / "set")
    maps = {"gain": np.ones(shape), "offset": np.zeros(shape), "visible": np.ones(shape[:3])}
    np.savez(tmp_path / "set" / "clean" / "shading.npz", **maps)
    with pytest.raises(
        RecordingError, match=r"drive clean: its pixel maps .* expected that of its frames, \(2, 88, 200"
    ):
        load_recordings(tmp_path / "set")
    np.savez(tmp_path / "set" / "clean" / "shading.npz", **maps | {"visible": 255 * maps["visible"]})
    with pytest.raises(RecordingError, match=r"shading\.npz: visible of the pixel maps goes from 255 to 255, expected"):
        load_recordings(tmp_path / "set")


def test_a_thinned_drive_ends_with_the_same_frame_and_keeps_what_belongs_to_each():
    maps = PixelMaps(torch.rand(8, 88, 200, 3), torch.zeros(8, 88, 200, 3), torch.ones(8, 88, 200))
    drive = replace(recording(Side.CLEAN, frames=8), maps=maps)
    few = drive.thinned(3)
    assert few.frame_number.tolist() == [11, 14, 17]
    for field in PER_FRAME:
        np.testing.assert_array_equal(getattr(few, field), getattr(drive, field)[[1, 4, 7]])
    assert torch.equal(few.maps.gain, maps.gain[[1, 4, 7]])
    assert drive.thinned(100).frame_number.tolist() == [17]
    assert recording(Side.CLEAN).thinned(2).maps is None


def test_the_canvas_and_the_tracks_travel_with_the_set(saved_placed):
    original, loaded = placed_set(), load_recordings(saved_placed)
    assert loaded.canvas == CANVAS
    for ours, theirs in zip(loaded.recordings, original.recordings, strict=True):
        if theirs.track is None:
            assert ours.track is None
            assert not (saved_placed / ours.name / "track.npz").exists()
            continue
        assert ours.track.dt_s == theirs.track.dt_s
        for name, values in asdict(theirs.track).items():
            np.testing.assert_array_equal(getattr(ours.track, name), values)
    manifest = json.loads((saved_placed / "recordings.json").read_text())
    assert manifest["version"] == 1
    assert manifest["canvas"] == asdict(CANVAS)
    assert "held until the next" in manifest["units"]["track"]


def test_the_weather_of_a_drive_travels_with_it(tmp_path):
    noon = recording_set(frames=2)
    both = pooled({"noon": noon, "rain": noon})
    save_recordings(both, tmp_path / "set")
    assert [drive.weather for drive in load_recordings(tmp_path / "set").recordings] == ["noon"] * 3 + ["rain"] * 3


def test_sets_written_before_there_were_tracks_still_load(saved):
    assert json.loads((saved / "recordings.json").read_text())["canvas"] is None
    edit_manifest(saved, lambda m: m.pop("canvas"))
    loaded = load_recordings(saved)
    assert loaded.canvas is None
    assert all(drive.track is None for drive in loaded.recordings)


def test_a_thinned_drive_keeps_its_whole_track():
    clean = placed_set().recordings[0]
    assert clean.thinned(2).track is clean.track


def test_a_drive_needs_a_pose_for_every_frame():
    with pytest.raises(RecordingError, match="drive clean: the track has no pose for frame 13"):
        replace(recording(Side.CLEAN, frames=4), track=track(10, 3))


def test_the_manifest_says_formats_units_and_drives(saved):
    manifest = json.loads((saved / "recordings.json").read_text())
    assert (manifest["format"], manifest["version"]) == ("roadproof-recordings", 1)
    assert "positive = right" in manifest["units"]["steer"]
    assert [drive["side"] for drive in manifest["drives"]] == ["clean", "right", "left"]


def edit_manifest(folder, change):
    manifest = json.loads((folder / "recordings.json").read_text())
    change(manifest)
    (folder / "recordings.json").write_text(json.dumps(manifest))


def edit_drive(folder, **fields):
    stored = dict(np.load(folder / "drive.npz"))
    np.savez(folder / "drive.npz", **(stored | fields))


def cut(path):
    path.write_bytes(path.read_bytes()[:60])


def edit_lens(model, *coefficients):
    return lambda folder: edit_manifest(
        folder, lambda m: m["camera"].update(lens={"model": model, "coefficients": coefficients})
    )


DAMAGE = {
    "manifest missing": (lambda s: (s / "recordings.json").unlink(), "no recordings.json"),
    "manifest cut": (lambda s: cut(s / "recordings.json"), "not valid JSON"),
    "newer version": (lambda s: edit_manifest(s, lambda m: m.update(version=9)), "version 9"),
    "unknown camera field": (lambda s: edit_manifest(s, lambda m: m["camera"].update(zoom=2)), "zoom"),
    "a lens that folds": (edit_lens("brown-conrady", -0.9, 0, 0, 0, 0), "camera lens folds the picture"),
    "a lens of too few numbers": (edit_lens("fisheye", 0.1), "fisheye lens has 1 coefficients, expected 4"),
    "an unknown lens": (edit_lens("tessar", 0.1), "Invalid enum value 'tessar'"),
    "no camera": (lambda s: edit_manifest(s, lambda m: m.pop("camera")), "camera"),
    "path out of the folder": (
        lambda s: edit_manifest(s, lambda m: m["drives"][0].update(name="../x")),
        "plain name",
    ),
    "drive missing": (lambda s: edit_manifest(s, lambda m: m["drives"][0].update(name="gone")), "gone"),
    "unknown side": (lambda s: edit_manifest(s, lambda m: m["drives"][0].update(side="up")), "Invalid enum value 'up'"),
    "side by another name": (
        lambda s: edit_manifest(s, lambda m: [drive.update(push=drive.pop("side")) for drive in m["drives"]]),
        "missing required field `side`",
    ),
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
        lambda s: edit_drive(s / "clean", image_from_canvas=-recording(Side.CLEAN, frames=3).image_from_canvas),
        "frame 10: homography has the wrong sign",
    ),
    "rank": (
        lambda s: edit_drive(s / "clean", image_from_canvas=np.ones((3, 3, 3))),
        "rank below 3",
    ),
    "unequal lengths": (lambda s: edit_drive(s / "clean", speed_mps=np.ones(2)), "speed_mps has shape"),
    "NaN speed": (lambda s: edit_drive(s / "clean", speed_mps=np.array([1, np.nan, 1])), "speed_mps of frame 11"),
    "speed of a rocket": (
        lambda s: edit_drive(s / "clean", speed_mps=np.array([1, 1, 900.0])),
        "expected −1 to 70 m/s",
    ),
    "backwards": (lambda s: edit_drive(s / "clean", speed_mps=np.array([1, -5.0, 1])), "speed_mps of frame 11 is -5.0"),
    "complex speed": (lambda s: edit_drive(s / "clean", speed_mps=np.ones(3, complex)), "expected numbers"),
    "unknown command": (lambda s: edit_drive(s / "clean", command=np.array([2, 99, 2])), "command of frame 11 is 99"),
    "half a command": (lambda s: edit_drive(s / "clean", command=np.array([2, 2.5, 2])), "expected whole numbers"),
    "more steer than there is": (lambda s: edit_drive(s / "clean", steer=np.array([0, 0, 3.0])), "expected −1 to 1"),
    "one frame number": (lambda s: edit_drive(s / "clean", frame_number=np.array(10)), r"frame_number has shape \(\)"),
    "frames in disorder": (
        lambda s: edit_drive(s / "clean", frame_number=np.array([12, 11, 10])),
        "frame numbers do not rise",
    ),
    "giant homography": (
        lambda s: edit_drive(s / "clean", image_from_canvas=1e300 * recording(Side.CLEAN, frames=3).image_from_canvas),
        "no camera's; scale it",
    ),
    "another canvas": (lambda s: edit_manifest(s, lambda m: m.update(canvas_px=800)), "canvas_px is 800, expected 400"),
    "a crop of more than there is": (
        lambda s: edit_manifest(s, lambda m: m["crop_resize"].update(right_px=5000)),
        "up to column 5000 and row 510 of camera pictures of 800×600 pixels",
    ),
    "other size": (lambda s: edit_manifest(s, lambda m: m["crop_resize"].update(width_px=100)), "expected 100×88"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_named_in_one_line(saved, name):
    damage, message = DAMAGE[name]
    damage(saved)
    with pytest.raises(RecordingError, match=message) as caught:
        load_recordings(saved)
    assert "\n" not in str(caught.value)


def edit_track(folder, **changes):
    """Change arrays; None leaves one out."""
    stored = dict(np.load(folder / "track.npz")) | changes
    np.savez(folder / "track.npz", **{name: values for name, values in stored.items() if values is not None})


def edit_canvas(folder, **changes):
    def change(manifest):
        canvas = manifest["canvas"] | changes
        manifest["canvas"] = {name: value for name, value in canvas.items() if value is not None}

    edit_manifest(folder, change)


def flip(path):
    """Spoil the middle of a file, its head and its directory kept."""
    content = bytearray(path.read_bytes())
    content[120:160] = bytes(40)
    path.write_bytes(bytes(content))


def claim(path, shape):
    """An array whose header claims a shape that its data do not have."""
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    head = (
        np.lib.format.magic(1, 0),
        f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".ljust(117) + "\n",
    )
    members["x_m.npy"] = head[0] + len(head[1]).to_bytes(2, "little") + head[1].encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)


class Anything:
    """What only a pickle can hold."""


TRACK_DAMAGE = {
    "cut": (lambda d: cut(d / "track.npz"), "damaged"),
    "spoilt": (lambda d: flip(d / "track.npz"), "damaged"),
    "empty": (lambda d: (d / "track.npz").write_bytes(b""), "damaged"),
    "an array only": (lambda d: (np.save(d / "x.npy", np.zeros(6)), (d / "x.npy").replace(d / "track.npz")), "damaged"),
    "no steer": (lambda d: edit_track(d, steer=None), "it has no steer"),
    "no time step": (lambda d: edit_track(d, dt_s=None), "it has no dt_s"),
    "many time steps": (lambda d: edit_track(d, dt_s=np.full(6, 0.1)), r"dt_s of shape \(6,\)"),
    "time step NaN": (lambda d: edit_track(d, dt_s=np.float64("nan")), "dt_s of the track is nan"),
    "steps in between": (
        lambda d: edit_track(d, step=np.arange(8.0, 14.0)),
        "step of type float64, expected whole numbers",
    ),
    "other length": (lambda d: edit_track(d, brake=np.zeros(5)), r"brake of the track has shape \(5,\)"),
    "table": (lambda d: edit_track(d, yaw_rad=np.zeros((6, 1))), r"yaw_rad of the track has shape \(6, 1\)"),
    "words": (lambda d: edit_track(d, throttle=np.array(["a"] * 6)), "throttle: it is of type <U1, expected numbers"),
    "pickle": (lambda d: edit_track(d, x_m=np.array([Anything()] * 6)), "x_m: it is of type object"),
    "NaN": (lambda d: edit_track(d, y_m=np.full(6, np.nan)), "y_m of the track has NaN"),
    "other steps": (lambda d: edit_track(d, step=np.arange(11, 17)), "the track has no pose for frame 10"),
    "too much": (lambda d: edit_track(d, more=np.zeros(2**24, np.float32)), "unpacks to 671.* bytes, expected at most"),
    "too much claimed": (lambda d: claim(d / "track.npz", (10**15,)), "damaged"),
}


@pytest.mark.parametrize("name", TRACK_DAMAGE)
def test_a_damaged_track_is_named_in_one_line(saved_placed, name):
    damage, message = TRACK_DAMAGE[name]
    damage(saved_placed / "clean")
    with pytest.raises(RecordingError, match=f"clean/track.npz.*{message}") as caught:
        load_recordings(saved_placed)
    assert "\n" not in str(caught.value)


CANVAS_DAMAGE = {
    "no extent": {"width_m": None},
    "unknown field": {"height_m": 2.0},
    "NaN": {"x_m": float("nan")},
    "infinite": {"yaw_rad": float("-inf")},
    "beyond any float": {"y_m": 10**400},
    "word": {"length_m": "9.5"},
    "flat": {"length_m": 0.0},
}


@pytest.mark.parametrize("name", CANVAS_DAMAGE)
def test_a_canvas_that_cannot_lie_anywhere_is_refused_in_one_line(saved_placed, name):
    edit_canvas(saved_placed, **CANVAS_DAMAGE[name])
    with pytest.raises(
        RecordingError, match=r"recordings\.json(: canvas is| is not valid JSON| is incomplete or damaged \(canvas)"
    ) as caught:
        load_recordings(saved_placed)
    assert "\n" not in str(caught.value)


def test_a_canvas_is_a_table_of_numbers_or_nothing(saved_placed):
    edit_manifest(saved_placed, lambda m: m.update(canvas=[1, 2]))
    with pytest.raises(RecordingError, match=r"recordings\.json .*\(canvas: Expected `object \| null`, got `array`\)"):
        load_recordings(saved_placed)


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

    monkeypatch.setattr("roadproof.io.arrays.np.lib.format.write_array", full)
    with pytest.raises(OutputError, match="No space left"):
        save_recordings(recording_set(frames=3), saved.parent / "second")
    assert [path.name for path in saved.parent.iterdir()] == ["set"]


@pytest.mark.parametrize(
    "change", [lambda f: f[..., 0], lambda f: f / 255, lambda f: f.repeat(2, -1)], ids=["grey", "floats", "channels"]
)
def test_frames_that_are_no_pictures_in_colour_are_refused(tmp_path, change):
    drive = recording(Side.CLEAN, frames=2)
    message = r"drive clean: frames are .*, expected uint8 \(frames, h, w, 3\)"
    with pytest.raises(RecordingError, match=message):
        replace(drive, frames=change(drive.frames))
    save_recordings(replace(recording_set(), recordings=(drive,)), tmp_path / "set", compact=True)
    np.save(tmp_path / "set" / "clean" / "frames.npy", change(drive.frames))
    with pytest.raises(RecordingError, match=message):
        load_recordings(tmp_path / "set")


def test_two_drives_need_two_names():
    drive = recording(Side.CLEAN)
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
    assert [drive.weather for drive in both.recordings] == ["noon"] * 3 + ["rain"] * 3
    apart = both.by_weather()
    assert [[drive.name for drive in part.recordings] for part in apart] == [
        ["clean", "right", "left"], ["rain-clean", "rain-right", "rain-left"]
    ]  # fmt: skip
    known = replace(dry, recordings=tuple(replace(drive, weather="dusk") for drive in dry.recordings))
    assert pooled({"noon": known}).recordings[0].weather == "dusk"
    assert len(dry.by_weather()) == 1
    darker = replace(wet, colour=ColourTransform(AffineResponse(0.5 * torch.eye(3), torch.zeros(3))))
    with pytest.raises(RecordingError, match="the recordings rain have another camera, crop or colour"):
        pooled({"noon": dry, "rain": darker})
    with pytest.raises(RecordingError, match="at least one set"):
        pooled({})


def test_sets_are_pooled_only_where_the_canvas_lies_in_one_place():
    here = placed_set()
    both = pooled({"noon": here, "rain": placed_set(2)})
    assert both.canvas == CANVAS
    assert [drive.track is not None for drive in both.recordings] == [True, False, True] * 2
    for other in (replace(CANVAS, x_m=31.0), None):
        with pytest.raises(RecordingError, match=r"the recordings rain place the canvas at .* but the first at"):
            pooled({"noon": here, "rain": replace(here, canvas=other)})


def test_sets_are_pooled_only_where_the_same_is_known_of_the_road():
    here = placed_set()
    marked = replace(here, marks=(LaneMark(points_m=((0.0, 0.0), (0.0, 5.0))),))
    for other in (marked, replace(here, obstacles=())):
        with pytest.raises(
            RecordingError, match="the recordings rain have other lane marks or obstacles than the first"
        ):
            pooled({"noon": here, "rain": other})


def test_frames_are_kept_evenly_and_the_last_of_all():
    assert evenly(10, 4).tolist() == [0, 3, 6, 9]
    assert evenly(10, 1).tolist() == [9]
    assert evenly(3, 40).tolist() == [0, 1, 2]
