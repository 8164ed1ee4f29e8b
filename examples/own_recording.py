"""Attack a drive that you recorded yourself: your frames, and where the canvas is in each of them.

    python examples/own_recording.py DRIVE CONTROLLER [out/own-recording]

DRIVE holds the camera's pictures as PNGs, in order, of a road with nothing painted on it, and corners.csv: for each
picture the far left, far right, near right and near left corner of the stretch of road that may be painted, x and y in
px, and the speed in m/s. CONTROLLER is what `roadproof attack --controller` takes.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import roadproof
from roadproof.attacks import parse_groups
from roadproof.geometry import CameraModel, CropResize, homography_from_points
from roadproof.photometry import AffineResponse, ColourTransform

CAMERA = CameraModel(width_px=800, height_px=600, fov_deg=100.0)
INPUT = CropResize(left_px=0, top_px=115, right_px=800, bottom_px=510, width_px=200, height_px=88)
CORNERS = np.array([[-0.5, -0.5], [399.5, -0.5], [399.5, 399.5], [-0.5, 399.5]])


def main() -> None:
    """Read, make a recording, attack it."""
    folder, controller = Path(sys.argv[1]), roadproof.load_controller(sys.argv[2])
    out = Path(sys.argv[3] if len(sys.argv) > 3 else "out/own-recording")
    box = (INPUT.left_px, INPUT.top_px, INPUT.right_px, INPUT.bottom_px)
    size = (INPUT.width_px, INPUT.height_px)
    pictures = [Image.open(path).convert("RGB").crop(box) for path in sorted(folder.glob("*.png"))]
    table = np.loadtxt(folder / "corners.csv", delimiter=",", ndmin=2)
    count = len(pictures)
    drive = roadproof.Recording(
        name="clean",
        push=roadproof.Push.CLEAN,
        frames=np.stack([np.asarray(each.resize(size, Image.Resampling.BILINEAR)) for each in pictures]),
        frame_number=np.arange(count),
        image_from_canvas=np.stack([homography_from_points(CORNERS, row[:8].reshape(4, 2)) for row in table]),
        speed_mps=table[:, 8],
        command=np.full(count, 2),  # follow the lane
        steer=np.zeros(count),
    )
    colour = ColourTransform(AffineResponse.identity())  # paint looks as it is; better: fit_colour
    recordings = roadproof.RecordingSet(camera=CAMERA, view=INPUT, colour=colour, recordings=(drive,))
    groups = parse_groups("all", recordings)
    result = roadproof.attack(recordings, controller, roadproof.SearchSpace(figures=3), groups=groups)
    result.save(out)
    print(f"{result.surrogate_shift:.3f} steer a frame, predicted; the pattern is {out / 'pattern.png'}")


if __name__ == "__main__":
    main()
