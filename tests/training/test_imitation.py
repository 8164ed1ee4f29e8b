"""Training learns what the pictures say, goes on where it stopped to the bit, and weighs what it is told to weigh."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from roadproof.controllers import (
    CIL,
    ConditionalPilotNet,
    CruiseControl,
    Plan,
    temporal_controller,
    waypoint_controller,
)
from roadproof.controllers.conditional import SPEED_SCALE_MPS, ConditionalOutput
from roadproof.controllers.temporal import WINDOW
from roadproof.errors import TrainingError
from roadproof.training import imitation
from roadproof.training.augmentation import Augmentation
from roadproof.training.dataset import SHARES, Batch, Dataset
from roadproof.training.imitation import (
    TrainingPlan,
    imitate,
    imitation_loss,
    plan_loss,
    scale_dropout,
)


@torch.no_grad()
def steering_error(network, data):
    """Mean distance between the network's steering and the expert's, over all frames as they are."""
    seen = data.batch(torch.arange(len(data)), torch.device("cpu"))
    return float((network.steer(seen.frames, seen.speed_mps, seen.command) - seen.expert[:, 0]).abs().mean())


def drives(count=240, seed=0):
    """A bright post stands where to steer to; the command says on which side to pass it."""
    generator = np.random.default_rng(seed)
    frames = generator.integers(60, 90, (count, 88, 200, 3)).astype(np.uint8)
    where = generator.integers(20, 180, count)
    command = generator.choice([2, 3, 4, 5], count).astype(np.int8)
    for frame, x in zip(frames, where, strict=True):
        frame[:, x - 8 : x + 8] = 240
    steer = (where - 100) / 160 + np.select([command == 3, command == 4], [-0.3, 0.3], 0.0)
    expert = np.stack([steer, np.full(count, 0.5), np.zeros(count)], 1).astype(np.float32)
    path = np.stack([np.arange(2.5, 20.1, 2.5) + 0 * steer[:, None], -np.outer(steer, np.arange(1, 9) ** 2 / 8)], 2)
    speed = generator.uniform(0, 8, count).astype(np.float32)
    return Dataset(frames, speed, command, expert, path.astype(np.float32), np.zeros(len(frames), np.int64))


def tiny(seed=0):
    return CIL(width=0.06, seed=seed)


PLAN = TrainingPlan(samples=32 * 60, batch=32, seed=1, learning_rate=4e-3, dropout=0.0)


@pytest.mark.parametrize(("network", "left"), [(tiny, 0.45), (ConditionalPilotNet, 0.85), (waypoint_controller, 0.95)])
def test_a_network_learns_to_steer_by_picture_and_command(network, left):
    data, unseen = drives(), drives(80, seed=9)
    untrained = steering_error(network().eval(), unseen)
    told = []
    learnt = imitate(network(), data, PLAN, every=20, on_progress=lambda *at: told.append(at))
    assert steering_error(learnt, unseen) < left * untrained
    assert [step for step, _ in told] == [20, 40, 60]
    assert told[-1][1] < 0.5 * told[0][1]
    assert not learnt.training


def test_an_interrupted_training_goes_on_to_the_bit(tmp_path):
    data, plan = drives(60), TrainingPlan(samples=8 * 40, batch=8, seed=3, dropout=1.0)
    whole = imitate(tiny(), data, plan, every=2)

    class CutError(Exception):
        pass

    def cut(step, _loss):
        # Before the checkpoint of this step is written.
        if step == 30:
            raise CutError

    with pytest.raises(CutError):
        imitate(tiny(), data, plan, every=2, checkpoint=tmp_path / "a.ckpt", on_progress=cut)
    steps = []
    resumed = imitate(
        tiny(), data, plan, every=2, checkpoint=tmp_path / "a.ckpt", on_progress=lambda step, _: steps.append(step)
    )
    assert steps[0] == 30
    for name, tensor in whole.state_dict().items():
        torch.testing.assert_close(resumed.state_dict()[name], tensor, rtol=0, atol=0)


def test_a_checkpoint_of_other_settings_or_a_damaged_one_is_refused(tmp_path):
    data, plan = drives(20), TrainingPlan(samples=16, batch=8)
    imitate(tiny(), data, plan, checkpoint=tmp_path / "a.ckpt", every=1)
    with pytest.raises(TrainingError, match="other settings"):
        imitate(tiny(), data, TrainingPlan(samples=16, batch=8, seed=9), checkpoint=tmp_path / "a.ckpt")
    with pytest.raises(TrainingError, match="damaged or of another network"):
        imitate(CIL(width=0.1), data, plan, checkpoint=tmp_path / "a.ckpt")
    (tmp_path / "a.ckpt").write_bytes(b"nothing")
    with pytest.raises(TrainingError, match="damaged"):
        imitate(tiny(), data, plan, checkpoint=tmp_path / "a.ckpt")


def test_a_checkpoint_from_before_all_plans_had_one_weight_decay_is_taken_up(tmp_path):
    data, plan, path = drives(20), TrainingPlan(samples=16, batch=8), tmp_path / "a.ckpt"
    imitate(tiny(), data, plan, checkpoint=path, every=1)
    content = torch.load(path, weights_only=True)
    content["plan"] |= {"weight_decay": 1e-2, "loss": {"steer": 0.6}}
    torch.save(content, path)
    steps = []
    imitate(tiny(), data, plan, checkpoint=path, every=1, on_progress=lambda step, _: steps.append(step))
    assert steps == []


def test_training_leaves_the_global_random_state_alone():
    before = torch.get_rng_state()
    imitate(tiny(), drives(20), TrainingPlan(samples=16, batch=8))
    assert torch.equal(before, torch.get_rng_state())


def test_the_loss_is_hubers_weighted():
    answer = ConditionalOutput(torch.tensor([[0.05, 0.0, 0.5]]), torch.tensor([0.3]))
    batch = Batch(
        torch.zeros(1, 3, 2, 2),
        torch.tensor([0.1 * SPEED_SCALE_MPS]),
        torch.tensor([2]),
        torch.zeros(1, 3),
        torch.zeros(1, 8, 2),
    )
    # Below 0.1: x² / 0.2; above: x − 0.05.
    expected = 0.6 * 0.05**2 / 0.2 + 0.2 * (0.5 - 0.05) + 0.05 * (0.2 - 0.05)
    assert float(imitation_loss(answer, batch)) == pytest.approx(expected, rel=1e-5)


def test_the_loss_of_a_plan_is_hubers_of_shares_of_the_distance_and_of_pedals():
    path = torch.tensor([[[3.0, 4.0], [10.0, 0.0]]])
    cruise = CruiseControl(gain_per_mps=0.5, hold=0.1)
    expert = torch.tensor([[0.0, 0.4, 0.0]])
    batch = Batch(torch.zeros(1, 3, 2, 2), torch.tensor([6.0]), torch.tensor([2]), expert, path)
    # One number of four is off by 0.5 m at 5 m; 6.6 m/s gives the expert's throttle, 7 m/s a fifth more.
    off = torch.tensor([[[0.5, 0.0], [0.0, 0.0]]])
    expected = 3.0 * 0.6 * (0.1 - 0.015) / 4 + 0.4 * (0.2 - 0.05)
    loss = plan_loss(Plan(path + off, torch.tensor([7.0])), batch, cruise)
    assert float(loss) == pytest.approx(expected, rel=1e-5)
    assert float(plan_loss(Plan(path, torch.tensor([6.6])), batch, cruise)) == pytest.approx(0.0, abs=1e-6)


def test_the_rate_rises_and_falls():
    plan = TrainingPlan(samples=1000 * 10, batch=10, learning_rate=2.0)
    rates = [plan.rate(step) for step in range(plan.steps)]
    assert rates[0] == pytest.approx(0.05)
    assert max(rates) == pytest.approx(2.0, rel=0.03)
    assert int(np.argmax(rates)) == pytest.approx(40, abs=2)
    assert rates[-1] == pytest.approx(0.01, rel=0.1)


def test_commands_are_drawn_in_their_shares_whatever_was_recorded():
    data = drives(400)
    command = np.where(np.arange(400) < 300, 2, np.where(np.arange(400) < 380, 3, np.where(np.arange(400) < 395, 4, 5)))
    data = replace(data, command=command.astype(np.int8))
    weights = data.weights().numpy()
    for asked, share in SHARES.items():
        assert weights[command == int(asked)].sum() == pytest.approx(share)


def test_frames_reach_the_network_as_they_were_recorded():
    data = drives(6)
    batch = data.batch(torch.tensor([4, 1]))
    assert batch.frames.shape == (2, 3, 88, 200)
    np.testing.assert_allclose(batch.frames[1, :, 20, 30] * 255, data.frames[1, 20, 30], atol=1e-4)
    np.testing.assert_array_equal(batch.expert, data.expert[[4, 1]])
    assert batch.command.tolist() == data.command[[4, 1]].tolist()


def test_dropout_is_scaled():
    network = tiny()
    before = [m.p for m in network.modules() if isinstance(m, torch.nn.Dropout)]
    scale_dropout(network, 0.5)
    after = [m.p for m in network.modules() if isinstance(m, torch.nn.Dropout)]
    assert after == pytest.approx([0.5 * p for p in before])
    assert max(before) == 0.5


@pytest.mark.parametrize("changes", [{"samples": 3}, {"batch": 0}, {"learning_rate": 0.0}, {"dropout": -1.0}])
def test_plans_that_make_no_sense_are_refused(changes):
    with pytest.raises(TrainingError):
        TrainingPlan(**({"samples": 1000} | changes))


def test_a_batch_has_a_whole_window_of_what_remembers():
    with pytest.raises(TrainingError, match=f"batch is 4, expected at least {WINDOW}, the frames of a network"):
        imitate(temporal_controller(), drives(20), TrainingPlan(samples=16, batch=4))


def test_nothing_recorded_is_refused():
    with pytest.raises(TrainingError, match="collect some first"):
        Dataset.load([])


def test_pictures_are_varied_as_they_are_learnt_from(monkeypatch):
    none = Augmentation(**dict.fromkeys(Augmentation.__slots__, 0.0))
    data = drives(20)
    one = imitate(tiny(), data, TrainingPlan(samples=16, batch=8))
    monkeypatch.setattr(imitation, "AUGMENTATION", none)
    other = imitate(tiny(), data, TrainingPlan(samples=16, batch=8))
    name = "convolutions.0.conv.weight"
    assert not torch.equal(one.state_dict()[name], other.state_dict()[name])


def test_windows_stay_in_their_drives():
    data = replace(drives(12), first=np.repeat([0, 5], [5, 7]))
    windows = data.windows(torch.tensor([3, 6, 11]), 4).reshape(3, 4)
    assert windows.tolist() == [[0, 1, 2, 3], [5, 5, 5, 6], [8, 9, 10, 11]]


def film(count=30, length=8, seed=0):
    """A post moves; the expert steers by how fast, which no single picture tells."""
    generator = np.random.default_rng(seed)
    frames = generator.integers(60, 70, (count * length, 88, 200, 3)).astype(np.uint8)
    pace = generator.choice([-8, 8], count)
    for k in range(count * length):
        x = 100 + pace[k // length] * (k % length - length // 2)
        frames[k, :, x - 10 : x + 10] = 240
    steer = np.repeat(pace / 16, length)
    expert = np.stack([steer, np.full(len(steer), 0.5), np.zeros(len(steer))], 1).astype(np.float32)
    path = np.stack([np.arange(2.5, 20.1, 2.5) + 0 * steer[:, None], -np.outer(steer, np.arange(1, 9) ** 2 / 8)], 2)
    speed, command = np.full(len(steer), 5.0, np.float32), np.full(len(steer), 2, np.int8)
    first = np.arange(count).repeat(length) * length
    return Dataset(frames, speed, command, expert, path.astype(np.float32), first)


def test_what_remembers_learns_what_no_single_picture_tells():
    plan = TrainingPlan(samples=64 * 60, batch=64, seed=1, learning_rate=4e-3, dropout=0.0)
    learnt = imitate(temporal_controller(seed=0), film(), plan)
    unseen = film(8, seed=9)
    batch = unseen.batch(torch.arange(len(unseen)))
    with torch.no_grad():
        plans = learnt.along(batch.frames, batch.speed_mps, batch.command)
        steer = learnt.steer_along(plans, batch.speed_mps)
        alone = learnt.steer(batch.frames, batch.speed_mps, batch.command)
    middle = torch.arange(4, len(unseen), 8)  # the post is in the middle, whichever way it goes
    right = batch.expert[middle, 0] > 0
    apart = steer[middle][right].mean() - steer[middle][~right].mean()
    assert apart > 0.06
    assert (alone[middle][right].mean() - alone[middle][~right].mean()).abs() < 0.1 * apart
