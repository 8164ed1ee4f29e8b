"""Steps that are replayed: what they do is what steps do one by one, and they ask for nothing from the device."""

import copy
import dataclasses
from collections import Counter

import pytest
import torch

from roadproof.attacks import GradOpt, Surrogate, attack, captured
from roadproof.attacks.captured import Replay, replay_of
from roadproof.attacks.gradopt import Rung, gradopt
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP
from roadproof.attacks.published import PublishedMeasure
from roadproof.attacks.step import corrected, state_at, stepped
from roadproof.compositing.variation import Variation
from roadproof.controllers import CIL, pilotnet_controller
from roadproof.coverage import Shape
from roadproof.errors import ControllerError, RoadproofError
from roadproof.paint.limits import PaintLimits
from roadproof.paint.site import LaneMark, Site
from roadproof.photometry import ColourTransform
from roadproof.photometry.responses import FilmResponse
from roadproof.search_space import SearchSpace
from scenes import LinearController, recording_set
from waiting import WaitingError, no_waiting, on_meta

GROUPS = (RIGHT_GROUP, LEFT_GROUP)
LADDER = (Rung(4, 3, every=2), Rung(3, 4), Rung(3, 3, 0.03))
FILM = ColourTransform(FilmResponse(torch.tensor([1.1, 1.0, 0.9]), torch.tensor(1.2), torch.tensor(1.0)))
MARK = LaneMark(points_m=((1.0, 0.0), (1.0, 9.0)))
LIMITED = SearchSpace(
    figures=2,
    family="free",
    limits=PaintLimits(
        max_area_m2=6.0,
        printable=True,
        contrast=(0.1, 0.9),
        keep_out_m=0.2,
        marks=(MARK,),
    ),
).on(Site(size_m=(7.56, 9.53), asphalt=(0.35, 0.35, 0.36)))


def steering():
    weight = torch.randn(3, 88, 200, generator=torch.Generator().manual_seed(0)) * 1e-3
    return LinearController(weight.cumsum(2) * 0.1)


class Asking(LinearController):
    """A controller of somebody's own that looks at a number on the way."""

    def steer(self, frames, speed_mps, command):
        return super().steer(frames, speed_mps, command) * (1.0 if speed_mps.mean().item() > 0 else 0.5)


class Breaking(LinearController):
    """Answers NaN once it has been asked a number of times."""

    asked = 0

    def steer(self, frames, speed_mps, command):
        self.asked += 1
        return super().steer(frames, speed_mps, command) * (torch.nan if self.asked > 9 else 1.0)


class Dense(Surrogate):
    """Paints as replayed steps do, so that nothing but the replay differs."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        vars(self).update(vars(self.replayable()), frames_evaluated=self.frames_evaluated)


class Drawn(Surrogate):
    """A measure with random gradients of very different sizes."""

    def __init__(self):
        super().__init__(recording_set(frames=1), steering(), GROUPS)
        self.generator = torch.Generator().manual_seed(0)

    def values_and_gradients(self, space, unit):
        size = 10.0 ** (6 * torch.rand(unit.shape, generator=self.generator) - 4)
        gradient = size * torch.randn(unit.shape, generator=self.generator)
        return gradient.flatten(2).sum(-1), gradient


@pytest.mark.parametrize("momentum", [0.9, 0.0])
@pytest.mark.parametrize("told", [float, lambda number: torch.tensor([number])], ids=["numbers", "tensors"])
def test_steps_are_those_of_torchs_adam_bit_for_bit(momentum, told):
    space = SearchSpace(figures=5)
    unit = space.random((2, 7), torch.Generator().manual_seed(1))
    state = state_at(unit)
    leaf = torch.nn.Parameter(unit.clone())
    adam, twin = torch.optim.Adam([leaf], lr=0.1, betas=(momentum, 0.999)), Drawn()
    measure = Drawn()
    for number in range(1, 101):
        rate, root = map(told, corrected(0.1, momentum, number))
        state, _, finite = stepped(measure, space, momentum, rate, root, state)
        leaf.grad = -twin.values_and_gradients(space, leaf)[1]
        adam.step()
        leaf.data.copy_(space.project(leaf.data))
        assert torch.equal(state["unit"], leaf), number
        assert bool(finite)


@pytest.mark.parametrize("look_s", [0.0, 1e9], ids=["each step looked at", "all together"])
def test_a_replayed_search_is_the_search_step_by_step_bit_for_bit(replayed_on_the_cpu, monkeypatch, look_s):
    monkeypatch.setattr(captured, "LOOK_S", look_s)
    space, steps = SearchSpace(figures=2), []
    dense = lambda: Dense(recording_set(), steering(), GROUPS)  # noqa: E731
    measure, plain = dense(), dense()
    found = gradopt(measure, space, LADDER, seed=3, on_step=lambda step, best: steps.append((step, best)))
    monkeypatch.delitem(captured.RECORDERS, "cpu")
    expected = gradopt(plain, space, LADDER, seed=3)
    for name in ("best_unit", "best", "history"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    assert measure.frames_evaluated == plain.frames_evaluated
    assert [step for step, _ in steps] == (list(range(1, 11)) if look_s == 0 else [1, 3, 4, 7, 8, 10])
    assert steps[-1][1] == float(expected.best.max())
    assert found.steps == "10 of 10 steps were replayed as a CUDA graph"
    assert expected.steps == ""


def test_a_gpu_for_which_triton_cannot_compile_is_told_of():
    told = captured.steps_in_words(Counter({"": 3}), kernels=False)
    assert told.startswith("3 of 3 steps were replayed as a CUDA graph; painting took longer than it could")
    assert captured.steps_in_words(Counter({None: 3}), kernels=False) == ""


def test_a_few_steps_are_not_worth_recording(replayed_on_the_cpu, monkeypatch):
    monkeypatch.setattr(captured, "LEAST", 4)
    found = gradopt(Dense(recording_set(), steering(), GROUPS), SearchSpace(figures=2), LADDER, seed=3)
    told = "4 of 10 steps were replayed as a CUDA graph; the others ran one operation at a time: too few in a row"
    assert found.steps.startswith(told)


def test_a_replayed_search_finds_what_the_sparse_way_finds(replayed_on_the_cpu, monkeypatch):
    space = SearchSpace(figures=2)
    run = lambda: gradopt(Surrogate(recording_set(), steering(), GROUPS), space, LADDER, seed=3)  # noqa: E731
    found = run()
    monkeypatch.delitem(captured.RECORDERS, "cpu")
    expected = run()
    torch.testing.assert_close(found.history, expected.history, rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(found.best, expected.best, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("at", [1, 3, 4, 8])
def test_an_interrupted_replay_goes_on_to_the_same_result(replayed_on_the_cpu, tmp_path, monkeypatch, at):
    monkeypatch.setattr(captured, "LOOK_S", 0.0)
    run = lambda **kept: gradopt(  # noqa: E731
        Surrogate(recording_set(), steering(), GROUPS), SearchSpace(figures=2), LADDER, seed=3, **kept
    )

    def interrupt(step, _best):
        if step == at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(checkpoint=tmp_path / "search.safetensors", on_step=interrupt)
    monkeypatch.setattr(captured, "LOOK_S", 1e9)
    resumed, straight = run(checkpoint=tmp_path / "search.safetensors"), run()
    for name in ("best_unit", "best", "history"):
        assert torch.equal(getattr(resumed, name), getattr(straight, name)), name


def test_nan_within_a_replay_is_refused_and_nothing_after_it_is_kept(replayed_on_the_cpu, tmp_path, monkeypatch):
    monkeypatch.setattr(captured, "LOOK_S", 1e9)
    controller = Breaking(steering().weight)
    surrogate, told = Surrogate(recording_set(), controller, (RIGHT_GROUP,)), []
    with pytest.raises(RoadproofError, match="NaN on a painted frame"):
        gradopt(
            surrogate,
            SearchSpace(figures=1),
            (Rung(2, 20),),
            seed=0,
            checkpoint=tmp_path / "search.safetensors",
            on_step=lambda step, best: told.append((step, best)),
        )
    # The first step is looked at alone; what came after it is not believed.
    assert [step for step, _ in told] == [1]
    assert told[0][1] > -torch.inf


def test_a_controller_that_looks_at_numbers_is_searched_step_by_step_and_the_result_says_so(replayed_on_the_cpu):
    controller, method = Asking(steering().weight), GradOpt(iterations=4, restarts=2, halving=False)
    result = attack(recording_set(), controller, SearchSpace(figures=1), method=method, groups=GROUPS)
    told = {check.name: check for check in result.checks}["steps on the GPU"]
    assert told.passed
    assert "0 of 4 steps were replayed as a CUDA graph; the others ran one operation at a time: " in told.finding
    assert "_local_scalar_dense waits for the device" in told.finding
    plain = attack(recording_set(), steering(), SearchSpace(figures=1), method=method, groups=GROUPS)
    assert result.surrogate_shift == pytest.approx(plain.surrogate_shift, rel=1e-5)


def test_what_differs_from_step_to_step_is_not_replayed(replayed_on_the_cpu):
    varied = Surrogate(recording_set(), steering(), GROUPS, variation=Variation(draws=2))
    for measure in (varied, PublishedMeasure(recording_set(), steering(), GROUPS)):
        assert started(measure, SearchSpace(figures=1)) == "their operations differ from step to step"


def test_a_controller_without_gradient_is_refused_as_ever(replayed_on_the_cpu):
    controller = steering()
    surrogate = Surrogate(recording_set(), controller, (RIGHT_GROUP,))
    controller.steer = lambda frames, speed_mps, command: (frames.detach() * controller.weight).sum((1, 2, 3))
    with pytest.raises(ControllerError, match="without a gradient"):
        gradopt(surrogate, SearchSpace(figures=1), (Rung(2, 2),), seed=0)


def test_on_a_cpu_steps_are_not_replayed():
    assert started(Surrogate(recording_set(), steering(), GROUPS), SearchSpace(figures=1)) is None


def started(measure, space, starts=2):
    unit = space.random((len(measure.groups), starts), torch.Generator().manual_seed(0)).to(measure.device)
    return replay_of(measure, space, learning_rate=0.1, momentum=0.9, iterations=3, state=state_at(unit))


SPACES = {
    "published": SearchSpace(figures=3),
    "canvas centre": SearchSpace(figures=2, family="published-canvas-centre", max_painted_share=0.1),
    "free": SearchSpace(figures=2, family="free"),
    "ellipses": SearchSpace(figures=2, family="free", shape=Shape.ELLIPSE),
    "black": SearchSpace(figures=2, colour=False),
    "limited": LIMITED,
    "palette": dataclasses.replace(LIMITED, limits=PaintLimits(colours=("#ffffff", "#102030"))),
}
NETWORKS = {
    "linear": steering,
    "cil": lambda: CIL(width=1 / 16, seed=0).folded(),
    "pilotnet": lambda: pilotnet_controller(seed=0).eval().requires_grad_(False),
}


@pytest.mark.parametrize(
    ("space", "network"), [*((name, "linear") for name in SPACES), ("published", "cil"), ("published", "pilotnet")]
)
def test_a_step_asks_for_nothing_and_makes_nothing_from_numbers_of_the_host(replayed_on_the_cpu, space, network):
    surrogate = Surrogate(recording_set(colour=FILM), NETWORKS[network](), GROUPS)
    assert isinstance(started(surrogate, SPACES[space]), Replay)


def away(surrogate):
    """What a surrogate replays, on a device from which and to which nothing may be copied."""
    same = surrogate.replayable()
    for name in ("views", "_speed", "_command", "clean_steer"):
        setattr(same, name, on_meta(getattr(same, name)))
    same.controller = copy.deepcopy(surrogate.controller).to("meta")
    return same


@pytest.mark.parametrize(
    ("space", "network"), [*((name, "linear") for name in SPACES), ("published", "cil"), ("published", "pilotnet")]
)
def test_a_step_on_another_device_copies_nothing_from_the_host(space, network):
    same = away(Surrogate(recording_set(frames=2, colour=FILM), NETWORKS[network](), GROUPS))
    unit = torch.empty(2, 3, SPACES[space].figures, len(SPACES[space].names), device="meta")
    state = {name: torch.empty_like(unit) for name in ("unit", "best_unit", "exp_avg", "exp_avg_sq")}
    state["best"] = torch.empty(2, 3, device="meta")
    rate = torch.empty(1, device="meta")
    step = lambda: stepped(same, SPACES[space], 0.9, rate, rate, state)  # noqa: E731
    step()
    with no_waiting():
        changed, value, finite = step()
    assert {each.device.type for each in (*changed.values(), value, finite)} == {"meta"}


@pytest.mark.parametrize(
    "wait",
    [
        lambda there: there.new_tensor([1.0, 2.0]),
        lambda there: torch.zeros(3).to(there),
        lambda there: there.copy_(torch.zeros(3)),
        lambda there: there[torch.tensor([0])],
    ],
    ids=["numbers", "a copy", "a copy in place", "an index"],
)
def test_copies_from_the_host_are_found(wait):
    with pytest.raises(WaitingError), no_waiting():
        wait(torch.empty(3, device="meta"))


@pytest.mark.parametrize(
    "wait",
    [
        lambda here: here.sum().item(),
        lambda here: here.nonzero(),
        lambda here: here[here > 0],
        lambda here: here.tolist(),
        bool,
    ],
)
def test_waiting_for_numbers_is_found(wait):
    with pytest.raises(WaitingError), no_waiting():
        wait(torch.ones(1))


no_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="this torch sees no CUDA device")


def on_gpu(controller):
    return Surrogate(recording_set(colour=FILM), controller.to("cuda"), GROUPS, device="cuda")


@pytest.mark.gpu
@no_gpu
@pytest.mark.parametrize("network", list(NETWORKS))
@pytest.mark.parametrize("space", ["published", "free", "limited"])
def test_a_captured_search_is_the_search_step_by_step(network, space, monkeypatch):
    run = lambda: gradopt(on_gpu(NETWORKS[network]()), SPACES[space], LADDER, seed=3)  # noqa: E731
    found = run()
    assert found.steps == "10 of 10 steps were replayed as a CUDA graph"
    monkeypatch.delitem(captured.RECORDERS, "cuda")
    expected = run()
    assert expected.steps == ""
    # Adam's first steps go by the sign of a gradient, so rounding may take a start another way later on.
    torch.testing.assert_close(found.history[:2], expected.history[:2], rtol=1e-2, atol=1e-3)
    torch.testing.assert_close(found.best.amax(), expected.best.amax(), rtol=5e-2, atol=1e-3)


@pytest.mark.gpu
@no_gpu
def test_on_a_gpu_a_controller_that_looks_at_numbers_is_searched_step_by_step():
    found = gradopt(on_gpu(Asking(steering().weight)), SearchSpace(figures=2), LADDER, seed=3)
    assert found.steps.startswith("0 of 10 steps were replayed as a CUDA graph; the others ran one operation")
    expected = gradopt(on_gpu(steering()), SearchSpace(figures=2), LADDER, seed=3)
    torch.testing.assert_close(found.best.amax(), expected.best.amax(), rtol=5e-2, atol=1e-3)
    # The failed attempt leaves the device's random numbers and other graphs as they were.
    assert torch.rand(3, device="cuda").isfinite().all()
    assert expected.steps == "10 of 10 steps were replayed as a CUDA graph"


@pytest.mark.gpu
@no_gpu
def test_on_a_gpu_nan_is_refused_by_the_end_of_the_rung():
    controller = steering()
    surrogate = on_gpu(controller)
    controller.weight.fill_(torch.nan)
    with pytest.raises(RoadproofError, match="NaN"):
        gradopt(surrogate, SearchSpace(figures=1), (Rung(2, 5),), seed=0)
