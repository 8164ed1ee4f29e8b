"""Recorded drives on disk: folders that explain themselves, checked when they are read.

    SET/recordings.json        what this is: format, version, units, camera, crop and resize, colour transform, the
                               canvas' place, the lane marks on it and what stands beside it (null where they are
                               not known), drives
    SET/DRIVE/drive.npz        per frame: frame number, homography, speed, command, steer
    SET/DRIVE/frames/N.png     the controller's input, unpainted; or all of them in SET/DRIVE/frames.npy
    SET/DRIVE/shading.npz      optional: gain, offset and visibility of every pixel (see `photometry.PixelMaps`)
    SET/DRIVE/track.npz        optional: poses and controls of the whole drive (see `recordings.Track`)

Nothing is pickled, and no path in a file leaves the folder.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from roadproof.datatypes import Obstacle
from roadproof.errors import ColourError, OutputError, RecordingError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CanvasPlacement, CropResize
from roadproof.io.arrays import read_archive, read_array, write_archive
from roadproof.io.files import AnyPath, as_path, check_closed, inside, write_folder_atomically
from roadproof.io.pictures import read_picture
from roadproof.io.records import Form, RecordFile
from roadproof.paint.site import LaneMark
from roadproof.photometry import ColourTransform, PixelMaps
from roadproof.recordings.recording import Recording, RecordingSet, Side
from roadproof.recordings.track import Track

_UNITS = {
    "frames": "RGB uint8, the controller's input, unpainted",
    "image_from_canvas": "homography, canvas px (x, y, 1) to camera px, pixel centres at integers, third > 0; where "
    "the camera has a lens, to those of a pinhole of its focal length",
    "speed_mps": "m/s",
    "command": "2 follow, 3 left, 4 right, 5 straight",
    "steer": "in [-1, 1], positive = right: what the recorded controller answered to the frame",
    "canvas": "its middle and extents in m, yaw in rad: direction of travel, in a right-handed world with z up",
    "marks": "middle lines in m on the canvas, x from its left edge, y from its far edge; width in m, paint as #rrggbb",
    "obstacles": "boxes on the ground in that world, m; yaw in rad: the direction of their length, left positive",
    "track": "steps numbered as frames, dt_s apart; x_m, y_m, yaw_rad (left positive) of the vehicle's origin in that "
    "world, speed in m/s; steer, throttle and brake as given at each step and held until the next",
}


_AGAIN = "record or copy it again"
_MOST_TRACK_BYTES = 2**26
"""A day at 10 steps a second: a track.npz that unpacks to more was not written by roadproof."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Drive:
    """A drive as recordings.json lists it."""

    name: str
    side: Side
    frames: int = 0
    weather: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Manifest:
    """The content of recordings.json."""

    origin: str = ""
    canvas_px: int = CANVAS_SIZE_PX
    camera: CameraModel
    crop_resize: CropResize
    colour: ColourTransform
    canvas: CanvasPlacement | None = None
    marks: tuple[LaneMark, ...] | None = None
    obstacles: tuple[Obstacle, ...] | None = None
    drives: tuple[_Drive, ...]

    def __post_init__(self) -> None:
        if self.canvas_px != CANVAS_SIZE_PX:
            raise RecordingError(f"canvas_px is {self.canvas_px}, expected {CANVAS_SIZE_PX}; scale homographies")


def _canvas(stated: dict[str, float] | None) -> CanvasPlacement | None:
    names = [each.name for each in fields(CanvasPlacement)]
    if stated is None:
        return None
    if set(stated) != set(names):
        raise RecordingError(f"canvas is {stated!r:.200}, expected finite numbers for {', '.join(names)}")
    return CanvasPlacement(**stated)


_MANIFEST = RecordFile(
    kind=_Manifest,
    name="roadproof-recordings",
    error=RecordingError,
    remedy=_AGAIN,
    forms={
        "camera": Form(CameraModel, lambda camera: camera.stated, lambda camera: camera),
        "colour": Form(dict[str, Any], ColourTransform.to_dict, ColourTransform.from_dict),
        "canvas": Form(dict[str, float] | None, lambda canvas: canvas, _canvas),
    },
    notes={"units": _UNITS},
)
_PER_FRAME = RecordFile(
    kind=Recording,
    error=RecordingError,
    remedy=_AGAIN,
    elsewhere=("name", "side", "frames", "maps", "track", "weather"),
    header=None,
    most_bytes=_MOST_TRACK_BYTES,
)
_TRACK = RecordFile(kind=Track, error=RecordingError, remedy=_AGAIN, header=None, most_bytes=_MOST_TRACK_BYTES)


def check_free(folder: Path) -> None:
    """See that recordings can be written to a folder, before they are made.

    Raises:
        OutputError: the folder is there already, and not empty.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder} exists already; choose a new folder for the recordings")


def save_recordings(recordings: RecordingSet, folder: AnyPath, *, compact: bool = False) -> None:
    """Write a set to a new folder, all or nothing.

    Args:
        recordings: the set to write.
        folder: path of the folder, which must not exist yet or be empty.
        compact: whether to write one frames.npy per drive instead of one PNG per frame.

    Raises:
        OutputError: the folder is there already, or cannot be written.
    """
    folder = as_path(folder)
    check_free(folder)

    def write(part: Path) -> None:
        for recording in recordings.recordings:
            _write_drive(recording, part / recording.name, compact=compact)
        manifest = _Manifest(
            origin=recordings.origin,
            camera=recordings.camera,
            crop_resize=recordings.view,
            colour=recordings.colour,
            canvas=recordings.canvas,
            marks=recordings.marks,
            obstacles=recordings.obstacles,
            drives=tuple(
                _Drive(name=each.name, side=each.side, frames=len(each.frames), weather=each.weather)
                for each in recordings.recordings
            ),
        )
        _MANIFEST.write(part / "recordings.json", manifest)

    write_folder_atomically(folder, write)


def _write_drive(recording: Recording, folder: Path, *, compact: bool) -> None:
    folder.mkdir()
    _PER_FRAME.write(folder / "drive.npz", recording)
    if recording.track is not None:
        _TRACK.write(folder / "track.npz", recording.track)
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


def stated_weather(folder: AnyPath) -> str:
    """The weather that the drives of a set say they were recorded in; empty where they say none, or several.

    Raises:
        RecordingError: the folder's recordings.json is missing or damaged.
    """
    weathers = {drive.weather for drive in _MANIFEST.read(as_path(folder) / "recordings.json").drives}
    return weathers.pop() if len(weathers) == 1 else ""


def load_recordings(folder: AnyPath) -> RecordingSet:
    """Read and check a set of recorded drives.

    Raises:
        RecordingError: the folder or a part of it is missing, damaged or inconsistent; the message names it.
    """
    folder = as_path(folder)
    if not folder.is_dir():
        raise RecordingError(f"no folder {folder}; expected a set of recordings with a recordings.json")
    if not (folder / "recordings.json").is_file():
        raise RecordingError(f"{folder} has no recordings.json; expected a set of recordings made by roadproof")
    check_closed(folder, RecordingError)
    manifest = _MANIFEST.read(folder / "recordings.json")
    return RecordingSet(
        camera=manifest.camera,
        view=manifest.crop_resize,
        colour=manifest.colour,
        recordings=tuple(_read_drive(folder, drive, manifest.crop_resize) for drive in manifest.drives),
        origin=manifest.origin,
        canvas=manifest.canvas,
        marks=manifest.marks,
        obstacles=manifest.obstacles,
    )


def _read_drive(root: Path, drive: _Drive, view: CropResize) -> Recording:
    folder = inside(root, drive.name, f"{root / 'recordings.json'}: drive", RecordingError)
    if not folder.is_dir():
        raise RecordingError(f"drive {drive.name} is listed in recordings.json but {folder} is missing")
    content = _PER_FRAME.content(folder / "drive.npz")
    numbers: np.ndarray = content["frame_number"]
    if numbers.ndim != 1:
        told = f"frame_number has shape {numbers.shape}, expected a number for each frame"
        raise RecordingError(f"{folder / 'drive.npz'}: {told}; {_AGAIN}")
    return _PER_FRAME.made(
        folder / "drive.npz",
        content,
        name=drive.name,
        side=drive.side,
        frames=_read_frames(folder, numbers, view),
        maps=_read_maps(folder / "shading.npz"),
        track=_read_track(folder / "track.npz", numbers),
        weather=drive.weather,
    )


def _read_track(path: Path, frame_number: np.ndarray) -> Track | None:
    if not path.exists():
        return None
    track = _TRACK.read(path)
    try:
        track.rows(frame_number)
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None
    return track


def _read_maps(path: Path) -> PixelMaps | None:
    if not path.exists():
        return None
    maps = read_archive(path, ("gain", "offset", "visible"), RecordingError, _AGAIN).values()
    try:
        return PixelMaps(*(torch.from_numpy(np.asarray(each, np.float32)) for each in maps))
    except ColourError as error:
        raise RecordingError(f"{path}: {error}") from None


def _read_frames(folder: Path, numbers: np.ndarray, view: CropResize) -> np.ndarray:
    if (folder / "frames.npy").exists():
        return read_array(folder / "frames.npy", RecordingError, _AGAIN)
    pictures = (folder / "frames" / f"{number}.png" for number in numbers)
    size = view.width_px, view.height_px
    frames = [read_picture(path, RecordingError, _AGAIN, size=size) for path in pictures]
    return np.stack(frames) if frames else np.empty((0, view.height_px, view.width_px, 3), np.uint8)
