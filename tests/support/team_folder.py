"""A team's folder with all that a check needs, made without a simulator: plan, scenario, recordings, a pattern."""

import numpy as np
import torch

from paint_shy import PaintShy, magenta
from recorded_drives import CANVAS, drivable_set, track
from roadproof.datatypes import Ending, VehicleState, Weather
from roadproof.drives import Drive, Swerve, Trajectories, Window
from roadproof.drives.folder import Settings, write_drive, write_settings
from roadproof.driving.episode import Episode
from roadproof.geometry import CIL_CAMERA, CIL_INPUT
from roadproof.patterns import Pattern, save_pattern
from roadproof.recordings import Side, save_recordings
from roadproof.scenarios import Scenario, save_scenarios

SPEED_MPS = 12.0
BAR = magenta(300.0)
GREEN = Pattern(BAR.shapes, BAR.boxes, torch.tensor([[0.0, 0.5, 0.0]]))

PLAN = """
format = "roadproof-check"
version = 1
controller = "team_folder:magenta_shy"
scenario_file = "scenarios.toml"
scenarios = ["test-road"]
patterns = "patterns"
random = 0
seeds = [0, 1]

[starts]
count = 3
right_m = 0.05
turned_rad = 0.004
faster_mps = 0.5

[smoke]
recordings = ["recordings"]

[limits]
stored = { deviation_m = 0.2, left_lane = 0.0 }
"""


class MagentaShy(PaintShy):
    """Minds magenta alone, and not the grain of the made-up road."""

    def steer(self, frames, speed_mps, command):
        red, green, blue = frames.unbind(1)
        return self.gain * (torch.minimum(red, blue) - green - 0.5).clamp_min(0).mean((1, 2))


def magenta_shy():
    return MagentaShy(gain=6.0)


def scenario():
    driven = track(speed_mps=SPEED_MPS)
    begin = driven.state(0)
    start = VehicleState(begin.x_m, begin.y_m, 0.0, begin.yaw_rad, SPEED_MPS)
    goal_m = (CANVAS.x_m + 20.0 * np.cos(CANVAS.yaw_rad), CANVAS.y_m + 20.0 * np.sin(CANVAS.yaw_rad))
    return Scenario(name="test-road", kind="straight", map_name="town", start=start, goal_m=goal_m, canvas=CANVAS,
                    time_limit_s=3.0)  # fmt: skip


def write_team(folder, *, plan=PLAN, patterns=(("magenta", BAR), ("green", GREEN))):
    """Write the folder; give the path of the plan."""
    save_scenarios([scenario()], folder / "scenarios.toml")
    for name, pattern in patterns:
        save_pattern(pattern, folder / "patterns" / "test-road" / f"{name}.json")
    write_recorded(folder / "recordings" / "test-road")
    (folder / "check.toml").write_text(plan, encoding="utf-8")
    return folder / "check.toml"


def write_recorded(run):
    """A run as `roadproof record` and `calibrate` leave it."""
    settings = Settings(
        scenario=scenario(), weather=Weather.CLEAR_NOON, window=Window(),
        trajectories=Trajectories(count=3, perturbation=Swerve((1.0,))),
        seed=0, driver="nobody", camera=CIL_CAMERA, view=CIL_INPUT, dt_s=0.05,
    )  # fmt: skip
    write_settings(settings, run / "record")
    for name, right_m in (("clean", 0.0), ("right", 1.0), ("left", -1.0)):
        driven = track(right_m, speed_mps=SPEED_MPS)
        steps = len(driven.x_m)
        episode = Episode(
            scenario="test-road", weather=Weather.CLEAR_NOON, painted=False, cars=0, pedestrians=0, seed=0, dt_s=0.05,
            ending=Ending.GOAL_REACHED, events=(), time_s=0.05 * np.arange(steps), x_m=driven.x_m, y_m=driven.y_m,
            z_m=np.zeros(steps), yaw_rad=driven.yaw_rad, speed_mps=driven.speed_mps, command=np.full(steps, 2),
            steer=driven.steer[:-1], throttle=driven.throttle[:-1], brake=driven.brake[:-1],
        )  # fmt: skip
        frames = np.zeros((2, 88, 200, 3), np.uint8)
        write_drive(
            Drive(name=name, side=Side(name), episode=episode, frame_number=np.array([3, 5]), frames=frames,
                  steer=np.zeros(2), right_m=np.full(2, right_m)),
            run / "record",
        )  # fmt: skip
    save_recordings(drivable_set(SPEED_MPS), run / "recordings")
