"""Does `roadproof import` see a real car's motion in its pictures alone? A stretch of Udacity's second challenge.

    git clone --depth 1 https://github.com/peikexin9/deepxplore
    git clone --depth 1 https://github.com/udacity/self-driving-car
    python benchmarks/real_drive.py --frames deepxplore/Driving/testing/center \
        --steering self-driving-car/challenges/challenge-2/CH2_final_evaluation.csv --out DRIVE --json OUT

The 5,614 pictures (MIT) are those of the challenge's last test, 20 a second; what was steered was published later. (The
angles in deepxplore's own final_example.csv are made up, as the challenge says.) DRIVE is left behind as a folder for
`roadproof import`. The JSON says how well pictures agree, the speed, and how yaw rate goes with steering times speed.

Assumed: the focal length that Udacity's repository states for the camera on the right, of the same make; horizon at row
231 of these pictures, where the road's marks meet; height so that dashes of the centre line come every 24 feet.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import shutil
from pathlib import Path

import numpy as np

from roadproof.drives.own import import_drives
from roadproof.io.files import write_json

FOCAL_PX, HORIZON_PX, UP_M = 2152.0, 231.0, 1.19
WHEEL_RAD = math.radians(25.0) * 14.8  # steer 1 turns the front wheels by 25°, the steering wheel 14.8 times that
WHEELBASE_M = 2.85

PLAN = """dt_s = 0.05
origin = "Udacity's challenge 2, final test, pictures {first} to {last}"

[camera]
width_px = 640
height_px = 480
fov_deg = {fov:.3f}
forward_m = 1.8
up_m = {up}
pitch_deg = {pitch:.3f}

[input]
left_px = 0
top_px = 230
right_px = 640
bottom_px = 480
width_px = 200
height_px = 66

[canvas]
ahead_m = {ahead}
width_m = 3.0
length_m = 9.0

[[drive]]
name = "clean"
side = "clean"
table = "clean.csv"
"""


def written(arguments: argparse.Namespace) -> np.ndarray:
    """The stretch as a folder of one's own; returns the angles of its steering wheel, radians, left positive."""
    rows = list(csv.DictReader(arguments.steering.open()))[arguments.first : arguments.first + arguments.count]
    arguments.out.mkdir(parents=True, exist_ok=True)
    plan = PLAN.format(
        first=arguments.first,
        last=arguments.first + len(rows) - 1,
        fov=math.degrees(2 * math.atan(320 / FOCAL_PX)),
        up=UP_M,
        pitch=-math.degrees(math.atan((239.5 - HORIZON_PX) / FOCAL_PX)),
        ahead=arguments.ahead_m,
    )
    (arguments.out / "drives.toml").write_text(plan)
    angle = np.array([float(row["steering_angle"]) for row in rows])
    with (arguments.out / "clean.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["picture", "steer"])
        for row, wheel in zip(rows, angle, strict=True):
            name = f"{row['frame_id']}.jpg"
            shutil.copyfile(arguments.frames / name, arguments.out / name)
            table.writerow([name, f"{-wheel / WHEEL_RAD:.6f}"])
    return angle


def main() -> None:
    """Write the stretch, import it and say what was seen."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=Path, required=True)
    parser.add_argument("--steering", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--first", type=int, default=5160)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--ahead-m", type=float, default=100.0)
    arguments = parser.parse_args()
    angle = written(arguments)
    recordings = import_drives(arguments.out)
    track = recordings.recordings[0].track
    assert track is not None
    rate = np.gradient(np.unwrap(track.yaw_rad), track.dt_s)
    by_wheel = track.speed_mps * np.tan(angle / 14.8) / WHEELBASE_M
    found = {
        "origin": recordings.origin,
        "speed_mps": [float(each) for each in np.percentile(track.speed_mps, [0, 50, 100])],
        "way_m": float(np.hypot(np.diff(track.x_m), np.diff(track.y_m)).sum()),
        "turned_deg": math.degrees(track.yaw_rad[-1] - track.yaw_rad[0]),
        "yaw_rate_with_steering": float(np.corrcoef(rate, by_wheel)[0, 1]),
        "yaw_rate_by_steering": [float(each) for each in np.polyfit(by_wheel, rate, 1)],
    }
    write_json(arguments.json, found)
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main()
