"""Turn the CARLA recordings published with the GradOpt paper (left turn 70 → 63) into a set of recordings.

    python examples/import_carla_left_70_63.py DATA OUT

DATA is a folder with t1, t2, t3 (clean, right, left) and colour. The homographies and the colours of the
paint come from the authors' own calibration runs; what is imported is what their attack saw. Poses were not recorded:
they, and the size of the canvas in metres, follow from the homographies.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from roadproof import Recording, RecordingSet, Side, save_recordings
from roadproof.geometry import CIL_CAMERA, CIL_INPUT
from roadproof.photometry import ColourFit, fit_colour, samples_from_pictures
from roadproof.recorded import placed

DRIVES = {"t1": Side.CLEAN, "t2": Side.RIGHT, "t3": Side.LEFT}
DT_S = 0.1


def read_log(folder: Path) -> dict[int, dict[str, str]]:
    """What was logged, by frame number."""
    with (folder / "log.csv").open() as file:
        return {int(row["frame"]): row for row in csv.DictReader(file)}


def read_drive(folder: Path, side: Side) -> Recording:
    """One drive: the frames whose homography agrees with the known camera."""
    stored = np.load(folder / "homographies.npz", allow_pickle=False)
    numbers = stored["frame"][stored["consistent"].astype(bool)]
    log = read_log(folder)
    return Recording(
        name=str(side),
        side=side,
        frames=np.stack([np.asarray(Image.open(folder / "frames" / f"{n}.png").convert("RGB")) for n in numbers]),
        frame_number=numbers.astype(np.int64),
        image_from_canvas=stored["H"][stored["consistent"].astype(bool)],
        speed_mps=np.array([float(log[n]["speed_mps"]) for n in numbers]),
        command=np.array([int(log[n]["command"]) for n in numbers]),
        steer=np.array([float(log[n]["steer_clean"]) for n in numbers]),
    )


def read_controls(folder: Path, drive: Recording) -> np.ndarray:
    """Steer, throttle and brake applied from each frame on, (F, 3)."""
    log = read_log(folder)
    columns = ("steer_applied", "throttle_applied", "brake_applied")
    return np.array([[float(log[int(n)][column]) for column in columns] for n in drive.frame_number])


def read_colours(folder: Path) -> ColourFit:
    """Fit painted → seen to the authors' renders of the canvas in one colour after another."""
    with (folder / "colours.csv").open() as file:
        rows = list(csv.DictReader(file))
    pictures = [np.asarray(Image.open(folder / "real" / f"{row['index']}.png").convert("RGB")) for row in rows]
    samples = samples_from_pictures(
        torch.tensor([[float(row[channel]) / 255 for channel in "rgb"] for row in rows], dtype=torch.float64),
        torch.tensor(np.stack(pictures)),
        torch.tensor(np.asarray(Image.open(folder / "inner_mask.png").convert("L")) > 0),
        group=torch.tensor([(int(row["index"]) - 1) // 2 for row in rows]),  # a bright and a dark shade of each hue
    )
    return fit_colour(samples)


def main() -> None:
    """Read, fit, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    colours = read_colours(args.data / "colour")
    drives = {name: read_drive(args.data / name, side) for name, side in DRIVES.items()}
    unplaced = RecordingSet(
        camera=CIL_CAMERA,
        view=CIL_INPUT,
        colour=colours.transform,
        recordings=tuple(drives.values()),
        origin="CARLA 0.8.2, Town01, start 70, goal 63; github.com/jinghanY/physicalAttackImageComposition",
    )
    controls = {drive.name: read_controls(args.data / name, drive) for name, drive in drives.items()}
    recordings = placed(unplaced, dt_s=DT_S, controls=controls)
    save_recordings(recordings, args.out)
    print(f"colour: {colours.report.model}, {colours.report.left_out:.1f} levels off on hues left out of the fit")
    if recordings.canvas:
        print(f"canvas: {recordings.canvas.width_m:.2f} m across the road, {recordings.canvas.length_m:.2f} m along it")
    print(f"{args.out}: " + ", ".join(f"{r.name} {len(r.frames)} frames" for r in recordings.recordings))


if __name__ == "__main__":
    main()
