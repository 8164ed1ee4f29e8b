"""How well do pictures of a chessboard tell the camera? Drawn ones, whose camera is known, and real ones.

    python benchmarks/calibrate_camera.py --json OUT

draws boards through known cameras, sharp and noisy, and fits the camera to them as `roadproof import` does. The JSON
says, the worst of all seeds, how far off the field of view is, by how much corners are missed, and how far from where
the true camera does the one found shows things all over the picture; beside it what the fit says of itself.

    git clone --depth 1 https://github.com/udacity/CarND-Advanced-Lane-Lines
    python benchmarks/calibrate_camera.py --pictures CarND-Advanced-Lane-Lines/camera_cal --corners 9 6 --json OUT
    git clone --depth 1 https://github.com/udacity/CarND-Camera-Calibration
    python benchmarks/calibrate_camera.py --pictures CarND-Camera-Calibration/calibration_wide --corners 8 6 \
        --lens fisheye --cut 24 42 0 0 --json OUT

fits the camera of real pictures (both MIT) to all of them, and to half of them, of which the corners of the other half
are missed by so much. Those of the commonest size count; --cut takes columns and rows from their left, top, right and
bottom first.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from roadproof.drives.own.boards import Boards, boards_in
from roadproof.drives.own.chessboard import calibrated
from roadproof.drives.own.plan import Chessboard
from roadproof.errors import RecordingError
from roadproof.geometry import CameraModel
from roadproof.io.files import write_json
from roadproof.lens import Lens, LensModel

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from chessboards import CORNERS, poses, write_boards
from lenses import ACTION, BARREL, PINCUSHION

PLAIN = CameraModel(width_px=640, height_px=480, fov_deg=62.0)
STRONG = Lens(model="brown-conrady", coefficients=(-0.31, 0.12, 0.0004, -0.0002, -0.03))
CAMERAS = {
    "pinhole, 62°": PLAIN,
    "barrel, 62°": replace(PLAIN, lens=BARREL),
    "strong barrel, 62°": replace(PLAIN, lens=STRONG),
    "pincushion, 45°": replace(PLAIN, fov_deg=45.0, lens=PINCUSHION),
    "fisheye, 100°": replace(PLAIN, fov_deg=100.0, lens=ACTION),
}
PICTURES = {"sharp": {"blur_px": 0.6, "noise": 2.0}, "noisy": {"blur_px": 1.5, "noise": 6.0}}


def elsewhere_px(camera: CameraModel, true: CameraModel) -> np.ndarray:
    """How far a camera shows what lies all over the picture of another from where that shows it, px."""
    columns, rows = (np.linspace(-0.5, size - 0.5, 41) for size in (true.width_px, true.height_px))
    places = np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)
    directions = true.undistorted(places)[0] @ np.linalg.inv(true.intrinsics).T
    return np.linalg.norm(camera.distorted(directions @ camera.intrinsics.T) - places, axis=1)


def drawn(true: CameraModel, count: int, how: dict[str, float], seeds: int) -> dict[str, object]:
    """What drawn pictures tell of the camera that drew them, the worst of some seeds."""
    lens: LensModel = "brown-conrady" if true.lens is None else true.lens.model
    rows: list[dict[str, float]] = []
    for seed in range(seeds):
        with tempfile.TemporaryDirectory() as place:
            write_boards(Path(place) / "boards", true, poses(true, count, seed), **how)
            boards = boards_in(Path(place), true, Chessboard(pictures="boards", corners=CORNERS, lens=lens))
        found = calibrated(PLAIN, boards, lens)
        off_px = elsewhere_px(found.camera, true)
        rows.append(
            {
                "fov_off_deg": abs(found.camera.fov_deg - true.fov_deg),
                "fov_error_deg": found.fov_error_deg,
                "missed_px": found.missed_px,
                "elsewhere_rms_px": math.sqrt(np.square(off_px).mean()),
                "unknown_px": found.unknown_px,
                "elsewhere_most_px": float(off_px.max()),
            }
        )
    return {"pictures": count, "seeds": seeds, **{name: max(row[name] for row in rows) for name in rows[0]}}


def half(boards: Boards, first: int) -> Boards:
    """Every second picture."""
    return replace(boards, names=boards.names[first::2], seen_px=boards.seen_px[first::2])


def missed_px(camera: CameraModel, boards: Boards) -> float:
    """By how much a camera misses corners in the median picture, rms, px, with poses that OpenCV finds of boards."""
    grid = np.column_stack([boards.grid, np.zeros(len(boards.grid))])
    each_px: list[float] = []
    for seen in boards.seen_px:
        straight = np.ascontiguousarray(camera.straightened(seen))
        _, turn, place = cv2.solvePnP(grid, straight, camera.intrinsics, None)
        turn, place = cv2.solvePnPRefineLM(grid, straight, camera.intrinsics, None, turn, place)
        shown = camera.distorted((grid @ cv2.Rodrigues(turn)[0].T + place.T) @ camera.intrinsics.T)
        each_px.append(math.sqrt(np.square(shown - seen).sum(-1).mean()))
    return float(np.median(each_px))


def real(folder: Path, corners: tuple[int, int], lens: LensModel, cut: list[int]) -> dict[str, object]:
    """What real pictures tell of their camera."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".jpg", ".png"))
    sizes = {path: Image.open(path).size for path in files}
    (wide, tall), _ = Counter(sizes.values()).most_common(1)[0]
    box = (cut[0], cut[1], wide - cut[2], tall - cut[3])
    with tempfile.TemporaryDirectory() as place:
        (Path(place) / "boards").mkdir()
        for path in (path for path, size in sizes.items() if size == (wide, tall)):
            Image.open(path).convert("RGB").crop(box).save(Path(place) / "boards" / f"{path.stem}.png")
        camera = CameraModel(width_px=box[2] - box[0], height_px=box[3] - box[1], fov_deg=60.0)
        boards = boards_in(Path(place), camera, Chessboard(pictures="boards", corners=corners, lens=lens))
    told: dict[str, object] = {"opencv_fov_deg": opencv_fov_deg(camera, boards)} if lens == "brown-conrady" else {}
    for name, some in {"all": boards, "every second picture": half(boards, 1)}.items():
        try:
            found = calibrated(camera, some, lens)
            told[name] = {
                "found": str(found),
                "lens": found.camera.stated.get("lens"),
                "missed_in_others_px": missed_px(found.camera, half(boards, 0)) if some is not boards else None,
            }
        except RecordingError as refused:
            told[name] = {"refused": str(refused)}
    return told


def opencv_fov_deg(camera: CameraModel, boards: Boards) -> float:
    """The field of view of OpenCV's own calibration with square pixels and a centred lens of five coefficients."""
    grid = np.column_stack([boards.grid, np.zeros(len(boards.grid))]).astype(np.float32)
    flags = cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_USE_INTRINSIC_GUESS
    size, seen = (camera.width_px, camera.height_px), list(boards.seen_px.astype(np.float32))
    _, intrinsics, *_ = cv2.calibrateCamera([grid] * len(seen), seen, size, camera.intrinsics, None, flags=flags)
    return math.degrees(2 * math.atan(camera.width_px / 2 / intrinsics[0, 0]))


def main() -> None:
    """Fit cameras and say how well."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--corners", type=int, nargs=2, default=CORNERS)
    parser.add_argument("--lens", choices=["brown-conrady", "fisheye"], default="brown-conrady")
    parser.add_argument("--cut", type=int, nargs=4, default=[0, 0, 0, 0])
    arguments = parser.parse_args()
    found: dict[str, object] = {"opencv": cv2.__version__}
    if arguments.pictures:
        found |= real(arguments.pictures, tuple(arguments.corners), arguments.lens, arguments.cut)
    else:
        for name, camera in CAMERAS.items():
            for kind, how in PICTURES.items():
                for count in (10, 20):
                    key = f"{name}, {kind}, {count} pictures"
                    found[key] = drawn(camera, count, how, arguments.seeds)
                    print(key, found[key], flush=True)
    write_json(arguments.json, found)
    print(json.dumps(found, indent=2, ensure_ascii=False))


if __name__ == "__main__":
    main()
