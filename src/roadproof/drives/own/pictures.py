"""Pictures in a folder of your own, by the names that its files give."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import UInt8

from roadproof.drives.own.plan import PLAN
from roadproof.errors import RecordingError
from roadproof.geometry import CameraModel
from roadproof.io.files import inside
from roadproof.io.pictures import read_picture


def place_of(folder: Path, name: str, what: str) -> Path:
    """The path of a file or folder that a name gives, which never leaves the folder.

    Args:
        folder: folder of drives.toml.
        name: names of folders and a file, with "/" between them.
        what: what the name stands for, for the message, such as "picture".

    Raises:
        RecordingError: a part of the name is not plain, or a link leads out of the folder.
    """
    path = folder
    for part in PurePosixPath(name).parts:
        path = inside(path, part, f"{what} {name!r:.80}", RecordingError)
    return path


def camera_picture(folder: Path, camera: CameraModel, name: str, remedy: str) -> UInt8[np.ndarray, "h w 3"]:
    """A picture that the camera took, RGB, (H, W, 3).

    Args:
        folder: folder of drives.toml.
        camera: camera that took the picture, of which only its size counts.
        name: name of the picture, relative to the folder.
        remedy: what the user can do where the picture is missing or damaged.

    Raises:
        RecordingError: the name leaves the folder, or the picture is missing, damaged or of another size.
    """
    path = place_of(folder, name, "picture")
    picture = read_picture(path, RecordingError, remedy)
    if picture.shape[:2] != (camera.height_px, camera.width_px):
        raise RecordingError(
            f"{path} has {picture.shape[1]}×{picture.shape[0]} pixels, expected {camera.width_px}×{camera.height_px} "
            f"as the camera in {PLAN}"
        )
    return picture
