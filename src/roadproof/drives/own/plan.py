"""What drives.toml of a folder of your own says."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

from roadproof.errors import RecordingError
from roadproof.geometry import CameraModel, CropResize
from roadproof.io.files import read_toml
from roadproof.io.records import RecordFile
from roadproof.recordings import Push

PLAN = "drives.toml"


@dataclass(frozen=True, kw_only=True, slots=True)
class GroundPoint:
    """A point of the ground whose place before the car is known, in the camera's picture.

    Args:
        x_px: column of the picture.
        y_px: row.
        ahead_m: before the vehicle's origin.
        left_m: to its left.
    """

    x_px: float
    y_px: float
    ahead_m: float
    left_m: float


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnCanvas:
    """Where may be painted: a place in the world of the poses, or so far along the way of the first drive.

    Args:
        width_m: extent across the road.
        length_m: extent along it.
        ahead_m: of its middle, from the first drive's first row along its way; instead of a place.
        x_m: of its middle.
        y_m: of its middle.
        yaw_rad: direction of travel.
    """

    width_m: float = 7.6
    length_m: float = 9.5
    ahead_m: float | None = None
    x_m: float | None = None
    y_m: float | None = None
    yaw_rad: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnColour:
    """How paint looks where it is: what is black and white on a sheet of paper, as the pictures have it, in [0, 1].

    Args:
        black: RGB of black paint.
        white: RGB of white paint.
    """

    black: tuple[float, float, float] = (0.0, 0.0, 0.0)
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnDrive:
    """One drive.

    Args:
        name: of the drive.
        table: file name of its table.
        push: whether it was pushed aside: clean, right, left or random.
        weather: what the light is called.
    """

    name: str
    table: str
    push: Push = Push.CLEAN
    weather: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnDrives:
    """drives.toml.

    Args:
        dt_s: seconds from one row of a table to the next.
        camera: of the pictures, and where it sits on the car.
        input: what the controller sees of them.
        drive: the drives; one of them clean.
        canvas: where may be painted; not needed where the tables give its corners.
        colour: how paint looks there.
        ground: known points, from which height, pitch and field of view of the camera are fitted; those stated are
            where the fit begins.
        origin: where the drives come from, in words.
    """

    dt_s: float
    camera: CameraModel
    input: CropResize
    drive: tuple[OwnDrive, ...]
    canvas: OwnCanvas | None = None
    colour: OwnColour = OwnColour()
    ground: tuple[GroundPoint, ...] = ()
    origin: str = ""

    def __post_init__(self) -> None:
        if not self.drive:
            raise RecordingError("there is no [[drive]], expected at least a clean one")


_FILE = RecordFile(kind=OwnDrives, error=RecordingError, remedy="see docs/recordings.md")


def read_plan(folder: Path) -> OwnDrives:
    """drives.toml of a folder.

    Raises:
        RecordingError: it is missing or damaged, or has an unknown key.
    """
    path = folder / PLAN
    content = read_toml(path, RecordingError)
    known = [each.name for each in fields(OwnDrives)]
    for key in content:
        if key not in known:
            raise RecordingError(f"{path} has an unknown key {key!r:.60}, expected {', '.join(known)}")
    return _FILE.made(path, content)
