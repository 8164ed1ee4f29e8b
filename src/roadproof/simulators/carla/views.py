"""Pictures of CARLA's cameras as numbers: levels, heights, kinds, and how a camera sees the world."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, UInt8

from roadproof.geometry import CameraModel
from roadproof.simulators.carla.inject import Scene
from roadproof.simulators.carla.session import carla

FARTHEST_M = 1000.0
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
"""CARLA's world from the town's, and back."""


def levels(image: carla.Image) -> UInt8[np.ndarray, "h w 3"]:
    """RGB of a picture."""
    bgra = np.frombuffer(image.raw_data, np.uint8).reshape(image.height, image.width, 4)
    return np.ascontiguousarray(bgra[..., 2::-1])


def image_from_world(camera: CameraModel, image: carla.Image) -> Float[np.ndarray, "3 4"]:
    """Camera px from homogeneous points of the town's world, for the pose a picture was taken from."""
    return camera.intrinsics @ _camera_from_world(image)


def scene(camera: CameraModel, images: Mapping[str, carla.Image], canvas_z_m: float) -> Scene:
    """What the three cameras see together at one moment.

    Args:
        camera: the optics of all three cameras.
        images: the pictures of one moment by camera: "rgb", "depth" and "semantic_segmentation".
        canvas_z_m: world z of the canvas, from which heights are counted.
    """
    depth_m = levels(images["depth"]).astype(np.float64) @ (1.0, 256.0, 65536.0) * (FARTHEST_M / (2**24 - 1))
    tags = levels(images["semantic_segmentation"])[..., 0]
    asphalt, line = (tags == int(label) for label in (carla.CityObjectLabel.Roads, carla.CityObjectLabel.RoadLines))
    camera_from_world = _camera_from_world(images["rgb"])
    up = camera_from_world[:, 2]
    # How far the ray of each pixel rises for every metre of depth.
    slope = up @ np.linalg.inv(camera.intrinsics)
    columns, rows = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rise = slope[0] * columns + slope[1] * rows + slope[2]
    camera_z_m = -float(up @ camera_from_world[:, 3])
    return Scene(levels(images["rgb"]), camera_z_m + depth_m * rise - canvas_z_m, asphalt | line, asphalt)


def _camera_from_world(image: carla.Image) -> Float[np.ndarray, "3 4"]:
    """Camera axes (x right, y down, z ahead) from the town's world."""
    own_from_world = np.array(image.transform.get_inverse_matrix()) @ MIRROR
    return np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0]]) @ own_from_world
