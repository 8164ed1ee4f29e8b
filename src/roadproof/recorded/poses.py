"""Poses of recorded frames, and the canvas' size in metres, from homographies and a known camera.

    symbol     meaning                                                          shape
    H          `image_from_canvas`, of any positive scale                       (n, 3, 3)
    K          intrinsics of the camera                                         (3, 3)
    A          vehicle axes (forward, left, up) from camera axes                (3, 3)
    a, b, o    columns of A K⁻¹ H                                               (n, 3)
    n          upward normal of the road, in vehicle axes: b × a / |b × a|      (n, 3)
    w, l       metres that a canvas pixel measures across and along the road

Seen from the camera at C, in vehicle axes and up to the unknown scale s of the homography, the canvas pixel (x, y) lies
at x a + y b + o. With the canvas' directions to the right r and forward f, its pixel (0, 0) at O and the road at height
h below the camera,

    a = s w r,    b = −s l f,    o = s (O − C),    −n·o = s h.

The camera's known height gives w and l, of which the median over all frames is kept. From then on each frame takes s
from the canvas' size, since a car sinks and rises on its springs: s = (|a|/w + |b|/l) / 2.

Convention:
    The world has its origin at the canvas' middle and its x axis along the canvas' direction of travel (yaw 0). A pose
    is that of the vehicle's origin on the ground; pitch and roll of the car are estimated with it, then left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from roadproof.errors import RecordingError
from roadproof.geometry import CANVAS_SIZE_PX, CameraModel, CanvasPlacement
from roadproof.recordings import Recording, RecordingSet, Track

_MOST_TILT_DEG = (3.0, 10.0)
"""Road against the level that the camera model states: in the median of a set, and in one frame of a swaying car."""
_MOST_SKEW = (0.05, 0.15)
"""Cosine between the canvas' axes on the road, which are at right angles: in the median, and in one frame."""
_MOST_STRETCH = 0.2
"""Size of the canvas in one frame against the median."""
_SPEED_RATIO = (0.75, 1.33)
"""Speed of the poses against the recorded speed, in the median of a set."""


def placed(
    recordings: RecordingSet, *, dt_s: float, controls: Mapping[str, Float[np.ndarray, "_ 3"]] | None = None
) -> RecordingSet:
    """A set that knows where its canvas lies and where every frame was taken, from its homographies alone.

    Args:
        recordings: a set whose camera model is right: field of view, pitch, height above the road, place on the car.
            What the set says of its canvas or tracks already is replaced; marks and obstacles, which lie in another
            world, are left out.
        dt_s: seconds from one frame number to the next.
        controls: by name of the drive, steer, throttle and brake that were applied from each frame on, (F, 3). A drive
            left out gets the recorded controller's steer and no pedals.

    Returns:
        The same set with a canvas of metric size at the world's origin, and a track of one step per frame for each
        drive. Homographies stay as they are.

    Raises:
        RecordingError: the homographies disagree with the camera model, a frame with the others, poses with the
            recorded speeds, or the controls do not fit the drives.
    """
    drives, camera = recordings.recordings, recordings.camera
    controls = controls or {}
    unknown = set(controls) - {drive.name for drive in drives}
    if unknown:
        raise RecordingError(f"there are controls for {min(unknown)}, which is no drive of the set; check the names")
    if not camera.up_m > 0:
        raise RecordingError(f"the camera is {camera.up_m} m above the road, expected a height above 0")
    ground = _Ground.seen(camera, np.concatenate([drive.image_from_canvas for drive in drives]))
    _check_views(ground, [f"drive {drive.name}, frame {number}" for drive in drives for number in drive.frame_number])
    width_px_m, length_px_m = np.median(ground.px_m, axis=0).tolist()
    poses = ground.poses(camera, width_px_m, length_px_m)
    parts = np.split(poses, np.cumsum([len(drive.frames) for drive in drives])[:-1])
    tracks = [_track(drive, part, dt_s, controls.get(drive.name)) for drive, part in zip(drives, parts, strict=True)]
    _check_speeds(drives, tracks)
    return replace(
        recordings,
        marks=None,
        obstacles=None,
        canvas=CanvasPlacement(
            x_m=0.0, y_m=0.0, width_m=width_px_m * CANVAS_SIZE_PX, length_m=length_px_m * CANVAS_SIZE_PX
        ),
        recordings=tuple(replace(drive, track=track) for drive, track in zip(drives, tracks, strict=True)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Ground:
    """The canvas as each frame sees it.

    Args:
        columns: columns a, b and o of the notation, side by side, (n, 3, 3).
        normal: upward normal n of the road, in vehicle axes, (n, 3).
        px_m: w and l that the camera's height gives in each frame, metres per canvas px, (n, 2).
    """

    columns: Float[np.ndarray, "n 3 3"]
    normal: Float[np.ndarray, "n 3"]
    px_m: Float[np.ndarray, "n 2"]

    @staticmethod
    def seen(camera: CameraModel, image_from_canvas: Float[np.ndarray, "n 3 3"]) -> _Ground:
        pitch = math.radians(camera.pitch_deg)
        sp, cp = math.sin(pitch), math.cos(pitch)
        vehicle_from_camera = np.array([[0.0, sp, cp], [-1.0, 0.0, 0.0], [0.0, -cp, sp]])
        columns = vehicle_from_camera @ np.linalg.inv(camera.intrinsics) @ image_from_canvas
        a, b, o = np.moveaxis(columns, 2, 0)
        normal = np.cross(b, a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        scale = -(normal * o).sum(1) / camera.up_m
        return _Ground(columns, normal, np.linalg.norm(columns[:, :, :2], axis=1) / scale[:, None])

    @property
    def skew(self) -> Float[np.ndarray, " n"]:
        """Cosine between the canvas' axes."""
        a, b, _ = np.moveaxis(self.columns, 2, 0)
        return (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)

    @property
    def tilt_deg(self) -> Float[np.ndarray, " n"]:
        """Angle between the road's normal and the vehicle's up axis, in a car that is level."""
        return np.degrees(np.arctan2(np.hypot(self.normal[:, 0], self.normal[:, 1]), self.normal[:, 2]))

    def poses(self, camera: CameraModel, width_px_m: float, length_px_m: float) -> Float[np.ndarray, "n 3"]:
        """x_m, y_m and yaw_rad of the vehicle in each frame, for a canvas of known size."""
        a, b, _ = np.moveaxis(self.columns, 2, 0)
        right = a / np.linalg.norm(a, axis=1, keepdims=True)
        forward = -b / np.linalg.norm(b, axis=1, keepdims=True)
        # The world's axes in vehicle axes; the nearest rotation, since right and forward are never quite square.
        u, _, vt = np.linalg.svd(np.stack([forward, -right, self.normal], axis=2))
        vehicle_from_world = u @ vt
        scale = np.linalg.norm(self.columns[:, :, :2] / (width_px_m, length_px_m), axis=1).mean(1)
        middle = (CANVAS_SIZE_PX - 1) / 2
        canvas_from_camera = self.columns @ np.array([middle, middle, 1.0]) / scale[:, None]
        mount = np.array([camera.forward_m, camera.left_m, camera.up_m])
        origin = -((canvas_from_camera + mount)[:, None] @ vehicle_from_world)[:, 0]
        ahead = vehicle_from_world[:, 0]
        return np.column_stack([origin[:, :2], np.arctan2(ahead[:, 1], ahead[:, 0])])


def _track(
    drive: Recording, poses: Float[np.ndarray, "f 3"], dt_s: float, controls: Float[np.ndarray, "_ 3"] | None
) -> Track:
    """The track of a drive with one step per frame."""
    if controls is None:
        zero = np.zeros(len(poses))
        controls = np.column_stack([drive.steer.clip(-1.0, 1.0), zero, zero])
    if controls.shape != poses.shape:
        raise RecordingError(
            f"controls of drive {drive.name} have shape {controls.shape}, expected {poses.shape}: steer, throttle and "
            "brake of each frame"
        )
    x_m, y_m, yaw_rad = poses.T
    steer, throttle, brake = controls.T
    try:
        return Track(
            dt_s=dt_s,
            step=drive.frame_number,
            x_m=x_m,
            y_m=y_m,
            yaw_rad=yaw_rad,
            speed_mps=drive.speed_mps,
            steer=steer,
            throttle=throttle,
            brake=brake,
        )
    except RecordingError as error:
        raise RecordingError(f"drive {drive.name}: {error}") from None


def _check_views(ground: _Ground, names: list[str]) -> None:
    """Refuse homographies of another camera, then single frames that see another canvas than the rest."""
    skew, tilt_deg = np.abs(ground.skew), ground.tilt_deg
    tilted, skewed = float(np.median(tilt_deg)), float(np.median(skew))
    if tilted > _MOST_TILT_DEG[0] or skewed > _MOST_SKEW[0]:
        raise RecordingError(
            f"the homographies are of another camera: through this one the road tilts by {tilted:.1f}° and the canvas' "
            f"axes have a cosine of {skewed:.2f}, expected at most {_MOST_TILT_DEG[0]:g}° and {_MOST_SKEW[0]:g}; check "
            "its field of view and pitch"
        )
    stretch = np.abs(ground.px_m / np.median(ground.px_m, axis=0) - 1.0).max(axis=1)
    bad = np.flatnonzero((tilt_deg > _MOST_TILT_DEG[1]) | (skew > _MOST_SKEW[1]) | (stretch > _MOST_STRETCH))
    if bad.size:
        at = int(bad[0])
        raise RecordingError(
            f"{names[at]}: the homography disagrees with the camera (road tilted by {tilt_deg[at]:.1f}°, canvas' axes "
            f"with a cosine of {skew[at]:.2f}, canvas {stretch[at]:.0%} off its size); drop the frame"
        )


def odd_ratio(moved_m: Float[np.ndarray, " n"], way_m: Float[np.ndarray, " n"], least_m: float) -> float | None:
    """How far poses move against the way that a speed makes, in the median of ways above the least; None if alike.

    Where no way is above it by the speed, those count that are by the poses: a speed in other units may seem to stand.
    """
    moving = way_m > least_m if (way_m > least_m).any() else moved_m > least_m
    ratio = float(np.median(moved_m[moving] / np.maximum(way_m[moving], 1e-6))) if moving.any() else 1.0
    return None if _SPEED_RATIO[0] < ratio < _SPEED_RATIO[1] else ratio


def _check_speeds(drives: tuple[Recording, ...], tracks: list[Track]) -> None:
    """Refuse poses that do not move as fast as the car did."""
    moved_m = [np.hypot(np.diff(track.x_m), np.diff(track.y_m)) for track in tracks]
    way_m = [
        (track.speed_mps[1:] + track.speed_mps[:-1]) * (0.5 * track.dt_s) * np.diff(track.step) for track in tracks
    ]
    ratio = odd_ratio(np.concatenate(moved_m), np.concatenate(way_m), 0.05)
    if ratio is not None:
        raise RecordingError(
            f"poses move {ratio:.2f} times as fast as the recorded speed says, expected about 1; "
            "check dt_s, the camera's height and the unit of speed_mps"
        )
    for drive, one, other in zip(drives, moved_m, way_m, strict=True):
        jumps = np.flatnonzero(np.abs(one - other) > 1.0 + 0.5 * np.abs(other))
        if jumps.size:
            at = int(jumps[0])
            first, last = drive.frame_number[at : at + 2]
            raise RecordingError(
                f"drive {drive.name}: the pose jumps by {one[at]:.1f} m from frame {first} to {last}, expected "
                f"{other[at]:.1f} m at the recorded speed; drop one of them"
            )
