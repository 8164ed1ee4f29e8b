"""Networks that answer with points: steering by the law, speed by the points' times, and files that come back."""

import numpy as np
import pytest
import torch
from torch import nn

from roadproof.controllers import (
    ControllerCard,
    FramePreparation,
    LinearMPC,
    Plan,
    PurePursuit,
    TrajectoryController,
    check_controller,
    load_controller,
    save_controller,
    waypoint_controller,
)
from roadproof.errors import ControllerError


class Ahead(nn.Module):
    """Points a metre apart times the speed, that bend with the picture's brightness."""

    def __init__(self, shape=(-1, 5, 2)) -> None:
        super().__init__()
        self.shape = shape

    def forward(self, frames, speed_mps):
        x = torch.arange(1.0, 6.0, device=frames.device)[None] * speed_mps[:, None]
        bend = frames.mean(dim=(1, 2, 3))[:, None]
        return torch.stack([x, 0.05 * bend * x**2], 2).reshape(self.shape)


def controller(dt_s=None, network=None, **changes):
    told = {"preparation": FramePreparation(), "dt_s": dt_s, "inputs": ("frames", "speed_mps")} | changes
    return TrajectoryController(network or Ahead(), **told)


def asked(speed=(2.0, 4.0)):
    frames = torch.rand(2, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    return frames, torch.tensor(speed), torch.tensor([2, 2])


def test_it_steers_by_the_law_of_its_points():
    frames, speed, command = asked()
    points = Ahead()(frames, speed)
    for law in (PurePursuit(), LinearMPC()):
        torch.testing.assert_close(controller(law=law).steer(frames, speed, command), law.steer(points, speed))


def test_points_may_come_in_one_row():
    one, rows = controller(), controller(network=Ahead((-1, 10)))
    torch.testing.assert_close(one.steer(*asked()), rows.steer(*asked()))


def test_points_at_known_times_say_how_fast_to_drive():
    frames, speed, command = asked()
    straight = torch.zeros_like(frames)
    # A metre a second times the speed, every half second: twice as fast as now, so full throttle; every two seconds:
    # half as fast, so the brake.
    faster, slower = (controller(dt_s)(straight, speed, command).target_mps for dt_s in (0.5, 2.0))
    torch.testing.assert_close(faster, 2 * speed)
    torch.testing.assert_close(slower, 0.5 * speed)
    assert (controller(0.5).controls(frames, speed, command)[:, 1] > 0.5).all()
    assert (controller(2.0).controls(straight, 4 * speed, command)[:, 2] > 0.3).all()
    assert controller()(frames, speed, command).target_mps is None


def test_it_keeps_the_promises_that_attacks_rely_on():
    check_controller(controller(0.5), size=(24, 32)).require()


def test_steering_in_half_precision_is_near():
    half = controller(network=Ahead())
    half.network.register_buffer("precision", torch.zeros(1, dtype=torch.bfloat16))
    torch.testing.assert_close(half.steer(*asked()), controller().steer(*asked()), atol=0.02, rtol=0.05)


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (Ahead((-1, 2, 5)), r"answers 2 frames with shape \(2, 2, 5\), expected points ahead and left"),
        (Ahead((10, 2)), r"shape \(10, 2\)"),
        (nn.Identity(), "expected points ahead and left"),
    ],
)
def test_an_answer_that_is_no_trajectory_is_refused(network, message):
    inputs = ("frames",) if isinstance(network, nn.Identity) else ("frames", "speed_mps")
    frames, speed, command = asked()
    with pytest.raises(ControllerError, match=message):
        controller(network=network, inputs=inputs).steer(frames[..., :7], speed, command)


@pytest.mark.parametrize("dt_s", [0.0, -1.0, float("nan"), 11.0])
def test_times_that_are_none_are_refused(dt_s):
    with pytest.raises(ControllerError, match=r"points of a trajectory lie .* s apart, expected above 0, at most 10"):
        controller(dt_s)


class TestWaypoint:
    def test_it_keeps_the_promises_that_attacks_rely_on(self):
        check_controller(waypoint_controller(seed=1).eval()).require()

    def test_only_the_commanded_head_answers(self):
        made = waypoint_controller(seed=1).eval()
        frames = torch.rand(4, 3, 88, 200, generator=torch.Generator().manual_seed(0))
        asked = frames, torch.full((4,), 5.0), torch.tensor([2, 3, 4, 5])
        before: Plan = made(*asked)
        with torch.no_grad():
            made.network.heads[2][-1].bias[0] += 0.36  # left, by a metre a second
        after: Plan = made(*asked)
        torch.testing.assert_close(after.target_mps - before.target_mps, torch.tensor([0.0, 1.0, 0.0, 0.0]))
        torch.testing.assert_close(after.path, before.path)

    def test_one_seed_gives_one_network_and_leaves_the_random_state_alone(self):
        before = torch.get_rng_state()
        one, other = (waypoint_controller(seed=3).state_dict() for _ in range(2))
        assert torch.equal(before, torch.get_rng_state())
        assert all(torch.equal(one[name], other[name]) for name in one)
        assert not torch.equal(waypoint_controller(seed=4).network.squeeze.weight, one["network.squeeze.weight"])

    def test_it_survives_its_file_with_its_law(self, tmp_path):
        made = waypoint_controller(seed=3, law=LinearMPC(pieces=3)).eval()
        save_controller(made, tmp_path / "w.safetensors")
        loaded = load_controller(tmp_path / "w.safetensors")
        assert isinstance(loaded, TrajectoryController)
        assert loaded.law == LinearMPC(pieces=3)
        frame = np.random.default_rng(0).integers(0, 256, (88, 200, 3), np.uint8)
        assert loaded.act(frame, 5.0, 3).steer == pytest.approx(made.act(frame, 5.0, 3).steer, abs=1e-5)


def test_an_exported_network_that_answers_with_points_is_a_controller(tmp_path):
    path = tmp_path / "net.pt2"
    batch = torch.export.Dim("batch")
    example = torch.rand(3, 3, 16, 16), torch.rand(3)
    program = torch.export.export(Ahead(), example, dynamic_shapes=({0: batch}, {0: batch}))
    torch.export.save(program, path)
    card = ControllerCard(tracking=PurePursuit(sight_m=3.0), dt_s=0.5)
    path.with_suffix(".json").write_text(card.to_json())
    loaded = load_controller(path)
    frames, speed = torch.rand(2, 3, 16, 16), torch.tensor([2.0, 4.0])
    expected = controller(0.5, law=PurePursuit(sight_m=3.0)).controls(frames, speed, torch.tensor([2, 2]))
    found = loaded.controls(frames, speed, torch.tensor([2, 2]))
    torch.testing.assert_close(found[:, 0], expected[:, 0])
