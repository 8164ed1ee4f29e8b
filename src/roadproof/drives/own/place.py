"""Where the car, the camera and the canvas were in drives of your own."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, cast

import numpy as np
from jaxtyping import Float
from scipy import optimize

from roadproof.datatypes import VehicleState
from roadproof.drives.own.plan import PLAN, GroundPoint, OwnDrives
from roadproof.drives.own.table import POSE, Table
from roadproof.errors import GeometryError, RecordingError
from roadproof.geometry import CameraModel, CanvasPlacement, wrapped_rad
from roadproof.recorded.poses import odd_ratio
from roadproof.recordings import Track

_ORIGIN = VehicleState(0.0, 0.0, 0.0, 0.0, 0.0)
_MOST_MISSED_PX = 5.0
_MOST_OPEN = 0.2  # of the camera's height
_LEAST_WAY_M = 0.5
_MOST_BESIDE_RAD = 0.35
_MOST_PER_M = 1 / 3


def track_of(own: OwnDrives, table: Table, *, alone: bool) -> Track:
    """The poses of a drive as its table states them, or integrated from speed and yaw rate.

    Args:
        own: content of drives.toml.
        table: table of the drive.
        alone: whether it is the only drive, as integrated poses begin at the world's origin, different for every drive.

    Raises:
        RecordingError: the table does not say where the car was, poses jump, or they do not move as fast as it says.
    """
    numbers, dt_s = table.numbers, own.dt_s
    if all(name in numbers for name in POSE):
        x_m, y_m, yaw_rad = (numbers[name] for name in POSE)
        _check_heading(table, x_m, y_m, yaw_rad, dt_s)
        if "speed_mps" not in numbers:
            _check_every_row_moves(table, x_m, y_m, dt_s)
        way = np.gradient(x_m) * np.cos(yaw_rad) + np.gradient(y_m) * np.sin(yaw_rad) if len(x_m) > 1 else x_m * 0
        speed = numbers.get("speed_mps", way / dt_s)
    elif "yaw_rate_rad_s" in numbers:
        if not alone:
            raise RecordingError(
                f"{table.drive.table} has speed and yaw rate alone, which do not say how drives lie to each "
                "other; give x_m, y_m and yaw_rad, or import one drive"
            )
        speed, rate = table.needed("speed_mps"), numbers["yaw_rate_rad_s"]
        _check_rate(table, speed, rate)
        yaw_rad = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * dt_s)])
        middle = (yaw_rad[1:] + yaw_rad[:-1]) / 2
        way = (speed[1:] + speed[:-1]) / 2 * dt_s
        x_m, y_m = (np.concatenate([[0.0], np.cumsum(way * turn(middle))]) for turn in (np.cos, np.sin))
    else:
        raise RecordingError(
            f"{table.drive.table} does not say where the car was: expected columns x_m, y_m and yaw_rad, or speed_mps "
            "and yaw_rate_rad_s, or the canvas' corners, or none of them and one drive whose pictures show its motion"
        )
    try:
        track = Track(
            dt_s=dt_s,
            step=np.arange(len(x_m)),
            x_m=x_m,
            y_m=y_m,
            yaw_rad=yaw_rad,
            speed_mps=speed,
            steer=table.needed("steer"),
            throttle=table.column("throttle"),
            brake=table.column("brake"),
        )
    except RecordingError as error:
        raise RecordingError(f"{table.drive.table}: {error}") from None
    if "speed_mps" in numbers:
        _check_speed(table, track)
    return track


def _check_heading(
    table: Table,
    x_m: Float[np.ndarray, " n"],
    y_m: Float[np.ndarray, " n"],
    yaw_rad: Float[np.ndarray, " n"],
    dt_s: float,
) -> None:
    """Refuse headings in another unit, or counted from elsewhere, than the way that the poses take."""
    # Over half a second: some log poses less often than rows. A metre is more than a pose jitters where a car stands.
    steps = max(1, round(0.5 / dt_s))
    dx, dy = x_m[steps:] - x_m[:-steps], y_m[steps:] - y_m[:-steps]
    yaw, speed = np.unwrap(yaw_rad), table.numbers.get("speed_mps", np.ones(len(x_m)))
    moves = (np.hypot(dx, dy) > 2 * _LEAST_WAY_M) & (speed[steps:] >= 0) & (speed[:-steps] >= 0)
    if not moves.any():
        return
    turned = np.arctan2(dy, dx) - (yaw[steps:] + yaw[:-steps]) / 2
    beside = float(np.median(np.abs(wrapped_rad(turned))[moves]))
    if beside > _MOST_BESIDE_RAD:
        raise RecordingError(
            f"{table.drive.table}: the car moves {beside:.2f} rad beside its yaw_rad (median), expected about 0; give "
            "radians, 0 along x and positive to the left"
        )


def _check_every_row_moves(
    table: Table, x_m: Float[np.ndarray, " n"], y_m: Float[np.ndarray, " n"], dt_s: float
) -> None:
    """Refuse poses that wait and jump in turn, of which no speed can be made from row to row."""
    half = max(1, round(0.25 / dt_s))
    at = np.arange(half, len(x_m) - half)
    # Where a car crawls, poses that are rounded wait too.
    clear = np.hypot(x_m[at + half] - x_m[at - half], y_m[at + half] - y_m[at - half]) > _LEAST_WAY_M
    moves = np.hypot(np.diff(x_m), np.diff(y_m)) > 1e-6
    turns = int((moves[at] != moves[at - 1])[clear].sum())
    if turns > max(6.0, clear.sum() / 10):
        raise RecordingError(
            f"{table.drive.table}: poses change in {int(moves.sum())} of {len(moves)} steps, now and then, so they do "
            "not say how fast the car was; give speed_mps, or a row for each pose"
        )


def _check_rate(table: Table, speed_mps: Float[np.ndarray, " n"], rate_rad_s: Float[np.ndarray, " n"]) -> None:
    """Refuse yaw rates with which no car could turn."""
    moves = speed_mps > 1.0
    if moves.any() and (tight := float(np.percentile(np.abs(rate_rad_s[moves] / speed_mps[moves]), 95))) > _MOST_PER_M:
        raise RecordingError(
            f"{table.drive.table}: by yaw_rate_rad_s the car turns on circles of {1 / tight:.1f} m, expected "
            f"{1 / _MOST_PER_M:.0f} m or more; give radians a second"
        )


def _check_speed(table: Table, track: Track) -> None:
    """Refuse a speed in another unit, or another time step, than that of the poses."""
    # Seconds are compared, not steps: some log poses less often than rows.
    steps = max(1, round(1 / track.dt_s))
    driven_m = np.concatenate([[0.0], ((track.speed_mps[1:] + track.speed_mps[:-1]) / 2 * track.dt_s).cumsum()])
    x, y, way = (values[steps:] - values[:-steps] for values in (track.x_m, track.y_m, driven_m))
    ratio = odd_ratio(np.hypot(x, y), way, _LEAST_WAY_M)
    if ratio is not None:
        raise RecordingError(
            f"{table.drive.table}: poses move {ratio:.2f} times as fast as speed_mps says, expected about 1; check its "
            "unit, and dt_s"
        )


def canvas_on(own: OwnDrives, track: Track) -> CanvasPlacement:
    """The canvas as drives.toml places it: by its pose, or by a distance along the first drive.

    Raises:
        RecordingError: the canvas is placed twice or not at all, lies beyond the driven path, or has no size or
            numbers that are none.
    """
    stated = own.canvas
    if stated is None:
        raise RecordingError(f"{PLAN} has no table [canvas]; say where may be painted, for instance ahead_m = 30")
    place = [stated.x_m, stated.y_m, stated.yaw_rad]
    if stated.ahead_m is None and None in place:
        raise RecordingError(f"[canvas] of {PLAN} has neither ahead_m nor x_m, y_m and yaw_rad; give one of them")
    if stated.ahead_m is not None:
        if place != [None] * 3:
            raise RecordingError(f"[canvas] of {PLAN} has both ahead_m and a place; leave one out")
        way_m = np.concatenate([[0.0], np.hypot(np.diff(track.x_m), np.diff(track.y_m)).cumsum()])
        if not 0.0 <= stated.ahead_m <= way_m[-1]:
            raise RecordingError(
                f"[canvas] has ahead_m {stated.ahead_m:g}, expected 0 to {way_m[-1]:.1f}, the way driven"
            )
        poses = (track.x_m, track.y_m, np.unwrap(track.yaw_rad))
        place = [float(np.interp(stated.ahead_m, way_m, values)) for values in poses]
    x_m, y_m, yaw_rad = cast("list[float]", place)
    try:
        return CanvasPlacement(x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, width_m=stated.width_m, length_m=stated.length_m)
    except GeometryError as error:
        raise RecordingError(f"[canvas] of {PLAN}: {error}") from None


def check_passes(table: Table, track: Track, canvas: CanvasPlacement) -> None:
    """See that a drive does not end before the canvas, where the recorded world would end with it.

    Raises:
        RecordingError: it does; the message says by how much.
    """
    short_m = -canvas.ahead_m(float(track.x_m[-1]), float(track.y_m[-1])) - canvas.length_m / 2
    if short_m > 0 and np.hypot(track.x_m - canvas.x_m, track.y_m - canvas.y_m).argmin() == len(track) - 1:
        raise RecordingError(
            f"drive {table.drive.name} ends {short_m:.1f} m before the canvas; give the rows of {table.drive.table} up "
            "to the canvas' end, or place it nearer"
        )


def fitted_camera(camera: CameraModel, ground: Sequence[GroundPoint], *, fov_known: bool = False) -> CameraModel:
    """The camera with height, pitch and field of view fitted so that known ground points are where they are seen.

    Args:
        camera: camera from which the fit begins; it is returned unchanged if no points are given.
        ground: none, or at least three known points of the ground.
        fov_known: whether the field of view stays as it is.

    Raises:
        RecordingError: there are one or two points, the fit misses them by more than 5 px, or they leave open what is
            fitted.
    """
    if not ground:
        return camera
    if len(ground) < 3:
        raise RecordingError(f"{len(ground)} known points of the ground, expected 3 or more, near and far, or none")
    place = np.array([[each.ahead_m, each.left_m, 0.0, 1.0] for each in ground])
    seen = np.array([[each.x_px, each.y_px] for each in ground])

    names = ("up_m", "pitch_deg", "fov_deg")[: 2 if fov_known else 3]

    def placed_as(numbers: Float[np.ndarray, " p"]) -> CameraModel:
        return replace(camera, **dict(zip(names, numbers.tolist(), strict=True)))

    def missed(numbers: Float[np.ndarray, " p"]) -> Float[np.ndarray, " m"]:
        tried = placed_as(numbers)
        shown = place @ tried.image_from_world(_ORIGIN).T
        shown[:, 2] = np.maximum(shown[:, 2], 1e-3)
        return (tried.distorted(shown) - seen).T.ravel()

    widest_deg = min(170.0, math.degrees(2 * math.atan2(camera.width_px / 2, camera.least_focal_px)))
    narrowest_deg = min(5.0, 0.5 * min(widest_deg, camera.fov_deg))
    begin = np.array([getattr(camera, name) for name in names])
    bounds = np.array([[0.1, -80.0, narrowest_deg], [10.0, 45.0, widest_deg]])[:, : len(names)]
    found = cast("Any", optimize).least_squares(
        missed, begin.clip(*bounds), bounds=bounds, x_scale=(0.1, 1.0, 1.0)[: len(names)]
    )
    off_px = float(np.hypot(*missed(found.x).reshape(2, -1)).max())
    if off_px > _MOST_MISSED_PX:
        raise RecordingError(
            f"known points of the ground are missed by up to {off_px:.1f} px, expected at most {_MOST_MISSED_PX:g}; "
            "check them, and the camera's forward_m and left_m"
        )
    _, spread, turned = np.linalg.svd(found.jac, full_matrices=False)
    per_px = np.linalg.norm(turned.T / np.maximum(spread, 1e-9), axis=1)
    for name, change, most in zip(names, per_px.tolist(), (_MOST_OPEN * found.x[0], 1.0, 5.0), strict=False):
        if change > most:
            raise RecordingError(
                f"known points of the ground leave {name} of the camera open: a pixel's error in them changes it by "
                f"{change:.2g}, expected at most {most:.2g}; give points near and far, and to both sides"
            )
    return placed_as(found.x)
