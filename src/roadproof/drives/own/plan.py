"""What drives.toml of a folder of your own says."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from roadproof.errors import RecordingError
from roadproof.geometry import CameraModel, CropResize
from roadproof.io.files import inside
from roadproof.io.tables import build
from roadproof.io.text import read_toml
from roadproof.lens import LensModel
from roadproof.recordings import Side
from roadproof.recordings.track import SHORTEST_S

PLAN = "drives.toml"


@dataclass(frozen=True, kw_only=True, slots=True)
class GroundPoint:
    """A ground point at a known place ahead of the car, and where the camera picture shows it.

    Args:
        x_px: column in the camera picture, px.
        y_px: row in the camera picture, px.
        ahead_m: distance ahead of the vehicle's origin, metres.
        left_m: distance to the left of the vehicle's origin, metres.
    """

    x_px: float
    y_px: float
    ahead_m: float
    left_m: float

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not abs(getattr(self, name)) < 1e6:
                told = f"{name} of a known point of the ground is {getattr(self, name)}"
                raise RecordingError(f"{told}, expected a finite number below 1e6")


@dataclass(frozen=True, kw_only=True, slots=True)
class Chessboard:
    """Pictures of a printed chessboard, which tell the field of view and the lens of the camera that took them.

    Args:
        pictures: folder of the pictures, in the folder of drives.toml; every PNG and JPEG there counts.
        corners: inner corners in a row of the board, and rows of them, 3 to 25 each: places where four squares meet.
        lens: kind of the lens.
    """

    pictures: str
    corners: tuple[int, int]
    lens: LensModel = "brown-conrady"

    def __post_init__(self) -> None:
        if not (min(self.corners) >= 3 and max(self.corners) <= 25):
            raise RecordingError(
                f"[chessboard] has corners {list(self.corners)}, expected 3 to 25 in a row and 3 to 25 rows: places "
                "where four squares meet, so that a board of 10 by 7 squares has [9, 6]"
            )


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnCanvas:
    """The road that may be painted, placed by a pose in the world or by a distance along the first drive.

    Args:
        width_m: extent across the road, metres.
        length_m: extent along the road, metres.
        ahead_m: driven distance of its middle from the first row of the first drive, metres; instead of a pose.
        x_m: world x of its middle, metres.
        y_m: world y of its middle, metres.
        yaw_rad: direction of travel, radians, left positive.
    """

    width_m: float = 7.6
    length_m: float = 9.5
    ahead_m: float | None = None
    x_m: float | None = None
    y_m: float | None = None
    yaw_rad: float | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnColour:
    """The colours of black and white paint as the pictures show them, such as those of a sheet of paper, in [0, 1].

    Args:
        black: RGB in which the pictures show black paint.
        white: RGB in which the pictures show white paint.
    """

    black: tuple[float, float, float] = (0.0, 0.0, 0.0)
    white: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnDrive:
    """One drive as drives.toml lists it.

    Args:
        name: name of the drive.
        table: file name of the drive's table, in the folder.
        side: side to which the drive was perturbed: clean, right, left or random.
        weather: name of the weather; empty if it is not known.
    """

    name: str
    table: str
    side: Side = Side.CLEAN
    weather: str = ""


@dataclass(frozen=True, kw_only=True, slots=True)
class OwnDrives:
    """The content of drives.toml.

    Args:
        dt_s: seconds from one row of a table to the next.
        camera: camera that took the pictures, and its place on the car.
        input: crop and resize that make the controller's input from the pictures.
        drive: the drives, one of which is clean.
        canvas: place of the canvas; None if the tables give its corners.
        colour: how black and white paint look in the pictures.
        chessboard: pictures of a chessboard to which the camera's field of view and lens are fitted; None if they are
            as `camera` states them.
        ground: known ground points to which the camera's height, pitch and field of view are fitted; the field of view
            stays where a chessboard tells it.
        origin: where the drives come from, in words.
    """

    dt_s: float
    camera: CameraModel
    input: CropResize
    drive: tuple[OwnDrive, ...]
    canvas: OwnCanvas | None = None
    colour: OwnColour = OwnColour()
    chessboard: Chessboard | None = None
    ground: tuple[GroundPoint, ...] = ()
    origin: str = ""

    def __post_init__(self) -> None:
        if not self.drive:
            raise RecordingError("there is no [[drive]], expected at least a clean one")
        camera = self.camera
        if not (camera.up_m > 0.0 and abs(camera.pitch_deg) < 90):
            raise RecordingError(
                f"the camera has up_m {camera.up_m:g}, pitch_deg {camera.pitch_deg:g}; expected above 0, and −90 to 90"
            )
        if camera.lens is not None and self.chessboard is not None:
            raise RecordingError("[camera.lens] and [chessboard] both tell the lens; leave one of them out")
        if not SHORTEST_S <= self.dt_s <= 1.0:
            raise RecordingError(f"dt_s is {self.dt_s:g}, expected {SHORTEST_S:g} to 1 seconds")


def read_plan(folder: Path) -> OwnDrives:
    """Read drives.toml of a folder.

    Raises:
        RecordingError: the file is missing or damaged, has an unknown key, or is a link that leads out of the folder.
    """
    path = inside(folder, PLAN, "plan", RecordingError)
    return build(OwnDrives, read_toml(path, RecordingError), str(path), RecordingError)
