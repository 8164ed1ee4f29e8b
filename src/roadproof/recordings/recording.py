"""Recorded drives past a canvas, as a search takes them: frames, homographies, colours, and where the car was."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from roadproof.datatypes import Command, Obstacle
from roadproof.errors import GeometryError, RecordingError
from roadproof.geometry import CameraModel, CanvasPlacement, CropResize
from roadproof.homographies import check_image_from_canvas
from roadproof.io.files import check_name
from roadproof.io.identity import digest
from roadproof.io.records import plain
from roadproof.paint.site import LaneMark
from roadproof.photometry import ColourTransform, PixelMaps
from roadproof.recordings.track import FASTEST_MPS, Track

PER_FRAME = ("frame_number", "image_from_canvas", "speed_mps", "command", "steer")
"""Arrays of a recording with one row a frame, besides its frames."""


class Side(StrEnum):
    """The side to which a drive was perturbed: none, one only, or both at random."""

    CLEAN = "clean"
    LEFT = "left"
    RIGHT = "right"
    RANDOM = "random"


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Recording:
    """One drive, as far as the canvas is in view.

    Args:
        name: name of the drive and of its folder.
        side: side to which the drive was perturbed.
        frames: the controller's input without any paint, RGB uint8, (F, H, W, 3).
        frame_number: number of each frame's step in the drive, rising, (F,).
        image_from_canvas: one homography per frame, canvas px to camera px, (F, 3, 3).
        speed_mps: speed at each frame, m/s, from −1 (rolling back) to `FASTEST_MPS`, (F,).
        command: what the route asks at each frame, in CARLA's codes (`datatypes.Command`), (F,).
        steer: what the recorded controller answered to each frame, in [−1, 1], (F,); for information.
        maps: gain and offset of the paint in every pixel, for the response of the set's colour; None if not calibrated.
        track: poses and controls of the whole drive, its steps numbered as the frames are; None if they are not known.
        weather: name of the weather that the drive was recorded in; empty if it is not known.

    Raises:
        RecordingError: a frame has no pose in the track, lengths or shapes differ, a value is not finite or outside its
            range, or a homography is not a view of the canvas.
    """

    name: str
    side: Side
    frames: Shaped[np.ndarray, "..."]
    frame_number: Int[np.ndarray, "..."]
    image_from_canvas: Float[np.ndarray, "..."]
    speed_mps: Float[np.ndarray, "..."]
    command: Int[np.ndarray, "..."]
    steer: Float[np.ndarray, "..."]
    maps: PixelMaps | None = None
    track: Track | None = None
    weather: str = ""

    def __post_init__(self) -> None:
        check_name(self.name, "drive", RecordingError)
        frames = self.frames
        if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3:
            told = f"drive {self.name}: frames are {frames.dtype} of shape {frames.shape}"
            raise RecordingError(f"{told}, expected uint8 (frames, h, w, 3)")
        count = len(frames)
        if count == 0:
            raise RecordingError(f"drive {self.name} has no frames, expected at least one that shows the canvas")
        for field in PER_FRAME:
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
        if self.maps is not None and self.maps.gain.shape != self.frames.shape:
            raise RecordingError(
                f"drive {self.name}: its pixel maps (shading.npz) have shape {tuple(self.maps.gain.shape)}, expected "
                f"that of its frames, {self.frames.shape}; drop the same frames from both, or calibrate it again"
            )
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
            (
                "command",
                np.isin(self.command, known),
                f"one of {', '.join(map(str, known))} (2 follow, 3 left, 4 right, 5 straight)",
            ),
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
        maps = self.maps and self.maps.at(frames)
        kept = {name: getattr(self, name)[frames] for name in ("frames", *PER_FRAME)}
        return replace(self, maps=maps, **kept)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RecordingSet:
    """Drives of one scenario with one camera, one controller input and one colour transform.

    Args:
        camera: camera on the car.
        view: crop and resize that make the controller's input from the camera picture.
        colour: colour transform from painted to seen, common to all drives.
        recordings: recordings of the drives, at least one, each with a name of its own.
        origin: where the drives come from, in words.
        canvas: place of the canvas in the world of the tracks; None if it is not known.
        marks: lane marks on the canvas and near it; None if they are not known.
        obstacles: what a car could run into near the canvas, in the world of the tracks; None if it is not known.

    Raises:
        RecordingError: there is no drive, two have one name, the controller's input is cut from beyond the camera
            picture, frames have another size than it, or only some drives have pixel maps.
    """

    camera: CameraModel
    view: CropResize
    colour: ColourTransform
    recordings: tuple[Recording, ...]
    origin: str = ""
    canvas: CanvasPlacement | None = None
    marks: tuple[LaneMark, ...] | None = None
    obstacles: tuple[Obstacle, ...] | None = None

    def __post_init__(self) -> None:
        if not self.recordings:
            raise RecordingError("the set has no drives, expected at least a clean one")
        names = [recording.name for recording in self.recordings]
        if len(set(names)) != len(names):
            raise RecordingError(f"two drives have the same name among {', '.join(names)}")
        if self.view.right_px > self.camera.width_px or self.view.bottom_px > self.camera.height_px:
            raise RecordingError(
                f"frames are cut up to column {self.view.right_px} and row {self.view.bottom_px} of camera pictures of "
                f"{self.camera.width_px}×{self.camera.height_px} pixels; expected a box inside them"
            )
        for recording in self.recordings:
            height, width = recording.frames.shape[1:3]
            if (height, width) != (self.view.height_px, self.view.width_px):
                raise RecordingError(
                    f"drive {recording.name} has frames of {width}×{height}, "
                    f"expected {self.view.width_px}×{self.view.height_px} as the set's crop and resize make them"
                )
        without = [recording.name for recording in self.recordings if recording.maps is None]
        if 0 < len(without) < len(names):
            raise RecordingError(
                f"drive {without[0]} has no pixel maps (shading.npz), other drives have some, and one colour cannot "
                "stand for both; calibrate it again, or leave it out"
            )

    @property
    def clean(self) -> Recording | None:
        """The first drive that was not perturbed; None if there is none."""
        return next((each for each in self.recordings if each.side is Side.CLEAN), None)

    @property
    def has_both_sides(self) -> bool:
        """Whether drives were perturbed to the left and to the right."""
        return {Side.LEFT, Side.RIGHT} <= {recording.side for recording in self.recordings}

    @property
    def is_placed(self) -> bool:
        """Whether the set can be driven in: its canvas and the poses of all drives are known."""
        return self.canvas is not None and all(recording.track is not None for recording in self.recordings)

    def digest(self) -> str:
        """SHA-256 of what a drive in these recordings depends on, not marks; the same for a set that was loaded."""
        told = _as_read((self.camera, self.view, self.colour.to_dict(), self.canvas, self.obstacles))
        contents: list[str | np.ndarray] = []
        for drive in self.recordings:
            contents.append(f"{drive.side} {drive.weather}")
            small = [getattr(drive, name) for name in PER_FRAME]
            small += [] if drive.track is None else [getattr(drive.track, field.name) for field in fields(drive.track)]
            large: list[Any] = [drive.frames]
            large += [] if drive.maps is None else [drive.maps.gain, drive.maps.offset, drive.maps.visible]
            contents += [*(np.asarray(each, np.float64) for each in small), *map(np.asarray, large)]
        return digest(told, *contents)

    def marks_digest(self) -> str:
        """SHA-256 of the lane marks, which limits on paint depend on; the same for a set that was loaded."""
        return digest(_as_read(self.marks))

    def by_weather(self) -> tuple[RecordingSet, ...]:
        """The drives of each weather as a set of their own, in the order of their first drives."""
        found: dict[str, list[Recording]] = {}
        for recording in self.recordings:
            found.setdefault(recording.weather, []).append(recording)
        return tuple(replace(self, recordings=tuple(some)) for some in found.values())


def _as_read(told: object) -> str:
    """Values as they are in a file: a number that was given as an integer is read as a float."""
    return repr(json.loads(json.dumps(plain(told)), parse_int=float))


def pooled(sets: Mapping[str, RecordingSet]) -> RecordingSet:
    """The drives of several sets as one, such as the same drives in several weathers.

    Args:
        sets: sets by name, such as the weather; drives of all but the first are named after their set, and drives of
            unknown weather get its name as their weather.

    Raises:
        RecordingError: there is no set, or one differs in camera, crop, colour transform, place of the canvas, lane
            marks or obstacles; per-pixel maps may differ.
    """
    first = next(iter(sets.values()), None)
    if first is None:
        raise RecordingError("there are no recordings to pool, expected at least one set")
    drives: list[Recording] = []
    for number, (name, each) in enumerate(sets.items()):
        if (each.camera, each.view, each.colour.to_dict()) != (first.camera, first.view, first.colour.to_dict()):
            raise RecordingError(f"the recordings {name} have another camera, crop or colour transform than the first")
        if each.canvas != first.canvas:
            raise RecordingError(
                f"the recordings {name} place the canvas at {each.canvas}, but the first at {first.canvas}; "
                "expected one place for all"
            )
        if (each.marks_digest(), each.obstacles) != (first.marks_digest(), first.obstacles):
            raise RecordingError(f"the recordings {name} have other lane marks or obstacles than the first")
        before = f"{name}-" if number else ""
        drives += [replace(drive, name=before + drive.name, weather=drive.weather or name) for drive in each.recordings]
    origin = "; ".join(each.origin for each in sets.values())
    return replace(first, recordings=tuple(drives), origin=origin)


def evenly(count: int, most: int) -> Int[np.ndarray, " f"]:
    """Indices of at most `most` of `count` frames, evenly spread, the first and the last included; of one, the last."""
    first = 0 if most > 1 else count - 1
    return np.unique(np.linspace(first, count - 1, min(most, count)).round().astype(int))
