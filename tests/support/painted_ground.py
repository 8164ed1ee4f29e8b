"""A road whose picture from any pose is known: smooth colours on the ground, a smooth sky, a straight clean drive."""

import dataclasses
from contextlib import contextmanager

import numpy as np
import pytest
import torch

from roadproof.datatypes import Control, VehicleState
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CanvasPlacement, homography_from_pose, sight
from roadproof.recorded import Vehicle
from roadproof.recordings import Recording, RecordingSet, Side, Track
from scenes import PLAIN

CANVAS = CanvasPlacement(x_m=120.0, y_m=-40.0, yaw_rad=0.0)
VIEW = dataclasses.replace(CIL_INPUT, resampling="area")
DT_S = 0.1
SPEED_MPS = 6.0
VEHICLE = dataclasses.replace(
    Vehicle.bicycle(wheelbase_m=2.8, steer_range_rad=0.7, dt_s=DT_S), pulling=(4.0, -8.0, -0.4, 0.0, 0.0)
)


@contextmanager
def known_vehicle():
    """The straight drives of the set say nothing of the steering."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Vehicle, "identified", staticmethod(lambda tracks: VEHICLE))
        yield


def pose(ahead_m, left_m=0.0, yaw_rad=0.0):
    """A car so far before (−) or behind the canvas' middle."""
    return VehicleState(CANVAS.x_m + ahead_m, CANVAS.y_m + left_m, 0.0, yaw_rad, SPEED_MPS)


def picture(state, camera=CIL_CAMERA):
    """What the camera sees, at the controller's input: colours by where on the ground, or by direction in the sky."""
    image = VIEW.input_from_camera @ camera.image_from_world(state)
    pixels = sight(VIEW, camera).through
    ground = np.linalg.inv(image[:, [0, 1, 3]]) @ pixels
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = ground[0] / ground[2] - CANVAS.x_m, ground[1] / ground[2] - CANVAS.y_m
    away = np.hypot(x + CANVAS.x_m - state.x_m, y + CANVAS.y_m - state.y_m)
    fade = np.exp(-away / 30)
    ramp = 8.0 * np.clip(y, -4.0, 4.0)
    waves = np.stack([12 * np.sin(x / 2), 10 * np.cos(y), 0 * x])
    ahead = np.linalg.inv(image[:, :3]) @ pixels
    turn = np.arctan2(ahead[1], ahead[0])
    sky = np.stack([120 + 30 * np.sin(3 * turn), 140 + 20 * np.cos(2 * turn), 180 + 10 * np.sin(turn)])
    shown = np.where(ground[2] > 0, 110 + fade * (ramp + waves), sky)
    return np.clip(np.round(shown), 0, 255).astype(np.uint8).T.reshape(VIEW.height_px, VIEW.width_px, 3)


def recorded(
    side=Side.CLEAN, left_m=0.0, *, yaw_rad=0.0, every=1, name=None, stands=0, camera=CIL_CAMERA, from_m=-29.0
):
    """A straight drive past the canvas, so far to the left, looking that way; it may stand for some steps first."""
    speed = np.full(67, SPEED_MPS)
    if stands:
        speed = np.concatenate([np.zeros(stands), np.minimum(0.3 * np.arange(1, 80), SPEED_MPS)])
    begin_m, shown_m = (-24.0, -25.0) if stands else (from_m - 3.0, from_m)
    ahead = begin_m + np.concatenate([[0.0], np.cumsum(speed[1:] * DT_S)])
    steps = np.arange(len(ahead))
    shown = steps[(ahead > shown_m) & (ahead < -1.5)][::every]
    count = len(ahead)
    states = [pose(ahead[step], left_m, yaw_rad) for step in shown]
    return Recording(
        name=name or str(side),
        side=side,
        frames=np.stack([picture(state, camera) for state in states]),
        frame_number=shown,
        image_from_canvas=np.stack([homography_from_pose(CIL_CAMERA, state, CANVAS) for state in states]),
        speed_mps=speed[shown],
        command=np.full(len(shown), 2),
        steer=np.zeros(len(shown)),
        track=Track(
            dt_s=DT_S,
            step=steps,
            x_m=CANVAS.x_m + ahead,
            y_m=np.full(count, CANVAS.y_m + left_m),
            yaw_rad=np.full(count, yaw_rad),
            speed_mps=speed,
            steer=np.zeros(count),
            throttle=np.full(count, 0.1),
            brake=np.zeros(count),
        ),
    )


def recorded_road(*, every=1, camera=CIL_CAMERA, from_m=-29.0):
    """A clean drive and one a metre and a half to each side, which show the canvas from so far before it."""
    drives = (
        recorded(every=every, camera=camera, from_m=from_m),
        recorded(Side.RIGHT, -1.5, every=every, camera=camera, from_m=from_m),
        recorded(Side.LEFT, 1.5, every=every, camera=camera, from_m=from_m),
    )
    return RecordingSet(camera=camera, view=VIEW, colour=PLAIN, recordings=drives, canvas=CANVAS)


MIDDLE = float(picture(pose(-15.0))[50:, :, 2].mean()) / 255


class RampFollower(torch.nn.Module):
    """Keeps to the middle of the ramp of brightness across the road; brighter paint steers it to the right."""

    input_size = (88, 200)

    def steer(self, frames, speed_mps, command):
        return 4.0 * (frames[:, 2, 50:].mean((1, 2)) - MIDDLE)

    def act(self, frame, speed_mps, command):
        frames = torch.tensor(frame).permute(2, 0, 1)[None] / 255
        return Control(steer=float(self.steer(frames, None, None)), throttle=0.1).clipped()


class Careful(RampFollower):
    """Keeps to the middle of the road at 6 m/s, brakes for bright paint and goes faster over dark paint."""

    def controls(self, frames, speed_mps, command):
        bright = frames[:, 2, 50:].mean((1, 2)) - MIDDLE
        effort = 0.1 + 0.2 * (6.0 - speed_mps) - 3.0 * bright
        return torch.stack([0.0 * effort, effort.clamp(0.0, 1.0), (-effort).clamp(0.0, 1.0)], 1)

    def act(self, frame, speed_mps, command):
        frames = torch.tensor(frame).permute(2, 0, 1)[None] / 255
        return Control(*map(float, self.controls(frames, torch.tensor([speed_mps]), None)[0]))
