"""Controllers that remember: what is kept in time, stacks of frames, the shipped network, and what is refused."""

import numpy as np
import pytest
import torch
from torch import nn

from roadproof.controllers import (
    ControllerCard,
    FramePreparation,
    HistoryController,
    PurePursuit,
    SteeringController,
    TemporalController,
    TrajectoryController,
    check_controller,
    load_controller,
    save_controller,
    temporal_controller,
)
from roadproof.controllers.history import TICK_S, kept_after
from roadproof.controllers.identity import identity_of
from roadproof.controllers.temporal import NOTES, WINDOW
from roadproof.datatypes import Command, Observation, VehicleState
from roadproof.driving.rollout import _acting
from roadproof.errors import ControllerError


def frames(count, size=(24, 32), seed=0):
    return torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(seed))


def asked(count=1, speed=4.0):
    return torch.full((count,), speed), torch.full((count,), 2)


class Rising(nn.Module):
    """Steers by how much brighter the newest of three frames is than the oldest, and a little by the middle one."""

    def forward(self, frames):
        light = frames.mean(dim=(2, 3, 4))
        return light[:, 2] - light[:, 0] + 0.1 * light[:, 1]


class Points(Rising):
    """The same as a line of points that bends."""

    def forward(self, frames):
        ahead = torch.arange(1.0, 9.0)
        return torch.stack([ahead.expand(len(frames), -1), super().forward(frames)[:, None] * ahead**2 / 64], 2)


def three(apart_s=0.1, network=None):
    return HistoryController(
        SteeringController(network or Rising(), preparation=FramePreparation()), frames=3, apart_s=apart_s
    )


def light(value, count=1):
    return torch.full((count, 3, 8, 8), value)


def driven(controller, values, elapsed_s):
    """Steering over single frames of a drive."""
    memory, steer = None, []
    for k, value in enumerate(values):
        controls, memory = controller.controls_after(memory, light(value), *asked(), elapsed_s if k else 0.0)
        steer.append(float(controls[0, 0]))
    return steer


@pytest.mark.parametrize("elapsed_s", [1 / 30, 0.02, 0.07, 0.0])
def test_moments_that_are_no_whole_ticks_apart_are_refused(elapsed_s):
    kept = kept_after(None, "a", 0.0, 3)
    with pytest.raises(
        ControllerError, match=f"the moments of the drive are {elapsed_s:g} s apart, expected a multiple"
    ):
        kept_after(kept, "b", elapsed_s, 3)


def test_places_are_a_tick_apart_newest_first():
    kept = None
    for k in range(6):
        kept = kept_after(kept, k, TICK_S, 3)
    assert kept == (5, 4, 3, 2)
    assert kept_after(None, 7, 0.0, 2) == (7, 7, 7)


def test_moments_further_apart_stand_for_the_ticks_between():
    kept = kept_after(kept_after(None, "a", 0.0, 5), "b", 3 * TICK_S, 5)
    assert kept == ("b", "a", "a", "a", "a", "a")
    assert kept_after(kept, "c", 2 * TICK_S, 5) == ("c", "b", "b", "a", "a", "a")


def test_a_stack_holds_the_frames_at_their_times():
    values = [0.0, 0.1, 0.3, 0.6, 0.9]
    # A frame a step, two steps apart: newest, the one two before, the one four before; at first the first stands in.
    at = [(max(k - 4, 0), max(k - 2, 0), k) for k in range(5)]
    expected = [values[c] - values[a] + 0.1 * values[b] for a, b, c in at]
    assert driven(three(0.1), values, TICK_S) == pytest.approx(expected, abs=1e-6)
    # Half as many frames, each for two steps, give the same where frames are the same.
    assert driven(three(0.1), values[::2], 2 * TICK_S) == pytest.approx(expected[::2], abs=1e-6)


def test_single_frames_are_answered_as_first_ones():
    controller, seen = three(), frames(4)
    speed, command = asked(4)
    expected = 0.1 * seen.mean(dim=(1, 2, 3))
    torch.testing.assert_close(controller.steer(seen, speed, command), expected)
    torch.testing.assert_close(controller.controls(seen, speed, command)[:, 0], expected)
    control = controller.act((seen[0].permute(1, 2, 0) * 255).byte().numpy(), 4.0, 2)
    assert control.steer == pytest.approx(float(expected[0]), abs=0.001)


def test_points_are_tracked_along_a_stack_too():
    single = TrajectoryController(Points(), preparation=FramePreparation(), law=PurePursuit())
    controller = HistoryController(single, frames=3, apart_s=0.05)
    steer = driven(controller, [0.0, 0.5, 0.0], TICK_S)
    assert steer[0] == pytest.approx(0.0, abs=1e-6)
    assert steer[1] < -0.02  # brighter: to the left, which is negative
    assert abs(steer[2]) < 0.2 * abs(steer[1])


def test_the_gradient_reaches_every_frame_of_a_stack():
    leaves = [light(0.5).requires_grad_() for _ in range(3)]
    memory = None
    for leaf in leaves:
        controls, memory = three(0.05).controls_after(memory, leaf, *asked(), TICK_S)
    gradients = torch.autograd.grad(controls[0, 0], leaves)
    assert [float(g.sum()) for g in gradients] == pytest.approx([-1.0, 0.1, 1.0], abs=1e-5)


@pytest.mark.parametrize("apart_s", [0.0, 0.03, 0.125, 11.0, float("nan")])
def test_times_that_are_no_ticks_are_refused(apart_s):
    with pytest.raises(ControllerError, match=r"expected a multiple of 0\.05 s"):
        three(apart_s)


def test_one_frame_is_no_stack():
    with pytest.raises(ControllerError, match="takes 1 frames at once, expected 2 to 64"):
        HistoryController(SteeringController(Rising(), preparation=FramePreparation()), frames=1, apart_s=0.1)


def test_what_remembers_keeps_the_promises():
    assert isinstance(three(), TemporalController)
    report = check_controller(three(), size=(24, 32))
    report.require()
    names = [check.name for check in report.checks]
    assert names[-5:] == ["memory", "memory untouched", "cars apart", "gradient through memory", "drives"]


class Forgetful(HistoryController):
    """Breaks one promise of those about its memory."""

    def __init__(self, fault):
        super().__init__(SteeringController(Rising(), preparation=FramePreparation()), frames=3, apart_s=0.05)
        self.fault, self.own = fault, 0.0

    def controls_after(self, memory, frames, speed_mps, command, elapsed_s):
        controls, kept = super().controls_after(memory, frames, speed_mps, command, elapsed_s)
        if self.fault == "own state":
            self.own += 0.01
            controls = controls + torch.tensor([self.own, 0.0, 0.0])
        if self.fault == "other first answer" and memory is None:
            controls = controls.detach() * 0 + 0.5 + 0 * frames.sum()
        if self.fault == "detached":
            kept = tuple(frame.detach() for frame in kept)
        if self.fault == "over the batch":
            controls = controls + 0.1 * frames.mean()
        if self.fault == "no tuple":
            return controls
        return controls, kept


@pytest.mark.parametrize(
    ("fault", "check"),
    [
        ("own state", "memory untouched"),
        ("other first answer", "memory"),
        ("detached", "gradient through memory"),
        ("over the batch", "cars apart"),
        ("no tuple", "memory"),
    ],
)
def test_a_broken_promise_is_found(fault, check):
    report = check_controller(Forgetful(fault), size=(24, 32))
    assert check in [failure.name for failure in report.failures]


def test_a_wrong_answer_is_one_line():
    class Wrong(Forgetful):
        def controls_after(self, *arguments):
            return super().controls_after(*arguments)[0][:, :1], None

    failure = check_controller(Wrong(None), size=(24, 32)).failures[0]
    assert "controls_after answered shape (8, 1)" in failure.finding


def seen(time_s, value):
    frame = np.full((8, 8, 3), round(255 * value), np.uint8)
    state = VehicleState(0.0, 0.0, 0.0, 4.0, 0.0)
    return Observation(frame=frame, time_s=time_s, state=state, command=Command.FOLLOW, events=(), done=False)


def test_each_drive_begins_without_a_memory():
    policies = [_acting(three(0.05)) for _ in range(2)]
    values = [0.0, 0.2, 0.4]
    steer = [[policy(seen(0.05 * k, value)).steer for k, value in enumerate(values)] for policy in policies]
    assert steer[0] == steer[1]
    assert steer[0] == pytest.approx(driven(three(0.05), values, TICK_S), abs=0.002)


class TestShipped:
    """The network that comes with the package."""

    def test_it_keeps_the_promises(self):
        check_controller(temporal_controller(seed=1).eval()).require()

    def test_windows_in_training_are_answered_as_frames_of_a_drive(self):
        controller = temporal_controller(seed=1).eval()
        window = frames(2 * WINDOW, (88, 200))
        with torch.no_grad():
            plan = controller.along(window, *asked(2 * WINDOW))
            for start in (0, WINDOW):
                memory = None
                for k in range(start, start + WINDOW):
                    told = (window[k : k + 1], *asked())
                    controls, memory = controller.controls_after(memory, *told, 0.1 if k > start else 0.0)
                    expected = controller.controls_along(
                        type(plan)(plan.path[k : k + 1], plan.target_mps[k : k + 1]), asked()[0]
                    )
                    torch.testing.assert_close(controls, expected, atol=1e-5, rtol=1e-5)

    def test_notes_are_a_tenth_of_a_second_apart_at_any_step(self):
        controller = temporal_controller(seed=1).eval()
        film = frames(NOTES + 1, (88, 200))
        answers = []
        for each in (1, 2):
            memory = None
            with torch.no_grad():
                for k in range(each * (NOTES + 1)):
                    told = (film[k // each][None], *asked())
                    controls, memory = controller.controls_after(memory, *told, 0.1 / each if k else 0.0)
            answers.append(controls)
        torch.testing.assert_close(*answers, atol=1e-5, rtol=1e-5)

    def test_what_came_before_matters(self):
        controller = temporal_controller(seed=1).eval()
        last, told = frames(1, (88, 200), seed=5), asked()
        with torch.no_grad():
            memories = [controller.controls_after(None, frames(1, (88, 200), seed=s), *told, 0.0)[1] for s in (1, 2)]
            one, other = (controller.controls_after(memory, last, *told, 0.1)[0] for memory in memories)
        assert (one - other).abs().max() > 1e-5

    def test_weights_come_back_as_they_were(self, tmp_path):
        made = temporal_controller(seed=2).eval()
        save_controller(made, tmp_path / "mine.safetensors")
        loaded = load_controller(tmp_path / "mine.safetensors")
        assert isinstance(loaded, TemporalController)
        told = (frames(2, (88, 200)), *asked(2))
        with torch.no_grad():
            torch.testing.assert_close(loaded.controls(*told), made.controls(*told))


def export(network, path, n=3):
    batch = torch.export.Dim("batch")
    stack = torch.rand(2, n, 3, 24, 32)
    torch.export.save(torch.export.export(network, (stack,), dynamic_shapes=({0: batch},)), path)


def test_an_exported_network_of_several_frames_drives(tmp_path):
    export(Rising(), tmp_path / "net.pt2")
    (tmp_path / "net.json").write_text(ControllerCard(frames_apart_s=0.1).to_json())
    controller = load_controller(tmp_path / "net.pt2")
    assert controller.input_size == (24, 32)
    values = [0.0, 0.1, 0.3, 0.6, 0.9]
    memory, steer = None, []
    for value in values:
        controls, memory = controller.controls_after(memory, torch.full((1, 3, 24, 32), value), *asked(), TICK_S)
        steer.append(float(controls[0, 0]))
    assert steer == pytest.approx(driven(three(0.1), values, TICK_S), abs=1e-5)
    check_controller(controller).require()


def test_an_exported_network_and_its_card_must_agree(tmp_path):
    export(Rising(), tmp_path / "net.pt2")
    with pytest.raises(ControllerError, match="takes 3 frames at once and its card says frames_apart_s None"):
        load_controller(tmp_path / "net.pt2")

    class One(nn.Module):
        def forward(self, frames):
            return frames.mean(dim=(1, 2, 3))

    batch = torch.export.Dim("batch")
    program = torch.export.export(One(), (torch.rand(2, 3, 24, 32),), dynamic_shapes=({0: batch},))
    torch.export.save(program, tmp_path / "one.pt2")
    (tmp_path / "one.json").write_text(ControllerCard(frames_apart_s=0.1).to_json())
    with pytest.raises(ControllerError, match=r"takes one frame at once and its card says frames_apart_s 0\.1"):
        load_controller(tmp_path / "one.pt2")


def test_what_is_remembered_tells_controllers_apart():
    networks = [temporal_controller(seed=1).eval() for _ in range(2)]
    with torch.no_grad():
        networks[1].network.note[2].weight.mul_(5.0)  # says nothing of a first frame
    first = [network.controls(frames(2, (88, 200)), *asked(2)) for network in networks]
    torch.testing.assert_close(*first, atol=0.0, rtol=0.0)
    answers = [identity_of(each, (88, 200)) for each in (*networks, three(0.1), three(0.2))]
    assert len(set(answers)) == 4
    assert identity_of(networks[0], (88, 200)) == answers[0]
