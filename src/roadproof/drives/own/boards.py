"""Where pictures show the corners of a chessboard; the one room that knows OpenCV, which is an extra."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from roadproof.drives.own.pictures import camera_picture, place_of
from roadproof.drives.own.plan import Chessboard
from roadproof.errors import RecordingError
from roadproof.geometry import CameraModel

LEAST_PICTURES, MOST_PICTURES = 5, 50
"""How many pictures of a chessboard are asked for, and how many are taken."""

_KINDS = (".png", ".jpg", ".jpeg")
_LEAST_MOVED = 0.02  # of the picture's width
_SOFT_PX = 1.0
_MOST_WINDOW_PX = 15
_LISTED = 8


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Boards:
    """Where pictures show the M inner corners of a chessboard.

    Args:
        names: the N pictures that show it whole, each from another place.
        seen_px: where each picture shows the corners, px, (N, M, 2).
        grid: where the corners are on the board, in squares from its middle, (M, 2).
        left_out: which pictures are left out and why, in words; empty if none is.
    """

    names: tuple[str, ...]
    seen_px: Float[np.ndarray, "n m 2"]
    grid: Float[np.ndarray, "m 2"]
    left_out: str

    def without(self, odd: Bool[np.ndarray, " n"], why: str) -> Boards:
        """The boards of the pictures that are not odd; why the others are left out is said in words."""
        told = f"{why} {_list([name for name, out in zip(self.names, odd, strict=True) if out])}"
        return replace(
            self,
            names=tuple(name for name, out in zip(self.names, odd, strict=True) if not out),
            seen_px=self.seen_px[~odd],
            left_out="; ".join(filter(None, [self.left_out, told])),
        )


def boards_in(folder: Path, camera: CameraModel, chessboard: Chessboard) -> Boards:
    """The corners of the chessboard in all pictures that show it whole.

    Args:
        folder: folder of drives.toml.
        camera: camera that took the pictures, of which only its size counts.
        chessboard: the board, and where its pictures are.

    Raises:
        RecordingError: OpenCV is not installed, a picture cannot be read or is of another size than the camera's, or
            fewer than five show the board, each in another place.
    """
    cv2 = _opencv()
    files = _files(place_of(folder, chessboard.pictures, "[chessboard] pictures"))
    seen: dict[str, Float[np.ndarray, "m 2"]] = {}
    without: list[str] = []
    again: list[str] = []
    for file in files:
        name = str(PurePosixPath(chessboard.pictures) / file)
        picture = camera_picture(folder, camera, name, "check the pictures of [chessboard]")
        corners = _corners(cv2, picture, chessboard.corners)
        if corners is None:
            without.append(file)
        elif any(np.abs(corners - other).max() < _LEAST_MOVED * camera.width_px for other in seen.values()):
            again.append(file)
        else:
            seen[file] = corners
    across, down = chessboard.corners
    why = {f"no board of {across} × {down} inner corners found in": without, "the board where it was before in": again}
    left_out = "; ".join(f"{reason} {_list(names)}" for reason, names in why.items() if names)
    if len(seen) < LEAST_PICTURES:
        raise RecordingError(
            f"{len(seen)} of {len(files)} pictures show the chessboard whole and in a place of its own, expected "
            f"{LEAST_PICTURES} or more; {left_out}; count the corners where four squares meet, leave a white edge, and "
            "move the board from picture to picture"
        )
    row, column = np.meshgrid(np.arange(down), np.arange(across), indexing="ij")
    grid = np.stack([column.ravel() - (across - 1) / 2, row.ravel() - (down - 1) / 2], 1)
    return Boards(names=tuple(seen), seen_px=np.stack(list(seen.values())), grid=grid, left_out=left_out)


def _opencv() -> Any:  # noqa: ANN401
    try:
        import cv2
    except ImportError:
        raise RecordingError(
            "chessboards are found by OpenCV, which is not installed: pip install 'roadproof[chessboard]'"
        ) from None
    return cv2


def _files(folder: Path) -> list[str]:
    try:
        found = sorted(each.name for each in folder.iterdir() if each.suffix.lower() in _KINDS)
    except OSError as reason:
        raise RecordingError(
            f"[chessboard] pictures: cannot read the folder {folder}: {reason.strerror or reason}; check its name"
        ) from None
    if not LEAST_PICTURES <= len(found) <= MOST_PICTURES:
        raise RecordingError(
            f"[chessboard] pictures: {folder} has {len(found)} pictures (PNG or JPEG), expected {LEAST_PICTURES} to "
            f"{MOST_PICTURES}; 20 are plenty"
        )
    return found


def _corners(cv2: Any, picture: UInt8[np.ndarray, "h w 3"], size: Sequence[int]) -> Float[np.ndarray, "m 2"] | None:  # noqa: ANN401
    """Where a picture shows the inner corners, px, row after row; None where it shows no such board."""
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    # Stretched contrast finds boards that are pale, and loses others.
    tries = (cv2.findChessboardCornersSB(grey, size, flags=flags) for flags in (0, cv2.CALIB_CB_NORMALIZE_IMAGE))
    rough = next((corners for found, corners in tries if found), None)
    if rough is None:
        return None
    # They are found to some 0.2 px; where the edges of four squares meet, in a window that holds no other, is nearer.
    rows = rough.reshape(size[1], size[0], 2)
    gap = min(np.linalg.norm(np.diff(rows, axis=axis), axis=-1).min() for axis in (0, 1))
    window = max(2, min(int(gap / 2.5), _MOST_WINDOW_PX))
    enough = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    soft = cv2.GaussianBlur(grey, (0, 0), _SOFT_PX)
    return np.float64(cv2.cornerSubPix(soft, rough, (window, window), (-1, -1), enough)).reshape(-1, 2)


def _list(names: Sequence[str]) -> str:
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return ", ".join(names[:_LISTED]) + more
