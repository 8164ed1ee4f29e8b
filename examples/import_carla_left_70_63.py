"""Turn the CARLA recordings published with the GradOpt paper (left turn 70 → 63) into a set of recordings.

    python examples/import_carla_left_70_63.py DATA OUT

DATA is a folder with t1, t2, t3 (clean, pushed right, pushed left) and colour. The homographies and the colours of the
paint come from the authors' own calibration runs; what is imported is what their attack saw.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
from PIL import Image

from roadproof.geometry import CIL_CAMERA, CIL_INPUT
from roadproof.photometry import ColourTransform
from roadproof.recordings import Push, Recording, RecordingSet, save_recordings

DRIVES = {"t1": Push.CLEAN, "t2": Push.RIGHT, "t3": Push.LEFT}


def read_drive(folder: Path, push: Push) -> Recording:
    """One drive: the frames whose homography agrees with the known camera."""
    stored = np.load(folder / "homographies.npz", allow_pickle=False)
    numbers = stored["frame"][stored["consistent"].astype(bool)]
    with (folder / "log.csv").open() as file:
        log = {int(row["frame"]): row for row in csv.DictReader(file)}
    return Recording(
        name=str(push),
        push=push,
        frames=np.stack([np.asarray(Image.open(folder / "frames" / f"{n}.png").convert("RGB")) for n in numbers]),
        frame_number=numbers.astype(np.int64),
        image_from_canvas=stored["H"][stored["consistent"].astype(bool)],
        speed_mps=np.array([float(log[n]["speed_mps"]) for n in numbers]),
        command=np.array([int(log[n]["command"]) for n in numbers]),
        steer=np.array([float(log[n]["steer_clean"]) for n in numbers]),
    )


def main() -> None:
    """Read, fit, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    recordings = RecordingSet(
        camera=CIL_CAMERA,
        view=CIL_INPUT,
        colour=ColourTransform(),
        recordings=tuple(read_drive(args.data / name, push) for name, push in DRIVES.items()),
        origin="CARLA 0.8.2, Town01, start 70, goal 63; github.com/jinghanY/physicalAttackImageComposition",
    )
    save_recordings(recordings, args.out)
    print(f"{args.out}: " + ", ".join(f"{r.name} {len(r.frames)} frames" for r in recordings.recordings))


if __name__ == "__main__":
    main()
