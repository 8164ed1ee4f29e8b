"""Drives that you recorded yourself, as recordings: a folder of pictures with a table of what the car did.

FOLDER/drives.toml    what is common to all drives (`own.plan`)
FOLDER/TABLE.csv      what a drive was, step by step (`own.table`)
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from PIL import Image, ImageDraw

from roadproof.drives.own.boards import boards_in
from roadproof.drives.own.chessboard import calibrated
from roadproof.drives.own.motion import motion_of
from roadproof.drives.own.pictures import camera_picture
from roadproof.drives.own.place import canvas_on, check_passes, fitted_camera, track_of
from roadproof.drives.own.plan import PLAN, OwnColour, OwnDrives, read_plan
from roadproof.drives.own.table import CORNERS, POSE, Table, read_table
from roadproof.drives.record import in_view
from roadproof.drives.trajectories import Window
from roadproof.errors import GeometryError, RecordingError
from roadproof.geometry import CANVAS_CORNERS_PX, homography_from_pose
from roadproof.homographies import Homography, apply_homography, homogeneous, homography_from_points
from roadproof.io.files import AnyPath, as_path
from roadproof.photometry import AffineResponse, ColourTransform
from roadproof.recorded import placed
from roadproof.recorded.poses import odd_ratio
from roadproof.recordings import Recording, RecordingSet, Side, Track, evenly
from roadproof.recordings.recording import PER_FRAME

_LEAST_MPS = 1.0
"""Slower cars do not tell whether a stated speed is that of the pictures."""
WINDOW = Window(frames=40, least_px=8)
"""Frames that are kept of a drive, as a recording for the recorded world has them."""

_CORNERS_PX = CANVAS_CORNERS_PX[:, :2]


def import_drives(folder: AnyPath) -> RecordingSet:
    """Recordings from pictures and tables of your own; see docs/recordings.md for what is in the folder.

    Poses come from the table; or from speed and yaw rate, for one drive alone, whose first row is then the world's
    origin; or, for one drive alone too, from how the ground moves in its pictures (`own.motion`); or from the canvas'
    corners in each picture. Of each drive at most `WINDOW.frames` frames are kept.

    Args:
        folder: path of a folder with drives.toml, the tables and the pictures.

    Returns:
        A set with canvas and tracks, which can be attacked and driven in.

    Raises:
        RecordingError: a file is missing or damaged, a column is missing or has no number, poses jump, the canvas is
            not in view or not reached, or known points or chessboards do not agree with the camera; the message names
            it.
    """
    folder = as_path(folder)
    own = read_plan(folder)
    tables = [read_table(folder, drive) for drive in own.drive]
    columns = {name for table in tables for name in table.numbers}
    if columns & {*CORNERS} and (own.canvas is not None or columns & {*POSE, "yaw_rate_rad_s"}):
        raise RecordingError(
            f"the canvas' corners in the tables say where it is and where the car was: leave out [canvas] of {PLAN}, "
            "poses and yaw rates, or the corners"
        )
    given: dict[str, Any] = {
        "view": own.input,
        "colour": _colour(own.colour),
        "origin": own.origin or f"imported from {folder.name}",
    }
    own, told = _with_camera(folder, own)
    given |= {"camera": own.camera, "origin": given["origin"] + told}
    if len(tables) == 1 and tables[0].tells_no_place:
        tables, agreed = _with_motion(folder, own, tables[0])
        given["origin"] += f"; speed and yaw rate seen in {agreed}"
    cornered = all(name in table.numbers for table in tables for name in CORNERS)
    whole = (_from_corners if cornered else _from_poses)(own, tables, given)
    drives = zip(tables, whole.recordings, strict=True)
    return replace(whole, recordings=tuple(_with_pictures(folder, own, *each) for each in drives))


def _with_camera(folder: Path, own: OwnDrives) -> tuple[OwnDrives, str]:
    """The plan with the camera that chessboards and known points tell, and what chessboards say of it."""
    camera, told = own.camera, ""
    if own.chessboard is not None:
        found = calibrated(camera, boards_in(folder, camera, own.chessboard), own.chessboard.lens)
        camera, told = found.camera, f"; {found}"
    camera = fitted_camera(camera, own.ground, fov_known=own.chessboard is not None)
    return replace(own, camera=camera, chessboard=None), told


def _with_motion(folder: Path, own: OwnDrives, table: Table) -> tuple[list[Table], str]:
    table.needed("steer")
    if len(table.pictured) < len(table.pictures):
        raise RecordingError(
            f"{table.drive.table} has {len(table.pictured)} pictures in {len(table.pictures)} rows, expected one in "
            "each to see the vehicle's motion in them; or give poses, or speed_mps and yaw_rate_rad_s"
        )
    names = table.pictures
    try:
        seen = motion_of(own.camera, own.input, lambda k: _picture(folder, own, names[k]), len(names), own.dt_s)
    except RecordingError as error:
        raise RecordingError(f"{table.drive.table}: {error}") from None
    stated = table.numbers.get("speed_mps")
    if stated is not None and (ratio := odd_ratio(seen.speed_mps, stated, _LEAST_MPS)) is not None:
        raise RecordingError(
            f"{table.drive.table}: the ground in the pictures moves {ratio:.2f} times as fast as speed_mps says, "
            "expected about 1; check its unit, dt_s, and how high the camera is"
        )
    found = {"speed_mps": seen.speed_mps, "yaw_rate_rad_s": seen.yaw_rate_rad_s}
    low, median = np.percentile(seen.correlation, [5, 50])
    agreed = (
        f"the ground of {len(names)} pictures, which agrees from one to the next with a correlation of {median:.2f} "
        f"(95 % of them {low:.2f} or more)"
    )
    return [replace(table, numbers={**found, **table.numbers})], agreed


def _from_poses(own: OwnDrives, tables: Sequence[Table], given: Mapping[str, Any]) -> RecordingSet:
    tracks = [track_of(own, table, alone=len(tables) == 1) for table in tables]
    canvas = canvas_on(own, tracks[0])
    drives: list[Recording] = []
    for table, track in zip(tables, tracks, strict=True):
        steps = table.pictured
        states = [track.state(int(step)) for step in steps]
        shown = steps[in_view(states, canvas, own.camera, own.input, WINDOW.least_px)]
        if not len(shown):
            raise RecordingError(
                f"drive {table.drive.name} never sees {WINDOW.least_px} pixels of the canvas at x_m {canvas.x_m:.1f}, "
                f"y_m {canvas.y_m:.1f}; check the camera, or where the canvas lies"
            )
        if table.drive.side is Side.CLEAN:
            check_passes(table, track, canvas)
        seen = np.stack([homography_from_pose(own.camera, track.state(int(step)), canvas) for step in shown])
        drives.append(_unpictured(own, table, shown, seen, track.speed_mps[shown], track))
    return RecordingSet(**given, recordings=tuple(drives), canvas=canvas)


def _from_corners(own: OwnDrives, tables: Sequence[Table], given: Mapping[str, Any]) -> RecordingSet:
    drives: list[Recording] = []
    controls: dict[str, Float[np.ndarray, "f 3"]] = {}
    for table in tables:
        rows = table.pictured
        corners = np.stack([table.numbers[name][rows] for name in CORNERS], 1).reshape(-1, 4, 2)
        seen: list[Homography] = []
        for row, four in zip(rows, corners, strict=True):
            try:
                seen.append(homography_from_points(_CORNERS_PX, own.camera.straightened(four)))
            except GeometryError as error:
                told = f"{table.drive.table}, row {row + 1}, corners of the canvas: {error}"
                raise RecordingError(told) from None
        drives.append(_unpictured(own, table, rows, np.stack(seen), table.needed("speed_mps")[rows]))
        columns = [table.column(name)[rows] for name in ("steer", "throttle", "brake")]
        controls[table.drive.name] = np.stack(columns, 1)
    return placed(RecordingSet(**given, recordings=tuple(drives)), dt_s=own.dt_s, controls=controls)


def _unpictured(
    own: OwnDrives,
    table: Table,
    rows: Int[np.ndarray, " f"],
    seen: Float[np.ndarray, "f 3 3"],
    speed_mps: Float[np.ndarray, " f"],
    track: Track | None = None,
) -> Recording:
    """The recording of some rows, all of which tell where the car was; its frames are not read yet, and black."""
    command = table.column("command", 2.0)[rows]
    odd = command[(command != command.round()) | (np.abs(command) > 100)]
    if odd.size:
        raise RecordingError(f"{table.drive.table}: command {odd[0]:g} is no command, expected 2, 3, 4 or 5")
    return Recording(
        name=table.drive.name,
        side=table.drive.side,
        frames=np.broadcast_to(np.uint8(0), (len(rows), own.input.height_px, own.input.width_px, 3)),
        frame_number=rows.astype(np.int64),
        image_from_canvas=seen,
        speed_mps=speed_mps,
        command=command.astype(np.int64),
        steer=table.needed("steer")[rows],
        track=track,
        weather=table.drive.weather,
    )


def _with_pictures(folder: Path, own: OwnDrives, table: Table, drive: Recording) -> Recording:
    """The frames of a drive that are kept; its track stays whole."""
    kept = evenly(len(drive.frames), WINDOW.frames)
    rows = {name: getattr(drive, name)[kept] for name in PER_FRAME}
    frames = np.stack([own.input(_picture(folder, own, table.pictures[int(step)])) for step in rows["frame_number"]])
    return replace(drive, frames=frames, **rows)


def _picture(folder: Path, own: OwnDrives, name: str) -> UInt8[np.ndarray, "h w 3"]:
    return camera_picture(folder, own.camera, name, "check the column picture")


def _colour(colour: OwnColour) -> ColourTransform:
    black, white = (torch.tensor(each, dtype=torch.float64) for each in (colour.black, colour.white))
    if not bool(((black >= 0) & (black < white) & (white <= 1)).all()):
        raise RecordingError(
            f"colour has black {colour.black} and white {colour.white}, expected 0 ≤ black < white ≤ 1"
        )
    return ColourTransform(AffineResponse(torch.diag(white - black), black))


def preview(recordings: RecordingSet) -> Image.Image:
    """First, middle and last frame of each drive with the canvas' outline, for people to see whether it is right."""
    rows: list[np.ndarray] = []
    for drive in recordings.recordings:
        count = len(drive.frames)
        rows.append(np.hstack([_outlined(recordings, drive, k) for k in (0, count // 2, count - 1)]))
    return Image.fromarray(np.vstack(rows))


def _outlined(recordings: RecordingSet, drive: Recording, k: int) -> UInt8[np.ndarray, "h w 3"]:
    view = recordings.view
    zoom = max(1, round(400 / view.width_px))
    picture = Image.fromarray(drive.frames[k]).resize((zoom * view.width_px, zoom * view.height_px))
    edge = np.linspace(_CORNERS_PX, np.roll(_CORNERS_PX, -1, 0), 300).swapaxes(0, 1).reshape(-1, 2)
    seen = homogeneous(drive.image_from_canvas[k], edge)
    seen = apply_homography(view.input_from_camera, recordings.camera.distorted(seen[seen[:, 2] > 0]))
    pen = ImageDraw.Draw(picture)
    for x, y in ((seen + 0.5) * zoom).clip(-10, 10_000).tolist():
        pen.rectangle((x - 1, y - 1, x + 1, y + 1), fill=(255, 64, 0))
    return np.asarray(picture)
