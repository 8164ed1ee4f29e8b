"""A small set of recordings that can be driven in, made without a simulator: a known car on a grainy, straight road."""

import numpy as np
import torch

from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CanvasPlacement, homography_from_pose
from roadproof.photometry import AffineResponse, ColourTransform
from roadproof.recorded.nearest import Poses
from roadproof.recorded.vehicle import Motion, Vehicle
from roadproof.recordings import Recording, RecordingSet, Side, Track

CANVAS = CanvasPlacement(x_m=130.0, y_m=-40.0, yaw_rad=0.6)
VEHICLE = Vehicle.bicycle(wheelbase_m=2.8, steer_range_rad=0.7, dt_s=0.05)
PLAIN = ColourTransform(AffineResponse(torch.eye(3), torch.zeros(3)))
BEFORE_M = 36.0


def track(right_m=0.0, steps=140, speed_mps=6.0):
    """Straight towards the canvas with a little swing, so much beside its middle, at about that speed."""
    yaw, c, s = CANVAS.yaw_rad, np.cos(CANVAS.yaw_rad), np.sin(CANVAS.yaw_rad)
    x_m, y_m = CANVAS.x_m - BEFORE_M * c + right_m * s, CANVAS.y_m - BEFORE_M * s - right_m * c
    numbers = (x_m, y_m, yaw, speed_mps, 0.0, 0.0)
    car = Motion(*(torch.tensor([value], dtype=torch.float64) for value in numbers))
    rows = []
    for step in range(steps):
        given = (0.04 * np.sin(step / 6), 0.05, 0.0)
        rows.append((float(car.x_m), float(car.y_m), float(car.yaw_rad), float(car.speed_mps), *given))
        car = VEHICLE.step(car, *(torch.tensor([value], dtype=torch.float64) for value in given))
    x, y, heading, speed, steer, throttle, brake = np.array(rows).T
    return Track(dt_s=0.05, step=np.arange(steps), x_m=x, y_m=y, yaw_rad=heading, speed_mps=speed, steer=steer,
                 throttle=throttle, brake=brake)  # fmt: skip


def drive(side, right_m=0.0, seed=0, speed_mps=6.0):
    driven = track(right_m, speed_mps=speed_mps)
    ahead = (CANVAS.x_m - driven.x_m) * np.cos(CANVAS.yaw_rad) + (CANVAS.y_m - driven.y_m) * np.sin(CANVAS.yaw_rad)
    # From 29 to 6 m before the canvas' middle, every second step.
    numbers = np.flatnonzero((ahead < 29.0) & (ahead > 6.0))[::2]
    coarse = np.random.default_rng(seed).integers(70, 150, (len(numbers), 11, 25, 3), dtype=np.uint8)
    return Recording(
        name=str(side),
        side=side,
        frames=coarse.repeat(8, 1).repeat(8, 2),
        frame_number=numbers,
        image_from_canvas=np.stack([homography_from_pose(CIL_CAMERA, driven.state(int(k)), CANVAS) for k in numbers]),
        speed_mps=driven.speed_mps[numbers],
        command=np.full(len(numbers), 2),
        steer=driven.steer[numbers],
        track=driven,
    )


def drivable_set(speed_mps=6.0, **changes):
    sides = ((Side.CLEAN, 0.0), (Side.RIGHT, 1.0), (Side.LEFT, -1.0))
    drives = tuple(drive(side, right_m, seed, speed_mps) for seed, (side, right_m) in enumerate(sides))
    given = {"camera": CIL_CAMERA, "view": CIL_INPUT, "colour": PLAIN, "recordings": drives, "canvas": CANVAS}
    return RecordingSet(**given | {"origin": "test-road, clear-noon, driven by nobody"} | changes)


def shown_from(bank, track, row):
    """A pose of a track and the nearest recorded one, as a bank shows them."""
    poses = Poses(*(torch.tensor([v], dtype=torch.float64) for v in
                    (track.x_m[row] - CANVAS.x_m, track.y_m[row] - CANVAS.y_m, track.yaw_rad[row])))  # fmt: skip
    return poses, bank.nearest(poses)
