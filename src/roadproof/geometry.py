"""Where the canvas is in the picture: cameras, crop and resize, the place of the canvas.

Convention:
    World: right-handed, metres, z up; yaw 0 looks along x, y points left. Camera pictures and canvases: x right,
    y down, pixel centres at integers, so that a picture of W columns spans [−0.5, W − 0.5]. Everything here is
    float64 numpy: calibration is data, never differentiated.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float, UInt8
from PIL import Image

from roadproof.datatypes import VehicleState
from roadproof.errors import GeometryError
from roadproof.homographies import Homography, Points
from roadproof.io.pictures import MOST_PIXELS
from roadproof.lens import Lens

CANVAS_SIZE_PX = 400
CANVAS_CORNERS_PX: Float[np.ndarray, "4 3"] = np.array(
    [(x, y, 1.0) for x, y in np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * CANVAS_SIZE_PX - 0.5]
)
"""The canvas' corners, homogeneous: far left, far right, near right, near left."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CameraModel:
    """A camera, and where it sits on the car: a pinhole with square pixels, or one behind a lens that distorts.

    Args:
        width_px: number of columns of the picture.
        height_px: number of rows of the picture.
        fov_deg: horizontal field of view, degrees, in (0, 180); with a lens, that of a pinhole of the same focal
            length, 2 atan(width / (2 fx)).
        forward_m: distance ahead of the vehicle's origin, metres.
        left_m: distance to the left of the vehicle's origin, metres.
        up_m: height above the ground, metres.
        pitch_deg: pitch in degrees, positive looking up; CARLA's imitation agent looks down by −15.
        lens: the distortion of its lens, about the middle of the picture; None for a pinhole.

    Raises:
        GeometryError: a size is not positive or the picture is larger than any here, the field of view is outside (0,
            180), a place or the pitch is beyond all reason, or the lens would fold the picture before its corners.
    """

    width_px: int
    height_px: int
    fov_deg: float
    forward_m: float = 0.0
    left_m: float = 0.0
    up_m: float = 1.4
    pitch_deg: float = 0.0
    lens: Lens | None = None

    def __post_init__(self) -> None:
        if self.width_px < 1 or self.height_px < 1:
            raise GeometryError(f"camera picture is {self.width_px}×{self.height_px}, expected at least 1×1 pixels")
        if not 0.1 <= self.fov_deg <= 179.0:
            raise GeometryError(f"camera fov_deg is {self.fov_deg}, expected 0.1 to 179")
        if self.width_px * self.height_px > MOST_PIXELS:
            raise GeometryError(f"camera picture is {self.width_px}×{self.height_px}, expected {MOST_PIXELS:,} at most")
        for name, most in (("forward_m", 1e4), ("left_m", 1e4), ("up_m", 1e4), ("pitch_deg", 360.0)):
            value: float = getattr(self, name)
            if not abs(value) <= most:
                raise GeometryError(f"camera {name} is {value:g}, expected −{most:g} to {most:g}")
        if self.lens is not None and self.focal_px < (least := self.least_focal_px):
            raise GeometryError(
                f"camera lens folds the picture {self.lens.reach * self.focal_px:.0f} px from its middle, before its "
                f"corners at {self.lens.reach * least:.0f} px; check the order of its coefficients, and fov_deg, which "
                "is that of the focal length"
            )

    @property
    def stated(self) -> dict[str, object]:
        """The camera as files have it: its fields, of which a pinhole has no lens."""
        fields = asdict(self)
        return fields if self.lens is not None else {name: fields[name] for name in fields if name != "lens"}

    @property
    def focal_px(self) -> float:
        """Focal length in pixels, the same in x and y."""
        return self.width_px / 2 / math.tan(math.radians(self.fov_deg) / 2)

    @property
    def least_focal_px(self) -> float:
        """The least focal length, px, with which the lens shows every point once, up to the picture's corners."""
        return 0.0 if self.lens is None else math.hypot(self.width_px, self.height_px) / 2 / self.lens.reach

    @property
    def intrinsics(self) -> Homography:
        """Picture from camera axes (x right, y down, z forward), (3, 3), without the lens."""
        f = self.focal_px
        return np.array([[f, 0, (self.width_px - 1) / 2], [0, f, (self.height_px - 1) / 2], [0, 0, 1.0]])

    def image_from_world(self, state: VehicleState) -> Float[np.ndarray, "3 4"]:
        """Projection of homogeneous world points (X, Y, Z, 1), in metres; the third coordinate is the depth in metres.

        The lens is left out: `distorted` gives where the picture shows them.

        Args:
            state: pose of the vehicle that carries the camera.
        """
        sy, cy = math.sin(state.yaw_rad), math.cos(state.yaw_rad)
        sp, cp = math.sin(math.radians(self.pitch_deg)), math.cos(math.radians(self.pitch_deg))
        forward = np.array([cy, sy, 0.0])
        left = np.array([-sy, cy, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        camera_from_world = np.stack([-left, sp * forward - cp * up, cp * forward + sp * up])
        ground = np.array([state.x_m, state.y_m, state.z_m])
        centre = ground + self.forward_m * forward + self.left_m * left + self.up_m * up
        return self.intrinsics @ np.column_stack([camera_from_world, -camera_from_world @ centre])

    def distorted(self, points: Float[np.ndarray, "*n 3"]) -> Points:
        """Where the picture shows points, px.

        Args:
            points: where a pinhole would show them, as homogeneous px with a positive third coordinate for what is in
                front of the camera.
        """
        if self.lens is None:
            with np.errstate(divide="ignore", invalid="ignore"):
                return points[..., :2] / points[..., 2:]
        x, y, z = np.moveaxis(points @ np.linalg.inv(self.intrinsics).T, -1, 0)
        return np.stack(self.lens.distort(x, y, z), -1) * self.focal_px + self.intrinsics[:2, 2]

    def undistorted(
        self, points_px: Float[np.ndarray, "n 2"]
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 2"]]:
        """Where a pinhole would show what the picture shows at some places: the inverse of `distorted`.

        Args:
            points_px: places in the picture, px.

        Returns:
            Homogeneous px of any positive scale, whose third coordinate is positive for what is in front of the camera
            (a fisheye shows more), and their derivatives by the place.
        """
        if self.lens is None:
            one = np.ones_like(points_px[..., :1])
            return np.concatenate([points_px, one], -1), np.broadcast_to(np.eye(3, 2), (*points_px.shape[:-1], 3, 2))
        directions, slopes = self.lens.undistort((points_px - self.intrinsics[:2, 2]) / self.focal_px)
        return directions @ self.intrinsics.T, self.intrinsics @ slopes / self.focal_px

    def straightened(self, points_px: Float[np.ndarray, "n 2"]) -> Points:
        """Where a pinhole would show what the picture shows at some places, px; NaN for what only a fisheye can see."""
        seen, _ = self.undistorted(points_px)
        return seen[:, :2] / np.where(seen[:, 2:] > 0, seen[:, 2:], np.nan)


Resampling = Literal["antialiased-bilinear", "area"]


@dataclass(frozen=True, kw_only=True, slots=True)
class CropResize:
    """How a controller's input is made from the camera picture: cut a box, then resize it.

    Args:
        left_px: first column of the camera picture that is kept.
        top_px: first row of the camera picture that is kept.
        right_px: one past the last column that is kept.
        bottom_px: one past the last row that is kept.
        width_px: number of columns of the input.
        height_px: number of rows of the input.
        resampling: "antialiased-bilinear" (Pillow's BILINEAR: a tent as wide as two input pixels) or "area" (a box as
            wide as one).

    Raises:
        GeometryError: the box or the input has no pixels, the input has too many, or `resampling` is another word.
    """

    left_px: int
    top_px: int
    right_px: int
    bottom_px: int
    width_px: int
    height_px: int
    resampling: Resampling = "antialiased-bilinear"

    def __post_init__(self) -> None:
        if not (0 <= self.left_px < self.right_px and 0 <= self.top_px < self.bottom_px):
            box = (self.left_px, self.top_px, self.right_px, self.bottom_px)
            raise GeometryError(f"crop box (left, top, right, bottom) is {box}, expected a box that is not empty")
        if max(self.right_px, self.bottom_px) > MOST_PIXELS:
            raise GeometryError(f"crop box ends at {max(self.right_px, self.bottom_px):g} px, beyond any picture")
        if self.width_px < 1 or self.height_px < 1 or self.width_px * self.height_px > MOST_PIXELS:
            raise GeometryError(
                f"controller input is {self.width_px}×{self.height_px}, expected at least 1×1 pixels and at most "
                f"{MOST_PIXELS:,} in all"
            )
        if self.resampling not in (known := get_args(Resampling)):
            raise GeometryError(f"resampling is {self.resampling!r:.40}, expected {' or '.join(known)}")

    @property
    def input_from_camera(self) -> Homography:
        """The exact affine map of pixel centres from the camera picture to the controller's input."""
        sx = self.width_px / (self.right_px - self.left_px)
        sy = self.height_px / (self.bottom_px - self.top_px)
        return np.array(
            [
                [sx, 0.0, sx * (0.5 - self.left_px) - 0.5],
                [0.0, sy, sy * (0.5 - self.top_px) - 0.5],
                [0.0, 0.0, 1.0],
            ]
        )

    def __call__(self, picture: UInt8[np.ndarray, "hc wc 3"]) -> UInt8[np.ndarray, "h w 3"]:
        """The controller's input made from a camera picture.

        Raises:
            GeometryError: the picture is smaller than the crop box.
        """
        height, width = picture.shape[:2]
        if height < self.bottom_px or width < self.right_px:
            raise GeometryError(
                f"camera picture is {width}×{height}, expected at least {self.right_px}×{self.bottom_px} for the crop"
            )
        box = (self.left_px, self.top_px, self.right_px, self.bottom_px)
        method = Image.Resampling.BOX if self.resampling == "area" else Image.Resampling.BILINEAR
        return np.asarray(Image.fromarray(picture).crop(box).resize((self.width_px, self.height_px), method))


class Sight(NamedTuple):
    """Where the N pixels of a controller's input look, row after row, as the input of a camera without its lens has it.

    Args:
        through: the place at which that input would show what the pixel's middle shows, homogeneous px, (3, N); a
            homography's inverse takes it to where the pixel looks.
        slope: its derivative by the pixel's column and row, (N, 3, 2).
    """

    through: Float[np.ndarray, "3 n"]
    slope: Float[np.ndarray, "n 3 2"]

    def on(self, canvas_from_input: Homography) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """Where the pixels look on a canvas or the ground, without a warning, and whether that is ahead of them."""
        mapped = self.through[:2].T @ canvas_from_input[:, :2].T + self.through[2:].T * canvas_from_input[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return mapped[:, :2] / mapped[:, 2:], mapped[:, 2] > 0


@lru_cache(maxsize=8)
def sight(view: CropResize, camera: CameraModel | None = None) -> Sight:
    """Where the pixels of a controller's input look.

    Args:
        view: crop and resize that make the input from the camera picture.
        camera: camera that takes the picture, of which only the lens counts; None for any pinhole.
    """
    columns, rows = np.meshgrid(np.arange(view.width_px), np.arange(view.height_px))
    pixels = np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)])
    if camera is None or camera.lens is None:
        found = Sight(pixels, np.tile(np.eye(3, 2), (rows.size, 1, 1)))
    else:
        camera_from_input = np.linalg.inv(view.input_from_camera)
        through, slope = camera.undistorted((camera_from_input @ pixels)[:2].T)
        found = Sight(view.input_from_camera @ through.T, view.input_from_camera @ slope @ camera_from_input[:2, :2])
    for part in found:
        part.flags.writeable = False
    return found


CIL_CAMERA = CameraModel(width_px=800, height_px=600, fov_deg=100.0, forward_m=2.0, up_m=1.4, pitch_deg=-15.0)
"""The camera of CARLA's imitation-learning agent."""

CIL_INPUT = CropResize(left_px=0, top_px=115, right_px=800, bottom_px=510, width_px=200, height_px=88)
"""What that agent's network sees of it: rows 115…509, resized to 200×88."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CanvasPlacement:
    """Where the canvas lies on the road.

    Args:
        x_m: world x of the canvas' centre, metres.
        y_m: world y of the canvas' centre, metres.
        z_m: height of the road at the canvas' centre, metres.
        yaw_rad: direction of travel, radians, towards the canvas' far edge (y = 0).
        width_m: extent across the road, metres.
        length_m: extent along the road, metres.

    Raises:
        GeometryError: a number is not finite, or no metres on earth, or an extent is not positive.
    """

    x_m: float
    y_m: float
    z_m: float = 0.0
    yaw_rad: float = 0.0
    width_m: float = 7.6
    length_m: float = 9.5

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not abs(getattr(self, name)) < 1e9:
                raise GeometryError(f"canvas {name} is {getattr(self, name)}, expected a finite number below 1e9")
        if not (self.width_m > 0 and self.length_m > 0):
            raise GeometryError(f"canvas is {self.width_m} m × {self.length_m} m, expected both extents above 0")

    def ahead_m(self, x_m: float, y_m: float) -> float:
        """How far a place in the world lies past the canvas' middle along the canvas, metres; below 0 before it."""
        return (x_m - self.x_m) * math.cos(self.yaw_rad) + (y_m - self.y_m) * math.sin(self.yaw_rad)

    @property
    def world_from_canvas(self) -> Float[np.ndarray, "4 3"]:
        """Homogeneous world points (X, Y, Z, 1) from canvas pixels (x, y, 1)."""
        forward = np.array([math.cos(self.yaw_rad), math.sin(self.yaw_rad), 0.0, 0.0])
        right = np.array([forward[1], -forward[0], 0.0, 0.0])
        per_x = right * (self.width_m / CANVAS_SIZE_PX)
        per_y = -forward * (self.length_m / CANVAS_SIZE_PX)
        centre = np.array([self.x_m, self.y_m, self.z_m, 1.0])
        return np.column_stack([per_x, per_y, centre - (CANVAS_SIZE_PX - 1) / 2 * (per_x + per_y)])


def wrapped_rad(angle_rad: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Angles within half a turn: −π to π, radians."""
    return np.remainder(angle_rad + np.pi, 2 * np.pi) - np.pi


def homography_from_pose(camera: CameraModel, state: VehicleState, canvas: CanvasPlacement) -> Homography:
    """`image_from_canvas` for a known camera, vehicle pose and canvas; its third coordinate is the depth in metres."""
    return camera.image_from_world(state) @ canvas.world_from_canvas
