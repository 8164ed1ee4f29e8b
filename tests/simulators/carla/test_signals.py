"""Lights and signs as CARLA's own client tells of them: on a server that has some, and in the town, which has none."""

import textwrap

import numpy as np
import pytest

import needs
from carla_serving import SMALL, SMALL_INPUT, STREET, serving

pytest.importorskip("carla", reason="CARLA's client is not installed: pip install 'roadproof[carla]'")
needs.town()
pytest.importorskip("msgpack", reason="serving needs the extra roadproof[carla]")
import carla

from roadproof.datatypes import Control, EventKind
from roadproof.driving.infractions import infraction_points
from roadproof.driving.rollout import rollout
from roadproof.simulators.carla.session import Session
from roadproof.simulators.carla.signals import trigger_volume
from roadproof.simulators.carla.simulator import CarlaSimulator
from roadproof.simulators.protocol import uniform

# Along the street's right lane, whose middle is y = 1.75 in CARLA's world, stand a light at 45 m that is red, one at
# 60 m that is green, one at 75 m that turns red 7.5 s after the lights were set back, and a stop sign at 90 m. A red
# light and a stop sign are for those who come the other way. Their poles stand beside the road, turned in many ways.
SIGNALLED = """
import struct
from roadproof.cli import main
from roadproof.simulators.carla_server import actors, calls, wire, world

RED, GREEN = 0, 2
BOXES = {}
STATES = {}
SET_BACK_S = [0.0]
WORLDS = []

def add(self, name, pose, place, extent, turned, state=GREEN):
    actor = actors.Actor(self._next_actor, 0, name, [], pose)
    self._next_actor += 1
    BOXES[actor.id], STATES[actor.id] = [list(place), list(extent), [0.0, turned, 0.0]], state
    self.actors[actor.id] = actor

load = world.World.load
def with_signals(self, name):
    town = load(self, name)
    light, sign = "traffic.traffic_light", "traffic.stop"
    # A pole at yaw 90 has its own x along the world's y: the volume lies 4.25 m back towards the lane's middle.
    add(self, light, (45.0, 6.0, 0.0, 0.0, 90.0, 0.0), (-4.25, 0.0, 0.5), (1.75, 1.0, 1.0), 0.0, RED)
    add(self, light, (60.0, 6.0, 0.0, 0.0, 90.0, 0.0), (-4.25, 0.0, 0.5), (1.75, 1.0, 1.0), 0.0, GREEN)
    add(self, light, (75.0, 6.0, 0.0, 0.0, 180.0, 0.0), (0.0, 4.25, 0.5), (1.75, 1.0, 1.0), -90.0, "later")
    add(self, sign, (90.0, 6.0, 0.0, 0.0, -90.0, 0.0), (4.25, 0.0, 0.5), (1.5, 3.0, 1.0), 0.0)
    add(self, light, (52.0, -6.0, 0.0, 0.0, -90.0, 0.0), (-4.25, 0.0, 0.5), (1.75, 1.0, 1.0), 0.0, RED)
    add(self, sign, (70.0, -6.0, 0.0, 0.0, 90.0, 0.0), (4.25, 0.0, 0.5), (1.5, 3.0, 1.0), 0.0)
    return town
world.World.load = with_signals

describe = actors.Actor.wire
def with_box(self, port):
    message = describe(self, port)
    return message[:3] + [BOXES.get(self.id, message[3])] + message[4:]
actors.Actor.wire = with_box

def set_back(self):
    SET_BACK_S[0] = self._world.time_s
del calls.NOT_THERE["reset_all_traffic_lights"]
calls.Calls.call_reset_all_traffic_lights = set_back

tell = wire.actor_state
def with_state(actor, pose, velocity, vehicle=b""):
    state = STATES.get(actor)
    if state is not None:
        if state == "later":
            state = RED if WORLDS[0].time_s - SET_BACK_S[0] > 7.5 else GREEN
        vehicle = struct.pack("<32sffffI?B", b"", 9.0, 0.1, 0.1, 0.0, 0, False, state)
    return tell(actor, pose, velocity, vehicle)
wire.actor_state = with_state

begin = world.World.__init__
def remembered(self, maps=()):
    WORLDS.append(self)
    begin(self, maps)
world.World.__init__ = remembered
main()
"""


@pytest.fixture(scope="module")
def signalled(street):
    """A server with lights and signs on the street."""
    with serving("--map", street, program=textwrap.dedent(SIGNALLED)) as (_, opened):
        yield opened


def steady(target_mps, stop_at_m=None):
    """Goes straight on at a speed; brakes to a stop once, from so far along the street on, where that is given."""

    def driver(_simulator):
        to_stop = stop_at_m is not None

        def drive(seen):
            nonlocal to_stop
            if to_stop and seen.state.x_m > stop_at_m:
                to_stop = seen.state.speed_mps > 0.05
                return Control(0.0, brake=1.0)
            return Control(0.0, throttle=min(max(0.5 * (target_mps - seen.state.speed_mps) + 0.1, 0.0), 1.0))

        return drive

    return driver


def test_volumes_are_read_in_the_towns_world(signalled):
    session = Session("127.0.0.1", signalled, dt_s=0.05, patience_s=20.0, loading_s=60.0)
    try:
        session.road_map("street")
        session.tick()
        actors = session.world.get_actors()
        found = {
            (actor.type_id, round(box.x_m, 3), round(box.y_m, 3), round(box.z_m, 3))
            for actor in actors
            if isinstance(actor, carla.TrafficSign)
            for box in [trigger_volume(actor)]
        }
        # The third volume is turned against its pole: its longer side lies across the road all the same.
        third = next(trigger_volume(actor) for actor in actors if actor.get_location().x == 75.0)
    finally:
        session.close()
    light, sign = "traffic.traffic_light", "traffic.stop"
    assert found == {
        (light, 45.0, -1.75, 0.5), (light, 60.0, -1.75, 0.5), (light, 75.0, -1.75, 0.5), (sign, 90.0, -1.75, 0.5),
        (light, 52.0, 1.75, 0.5), (sign, 70.0, 1.75, 0.5),
    }  # fmt: skip
    assert third.holds(np.array([[75.0, -3.4]])).all()
    assert not third.holds(np.array([[76.5, -1.75]])).any()


def test_a_drive_past_lights_and_signs_is_told_what_it_ran_every_time_the_same(signalled):
    with CarlaSimulator(port=signalled, camera=SMALL, input=SMALL_INPUT) as simulator:
        slow, again = (rollout(simulator, steady(8.0), STREET) for _ in range(2))
        fast = rollout(simulator, steady(25.0), STREET)
        stopped = rollout(simulator, steady(8.0, stop_at_m=82.0), STREET)
    told = [(event.kind, event.detail) for event in slow.events]
    first, third, sign = (
        (EventKind.RED_LIGHT, "traffic light at (45.0, -1.8)"),
        (EventKind.RED_LIGHT, "traffic light at (75.0, -1.8)"),
        (EventKind.STOP_SIGN, "stop sign at (90.0, -1.8)"),
    )
    assert told == [first, third, sign]
    # Lights are set back for every drive, or the third light would be red from the second drive on.
    assert again.events == slow.events
    assert [(event.kind, event.detail) for event in fast.events] == [first, sign]
    assert [(event.kind, event.detail) for event in stopped.events] == [first, third]
    assert infraction_points(slow.events) == 3 + 3 + 2
    for event, passed_m in zip(slow.events, (46.0, 76.0, 93.0), strict=True):
        k = round(event.time_s / slow.dt_s)
        assert slow.x_m[k - 1] < passed_m <= slow.x_m[k] + 1e-3


def test_lights_are_met_in_the_same_phase_however_many_cameras_paint_needs(signalled, monkeypatch):
    asked, ask = [], Session.ask
    monkeypatch.setattr(Session, "ask", lambda session, what, call: asked.append(what) or ask(session, what, call))
    ticks = []
    with CarlaSimulator(port=signalled, camera=SMALL, input=SMALL_INPUT) as simulator:
        for pattern in (None, uniform(255, 0, 0)):
            simulator.reset(STREET, pattern=pattern)
            since = len(asked) - 1 - asked[::-1].index("its traffic lights anew")
            ticks.append(asked[since:].count("a tick"))
    assert ticks == [1, 1]


def test_the_served_town_has_neither_and_drives_there_report_none(port):
    with CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT) as simulator:
        drive = rollout(simulator, steady(8.0), STREET)
        actors = list(simulator.session.world.get_actors())
    assert drive.x_m[-1] > 130.0
    assert drive.events == ()
    assert not any(isinstance(actor, carla.TrafficSign) for actor in actors)
