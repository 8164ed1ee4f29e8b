"""Steps in the recorded world that are replayed: they drive as any others do, and ask for nothing from the device."""

import copy
import dataclasses

import pytest
import torch

from painted_ground import CANVAS, Careful, RampFollower, known_vehicle, recorded_road
from roadproof.attacks import GradOpt, PathDeviation, SpeedChange, attack, captured
from roadproof.attacks.captured import Replay, replay_of
from roadproof.attacks.gradopt import Rung, gradopt
from roadproof.attacks.groups import LEFT_GROUP, RIGHT_GROUP, parse_groups
from roadproof.attacks.step import state_at, stepped
from roadproof.compositing import Variation
from roadproof.controllers import CIL, load_controller, pilotnet_controller
from roadproof.datatypes import Obstacle
from roadproof.errors import RoadproofError
from roadproof.photometry import ColourTransform
from roadproof.photometry.responses import FilmResponse
from roadproof.recorded import BiasedStart, RecordedWorld
from roadproof.search_space import SearchSpace
from waiting import no_waiting, on_meta

GROUPS = (RIGHT_GROUP, LEFT_GROUP)
SPACE = SearchSpace(figures=2)
LADDER = (Rung(2, 1, 0.05, every=4), Rung(1, 2, 0.05))
FILM = ColourTransform(FilmResponse(torch.tensor([1.1, 1.0, 0.9]), torch.tensor(1.2), torch.tensor(1.0)))
BESIDE = Obstacle(x_m=CANVAS.x_m - 6.0, y_m=CANVAS.y_m - 2.6, yaw_rad=0.0, half_length_m=6.0, half_width_m=0.3)


@pytest.fixture(scope="module", autouse=True)
def vehicle():
    with known_vehicle():
        yield


@pytest.fixture(scope="module")
def road():
    return recorded_road(every=2, from_m=-17.0)


class Breaking(RampFollower):
    """Answers NaN to the brightest of pictures."""

    def steer(self, frames, speed_mps, command):
        steer = super().steer(frames, speed_mps, command)
        return torch.where(frames.amax((1, 2, 3)) > 0.99, torch.nan, steer)


def deviation_on(road, controller=None):
    return short(PathDeviation(every=4).measure(road, controller or RampFollower(), GROUPS, device="cpu"))


def speed_on(road):
    goal = SpeedChange(every=4)
    return short(goal.measure(road, Careful(), parse_groups("slower,faster", road), device="cpu"))


def short(measure):
    """The measure of eight instants from where the canvas is near: a look at every operation takes long."""
    for world in measure.worlds:
        world.course.first, world.course.count = world.course.seen.stop - 20, 8
    return measure


def dense(measure):
    """The measure as replayed steps compute it, so that nothing but the replay differs."""
    same = measure.replayable()
    same.replayable = lambda: same
    same.thinned = lambda every: dense(type(same).thinned(measure, every))
    return same


def points(measure, starts=1, seed=0, space=SPACE):
    return space.random((len(measure.groups), starts), torch.Generator().manual_seed(seed))


def started(measure, space=SPACE):
    state = state_at(points(measure, space=space))
    return replay_of(measure, space, learning_rate=0.1, momentum=0.9, iterations=2, state=state)


@pytest.mark.parametrize("name", ["plain", "beside a rail", "turned away", "film"])
def test_a_car_drives_there_as_it_does_elsewhere(road, name):
    if name == "beside a rail":
        road = dataclasses.replace(road, obstacles=(BESIDE,))
    if name == "film":
        road = dataclasses.replace(road, colour=FILM)
    world = RecordedWorld(road)
    world.fit(RampFollower())
    starts = (
        BiasedStart(),
        BiasedStart(right_m=0.7, turned_rad=-0.25 if name == "turned away" else -0.05, faster_mps=0.5),
    )
    unit = SPACE.random((3,), torch.Generator().manual_seed(2))
    drives, gradients = [], []
    for each in (world, world.replayable()):
        leaf = unit.clone().requires_grad_()
        rolled = each.roll(RampFollower(), SPACE.pattern(leaf), starts=starts, every=4)
        rolled.right_m.mean().backward()
        drives.append(rolled)
        gradients.append(leaf.grad)
    for field in dataclasses.fields(drives[0]):
        one, other = (getattr(drive, field.name).detach() for drive in drives)
        torch.testing.assert_close(other, one, rtol=0.0, atol=2e-4, msg=lambda told, n=field.name: f"{n}: {told}")
    torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-2, atol=1e-4)
    if name == "beside a rail":
        free = RecordedWorld(dataclasses.replace(road, obstacles=()))
        free.fit(RampFollower())
        with torch.no_grad():
            past = free.roll(RampFollower(), SPACE.pattern(unit), starts=starts, every=4)
        assert not torch.allclose(past.y_m, drives[0].y_m), "a car touches the rail"


@pytest.mark.parametrize("measured", [deviation_on, speed_on], ids=["deviation", "speed"])
def test_a_replayed_search_is_the_search_step_by_step_bit_for_bit(replayed_on_the_cpu, monkeypatch, road, measured):
    run = lambda: gradopt(dense(measured(road)), SPACE, LADDER, seed=3)  # noqa: E731
    found = run()
    monkeypatch.delitem(captured.RECORDERS, "cpu")
    expected = run()
    for name in ("best_unit", "best", "history"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    assert found.steps == "3 of 3 steps were replayed as a CUDA graph"
    assert expected.steps == ""


def test_the_default_search_is_replayed_whole_and_finds_what_the_usual_way_finds(
    replayed_on_the_cpu, monkeypatch, road
):
    monkeypatch.setattr("roadproof.attacks.gradopt.DRAWN", 16)
    method = GradOpt(iterations=2, restarts=1, halving=False)
    run = lambda: attack(  # noqa: E731
        road, RampFollower(), SPACE, method=method, objective=PathDeviation(every=6), groups=GROUPS
    )
    found = run()
    told = {check.name: check for check in found.checks}["steps on the GPU"]
    assert told.passed
    assert told.finding == "2 of 2 steps were replayed as a CUDA graph"
    monkeypatch.delitem(captured.RECORDERS, "cpu")
    assert found.predicted_m == pytest.approx(run().predicted_m, abs=0.02)


def test_nan_in_a_drive_that_nobody_looks_at_is_refused(replayed_on_the_cpu, road):
    white = SearchSpace(figures=1, albedo=(0.98, 1.0))
    with pytest.raises(RoadproofError, match="NaN on a painted frame"):
        gradopt(deviation_on(road, Breaking()), white, (Rung(2, 3),), seed=0)


def test_drives_with_looks_of_their_own_are_not_replayed(replayed_on_the_cpu, road):
    varied = PathDeviation(every=8, variation=Variation(draws=2)).measure(road, RampFollower(), GROUPS, device="cpu")
    assert started(varied) == "their operations differ from step to step"


NETWORKS = {
    "ramp": RampFollower,
    "pilotnet": lambda: pilotnet_controller(seed=0).eval().requires_grad_(False),
    "cil": lambda: CIL(width=1 / 16, seed=0).folded(),
    "temporal": lambda: load_controller("temporal"),
    "waypoint": lambda: load_controller("waypoint"),
}


@pytest.mark.parametrize("network", NETWORKS)
def test_a_step_asks_for_nothing_and_makes_nothing_from_numbers_of_the_host(replayed_on_the_cpu, road, network):
    railed = dataclasses.replace(road, colour=FILM, obstacles=(BESIDE,))
    assert isinstance(started(deviation_on(railed, NETWORKS[network]())), Replay)


def away(measure):
    """What a measure replays, on a device from which and to which nothing may be copied."""
    same = measure.replayable()
    for world in same.worlds:
        world.device = torch.device("meta")
        for part in (world.bank, world.bank._light, world.course, world.obstacles):
            vars(part).update({name: on_meta(value) for name, value in vars(part).items()})
        world.bank.device = world.device
    same.controller = copy.deepcopy(measure.controller).to("meta")
    return same


@pytest.mark.parametrize("network", NETWORKS)
def test_a_step_on_another_device_copies_nothing_from_the_host(network):
    railed = dataclasses.replace(recorded_road(every=4), colour=FILM, obstacles=(BESIDE,))
    same = away(deviation_on(railed, NETWORKS[network]()))
    unit = torch.empty(2, 3, SPACE.figures, len(SPACE.names), device="meta")
    state = {name: torch.empty_like(unit) for name in ("unit", "best_unit", "exp_avg", "exp_avg_sq")}
    state["best"] = torch.empty(2, 3, device="meta")
    rate = torch.empty(1, device="meta")
    step = lambda: stepped(same, SPACE, 0.9, rate, rate, state)  # noqa: E731
    step()
    with no_waiting():
        changed, value, finite = step()
    assert {each.device.type for each in (*changed.values(), value, finite)} == {"meta"}


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="this torch sees no CUDA device")
@pytest.mark.parametrize("network", NETWORKS)
def test_captured_drives_are_the_drives_step_by_step(network, monkeypatch, road):
    railed = dataclasses.replace(road, colour=FILM, obstacles=(BESIDE,))

    def run():
        goal = PathDeviation(every=4)
        measure = goal.measure(railed, NETWORKS[network]().to("cuda"), GROUPS, device="cuda")
        return gradopt(measure, SPACE, LADDER, seed=3)

    found = run()
    assert found.steps == "3 of 3 steps were replayed as a CUDA graph"
    monkeypatch.delitem(captured.RECORDERS, "cuda")
    expected = run()
    # Adam's first steps go by the sign of a gradient, so rounding may take a start another way later on.
    torch.testing.assert_close(found.history[:1], expected.history[:1], rtol=1e-2, atol=1e-3)
