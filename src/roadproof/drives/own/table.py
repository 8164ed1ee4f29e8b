"""The table of a drive: one row a step, dt_s apart.

column                    meaning                                                           needed
picture                   file of the camera's picture, relative to the folder; may be empty  yes
x_m, y_m, yaw_rad         pose of the vehicle's origin on the ground, yaw left positive     one
yaw_rate_rad_s            odometry with speed_mps, instead of poses                         of these
far_left_x … near_left_y  the canvas' four corners in the picture, px, instead of both      three, or none
speed_mps                 forward                                                           with the last two
steer                     in [−1, 1], positive to the right                                 yes
throttle, brake           in [0, 1]                                                         no: 0
command                   CARLA's codes                                                     no: 2, follow
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from roadproof.drives.own.plan import PLAN, OwnDrive
from roadproof.errors import RecordingError
from roadproof.io.files import inside, open_file
from roadproof.io.tables import first_twice

POSE = ("x_m", "y_m", "yaw_rad")
CORNERS = tuple(f"{corner}_{axis}" for corner in ("far_left", "far_right", "near_right", "near_left") for axis in "xy")
_COLUMNS = (*POSE, "yaw_rate_rad_s", *CORNERS, "speed_mps", "steer", "throttle", "brake", "command")
_MOST_BYTES = 2**26


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """The table of one drive.

    Args:
        drive: the drive as drives.toml lists it.
        pictures: file of each step's picture; empty for a step without one.
        numbers: columns of numbers by name, one value per step.
    """

    drive: OwnDrive
    pictures: tuple[str, ...]
    numbers: dict[str, Float[np.ndarray, " n"]]

    @property
    def pictured(self) -> Int[np.ndarray, " f"]:
        """Indices of the steps that have a picture."""
        return np.flatnonzero([bool(name) for name in self.pictures])

    @property
    def tells_no_place(self) -> bool:
        """Whether no column says where the car was, nor how it turned."""
        return not any(name in self.numbers for name in (*POSE, "yaw_rate_rad_s", *CORNERS))

    def column(self, name: str, usual: float = 0.0) -> Float[np.ndarray, " n"]:
        """The column of a name, or the `usual` value for every step if the table has no such column."""
        return self.numbers.get(name, np.full(len(self.pictures), usual))

    def needed(self, name: str) -> Float[np.ndarray, " n"]:
        """The column of a name that the table must have.

        Raises:
            RecordingError: the table has no such column.
        """
        if name not in self.numbers:
            raise RecordingError(f"{self.drive.table} has no column {name}; see docs/recordings.md")
        return self.numbers[name]


def read_table(folder: Path, drive: OwnDrive) -> Table:
    """Read the table of a drive.

    Raises:
        RecordingError: the file is missing, too long, no table or names no picture, or has an unknown column, one twice
            or a wrong number.
    """
    path = inside(folder, drive.table, f"{folder / PLAN}: table", RecordingError)
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise RecordingError(
                f"{path} has more than {_MOST_BYTES >> 20} MiB, expected a row a step; leave others out"
            )
        # Spreadsheets begin a file with a byte order mark.
        with open_file(path) as file:
            reader = csv.DictReader(io.TextIOWrapper(file, encoding="utf-8-sig", newline=""))
            rows = list(reader)
            names = list(reader.fieldnames or ())
    except OSError as reason:
        raise RecordingError(f"cannot read {path}: {reason.strerror or reason}; check the path") from None
    except (ValueError, csv.Error) as reason:
        raise RecordingError(f"{path} is no table of comma-separated values ({reason})") from None
    if (twice := first_twice(names)) is not None:
        raise RecordingError(f"{path} has two columns {twice!r:.60}, expected one of each name; leave one out")
    if (long := next((k for k, row in enumerate(rows, 1) if None in row), None)) is not None:
        raise RecordingError(f"{path}, row {long}: it has more cells than the {len(names)} columns; check its commas")
    if "picture" not in names or not rows:
        raise RecordingError(f"{path} has {len(rows)} rows and columns {', '.join(names)!r:.200}; expected one picture")
    pictures = tuple((row["picture"] or "").strip() for row in rows)
    if not any(pictures):
        raise RecordingError(f"{path} names no picture in {len(rows)} rows, expected one at least")
    numbers = {name: _numbers(path, name, rows) for name in names if name in _COLUMNS}
    unknown = [name for name in names if name not in _COLUMNS and name != "picture"]
    if unknown:
        raise RecordingError(f"{path} has a column {unknown[0]!r:.60}, expected {', '.join(('picture', *_COLUMNS))}")
    return Table(drive, pictures, numbers)


def _numbers(path: Path, name: str, rows: Sequence[dict[str, str]]) -> Float[np.ndarray, " n"]:
    found = np.empty(len(rows))
    for k, row in enumerate(rows):
        text = row[name]
        try:
            # Corners are known where there is a picture.
            found[k] = np.nan if name in CORNERS and not text and not row["picture"] else float(text)
        except (TypeError, ValueError):
            raise RecordingError(f"{path}, row {k + 1}: {name} is {text!r:.60}, expected a number") from None
        if np.isinf(found[k]) or (np.isnan(found[k]) and row["picture"]):
            raise RecordingError(f"{path}, row {k + 1}: {name} is {text!r:.60}, expected a finite number")
    return found
