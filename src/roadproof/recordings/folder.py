"""Recorded drives on disk: folders that explain themselves, checked when they are read.

    SET/recordings.json        what this is: format, version, units, camera, crop and resize, colour transform, the
                               canvas' place (null where it is not known), drives
    SET/DRIVE/drive.npz        per frame: frame number, homography, speed, command, steer
    SET/DRIVE/frames/N.png     the controller's input, unpainted; or all of them in SET/DRIVE/frames.npy
    SET/DRIVE/shading.npz      optional: gain, offset and visibility of every pixel (see `photometry.PixelMaps`)
    SET/DRIVE/track.npz        optional: poses and controls of the whole drive (see `recordings.Track`)

Nothing is pickled, and no path in a file leaves the folder.
"""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image

from roadproof.errors import ColourError, GeometryError, OutputError, RecordingError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CanvasPlacement, CropResize
from roadproof.io.arrays import read_archive, read_array, write_archive
from roadproof.io.files import inside, read_json, write_folder_atomically
from roadproof.io.pictures import read_picture
from roadproof.photometry import ColourTransform, PixelMaps, Response
from roadproof.recordings.recording import PER_FRAME, Push, Recording, RecordingSet
from roadproof.recordings.track import Track

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


_TRACK = tuple(field.name for field in fields(Track))


_AGAIN = "record or copy it again"


_MOST_TRACK_BYTES = 2**26
"""A day at 10 steps a second: a track.npz that unpacks to more was not written by roadproof."""


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
    per_frame: dict[str, Any] = {field: getattr(recording, field) for field in PER_FRAME}
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
    stored = read_archive(folder / "drive.npz", PER_FRAME, RecordingError, _AGAIN)
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
