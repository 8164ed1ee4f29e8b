"""A folder of pictures and tables, as someone brings it who has no simulator."""

import csv

import numpy as np
from PIL import Image

from recorded_drives import CANVAS, track
from roadproof.geometry import CANVAS_CORNERS_PX, CIL_CAMERA, homography_from_pose
from roadproof.homographies import homogeneous

PLAN = """
dt_s = 0.05
origin = "a test road"

[camera]
width_px = 800
height_px = 600
fov_deg = 100.0
forward_m = 2.0
up_m = 1.4
pitch_deg = -15.0

[input]
left_px = 0
top_px = 115
right_px = 800
bottom_px = 510
width_px = 200
height_px = 88

[canvas]
x_m = 130.0
y_m = -40.0
yaw_rad = 0.6
"""
DRIVE = '\n[[drive]]\nname = "{0}"\nside = "{0}"\ntable = "{0}.csv"\n'
SIDES = {"clean": 0.0, "right": 1.0, "left": -1.0}
STATED = ("x_m", "y_m", "yaw_rad", "speed_mps", "steer", "throttle")
CORNER_NAMES = [f"{corner}_{axis}" for corner in ("far_left", "far_right", "near_right", "near_left") for axis in "xy"]


def corners(state, camera=CIL_CAMERA):
    """Where the corners of the canvas are seen, px."""
    return camera.distorted(homogeneous(homography_from_pose(camera, state, CANVAS), CANVAS_CORNERS_PX[:, :2])).ravel()


def through(lens, plan=PLAN):
    """A plan whose camera has a lens."""
    stated = f'[camera.lens]\nmodel = "{lens.model}"\ncoefficients = {list(lens.coefficients)}\n\n'
    return plan.replace("[input]", stated + "[input]")


def write_own(
    folder, drives=("clean", "right", "left"), columns=("x_m", "y_m", "yaw_rad"), plan=PLAN, every=4, camera=CIL_CAMERA
):
    """Drives towards the canvas, a picture every so many steps from 30 to 8 m before it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "drives.toml").write_text(plan + "".join(DRIVE.format(name) for name in drives))
    for name in drives:
        driven = track(SIDES[name])
        ahead = (CANVAS.x_m - driven.x_m) * np.cos(CANVAS.yaw_rad) + (CANVAS.y_m - driven.y_m) * np.sin(CANVAS.yaw_rad)
        shown = [k for k in np.flatnonzero((ahead < 30) & (ahead > 8)).tolist() if k % every == 0]
        (folder / name).mkdir(exist_ok=True)
        rate = np.gradient(driven.yaw_rad, driven.dt_s)
        rows = []
        for k in range(len(driven)):
            known = {each: getattr(driven, each)[k] for each in STATED}
            known |= {"yaw_rate_rad_s": rate[k], "picture": f"{name}/{k}.png" if k in shown else ""}
            if "far_left_x" in columns:
                known |= dict(zip(CORNER_NAMES, corners(driven.state(k), camera), strict=True))
            wanted = ("picture", *columns, "speed_mps", "steer", "throttle")
            rows.append({each: known[each] for each in dict.fromkeys(wanted)})
            if k in shown:
                grain = np.random.default_rng(k).integers(70, 150, (38, 50, 3), dtype=np.uint8)
                Image.fromarray(grain).resize((800, 600), 0).save(folder / f"{name}/{k}.png")
        if "far_left_x" in columns:
            rows = [row for row in rows if row["picture"]]
        write_table(folder / f"{name}.csv", rows)
    return folder


def write_table(path, rows):
    """Rows as comma-separated values."""
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


def changed_table(path, row, **values):
    """A table with other values in one row."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    rows[row] |= values
    write_table(path, rows)
