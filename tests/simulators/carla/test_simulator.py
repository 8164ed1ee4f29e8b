"""The adapter through CARLA's own client and the network, against `roadproof carla serve` in another process."""

import contextlib
import dataclasses
import inspect
import os
import signal
import textwrap
import time

import numpy as np
import pytest

import needs
from carla_serving import CAMERA, INPUT, SMALL, SMALL_INPUT, STREET, free_port, serving

pytest.importorskip("carla", reason="CARLA's client is not installed: pip install 'roadproof[carla]'")
needs.town()
pytest.importorskip("msgpack", reason="serving needs the extra roadproof[carla]")
import carla

from command import roadproof
from roadproof.datatypes import Control, EventKind, Weather
from roadproof.errors import ScenarioError, SimulatorError
from roadproof.simulators.carla.actors import Crowd
from roadproof.simulators.carla.simulator import CarlaSimulator
from roadproof.simulators.checks import check_simulator
from roadproof.simulators.loading import open_simulator
from roadproof.simulators.protocol import PaintKind, world_of
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.traffic.traffic import Traffic

AHEAD = Control(0.0, throttle=0.6)


@pytest.fixture
def simulator(port):
    with CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT) as opened:
        yield opened


@pytest.fixture
def onlooker(port):
    """Another client, with a look at settings and actors."""
    client = carla.Client("127.0.0.1", port, worker_threads=1)
    client.set_timeout(30.0)
    return client


def left_behind(onlooker):
    """Actors on the server; it runs freely again, so that they are listed."""
    world = onlooker.get_world()
    assert not world.get_settings().synchronous_mode
    world.wait_for_tick(30.0)
    world.wait_for_tick(30.0)
    return [actor.type_id for actor in world.get_actors()]


def test_an_unknown_way_to_paint_is_refused():
    with pytest.raises(SimulatorError, match="paint is 'nativ', expected one of"):
        # The tests' own check of types would refuse it first.
        inspect.unwrap(CarlaSimulator.__init__)(object.__new__(CarlaSimulator), paint="nativ")


def test_a_server_is_known_by_its_version(simulator):
    assert world_of(simulator) == f"CarlaSimulator {simulator.session.version}"


def test_it_keeps_what_a_simulator_promises(port):
    with CarlaSimulator(port=port, camera=CAMERA, input=INPUT) as simulator:
        report = check_simulator(simulator, STREET, steps=12)
    assert report.passed, str(report)
    assert len(report.checks) == 14


def test_a_drive_is_that_of_the_town_driven_directly(simulator, street):
    controls = [Control(0.15 * np.sin(k / 6), throttle=0.7) for k in range(50)]
    controls += [Control(0.0, brake=0.6) for _ in range(10)]

    def driven(world, scenario):
        seen = [world.reset(scenario, cars=3, pedestrians=4, seed=2)]
        return seen + [world.step(control) for control in controls]

    served = driven(simulator, STREET)
    with TownSimulator(camera=SMALL, input=SMALL_INPUT) as town:
        direct = driven(town, dataclasses.replace(STREET, map_name=str(street)))
        others = [dataclasses.astuple(agents) for agents in (town.cars, town.pedestrians)]
    for mine, expected in zip((simulator.cars, simulator.pedestrians), others, strict=True):
        for a, b in zip(dataclasses.astuple(mine), expected, strict=True):
            np.testing.assert_allclose(a, b, atol=0.02)
    assert direct[-1].state.x_m > 30.0
    for a, b in zip(served, direct, strict=True):
        assert np.hypot(a.state.x_m - b.state.x_m, a.state.y_m - b.state.y_m) < 0.02
        assert a.state.yaw_rad == pytest.approx(b.state.yaw_rad, abs=0.002)
        assert a.state.speed_mps == pytest.approx(b.state.speed_mps, abs=0.02)
        assert (a.command, a.time_s, a.done) == (b.command, b.time_s, b.done)


def test_a_start_with_speed_begins_in_its_place(simulator):
    moving = dataclasses.replace(STREET, start=dataclasses.replace(STREET.start, speed_mps=6.0))
    state = simulator.reset(moving).state
    assert state.x_m == pytest.approx(20.0, abs=0.1)
    assert state.speed_mps == pytest.approx(6.0, abs=0.3)


def test_leaving_the_road_is_told_as_in_the_town(simulator):
    simulator.reset(STREET)
    events = []
    for _ in range(90):
        events += simulator.step(Control(0.35, throttle=0.8)).events
    kinds = [event.kind for event in events]
    assert kinds[0] == EventKind.SIDEWALK
    assert EventKind.COLLISION_STATIC in kinds


def test_traffic_is_spawned_while_pictures_come(port, onlooker):
    with CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT, patience_s=5.0) as simulator:
        simulator.reset(STREET)
        roads = simulator.session.road_map("street")
        traffic = Traffic(roads, cars=2, pedestrians=1, seed=0, ego=STREET.start)
        moves = Crowd(simulator.session, roads, traffic).moves()
        assert len(moves) == 3
        simulator.step(AHEAD)
        assert len(onlooker.get_world().get_actors([move.actor_id for move in moves])) == 3
    assert left_behind(onlooker) == []


def test_weathers_are_seen(simulator):
    levels = {weather: simulator.reset(STREET, weather=weather).frame.mean() for weather in list(Weather)[:3]}
    assert levels[Weather.CLEAR_NOON] > levels[Weather.RAINY_NOON] + 5


def test_settings_and_weather_are_put_back_and_actors_destroyed(port, onlooker):
    before, weather = onlooker.get_world().get_settings(), onlooker.get_world().get_weather()
    with CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT) as simulator:
        pattern = np.full((400, 400, 4), 255, np.uint8)
        simulator.reset(STREET, cars=2, pedestrians=2, pattern=pattern, weather=Weather.RAINY_NOON)
        assert onlooker.get_world().get_weather() != weather
        simulator.step(AHEAD)
        assert len(onlooker.get_world().get_actors()) == 1 + 4 + 4
    assert left_behind(onlooker) == []
    assert onlooker.get_world().get_weather() == weather
    after = onlooker.get_world().get_settings()
    for name in ("synchronous_mode", "no_rendering_mode", "fixed_delta_seconds", "substepping", "max_substeps"):
        assert getattr(after, name) == getattr(before, name), name
    with pytest.raises(SimulatorError, match="closed"):
        simulator.reset(STREET)


def test_they_are_put_back_after_an_error_too(port, onlooker):
    with pytest.raises(ZeroDivisionError), CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT) as simulator:
        simulator.reset(STREET)
        _ = 1 / 0
    assert left_behind(onlooker) == []


def test_a_map_the_server_lacks_is_refused_with_those_it_has(simulator):
    with pytest.raises(ScenarioError, match="no map 'Town01', expected one of second, street, town"):
        simulator.reset(dataclasses.replace(STREET, map_name="Town01"))


def test_a_taken_place_is_refused_and_the_next_drive_goes_well(simulator, onlooker):
    world = onlooker.get_world()
    blueprint = world.get_blueprint_library().find("vehicle.audi.a2")
    other = world.spawn_actor(blueprint, carla.Transform(carla.Location(20.5, 1.75, 0.3)))
    try:
        with pytest.raises(SimulatorError, match=r"refused the car at \(20.0, -1.8\): Spawn failed"):
            simulator.reset(STREET)
    finally:
        other.destroy()
    assert not simulator.reset(STREET).done


def test_a_spec_opens_it(port):
    with open_simulator(f"carla://127.0.0.1:{port}") as simulator:
        assert simulator.road_map("street").lanes
        assert simulator.paint is PaintKind.INJECT


def test_nobody_at_the_port_is_told_in_time():
    port, begin = free_port(), time.monotonic()
    with pytest.raises(SimulatorError, match=f"127.0.0.1:{port} did not answer for its version in time; check that"):
        CarlaSimulator(port=port, patience_s=1.0).__enter__()
    assert time.monotonic() - begin < 10.0
    with pytest.raises(SimulatorError, match=r"at none\.invalid:2000 refused a connection: resolve: Host not found"):
        CarlaSimulator("none.invalid").__enter__()


def test_a_frozen_and_then_a_dead_server_end_a_drive_in_time(street):
    with serving("--map", street) as (process, port):
        world = CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT, patience_s=2.0)
        with contextlib.suppress(SimulatorError), world:
            world.reset(STREET)
            world.step(AHEAD)
            os.kill(process.pid, signal.SIGSTOP)
            begin = time.monotonic()
            with pytest.raises(SimulatorError, match="did not answer for a control in time"):
                world.step(AHEAD)
            with pytest.raises(SimulatorError, match="is lost; open it again"):
                world.step(AHEAD)
        assert time.monotonic() - begin < 15.0
        os.kill(process.pid, signal.SIGCONT)
        with CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT, patience_s=5.0) as world:
            world.reset(STREET)
            process.kill()
            process.wait()
            begin = time.monotonic()
            with pytest.raises(SimulatorError, match="did not answer"):
                for _ in range(3):
                    world.step(AHEAD)
        assert time.monotonic() - begin < 20.0


UNSTEADY = """
import asyncio, sys
from roadproof.simulators.carla_server import server, wire
from roadproof.cli import main

class Unsteady(server.Server):
    count = 0

    def send(self, stream, message, *, once=True):
        if stream == wire.WORLD_STREAM:
            return super().send(stream, message, once=once)
        # Every picture comes twice, and late.
        Unsteady.count += 1
        loop, send = asyncio.get_running_loop(), super().send
        for delay in (0.02 * (Unsteady.count % 4), 0.1):
            loop.call_later(delay, send, stream, message)

server.Server = Unsteady
main()
"""


def test_late_and_repeated_pictures_are_sorted_out(street):
    with (
        serving("--map", street, program=textwrap.dedent(UNSTEADY)) as (_, port),
        CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT) as world,
    ):
        drives = []
        for _ in range(2):
            seen = [world.reset(STREET)] + [world.step(AHEAD) for _ in range(25)]
            drives.append([observation.frame for observation in seen])
    assert all((a == b).all() for a, b in zip(*drives, strict=True))
    # The picture is that of its step: it changes with every one once the car rolls.
    assert all((a != b).any() for a, b in zip(drives[0][5:], drives[0][6:], strict=False))


def test_a_server_of_another_version_is_refused(street):
    program = "from roadproof.simulators.carla_server import wire; wire.VERSION = '0.9.13'\n"
    complaint = r"is version 0.9.13, its client here is 0.9.16; .* carla==0.9.13"
    with (
        serving("--map", street, program=program + "from roadproof.cli import main; main()") as (_, port),
        pytest.raises(SimulatorError, match=complaint),
    ):
        CarlaSimulator(port=port).__enter__()


@pytest.mark.parametrize(
    "words",
    [
        ["drive", "--simulator", "carla://127.0.0.1:1"],
        ["record", "left-03", "--simulator", "carla://127.0.0.1:1?paint=native"],
        ["carla", "doctor"],
        ["carla", "scenario", "0", "1"],
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_without_the_client_one_line_names_the_extra(words):
    told = roadproof(*words, before="import sys; sys.modules['carla'] = None")
    assert told.returncode == 2
    assert told.stderr.count("\n") == 1
    assert "pip install 'roadproof[carla]'" in told.stderr
