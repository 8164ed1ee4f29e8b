"""What becomes of a drive, its recordings and the server when one of the two ends dies or hangs."""

import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import needs
from carla_serving import SMALL, SMALL_INPUT, serving
from carla_serving import STREET as WHOLE_STREET
from command import PROGRAM

pytest.importorskip("carla", reason="CARLA's client is not installed: pip install 'roadproof[carla]'")
needs.town()
pytest.importorskip("msgpack", reason="serving needs the extra roadproof[carla]")
import carla

from roadproof.datatypes import Control, VehicleState
from roadproof.drives import Drives, Swerve, Trajectories, Window, record
from roadproof.errors import SimulatorError
from roadproof.geometry import CanvasPlacement
from roadproof.scenarios import save_scenarios
from roadproof.simulators.carla.simulator import CarlaSimulator

STREET = dataclasses.replace(
    WHOLE_STREET,
    start=VehicleState(25.0, -1.75, 0.0, 0.0, 6.0),
    canvas=CanvasPlacement(x_m=45.0, y_m=0.0, width_m=6.0),
    time_limit_s=3.0,
)
AHEAD = Control(0.0, throttle=0.6)
PATIENCE_S = 3.0


def small(port):
    return CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT, patience_s=PATIENCE_S)


def straight_on(_):
    return lambda seen: Control(-0.5 * seen.state.yaw_rad, throttle=0.5)


def recorded(world, folder, controller=straight_on, on_drive=lambda _: None):
    return record(
        world,
        controller,
        STREET,
        trajectories=Trajectories(count=3, perturbation=Swerve((0.5,))),
        window=Window(frames=3, least_px=5),
        folder=folder,
        on_drive=on_drive,
    )


DOOMED, KILLED_S = [], []
"""Servers that the next step of `straight_on_for_a_while` kills, and when it did."""


def straight_on_for_a_while(scenario):
    steer = straight_on(scenario)

    def act(seen):
        if DOOMED:
            KILLED_S.append(time.monotonic())
            DOOMED.pop().kill()
        return steer(seen)

    return act


@pytest.mark.slow
def test_a_server_killed_in_mid_episode_keeps_the_recordings_so_far_and_the_rest_is_recorded_later(street, tmp_path):
    threads = threading.active_count()
    with serving("--map", street) as (process, port):

        def doom(done):
            if done == 1:
                DOOMED.append(process)

        with pytest.raises(SimulatorError, match=r"did not answer|sent no picture"), small(port) as world:
            recorded(world, tmp_path, straight_on_for_a_while, doom)
        # The call that found nobody, and the farewells.
        assert time.monotonic() - KILLED_S.pop() < 5 * PATIENCE_S
    (kept,) = tmp_path.rglob("episode.npz")
    before = kept.stat().st_mtime_ns
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".")]
    assert threading.active_count() <= threads + 1
    with serving("--map", street) as (_, port), small(port) as world:
        drives = recorded(world, tmp_path, straight_on_for_a_while)
    assert [drive.name for drive in drives.drives] == ["clean", "right", "left"]
    assert kept.stat().st_mtime_ns == before
    assert len(Drives.load(tmp_path).drives) == 3


@pytest.mark.slow
def test_a_server_that_was_frozen_has_its_settings_and_no_actors_of_ours_when_it_goes_on(street):
    with serving("--map", street) as (process, port):
        onlooker = carla.Client("127.0.0.1", port, worker_threads=1)
        onlooker.set_timeout(30.0)
        before = onlooker.get_world().get_settings()
        with contextlib.suppress(SimulatorError), small(port) as world:
            world.reset(STREET, cars=2, pattern=np.full((400, 400, 4), 255, np.uint8))
            os.kill(process.pid, signal.SIGSTOP)
            begin = time.monotonic()
            world.step(AHEAD)
        assert time.monotonic() - begin < 4 * PATIENCE_S
        os.kill(process.pid, signal.SIGCONT)
        seen = onlooker.get_world()
        until = time.monotonic() + 30.0
        while seen.get_settings().synchronous_mode and time.monotonic() < until:
            time.sleep(0.1)
        after = seen.get_settings()
        assert (after.synchronous_mode, after.fixed_delta_seconds) == (
            before.synchronous_mode,
            before.fixed_delta_seconds,
        )
        for _ in range(2):
            seen.wait_for_tick(30.0)
        assert [actor.type_id for actor in seen.get_actors()] == []


@pytest.mark.slow
def test_a_command_whose_server_dies_ends_with_one_line_and_leaves_no_process(street, tmp_path):
    save_scenarios([STREET], tmp_path / "street.toml")
    with serving("--map", street) as (process, port):
        options = ["--scenarios", "street.toml", "--scenario", "street", "--simulator", f"carla://127.0.0.1:{port}"]
        with subprocess.Popen(
            [sys.executable, "-c", PROGRAM, "drive", *options],
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        ) as command:
            onlooker = carla.Client("127.0.0.1", port, worker_threads=1)
            onlooker.set_timeout(60.0)
            seen, until = onlooker.get_world(), time.monotonic() + 120.0
            # Until the drive is under way: the camera is the last to come.
            while not any(each.type_id == "sensor.camera.rgb" for each in seen.get_actors()):
                assert time.monotonic() < until
                time.sleep(0.05)
            process.kill()
            begin = time.monotonic()
            _, complaint = command.communicate(timeout=120)
    assert time.monotonic() - begin < 90.0
    assert command.returncode == 2, complaint
    assert complaint.startswith(f"roadproof: the CARLA server at 127.0.0.1:{port}"), complaint
    assert complaint.count("\n") == 1
    assert "check" in complaint or "lost" in complaint
    with pytest.raises(ProcessLookupError):
        os.killpg(command.pid, 0)
    assert not list(Path(tmp_path / "out").rglob("episode.npz"))


REFUSES_TRAFFIC = """
from roadproof.errors import SimulatorError
from roadproof.simulators.carla_server import calls
allowed = calls.Calls._spawn_command
count = 0
def spawn(self, body):
    global count
    count += 1
    if count == 3:
        raise SimulatorError("Spawn failed because of collision at spawn position")
    return allowed(self, body)
calls.Calls._spawn_command = spawn
from roadproof.cli import main
main()
"""


def test_traffic_that_is_refused_half_way_is_taken_away_again(street):
    with serving("--map", street, program=REFUSES_TRAFFIC) as (_, port):
        with pytest.raises(SimulatorError, match="refused a car of the traffic: Spawn failed"), small(port) as world:
            world.reset(STREET, cars=4)
        onlooker = carla.Client("127.0.0.1", port, worker_threads=1)
        onlooker.set_timeout(30.0)
        seen = onlooker.get_world()
        for _ in range(2):
            seen.wait_for_tick(30.0)
        assert [actor.type_id for actor in seen.get_actors()] == []
