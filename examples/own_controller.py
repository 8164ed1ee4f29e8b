"""Stress-test a controller of your own in the town.

    python examples/own_controller.py [out/own-controller]

A controller is any object with these three members; `steer` must be differentiable in the frames. This one follows the
yellow line in the middle of the road, so paint that looks like one should lead it astray.
"""

import sys
from pathlib import Path

import torch

import roadproof


class LineFollower(torch.nn.Module):
    """Keeps the yellow line where it belongs in the picture."""

    input_size = (88, 200)

    def steer(self, frames: torch.Tensor, speed_mps: torch.Tensor, command: torch.Tensor) -> torch.Tensor:  # noqa: ARG002
        """(b, 3, 88, 200) in [0, 1] to (b,), positive to the right."""
        red, green, blue = frames[:, :, 40:80].unbind(1)
        yellow = (torch.minimum(red, green) - blue - 0.1).clamp(min=0)
        off = torch.arange(200.0) - (73.0 - 1.36 * torch.arange(40.0)[:, None])
        seen = yellow * torch.exp(-((off / 15) ** 2))
        return 0.03 * (seen * off).sum((1, 2)) / (seen.sum((1, 2)) + 1.0)

    def act(self, frame, speed_mps: float, command: int) -> roadproof.Control:  # noqa: ANN001
        """What the car does now."""
        frames = torch.tensor(frame).permute(2, 0, 1)[None] / 255
        steer = self.steer(frames, torch.tensor([speed_mps]), torch.tensor([command]))
        return roadproof.CruiseControl(target_mps=6.0).control(float(steer), speed_mps)


def main() -> None:
    """Record, calibrate, attack, drive, report."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/own-controller")
    scenario = roadproof.find_scenario("straight-04")
    with roadproof.TownSimulator() as town:
        result = roadproof.stress_test(town, LineFollower(), scenario, out)
    for trial in result.evaluation.trials:
        print(
            f"{trial.weather}: {trial.deviation_m:.2f} m, {trial.points:.0f} points instead of {trial.clean_points:.0f}"
        )
    print(roadproof.write_report(out))


if __name__ == "__main__":
    main()
