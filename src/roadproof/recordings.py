"""Recorded drives on disk: folders that explain themselves, checked when they are read.

    SET/recordings.json        what this is: format, version, units, camera, crop and resize, colour transform, the
                               canvas' place (null where it is not known), drives
    SET/DRIVE/drive.npz        per frame: frame number, homography, speed, command, steer
    SET/DRIVE/frames/N.png     the controller's input, unpainted; or all of them in SET/DRIVE/frames.npy
    SET/DRIVE/shading.npz      optional: gain, offset and visibility of every pixel (see `photometry.PixelMaps`)
    SET/DRIVE/track.npz        optional: poses and controls of the whole drive (see `tracks.Track`)

Nothing is pickled, and no path in a file leaves the folder.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image

from roadproof.datatypes import Command
from roadproof.errors import ColourError, GeometryError, OutputError, RecordingError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CanvasPlacement, CropResize, check_image_from_canvas
from roadproof.io.arrays import read_archive, read_array, write_archive
from roadproof.io.files import check_name, inside, read_json, write_folder_atomically
from roadproof.io.pictures import read_picture
from roadproof.photometry import ColourTransform, PixelMaps, Response
from roadproof.tracks import FASTEST_MPS, Track

FORMAT = "roadproof-recordings"
FORMAT_VERSION = 1
_UNITS = {
    "frames": "RGB uint8, the controller's input, unpainted",
    "image_from_canvas": "homography, canvas px (x, y, 1) to camera px, pixel centres at integers, third > 0",
    "speed_mps": "m/s",
    "command": "2 follow, 3 left, 4 right, 5 straight",
    "steer": "in [-1, 1], positive = right: what the recorded controller answered to the frame",
    "canvas": "its middle and extents in m, yaw in rad: direction of travel, in a right-handed world with z up",
    "track": "steps numbered as frames, dt_s apart; x_m, y_m, yaw_rad (left positive) of the vehicle's origin in that "
    "world, speed in m/s; steer, throttle and brake as given at each step and held until the next",
}
_PER_FRAME = ("frame_number", "image_from_canvas", "speed_mps", "command", "steer")
_TRACK = tuple(field.name for field in fields(Track))
_AGAIN = "record or copy it again"
_MOST_TRACK_BYTES = 2**26
"""A day at 10 steps a second: a track.npz that unpacks to more was not written by roadproof."""


class Push(StrEnum):
    """How a drive was perturbed: not at all, to one side only, or at random."""

    CLEAN = "clean"
    LEFT = "left"
    RIGHT = "right"
    RANDOM = "random"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Recording:
    """One drive, as far as the canvas is in view.

    Args:
        name: names its folder.
        push: how it was perturbed.
        frames: the controller's input without any paint, (F, H, W, 3).
        frame_number: of each frame in the drive, rising.
        image_from_canvas: one homography a frame, canvas px to camera px.
        speed_mps: m/s, from −1 (rolling back) to `FASTEST_MPS`.
        command: CARLA's codes (`datatypes.Command`).
        steer: what the recorded controller answered to each frame, in [−1, 1]; for information.
        maps: per-pixel gain and offset of the paint, where they were calibrated; to the response of the set's colour.
        track: poses and controls of the whole drive, where they are known; its steps are numbered as the frames are.

    Raises:
        RecordingError: a frame has no pose in the track, lengths differ, a value is not finite or outside its range,
            or a homography is not a view of the canvas.
    """

    name: str
    push: Push
    frames: UInt8[np.ndarray, "f h w 3"]
    frame_number: Int[np.ndarray, "..."]
    image_from_canvas: Float[np.ndarray, "..."]
    speed_mps: Float[np.ndarray, "..."]
    command: Int[np.ndarray, "..."]
    steer: Float[np.ndarray, "..."]
    maps: PixelMaps | None = None
    track: Track | None = None

    def __post_init__(self) -> None:
        check_name(self.name, "drive", RecordingError)
        count = len(self.frames)
        if count == 0:
            raise RecordingError(f"drive {self.name} has no frames, expected at least one that shows the canvas")
        for field in _PER_FRAME:
            values: np.ndarray = getattr(self, field)
            tail = (3, 3) if field == "image_from_canvas" else ()
            if values.shape != (count, *tail):
                raise RecordingError(
                    f"drive {self.name}: {field} has shape {values.shape}, expected {(count, *tail)} for {count} frames"
                )
            bad = np.flatnonzero(~np.isfinite(values.reshape(count, -1)).all(1))
            if bad.size:
                number = self.frame_number[bad[0]]
                raise RecordingError(f"drive {self.name}: {field} of frame {number} is NaN or infinite; drop the frame")
        self._check_ranges()
        for number, homography in zip(self.frame_number, self.image_from_canvas, strict=True):
            try:
                check_image_from_canvas(homography)
            except GeometryError as error:
                raise RecordingError(f"drive {self.name}, frame {number}: {error}") from None
        if self.track is not None:
            try:
                self.track.rows(self.frame_number)
            except RecordingError as error:
                raise RecordingError(f"drive {self.name}: {error}") from None

    def _check_ranges(self) -> None:
        if self.frame_number[0] < 0 or (np.diff(self.frame_number.astype(np.int64)) < 1).any():
            raise RecordingError(f"drive {self.name}: frame numbers do not rise from 0; order its frames, each once")
        known = [int(command) for command in Command]
        for field, fits, expected in (
            ("command", np.isin(self.command, known), f"one of {', '.join(map(str, known))} ({_UNITS['command']})"),
            ("speed_mps", (self.speed_mps >= -1) & (self.speed_mps <= FASTEST_MPS), f"−1 to {FASTEST_MPS:g} m/s"),
            ("steer", np.abs(self.steer) <= 1, "−1 to 1"),
        ):
            for row in np.flatnonzero(~fits)[:1]:
                value, number = getattr(self, field)[row], self.frame_number[row]
                raise RecordingError(
                    f"drive {self.name}: {field} of frame {number} is {value}, expected {expected}; drop the frame"
                )

    def thinned(self, every: int) -> Recording:
        """Every n-th frame, counted back from the last one, which shows the canvas largest; the track stays whole."""
        frames = slice((len(self.frames) - 1) % every, None, every)
        maps = self.maps and PixelMaps(
            self.maps.gain[frames], self.maps.offset[frames], self.maps.visible[frames], self.maps.response
        )
        kept = {name: getattr(self, name)[frames] for name in ("frames", *_PER_FRAME)}
        return replace(self, maps=maps, **kept)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RecordingSet:
    """Drives of one scenario with one camera, one controller input and one colour transform.

    Args:
        camera: the camera on the car.
        view: how the controller's input is made from its picture.
        colour: painted → seen, common to all drives.
        recordings: the drives.
        origin: where they come from, in words.
        canvas: where it lies in the world of the tracks, where that is known.

    Raises:
        RecordingError: no drive, two of one name, or frames of another size than the controller's input.
    """

    camera: CameraModel
    view: CropResize
    colour: ColourTransform
    recordings: tuple[Recording, ...]
    origin: str = ""
    canvas: CanvasPlacement | None = None

    def __post_init__(self) -> None:
        if not self.recordings:
            raise RecordingError("the set has no drives, expected at least a clean one")
        names = [recording.name for recording in self.recordings]
        if len(set(names)) != len(names):
            raise RecordingError(f"two drives have the same name among {', '.join(names)}")
        for recording in self.recordings:
            height, width = recording.frames.shape[1:3]
            if (height, width) != (self.view.height_px, self.view.width_px):
                raise RecordingError(
                    f"drive {recording.name} has frames of {width}×{height}, "
                    f"expected {self.view.width_px}×{self.view.height_px} as the set's crop and resize make them"
                )

    @property
    def is_placed(self) -> bool:
        """Whether the set can be driven in: its canvas and the poses of all drives are known."""
        return self.canvas is not None and all(recording.track is not None for recording in self.recordings)


def pooled(sets: Mapping[str, RecordingSet]) -> RecordingSet:
    """The drives of several sets as one, such as the same drives in several weathers.

    Args:
        sets: by name; drives of all but the first are named after theirs.

    Raises:
        RecordingError: there is none, or one differs in camera, crop, colour transform or the place of the canvas;
            per-pixel maps may differ.
    """
    first, *others = sets.values() or (None,)
    if first is None:
        raise RecordingError("there are no recordings to pool, expected at least one set")
    drives = list(first.recordings)
    for name, each in list(sets.items())[1:]:
        if (each.camera, each.view, each.colour.to_dict()) != (first.camera, first.view, first.colour.to_dict()):
            raise RecordingError(f"the recordings {name} have another camera, crop or colour transform than the first")
        if each.canvas != first.canvas:
            raise RecordingError(
                f"the recordings {name} place the canvas at {each.canvas}, but the first at {first.canvas}; "
                "expected one place for all"
            )
        drives += [replace(drive, name=f"{name}-{drive.name}") for drive in each.recordings]
    origin = "; ".join(each.origin for each in (first, *others))
    return replace(first, recordings=tuple(drives), origin=origin)


def save_recordings(recordings: RecordingSet, folder: Path, *, compact: bool = False) -> None:
    """Write a set to a new folder, all or nothing.

    Args:
        recordings: the set.
        folder: must not exist yet, or be empty.
        compact: one frames.npy a drive instead of a PNG a frame.

    Raises:
        OutputError: the folder is there already, or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder} exists already; choose a new folder for the recordings")

    def write(part: Path) -> None:
        for recording in recordings.recordings:
            _write_drive(recording, part / recording.name, compact=compact)
        (part / "recordings.json").write_text(json.dumps(_manifest(recordings), indent=1, ensure_ascii=False) + "\n")

    write_folder_atomically(folder, write)


def _manifest(recordings: RecordingSet) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "origin": recordings.origin,
        "units": _UNITS,
        "canvas_px": CANVAS_SIZE_PX,
        "camera": asdict(recordings.camera),
        "crop_resize": asdict(recordings.view),
        "colour": recordings.colour.to_dict(),
        "canvas": recordings.canvas and asdict(recordings.canvas),
        "drives": [
            {"name": recording.name, "push": str(recording.push), "frames": len(recording.frames)}
            for recording in recordings.recordings
        ],
    }


def _write_drive(recording: Recording, folder: Path, *, compact: bool) -> None:
    folder.mkdir()
    per_frame: dict[str, Any] = {field: getattr(recording, field) for field in _PER_FRAME}
    write_archive(folder / "drive.npz", per_frame)
    if recording.track is not None:
        write_archive(folder / "track.npz", asdict(recording.track))
    if recording.maps is not None:
        maps = recording.maps
        write_archive(
            folder / "shading.npz",
            {"gain": maps.gain.numpy(), "offset": maps.offset.numpy(), "visible": maps.visible.numpy()},
        )
    if compact:
        np.save(folder / "frames.npy", recording.frames, allow_pickle=False)
        return
    (folder / "frames").mkdir()
    for number, frame in zip(recording.frame_number, recording.frames, strict=True):
        Image.fromarray(frame).save(folder / "frames" / f"{number}.png")


def load_recordings(folder: Path) -> RecordingSet:
    """Read and check a set of recorded drives.

    Raises:
        RecordingError: the folder or a part of it is missing, damaged or inconsistent; the message names it.
    """
    if not folder.is_dir():
        raise RecordingError(f"no folder {folder}; expected a set of recordings with a recordings.json")
    if not (folder / "recordings.json").is_file():
        raise RecordingError(f"{folder} has no recordings.json; expected a set of recordings made by roadproof")
    manifest = read_json(folder / "recordings.json", FORMAT, FORMAT_VERSION, RecordingError)
    size = manifest.get("canvas_px", CANVAS_SIZE_PX)
    if size != CANVAS_SIZE_PX:
        raise RecordingError(
            f"{folder / 'recordings.json'}: canvas_px is {size!r:.60}, expected {CANVAS_SIZE_PX}; scale homographies"
        )
    try:
        colour = ColourTransform.from_dict(manifest["colour"])
        return RecordingSet(
            camera=CameraModel(**manifest["camera"]),
            view=CropResize(**manifest["crop_resize"]),
            colour=colour,
            recordings=tuple(_read_drive(folder, drive, colour.response) for drive in manifest["drives"]),
            origin=str(manifest.get("origin", "")),
            canvas=_read_canvas(folder / "recordings.json", manifest.get("canvas")),
        )
    except (KeyError, TypeError) as error:
        raise RecordingError(f"{folder / 'recordings.json'} is incomplete or has an unknown field: {error}") from None
    except (ColourError, GeometryError) as error:
        raise RecordingError(f"{folder / 'recordings.json'}: {error}") from None


def _read_canvas(path: Path, stored: object) -> CanvasPlacement | None:
    if stored is None:
        return None
    names = [field.name for field in fields(CanvasPlacement)]
    values = cast("dict[str, Any]", stored) if isinstance(stored, dict) else {}
    # Python's JSON reads NaN, Infinity and integers that no float holds.
    numbers = {
        name: float(value) for name, value in values.items() if isinstance(value, int | float) and abs(value) < 1e9
    }
    if set(values) != set(names) or len(numbers) != len(names):
        raise RecordingError(f"{path}: canvas is {stored!r:.200}, expected finite numbers for {', '.join(names)}")
    return CanvasPlacement(**numbers)


def _read_drive(root: Path, drive: dict[str, Any], response: Response) -> Recording:
    name = drive["name"]
    folder = inside(root, name, f"{root / 'recordings.json'}: drive", RecordingError)
    if not folder.is_dir():
        raise RecordingError(f"drive {name} is listed in recordings.json but {folder} is missing")
    try:
        push = Push(drive["push"])
    except ValueError:
        raise RecordingError(f"drive {name} has push {drive['push']!r}, expected one of {', '.join(Push)}") from None
    stored = read_archive(folder / "drive.npz", _PER_FRAME, RecordingError, _AGAIN)
    for field in ("frame_number", "command"):
        if stored[field].dtype.kind not in "iu":
            raise RecordingError(f"drive {name}: {field} is of type {stored[field].dtype}, expected whole numbers")
    return Recording(
        name=name,
        push=push,
        frames=_read_frames(folder, stored["frame_number"]),
        frame_number=stored["frame_number"],
        image_from_canvas=stored["image_from_canvas"].astype(np.float64),
        speed_mps=stored["speed_mps"].astype(np.float64),
        command=stored["command"],
        steer=stored["steer"].astype(np.float64),
        maps=_read_maps(folder / "shading.npz", response),
        track=_read_track(folder / "track.npz", stored["frame_number"]),
    )


def _read_track(path: Path, frame_number: np.ndarray) -> Track | None:
    if not path.exists():
        return None
    stored = read_archive(path, _TRACK, RecordingError, _AGAIN, most_bytes=_MOST_TRACK_BYTES)
    dt_s, step = stored.pop("dt_s"), stored.pop("step")
    if dt_s.shape != () or step.dtype.kind not in "iu":
        raise RecordingError(
            f"{path} has dt_s of shape {dt_s.shape} and steps of type {step.dtype}, expected one number and integers"
        )
    try:
        values = {name: array.astype(np.float64) for name, array in stored.items()}
        track = Track(dt_s=float(dt_s), step=step.astype(np.int64), **values)
        track.rows(frame_number)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None
    return track


def _read_maps(path: Path, response: Response) -> PixelMaps | None:
    if not path.exists():
        return None
    gain, offset, visible = read_archive(path, ("gain", "offset", "visible"), RecordingError, _AGAIN).values()
    try:
        return PixelMaps(torch.tensor(gain), torch.tensor(offset), torch.tensor(visible), response)
    except ColourError as error:
        raise RecordingError(f"{path}: {error}") from None


def _read_frames(folder: Path, numbers: np.ndarray) -> UInt8[np.ndarray, "f h w 3"]:
    if (folder / "frames.npy").exists():
        frames = read_array(folder / "frames.npy", RecordingError, _AGAIN)
        if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[-1] != 3:
            raise RecordingError(
                f"{folder / 'frames.npy'} is {frames.dtype} of shape {frames.shape}, expected uint8 (frames, h, w, 3)"
            )
        return frames
    pictures = (folder / "frames" / f"{number}.png" for number in numbers)
    frames = [read_picture(path, RecordingError, _AGAIN) for path in pictures]
    sizes = {frame.shape[1::-1] for frame in frames}
    if len(sizes) > 1:
        raise RecordingError(f"{folder / 'frames'} has pictures of different sizes: {sorted(sizes)}")
    return np.stack(frames)
