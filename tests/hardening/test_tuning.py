"""Fine-tuning: paint moves the controller less, the bare road is answered as before, the rest stays as it was."""

import dataclasses
import shutil

import pytest
import torch

from hardening_road import SPACE, RampNet
from painted_ground import RampFollower
from roadproof.attacks.checkpoint import Checkpoint
from roadproof.controllers import pilotnet_controller
from roadproof.errors import ControllerError, TrainingError
from roadproof.hardening import HardeningBudget, Tuning, TuningBatch, views
from roadproof.hardening.batches import answers
from roadproof.hardening.tuning import require_loss, training_step, tune

TUNING = Tuning(steps=20, repeats=3, batch=16, learning_rate=0.3)


def tuned(street, *, spaces=(SPACE,), tuning=TUNING, seed=0, **options):
    network, found = RampNet(), SPACE.random((4,), torch.Generator().manual_seed(5))
    streets = street if isinstance(street, list) else [street]
    tune(network, RampFollower(), streets, spaces, found, None, tuning, seed=seed, **options)
    return network


def errors(network, street):
    """Mean distance from the teacher's answer to the bare road, on bare and on painted pictures."""
    views = street.draw(64, torch.Generator().manual_seed(99))
    patterns = SPACE.pattern(SPACE.random((len(views.frames),), torch.Generator().manual_seed(98)))
    teacher = RampFollower().steer(views.frames, None, None)
    with torch.no_grad():
        shown = (views.frames, views.painted(patterns))
        return [float((network.eval().steer(frames, None, None) - teacher).abs().mean()) for frames in shown]


def test_paint_moves_a_tuned_controller_less_and_the_bare_road_as_before(street):
    bare, painted = errors(RampNet(), street)
    network = tuned(street)
    bare_after, painted_after = errors(network, street)
    assert bare < 1e-4
    assert painted_after < 0.3 * painted
    assert bare_after < 0.2 * painted
    assert network.weight[1].item() == pytest.approx(4.0 * 0.43 / 0.2, rel=0.3)


def test_the_same_seed_learns_the_same_and_buffers_stay(street):
    one, same, other = (tuned(street, tuning=Tuning(steps=5, repeats=2, batch=8), seed=seed) for seed in (0, 0, 1))
    assert torch.equal(one.weight, same.weight)
    assert not torch.equal(one.weight, other.weight)
    assert not one.training
    for name, buffer in RampNet().named_buffers():
        assert torch.equal(buffer, one.get_buffer(name))


@pytest.mark.parametrize("frozen", [False, True])
def test_an_interrupted_tuning_goes_on_to_the_same_weights(street, tmp_path, frozen):
    def step(model, batch):
        return (model.bias - 3.0).square() if frozen else training_step(model, batch)

    def stop(done, loss):
        if done == 20:
            raise KeyboardInterrupt

    tuning, seen = Tuning(steps=25, repeats=2, batch=4), []
    kept = Checkpoint(tmp_path / "learning.safetensors", "this one")
    whole = tuned(street, tuning=tuning, step=step)
    with pytest.raises(KeyboardInterrupt):
        tuned(street, tuning=tuning, step=step, checkpoint=kept, on_step=stop)
    another = dataclasses.replace(kept, path=shutil.copy(kept.path, tmp_path / "other.safetensors"), identity="another")
    tuned(street, tuning=tuning, step=step, checkpoint=another, on_step=lambda done, loss: seen.append(done))
    assert seen == [10, 20, 25], "one of another tuning begins anew"
    seen.clear()
    again = tuned(street, tuning=tuning, step=step, checkpoint=kept, on_step=lambda done, loss: seen.append(done))
    assert seen == [25]
    assert torch.equal(again.weight, whole.weight)
    assert torch.equal(again.bias, whole.bias)


def test_a_training_step_of_ones_own_is_given_the_batch_and_its_loss_is_made_small(street):
    seen = []

    def step(model, batch):
        seen.append(batch)
        return (model.bias - 3.0).square()

    network = tuned(street, tuning=Tuning(steps=10, repeats=2, batch=4, learning_rate=0.5), step=step)
    assert network.bias.item() == pytest.approx(3.0, abs=0.5)
    assert torch.equal(network.weight, RampNet().weight)
    assert len(seen) == 20
    assert isinstance(seen[0], TuningBatch)
    # This controller only steers.
    assert seen[0].target.shape == (len(seen[0].frames), 1)
    assert max(training_step(RampNet().eval(), batch).item() for batch in seen) > 0


def test_a_tuning_that_comes_apart_is_told_and_not_gone_on_with(street, tmp_path):
    def step(model, batch):
        seen.append(batch)
        return (model.bias - 3.0).square() * (100.0 if len(seen) > 40 else 1.0)

    seen, kept = [], Checkpoint(tmp_path / "learning.safetensors", "this one")
    tuning = Tuning(steps=40, repeats=2, batch=4, learning_rate=1e-9)
    with pytest.raises(TrainingError, match=r"came apart at step 30: its loss is \S+, and was [\d.]+ at most before"):
        tuned(street, tuning=tuning, step=step, checkpoint=kept)
    assert int(kept.load(torch.device("cpu"))["steps"]) == 20
    with pytest.raises(TrainingError, match="came apart at step 30: "):
        tuned(street, tuning=tuning, step=step, checkpoint=kept)


def test_a_loss_that_is_a_root_is_none_that_cannot_be_learnt_from():
    def root(model, batch):
        answer = model.steer(batch.frames, batch.speed_mps, batch.command)
        return (answer - batch.target[:, 0]).square().mean().sqrt()

    same = RampNet().eval()
    require_loss(root, same, same, size=RampNet.input_size, device="cpu")


def written_over(model, batch):
    kept = model.bias.exp()
    loss = kept.square()
    kept += 1.0
    return loss


@pytest.mark.parametrize(
    ("step", "error", "message"),
    [
        (lambda model, batch: model.bias * float("nan"), TrainingError, "the loss is nan at step 1"),
        (lambda model, batch: 0.5, TrainingError, "gave a float, expected one number with a gradient"),
        (lambda model, batch: model.weight, TrainingError, r"a tensor of shape \(2,\)"),
        (lambda model, batch: torch.tensor(1.0), TrainingError, "with a gradient to the parameters"),
        (lambda model, batch: 1 / 0, ControllerError, "the training step raised ZeroDivisionError at .*test_tuning.py"),
        (lambda model, batch: (model.bias * 0).sqrt(), TrainingError, "the gradient of the loss is not finite at step"),
        (lambda model, batch: torch.ones((), requires_grad=True) * 2, TrainingError, "depends on no parameter"),
        (written_over, ControllerError, "the gradient of the training step raised RuntimeError: .*inplace operation"),
    ],
)
def test_training_steps_that_give_no_loss_or_gradient_are_one_line_before_anything_is_driven(
    street, step, error, message
):
    with pytest.raises(error, match=message):
        tuned(street, step=step)
    with pytest.raises(error, match=message):
        require_loss(step, RampNet(), RampFollower(), size=RampNet.input_size, device="cpu")


def test_a_batch_is_learnt_from_again_while_its_patterns_climb(street):
    seen, losses = [], []

    def step(model, batch):
        loss = training_step(model, batch)
        seen.append(batch)
        losses.append(loss.item())
        return loss

    # So slow that the controller stays what it was.
    tuned(street, tuning=Tuning(steps=10, repeats=4, batch=16, learning_rate=1e-9), step=step)
    first, last = losses[::4], losses[3::4]
    assert sum(last) > 1.1 * sum(first)
    asked = [batch.frames.requires_grad for batch in seen]
    assert asked == [True, True, True, False] * 10, "no gradient is taken for a step that is not made"
    pairs = list(zip(seen[::4], seen[3::4], strict=True))
    assert all(torch.equal(one.target, again.target) for one, again in pairs)
    changed = torch.cat([(one.frames != again.frames).flatten(1).any(1) for one, again in pairs])
    assert changed.any(), "patterns climb"
    assert not changed.all(), "what is bare stays bare"


def test_every_second_pass_over_the_streets_paints_what_attacks_do_not(street, monkeypatch):
    others, seen_shapes = HardeningBudget().learnt(SPACE)[1:], ["rectangle", "triangle", "diamond"]
    assert [(each.family, each.shape) for each in others] == [("free", each) for each in seen_shapes]
    drawn = []
    composite = views.composite_own

    def seen(pattern, *rest):
        drawn.append(pattern)
        return composite(pattern, *rest)

    monkeypatch.setattr(views, "composite_own", seen)
    tuned([street, street], spaces=(SPACE, *others), tuning=Tuning(steps=12, repeats=2, batch=16, learning_rate=1e-9))
    boxes = [pattern.boxes.detach() for pattern in drawn]
    # Published figures lie along the middle of the canvas.
    assert [bool((each[..., 1] == 200).all()) for each in boxes] == ([True] * 4 + [False] * 4) * 3
    assert [pattern.shapes[0] for pattern in drawn[4::8]] == seen_shapes
    moved = [not torch.equal(one, again) for one, again in zip(boxes[::2], boxes[1::2], strict=True)]
    assert all(moved), "those climb too"


@pytest.mark.parametrize(
    "changes",
    [
        {"steps": 0},
        {"batch": 2},
        {"learning_rate": 0.0},
        {"repeats": 0},
        {"climb": -0.1},
        {"learning_rate": float("inf")},
        {"bare": 1.5},
        {"found": -0.1},
    ],
)
def test_tunings_that_make_no_sense_are_refused(changes):
    with pytest.raises(TrainingError, match="expected"):
        Tuning(**changes)
    unchecked = Tuning.__init__.__wrapped__  # as it is without the tests' checks of types
    with pytest.raises(TrainingError, match=r"steps is 2\.5, expected a whole number, 1 or more"):
        unchecked(object.__new__(Tuning), steps=2.5)


def test_steering_that_controls_cut_can_still_be_learnt_from():
    network = pilotnet_controller()
    with torch.no_grad():
        network.network.fc[-1].bias += 3.0
    frames = torch.rand(2, 3, 88, 200, generator=torch.Generator().manual_seed(0))
    given = frames, torch.full((2,), 6.0), torch.full((2,), 2)
    said = answers(network, *given)
    assert network.controls(*given)[:, 0].tolist() == [1.0, 1.0]
    torch.testing.assert_close(said[:, 0], network.steer(*given), atol=0.05, rtol=0.0)
    torch.testing.assert_close(said[:, 1:], network.controls(*given)[:, 1:])
    assert said[:, 0].min() > 2.0
    loss = training_step(network, TuningBatch(*given, torch.zeros(2, 3)))
    loss.backward()
    assert float(network.network.fc[-1].bias.grad.abs().sum()) > 0.0
