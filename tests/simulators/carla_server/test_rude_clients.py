"""`roadproof carla serve` against clients that send rubbish, too much, too slowly, or never read."""

import contextlib
import math
import random
import re
import signal
import socket
import struct
import subprocess
import sys
import time

import pytest

import needs
from carla_serving import interruptible, serving
from command import PROGRAM, roadproof

needs.town()
msgpack = pytest.importorskip("msgpack", reason="serving needs the extra roadproof[carla]")

from raw_carla import Caller, connections, exactly, frame_of, listen, memory_mb, message, stream_of

LINUX = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
WORLD_STREAM = 1
NAN = math.nan
SHORT = """
from roadproof.simulators.carla_server import limits
limits.QUIET_S, limits.MESSAGE_S, limits.STREAM_ID_S = 4.0, 2.0, 2.0
limits.LISTENER_BYTES, limits.HELD_BYTES = 4 << 20, 12 << 20
from roadproof.cli import main
main()
"""
"""A server that loses patience soon."""


@pytest.fixture(scope="module")
def server(street):
    with serving("--map", street) as opened:
        yield opened


@pytest.fixture(scope="module")
def impatient(street):
    with serving("--map", street, program=SHORT) as opened:
        yield opened


@pytest.fixture
def caller(server):
    with Caller(server[1]) as made:
        yield made


@pytest.fixture
def car(caller):
    made = caller.spawn("vehicle.ford.mustang")
    yield made[0]
    caller.granted("destroy_actor", made[0])


def check_served(port):
    """The server answers a well-behaved client, steps and sends."""
    with Caller(port) as calm, listen(port, WORLD_STREAM) as world:
        assert calm.granted("version") == "0.9.16"
        calm.synchronous()
        frame = calm.granted("tick_cue")
        while frame_of(message(world)) < frame:
            pass


POSE = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
CAR = "vehicle.ford.mustang"
DESCRIBED = [1, CAR, []]
CONTROL = [0.0, 0.0, 0.0, False, False, False, 0]
SETTINGS = [True, False, [True, 0.05], True, 0.01, 10, 0.0, True, 3000.0, 2000.0, True]
BAD_CALLS = [
    ("fly", [], "does not know 'fly'"),
    ("answer", [], "does not know 'answer'"),
    ("__init__", [], "does not know"),
    ("x" * 200, [], "does not know 'xxx"),
    ("version", [1], "called with 1 arguments, expected none"),
    ("spawn_actor", [], "called with 0 arguments, expected 2"),
    ("spawn_actor", ["car", POSE], "description of spawn_actor is 'car': expected `array`, got `str`"),
    ("spawn_actor", [DESCRIBED, [[NAN, 0.0, 0.0], [0.0, 0.0, 0.0]]], r"pose of spawn_actor is \[\[nan, 0.0.*expected"),
    ("spawn_actor", [DESCRIBED, [[1e30, 0.0, 0.0], [0.0, 0.0, 0.0]]], "expected `float` <= 100000.0"),
    ("spawn_actor", [[1, "vehicle.tank", []], POSE], "there is no blueprint 'vehicle.tank'"),
    ("spawn_actor", [[1, CAR, [["color", 5, "red"]]], POSE], "color of vehicle.ford.mustang is 'red'"),
    ("spawn_actor", [[1, CAR, [["wings", 2, "2"]]], POSE], "has no attribute 'wings', expected one of role_name"),
    ("spawn_actor", [[1, CAR, [["color", 5, "1" * 300]]], POSE], "expected `str` of length <= 256"),
    ("spawn_actor", [[1, "sensor.camera.rgb", [["fov", 3, "nan"]]], POSE], "fov of sensor.camera.rgb is 'nan'"),
    ("spawn_actor", [[1, "sensor.camera.rgb", [["image_size_x", 2, "99999"]]], POSE], "out of range"),
    ("spawn_actor_with_parent", [[1, "sensor.camera.rgb", []], POSE, 5, 0, ""], "there is no actor 5"),
    ("spawn_actor_with_parent", [[1, "sensor.camera.rgb", []], POSE, -5, 0, ""], "parent of .* is -5: expected"),
    ("destroy_actor", [5], "there is no actor 5"),
    ("destroy_actor", [None], "key of destroy_actor is None"),
    ("destroy_actor", [True], "expected `int`, got `bool`"),
    ("apply_control_to_vehicle", [5, CONTROL], "there is no actor 5"),
    ("apply_control_to_vehicle", [5, CONTROL[:3]], "of length 7"),
    ("apply_control_to_vehicle", [5, [NAN, *CONTROL[1:]]], r"is \[nan, 0.0"),
    ("set_actor_target_velocity", [5, [math.inf, 0.0, 0.0]], r"is \[inf, 0.0"),
    ("get_actor_bounding_box", [2**40], "expected `int` <= 4294967295"),
    ("get_sensor_token", [77], "there is no stream 77"),
    ("set_weather_parameters", [[NAN] * 14], "parameters of set_weather_parameters"),
    ("set_weather_parameters", [[1.0]], "of length"),
    ("set_episode_settings", [[*SETTINGS[:2], [True, NAN], *SETTINGS[3:]]], "settings of set_episode_settings"),
    ("set_episode_settings", [[*SETTINGS[:2], [True, 1e6], *SETTINGS[3:]]], "expected a multiple of 0.01 up to 1.0"),
    ("set_episode_settings", [[]], "of length 11"),
    ("load_new_episode", ["../../etc/passwd", False, 0], "there is no map 'passwd'"),
    ("apply_color_texture_to_objects", [["x"], 2, [1, 1, [["red"] * 4]]], "expected `int`, got `str`"),
    ("freeze_all_traffic_lights", [], "called with 0 arguments, expected 1"),
    ("add_traffic_manager_running", [["127.0.0.1", 1 << 20]], "manager of add_traffic_manager_running"),
]


@pytest.mark.parametrize(
    ("name", "arguments", "complaint"), BAD_CALLS, ids=[f"{b[0][:32]} {b[2][:24]}" for b in BAD_CALLS]
)
def test_a_bad_call_is_refused_with_the_reason_and_the_connection_goes_on(caller, name, arguments, complaint):
    said = caller.refused(name, *arguments)
    assert re.search(complaint, said), said
    assert "\n" not in said
    assert len(said) < 500
    assert caller.granted("version") == "0.9.16"


def test_a_call_for_another_kind_of_actor_is_refused(caller, car):
    assert "is a vehicle, expected a walker" in caller.refused(
        "apply_control_to_walker", car, [[1.0, 0.0, 0.0], 1.0, False]
    )
    told = caller.refused("spawn_actor_with_parent", [1, "vehicle.audi.a2", []], POSE, car, 0, "")
    assert "cannot be attached" in told
    camera = caller.spawn("sensor.camera.rgb", parent=car)[0]
    assert "expected a vehicle or walker" in caller.refused(
        "spawn_actor_with_parent", [1, "sensor.camera.rgb", []], POSE, camera, 0, ""
    )
    rolled = [[0.0, 0.0, 2.0], [0.0, 0.0, 30.0]]
    assert "rolled by 30" in caller.refused("set_actor_transform", camera, rolled)


def test_a_batch_refuses_each_bad_command_by_itself_and_a_bad_batch_as_a_whole(caller, car):
    good, unknown = [2, [car, CONTROL]], [2, [5, CONTROL]]
    nested = [
        0,
        [[1, "vehicle.audi.a2", []], [[60.0, 1.75, 0.0], [0.0, 0.0, 0.0]], [False], 7, "", [[good], [[0, []]]]],
    ]
    bad = [[2, [car]], [2, []], [2, 7], [77, [car]], [0, []], [0, [[1, CAR, []]]], nested]
    answers = caller.call("apply_batch", [[command] for command in [good, unknown, *bad, good]], False)
    assert [answer[0][0] for answer in answers] == [1, *[0] * 8, 1]
    assert "there is no actor 5" in answers[1][0][1][0]
    for batch in ([1], [[good]] * 20_000, "all", [good]):
        caller.socket.sendall(caller.request("apply_batch", batch, False))
        kind, number, error, result = caller.answer()
        assert (kind, number, result) == (1, caller.count, None)
        assert "commands of apply_batch" in error
    with Caller(caller.socket.getpeername()[1]) as onlooker:
        snapshot = onlooker.granted("get_actors_by_id", list(range(car, car + 50)))
    caller.clear(*[actor[0] for actor in snapshot if actor[0] != car])


def test_a_call_without_an_answer_that_is_bad_changes_nothing_and_gets_none(caller, car):
    caller.synchronous()
    caller.tell("apply_control_to_vehicle", car, [NAN, *CONTROL[1:]])
    caller.tell("fly")
    caller.tell("destroy_actor")
    caller.tell("set_weather_parameters", [NAN] * 14)
    assert caller.granted("tick_cue") > 0
    assert not any(math.isnan(value) for value in caller.granted("get_weather_parameters"))
    with listen(caller.socket.getpeername()[1], WORLD_STREAM) as world:
        states = message(world)[48 + 8 + 8 + 4 + 12 + 4 :]
    assert not any(math.isnan(value) for value in struct.unpack_from("<6f", states, 5))


NO_REQUESTS = {
    "a number": b"\x01",
    "an answer": msgpack.packb([1, 1, None, 2]),
    "a notification": msgpack.packb([2, "version", []]),
    "no parameters": msgpack.packb([0, 1, "version", []]),
    "no metadata": msgpack.packb([0, 1, "version", [1]]),
    "another name": msgpack.packb([0, 1, 5, [[False]]]),
    "text that is none": b"\x94\x00\x01\xa2\xff\xfe\x91\x91\xc2",
    "a reserved byte": b"\xc1",
    "too deep": b"\x91" * 3000,
    "a map": msgpack.packb({0: 1}),
    "too many arguments": msgpack.packb([0, 1, "version", [[False]] * 100]),
    "HTTP": b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n",
}


@pytest.mark.parametrize("sent", NO_REQUESTS.values(), ids=NO_REQUESTS)
def test_what_is_no_request_is_answered_with_an_error_and_closed(server, sent):
    with Caller(server[1]) as rude:
        rude.socket.sendall(sent)
        kind, number, error, result = rude.answer()
        assert kind == 1
        assert "a message is" in (error if number == 0 else result[0][1][0])
        assert rude.answer() is None
    check_served(server[1])


@LINUX
def test_what_a_header_claims_takes_no_memory_and_its_call_is_refused_in_time(impatient):
    process, port = impatient
    before = memory_mb(process)
    start = b"\x94\x00\xcd\x01\x02\xa7version"
    with contextlib.ExitStack() as stack:
        rude = [stack.enter_context(Caller(port)) for _ in range(12)]
        for k, each in enumerate(rude):
            claim = (b"\xc6", b"\xdb", b"\xdd", b"\xdf")[k % 4] + b"\xff\xff\xff\xff"
            each.socket.sendall(start + claim)
        check_served(port)
        assert memory_mb(process) < before + 30
        for each in rude:
            kind, number, error, ((which, (text,)),) = each.answer()
            assert (kind, number, error, which) == (1, 258, None, 0)
            assert "did not come within" in text
            assert each.answer() is None


def test_a_message_sent_byte_by_byte_is_refused_in_time_and_stops_nobody(impatient):
    with Caller(impatient[1]) as slow, Caller(impatient[1]) as calm:
        begin = time.monotonic()
        slowest = 0.0
        with contextlib.suppress(OSError):
            for byte in slow.request("get_required_files", "a" * 200):
                slow.socket.sendall(bytes([byte]))
                asked = time.monotonic()
                assert calm.granted("version") == "0.9.16"
                slowest = max(slowest, time.monotonic() - asked)
                time.sleep(0.05)
                if time.monotonic() - begin > 5.0:
                    break
        assert "did not come within 2.0 s" in slow.answer()[3][0][1][0]
        assert slowest < 2.0


def test_slow_but_whole_messages_are_met(impatient):
    with Caller(impatient[1]) as slow:
        for _ in range(4):
            sent = slow.request("version")
            slow.socket.sendall(sent[:5])
            time.sleep(0.4)
            slow.socket.sendall(sent[5:])
            assert slow.answer() == [1, slow.count, None, [[1, "0.9.16"]]]


@LINUX
def test_a_message_that_is_too_large_is_refused_and_takes_no_more_memory_the_next_time(server):
    process, port = server
    sizes = []
    for _ in range(6):
        with Caller(port) as rude:
            with contextlib.suppress(OSError):
                rude.socket.sendall(rude.request("get_required_files", "a" * (20 << 20)))
            assert "larger than 16777216 bytes" in rude.answer()[3][0][1][0]
        check_served(port)
        sizes.append(memory_mb(process))
    # Kept, the four would be 80 MiB.
    assert sizes[-1] < sizes[1] + 40


@LINUX
def test_messages_that_wait_unfinished_share_a_bound(impatient):
    process, port = impatient
    before = memory_mb(process)
    with contextlib.ExitStack() as stack:
        for _ in range(30):
            rude = stack.enter_context(Caller(port))
            with contextlib.suppress(OSError):
                rude.socket.sendall(rude.request("get_required_files", "a" * (8 << 20))[: 4 << 20])
        check_served(port)
        assert memory_mb(process) < before + 80


@LINUX
def test_300_silent_connections_leave_room_for_a_client_and_are_given_back(impatient):
    process, port = impatient
    check_served(port)
    files, before = connections(process), memory_mb(process)
    with contextlib.ExitStack() as stack:
        silent = [stack.enter_context(socket.create_connection(("127.0.0.1", port + k % 2))) for k in range(300)]
        begin = time.monotonic()
        check_served(port)
        assert time.monotonic() - begin < 30.0
        assert connections(process) <= files + 256 + 4
        assert memory_mb(process) < before + 60
        assert len(silent) == 300
    until = time.monotonic() + 20.0
    while connections(process) > files + 2 and time.monotonic() < until:
        time.sleep(0.1)
    assert connections(process) <= files + 2
    check_served(port)


def test_who_speaks_keeps_the_connection_when_silent_ones_press(impatient):
    port = impatient[1]
    with Caller(port) as calm, contextlib.ExitStack() as stack:
        for k in range(300):
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
            if k % 10 == 0:
                assert calm.granted("version") == "0.9.16"
        for _ in range(60):
            assert calm.granted("version") == "0.9.16"
            time.sleep(0.1)


def test_a_stream_that_does_not_exist_is_closed_after_a_while(impatient):
    with listen(impatient[1], 4_000_000_000) as lost:
        begin = time.monotonic()
        assert lost.recv(1) == b""
        assert 0.9 < time.monotonic() - begin < 5.0


def test_a_connection_that_names_no_stream_is_closed(impatient):
    with socket.create_connection(("127.0.0.1", impatient[1] + 1), timeout=20.0) as mute:
        mute.sendall(b"\x01\x00")
        assert mute.recv(1) == b""


@pytest.fixture
def filmed(impatient):
    """A synchronous caller, its process and port, and the stream of a camera of 300 kB a picture."""
    process, port = impatient
    with Caller(port) as made:
        made.synchronous()
        parent = made.spawn(CAR)[0]
        camera = made.spawn("sensor.camera.rgb", parent=parent, image_size_x=320, image_size_y=240)
        yield made, process, port, stream_of(camera)
        made.clear(parent)
        made.synchronous()


@LINUX
def test_in_synchronous_mode_who_never_reads_is_dropped_and_others_get_every_frame(filmed):
    caller, process, port, stream = filmed
    with listen(port, stream, buffer_bytes=1 << 14) as deaf, listen(port, stream) as calm:
        time.sleep(0.3)
        before, slowest, frames = memory_mb(process), 0.0, []
        for _ in range(60):
            asked = time.monotonic()
            frame = caller.granted("tick_cue")
            slowest = max(slowest, time.monotonic() - asked)
            frames.append((frame, frame_of(message(calm))))
        assert slowest < 10.0
        assert all(asked == seen for asked, seen in frames)
        assert memory_mb(process) < before + 30
        with pytest.raises((EOFError, ConnectionResetError)):
            for _ in range(60):
                message(deaf)


def test_in_synchronous_mode_who_reads_late_misses_nothing(filmed):
    caller, _, port, stream = filmed
    with listen(port, stream, buffer_bytes=1 << 14) as late:
        time.sleep(0.3)
        frames = [caller.granted("tick_cue") for _ in range(10)]
        assert [frame_of(message(late)) for _ in frames] == frames


@LINUX
def test_a_free_running_world_skips_frames_for_who_reads_slowly_and_goes_on(filmed):
    caller, process, port, stream = filmed
    with listen(port, WORLD_STREAM) as world, listen(port, stream, buffer_bytes=1 << 14) as slow:
        caller.synchronous(False)
        before = memory_mb(process)
        first = frame_of(message(world))
        while frame_of(message(world)) < first + 80:
            pass
        assert memory_mb(process) < before + 30
        caller.synchronous(True)
        last = caller.granted("tick_cue")
        frames = [frame_of(message(slow))]
        while frames[-1] < last:
            frames.append(frame_of(message(slow)))
        # What the system keeps of two sockets, then a gap, never backwards.
        assert frames == sorted(frames)
        assert len(frames) < last - frames[0]


@LINUX
def test_who_asks_much_and_never_reads_holds_little_and_stops_nobody(impatient):
    process, port = impatient
    before = memory_mb(process)
    with Caller(port) as greedy, Caller(port) as calm:
        greedy.socket.settimeout(0.5)
        asked = greedy.request("get_actor_definitions") * 50_000
        with contextlib.suppress(OSError):
            greedy.socket.sendall(asked)
        for _ in range(20):
            begin = time.monotonic()
            assert calm.granted("version") == "0.9.16"
            assert time.monotonic() - begin < 5.0
        assert memory_mb(process) < before + 30


@LINUX
def test_cameras_that_look_elsewhere_with_every_step_take_no_more_memory(server):
    process, port = server
    with Caller(port) as caller:
        caller.synchronous()
        camera = caller.spawn("sensor.camera.rgb", x=40.0, y=0.0, image_size_x=400, image_size_y=300)
        caller.granted("apply_color_texture_to_objects", ["Road_Road_street_2"], 2, [1, 1, [[255, 0, 255, 255]]])
        with listen(port, stream_of(camera)) as seen:
            time.sleep(0.3)

            def look(steps):
                for k in steps:
                    pose = [[40.0, 0.0, 3.0 + 0.1 * (k % 100)], [-30.0 - 0.1 * k, 0.0, 0.0]]
                    caller.granted("set_actor_transform", camera[0], pose)
                    caller.granted("tick_cue")
                    message(seen)

            look(range(20))
            before = memory_mb(process)
            look(range(20, 50))
            assert memory_mb(process) < before + 20
        caller.clear(camera[0])
        caller.granted("load_new_episode", "", False, 0)


def test_how_many_actors_and_pixels_there_may_be_is_bounded(server):
    with Caller(server[1]) as caller:
        large = {"image_size_x": 4096, "image_size_y": 2048}
        cameras = [caller.spawn("sensor.camera.rgb", **large)[0] for _ in range(2)]
        given = [[key, 2, str(value)] for key, value in large.items()]
        assert "all cameras together" in caller.refused("spawn_actor", [1, "sensor.camera.rgb", given], POSE)
        walkers = []
        with pytest.raises(AssertionError, match="there are 2000 actors"):
            for _ in range(2001):
                walkers.append(caller.spawn("walker.pedestrian.0001")[0])
        assert len(walkers) == 1998
        caller.clear(*cameras, *walkers)


def test_vehicles_that_move_by_themselves_are_bounded(server):
    with Caller(server[1]) as caller:
        lanes = [[[5.0 * k, 6.0 * row, 0.0], [0.0, 0.0, 0.0]] for row in range(10) for k in range(25)]
        spawn = [[[0, [DESCRIBED, pose, [False], 0, "", []]]] for pose in lanes]
        answers = caller.call("apply_batch", spawn, False)
        made = [value for ((ok, value),) in answers if ok]
        assert len(made) == 200
        assert "201 of 201 vehicles would move by themselves" in answers[200][0][1][0]
        caller.clear(*made)


POOL = [
    None, True, False, 0, 1, -1, 2**31, 2**32 - 1, 2**63, 0.0, NAN, math.inf, -1e300, "", "street", "x" * 300,
    b"\x00" * 30, [], [[]], [0, 0, 0], [0.0, 0.0, 0.0], POSE, CONTROL, DESCRIBED, [1, "sensor.camera.rgb", []],
    SETTINGS, [0.0] * 14, [[1.0, 0.0, 0.0], 1.5, False], [1, 1, [[255, 0, 255, 255]]], ["Road_Road_street_1"],
    {1: 2}, [[[0, []]]],
    [[[1, [100]]], [[2, [100, CONTROL]]]], [1e5, -1e5, 1e5], [[1e5, -1e5, 1e5], [90.0, 36000.0, 0.0]],
    [[25.0, 1.75, 1e5], [-90.0, 0.0, 0.0]], [200.0, 200.0, 200.0], [-100.0, 100.0, -100.0, True, True, True, -(2**31)],
]  # fmt: skip


def names_of_calls():
    from roadproof.simulators.carla_server.calls import NOT_THERE, Calls

    known = [name.removeprefix("call_") for name in dir(Calls) if name.startswith("call_")]
    return [*known, *NOT_THERE]


@pytest.mark.parametrize("seed", range(3))
def test_calls_with_arguments_at_random_are_all_answered_and_leave_a_world_that_steps(street, seed):
    chance = random.Random(seed)
    names = names_of_calls()
    small = {"image_size_x": 32, "image_size_y": 24}
    with serving("--map", street) as (process, port), contextlib.ExitStack() as stack:
        caller = stack.enter_context(Caller(port))
        stack.enter_context(listen(port, WORLD_STREAM))
        for k in range(1500):
            if k % 150 == 0:
                # A new world, since what is asked at random soon destroys it.
                caller.granted("load_new_episode", "street", True, 0)
                car, walker = caller.spawn(CAR)[0], caller.spawn("walker.pedestrian.0001", x=30.0)[0]
                rgb = caller.spawn("sensor.camera.rgb", parent=walker, **small)
                depth = caller.spawn("sensor.camera.depth", parent=car, **small)
                hits = caller.spawn("sensor.other.collision", parent=car)
                for seen in (rgb, depth, hits):
                    stack.enter_context(listen(port, stream_of(seen)))
                made = [car, walker, rgb[0], depth[0], hits[0]]
                texture = ["Road_Road_street_1", "Road_Road_street_2"], 2, [1, 1, [[255, 0, 255, 255]]]
                caller.granted("apply_color_texture_to_objects", *texture)
            if k % 15 == 0:
                caller.granted("tick_cue")
            arguments = [chance.choice(POOL) for _ in range(chance.choice((0, 1, 1, 2, 2, 2, 3, 5)))]
            if arguments and chance.random() < 0.7:
                arguments[0] = chance.choice(made)
            caller.socket.sendall(caller.request(chance.choice(names), *arguments))
            kind, number, error, result = caller.answer()
            assert (kind, number) == (1, caller.count)
            assert "failed in the server" not in str(error or result)
        check_served(port)
        process.terminate()
        assert "Traceback" not in process.stdout.read().decode()
        assert process.wait(30) == 0


POISON = """
from roadproof.simulators.carla_server import world
step = world.World.step
def poisoned(self):
    if any("poison" in actor.values.values() for actor in self.actors.values()):
        raise ZeroDivisionError
    return step(self)
world.World.step = poisoned
from roadproof.cli import main
main()
"""
"""A server with a mistake that a client can bring about."""


def test_a_step_that_fails_is_an_error_for_who_asked_for_it_and_else_a_new_map(street):
    with serving("--map", street, program=POISON) as (_, port), Caller(port) as caller, listen(port, WORLD_STREAM):
        caller.synchronous()
        poison = caller.spawn(CAR, role_name="poison")[0]
        assert caller.refused("tick_cue") == "tick_cue failed in the server: ZeroDivisionError"
        caller.clear(poison)
        assert caller.granted("tick_cue") > 0
        episode, _ = caller.granted("get_episode_info")
        poison = caller.spawn(CAR, role_name="poison")[0]
        caller.synchronous(False)
        until = time.monotonic() + 20.0
        while caller.granted("get_actors_by_id", [poison]) and time.monotonic() < until:
            time.sleep(0.1)
        assert caller.granted("get_episode_info")[0] == episode + 1
        check_served(port)


@LINUX
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_bytes_at_random_on_both_ports_hurt_nobody(server, seed):
    process, port = server
    chance = random.Random(seed)
    before = memory_mb(process)
    with Caller(port) as calm:
        good = [calm.request(name) for name in ("version", "get_map_info", "get_episode_settings")]
        for k in range(90):
            rubbish = bytearray(chance.randbytes(chance.choice((1, 4, 30, 1000, 70_000))))
            if k % 3 == 0:  # a request with a few bytes changed
                rubbish = bytearray(b"".join(chance.choices(good, k=20)))
                for _ in range(5):
                    rubbish[chance.randrange(len(rubbish))] = chance.randrange(256)
            with (
                socket.create_connection(("127.0.0.1", port + (k % 4 == 3)), timeout=30.0) as rude,
                contextlib.suppress(OSError),
            ):
                rude.sendall(rubbish)
                if k % 4 == 1:
                    rude.shutdown(socket.SHUT_WR)
                    while rude.recv(1 << 16):
                        pass
            if k % 10 == 0:
                assert calm.granted("version") == "0.9.16"
    check_served(port)
    assert memory_mb(process) < before + 40


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_in_one_line_with_clients_there(street, number):
    with serving("--map", street) as (process, port), Caller(port) as calm, listen(port, WORLD_STREAM) as world:
        assert calm.granted("version") == "0.9.16"
        message(world)
        process.send_signal(number)
        assert process.stdout.read() == b"Ended; all connections and the town are closed\n"
        assert process.wait(30) == 0
        with pytest.raises(EOFError):
            while True:
                exactly(world, 1)


INTERRUPTED_WHERE_NOTHING_CAN_BE_RAISED = """
import signal, sys
from pathlib import Path
from roadproof.simulators.carla_server.server import serve

class Last:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

def interrupt(number, frame):  # another than Python's own, as the command has
    raise KeyboardInterrupt

signal.signal(signal.SIGINT, interrupt)
path = Path(sys.argv[1])
serve(port=0, maps=[path], first=path.stem, ready=lambda _: Last() and None)
print("ended")
"""


@LINUX
def test_a_signal_is_never_lost(street):
    command = [sys.executable, "-c", INTERRUPTED_WHERE_NOTHING_CAN_BE_RAISED, street]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "ended\n", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_the_town_is_built_ends_it_too(number):
    command = [sys.executable, "-c", PROGRAM, "carla", "serve", "--port", "0"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(command, preexec_fn=interruptible, **pipes) as process:
        assert process.stdout.readline().startswith(b"Building town")
        time.sleep(0.5)
        process.send_signal(number)
        said = process.stdout.read().decode()
    assert "Traceback" not in said
    assert "Serving" not in said
    assert process.returncode in (0, 130)


@pytest.mark.parametrize("port", [-1, 65535, 65536, 70000])
def test_a_port_that_cannot_be_is_refused_before_anything_begins(port):
    told = roadproof("carla", "serve", "--port", port)
    assert (told.returncode, told.stdout) == (2, "")
    assert told.stderr == f"roadproof: --port is {port}, expected 0 to 65,534\n"


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_other_addresses_than_loopback_need_a_word(street, host):
    told = roadproof("carla", "serve", "--map", street, "--port", "0", "--host", host)
    assert told.returncode == 2
    assert told.stderr.startswith(f"roadproof: host {host!r} is not this machine's loopback: whoever reaches the port")
    assert "--allow-remote" in told.stderr
    assert told.stderr.count("\n") == 1


def test_with_the_word_it_listens_elsewhere(street):
    with serving("--map", street, "--host", "0.0.0.0", "--allow-remote") as (_, port):
        check_served(port)


def test_a_host_without_an_address_here_is_one_clear_line(street):
    told = roadproof("carla", "serve", "--map", street, "--host", "nowhere.invalid")
    assert told.returncode == 2
    assert "roadproof: host 'nowhere.invalid' has no address" in told.stderr
