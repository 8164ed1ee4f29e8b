"""The unmodified CARLA client against `roadproof carla serve` in another process."""

import contextlib
import pathlib
import queue
import select
import socket
import struct
import subprocess
import sys
import time

import numpy as np
import pytest

import needs
from carla_serving import free_port, serving
from command import roadproof

carla = pytest.importorskip("carla", reason="CARLA's client is not installed: pip install 'roadproof[carla]'")
needs.town()
msgpack = pytest.importorskip("msgpack", reason="serving needs the extra roadproof[carla]")

PATIENCE_S = 60.0
LISTENING = []


@pytest.fixture(scope="module")
def port(street):
    with serving("--map", street) as (_, opened):
        yield opened


@pytest.fixture(scope="module")
def client(port):
    connected = carla.Client("127.0.0.1", port, worker_threads=1)
    connected.set_timeout(PATIENCE_S)
    return connected


@pytest.fixture
def world(client):
    """Synchronous, and empty again afterwards."""
    found = client.get_world()
    before = found.get_settings()
    settings = found.get_settings()
    settings.synchronous_mode, settings.fixed_delta_seconds = True, 0.05
    found.apply_settings(settings)
    yield found
    found.tick()  # only then are actors listed that were spawned last
    forget_sensors(found)
    for actor in found.get_actors():
        if not actor.type_id.startswith("sensor"):
            actor.destroy()
    found.tick()
    assert list(found.get_actors()) == []
    found.apply_settings(before)


def forget_sensors(world):
    """Stop and destroy all sensors.

    By the objects that listen, and with ticks after it: the client ends the process if others are destroyed in their
    place, or if the server closes a stream that is just being left.
    """
    for made in LISTENING:
        made.stop()
        made.destroy()
    LISTENING.clear()
    for _ in range(5):
        world.tick()


def car(world, x=20.0, y=1.75, yaw=0.0, name="vehicle.ford.mustang"):
    blueprint = world.get_blueprint_library().find(name)
    return world.spawn_actor(blueprint, carla.Transform(carla.Location(x, y, 0.3), carla.Rotation(yaw=yaw)))


def sensor(world, parent, name, place=None, **attributes):
    """The queue of what a new sensor sees."""
    blueprint = world.get_blueprint_library().find(f"sensor.{name}")
    for key, value in attributes.items():
        blueprint.set_attribute(key, str(value))
    seen = queue.Queue()
    # Kept with the queue: a sensor that goes out of scope stops listening.
    seen.sensor = world.spawn_actor(blueprint, place or carla.Transform(), attach_to=parent)
    seen.sensor.listen(seen.put)
    LISTENING.append(seen.sensor)
    return seen


def shown(world, seen):
    """The picture of a new tick; the first ones are lost while the stream is being opened."""
    for _ in range(60):
        frame = world.tick()
        with contextlib.suppress(queue.Empty):
            image = seen.get(timeout=1.0)
            while image.frame < frame:
                image = seen.get(timeout=PATIENCE_S)
            return frame, image
    raise AssertionError("no picture came")


def pixels(image):
    return np.frombuffer(image.raw_data, np.uint8).reshape(image.height, image.width, 4)


def test_versions_and_maps_are_what_the_client_expects(client):
    assert client.get_client_version() == client.get_server_version()
    assert client.get_available_maps() == [f"/Game/Carla/Maps/{name}" for name in ("street", "town", "second")]


def test_the_map_is_read_by_the_clients_own_reader(world):
    road = world.get_map()
    assert road.name == "Carla/Maps/street"
    places = road.get_spawn_points()
    assert len(places) == 20
    for place in places:
        waypoint = road.get_waypoint(place.location)
        assert waypoint.transform.location.distance(place.location) < 0.31
        assert abs((waypoint.transform.rotation.yaw - place.rotation.yaw + 180) % 360 - 180) < 0.01


def test_settings_are_kept_and_a_step_that_does_not_fit_is_refused(world):
    settings = world.get_settings()
    assert (settings.synchronous_mode, settings.fixed_delta_seconds) == (True, 0.05)
    settings.fixed_delta_seconds = 0.033
    with pytest.raises(RuntimeError, match="expected a multiple of"):
        world.apply_settings(settings)
    assert world.get_settings().fixed_delta_seconds == 0.05


def test_ticks_count_frames_and_seconds(world):
    first = world.tick()
    before = world.get_snapshot().timestamp.elapsed_seconds
    assert [world.tick() for _ in range(3)] == [first + 1, first + 2, first + 3]
    assert world.get_snapshot().timestamp.elapsed_seconds - before == pytest.approx(0.15)


def test_a_car_drives_and_steers_as_carlas_signs_say(world):
    ego = car(world)
    for _ in range(30):
        ego.apply_control(carla.VehicleControl(throttle=0.8, steer=0.2))
        world.tick()
    place, speed = ego.get_transform(), ego.get_velocity()
    assert place.location.x > 22.0
    assert place.location.y > 1.8  # y and yaw grow to the right
    assert 3.0 < place.rotation.yaw < 60.0
    along = place.get_forward_vector()
    assert speed.x * along.x + speed.y * along.y == pytest.approx(speed.length(), rel=0.02)
    assert speed.length() > 3.0
    assert ego.get_control().steer == pytest.approx(0.2)


def test_a_second_car_in_the_same_place_is_refused(world):
    car(world)
    with pytest.raises(RuntimeError, match="collision at spawn position"):
        car(world, x=21.0)
    second = car(world, y=-1.75, yaw=180.0)
    world.tick()  # a snapshot from before it was spawned may come late, and the client goes by the last one
    assert second.is_alive


def test_a_camera_sends_the_picture_of_every_tick_from_where_it_is(world):
    ego = car(world)
    place = carla.Transform(carla.Location(x=2.0, z=1.4), carla.Rotation(pitch=-15.0))
    seen = sensor(world, ego, "camera.rgb", place, image_size_x=160, image_size_y=120, fov=100)
    for _ in range(3):
        ego.apply_control(carla.VehicleControl(throttle=1.0))
        frame, image = shown(world, seen)
        assert (image.frame, image.width, image.height, image.fov) == (frame, 160, 120, 100.0)
        expected = ego.get_transform().transform(carla.Location(x=2.0, z=1.4))
        assert image.transform.location.distance(expected) < 1e-3
        assert image.transform.rotation.pitch == pytest.approx(-15.0, abs=1e-3)
    picture = pixels(image).astype(float)
    assert (picture[..., 3] == 255).all()
    # Sky above, BGR; the road, without much colour, below.
    assert picture[:15, :, 0].mean() > picture[:15, :, 2].mean()
    assert np.ptp(picture[100:, 60:100, :3].mean(axis=(0, 1))) < 25
    assert picture[:15, :, :3].mean() > picture[100:, 60:100, :3].mean() + 30


def test_boxes_of_what_stands_there_come_by_their_labels_and_those_of_cars_with_them(world):
    labels = carla.CityObjectLabel
    ego = car(world, yaw=30.0)
    world.tick()
    boxes = {name: world.get_level_bbs(label) for name, label in labels.names.items()}
    # Nothing bends on this street, so it has no guard rails.
    assert {"Buildings", "Fences", "Poles", "Vegetation", "Car"} == {name for name in boxes if boxes[name]} - {"Any"}
    assert len(boxes["Any"]) == sum(map(len, boxes.values())) - len(boxes["Any"])
    (own,) = (each for each in boxes["Car"] if each.location.distance(ego.get_location()) < 1.0)
    assert {box.actor_id for box in boxes["Any"]} == {0, ego.id} == {0, own.actor_id}
    assert (own.extent.x, own.extent.y, own.rotation.yaw) == pytest.approx((2.25, 0.95, 30.0), abs=1e-3)
    for each in boxes["Vegetation"] + boxes["Buildings"]:
        assert each.location.z == pytest.approx(each.extent.z)
        assert each.extent.z > 1.5
        # Beside the road, which is 3.5 m wide on each side of y = 0, with 2.5 m of pavement.
        assert abs(each.location.y) > 5.0 or not 0.0 < each.location.x < 160.0


def test_the_weather_changes_the_picture_and_comes_back_as_it_was_set(world):
    ego = car(world)
    place = carla.Transform(carla.Location(x=2.0, z=1.4))
    seen = sensor(world, ego, "camera.rgb", place, image_size_x=80, image_size_y=60, fov=100)
    levels = []
    for weather in (carla.WeatherParameters.ClearNoon, carla.WeatherParameters.HardRainNoon):
        world.set_weather(weather)
        assert world.get_weather() == weather
        _, image = shown(world, seen)
        levels.append(pixels(image)[:10, :, :3].mean())
    assert levels[0] > levels[1] + 15
    world.set_weather(carla.WeatherParameters.ClearNoon)


def test_a_car_that_is_hit_is_named_by_the_collision_sensor(world):
    ego, other = car(world), car(world, x=30.0, name="vehicle.audi.a2")
    hits = sensor(world, ego, "other.collision")
    time.sleep(1.0)  # until its stream is open
    for _ in range(80):
        ego.apply_control(carla.VehicleControl(throttle=1.0))
        world.tick()
        if not hits.empty():
            break
    hit = hits.get(timeout=PATIENCE_S)
    assert (hit.actor.id, hit.other_actor.id, hit.other_actor.type_id) == (ego.id, other.id, "vehicle.audi.a2")
    assert 30.0 - 4.6 < ego.get_location().x < 30.0


def test_a_lane_is_left_where_the_client_sees_its_line(world):
    ego = car(world)
    crossed = sensor(world, ego, "other.lane_invasion")
    for _ in range(60):
        ego.apply_control(carla.VehicleControl(throttle=0.7, steer=-0.15))
        world.tick()
    first = crossed.get(timeout=PATIENCE_S)
    assert [str(mark.type) for mark in first.crossed_lane_markings] == ["Broken"]


def test_a_walker_goes_where_it_is_told(world):
    blueprint = world.get_blueprint_library().find("walker.pedestrian.0003")
    walker = world.spawn_actor(blueprint, carla.Transform(carla.Location(30.0, 4.5, 1.0)))
    walker.apply_control(carla.WalkerControl(carla.Vector3D(1.0, 0.0, 0.0), 1.5, False))
    for _ in range(20):
        world.tick()
    assert walker.get_location().x == pytest.approx(31.5, abs=0.01)


def test_an_actor_can_be_put_elsewhere_with_a_speed(world):
    ego = car(world)
    ego.set_transform(carla.Transform(carla.Location(60.0, 1.75, 0.0), carla.Rotation(yaw=0.0)))
    ego.set_target_velocity(carla.Vector3D(6.0, 0.0, 0.0))
    world.tick()
    assert ego.get_location().x == pytest.approx(60.27, abs=0.06)
    assert ego.get_velocity().length() == pytest.approx(6.0, abs=0.3)


def test_batches_spawn_move_and_destroy(client, world):
    command = carla.command
    blueprint = world.get_blueprint_library().find("vehicle.tesla.model3")
    places = [carla.Transform(carla.Location(x, 1.75, 0.3)) for x in (20.0, 40.0, 41.0)]
    answers = client.apply_batch_sync(
        [command.SpawnActor(blueprint, p).then(command.SetSimulatePhysics(command.FutureActor, False)) for p in places]
    )
    assert [bool(answer.error) for answer in answers] == [False, False, True]
    ids = [answer.actor_id for answer in answers[:2]]
    moved = [carla.Transform(carla.Location(80.0 + 10 * k, 1.75, 0.0)) for k in range(2)]
    client.apply_batch_sync([command.ApplyTransform(i, p) for i, p in zip(ids, moved, strict=True)], True)
    assert [round(actor.get_location().x) for actor in world.get_actors(ids)] == [80, 90]
    assert not any(answer.error for answer in client.apply_batch_sync([command.DestroyActor(i) for i in ids], True))


def test_a_camera_that_cannot_be_served_is_refused_and_leaves_nothing(world):
    ego = car(world)
    rolled = carla.Transform(carla.Location(z=2.0), carla.Rotation(roll=20.0))
    with pytest.raises(RuntimeError, match="rolled by 20"):
        sensor(world, ego, "camera.rgb", rolled)
    with pytest.raises(RuntimeError, match="pitched by 400"):
        sensor(world, ego, "camera.rgb", carla.Transform(carla.Location(z=2.0), carla.Rotation(pitch=400.0)))
    with pytest.raises(RuntimeError, match="out of range"):
        sensor(world, ego, "camera.rgb", fov=170)
    with pytest.raises(RuntimeError, match="sensor_tick 1 s cannot be served"):
        sensor(world, ego, "camera.rgb", sensor_tick=1.0)
    world.tick()
    assert [actor.type_id for actor in world.get_actors()] == ["vehicle.ford.mustang"]


def test_another_map_is_loaded_and_an_unknown_one_refused(client, world):
    with pytest.raises(RuntimeError, match="no map 'Town77'"):
        client.load_world("Town77")
    again = client.reload_world(False)
    assert again.id != world.id
    assert again.get_map().name == "Carla/Maps/street"


def test_that_the_map_is_another_is_told_with_the_next_tick_and_once(port, world):
    # Told with the answer, it reaches a client that is about to open its stream anew, which ends with the process.
    calls, stream = (socket.create_connection(("127.0.0.1", each), timeout=PATIENCE_S) for each in (port, port + 1))

    def call(name, *arguments):
        calls.sendall(msgpack.packb([0, 1, name, [[False], *arguments]]))
        assert calls.recv(4096)

    def told():
        (size,) = struct.unpack("<I", stream.recv(4, socket.MSG_WAITALL))
        return struct.unpack_from("<Qdf3ii", stream.recv(size, socket.MSG_WAITALL), 48)[::6]

    with calls, stream:
        stream.sendall(struct.pack("<I", 1))
        assert told() == (world.id, 0)
        call("load_new_episode", "", False, 0)
        assert not select.select([stream], [], [], 0.3)[0]
        call("tick_cue")
        assert told() == (world.id + 1, 1)
        call("tick_cue")
        assert told() == (world.id + 1, 0)


def test_a_call_it_does_not_know_is_refused(world):
    with pytest.raises(RuntimeError, match="does not know"):
        world.cast_ray(carla.Location(), carla.Location(1.0, 0.0, 0.0))


def test_what_is_no_number_or_too_large_is_refused_and_the_client_told(world):
    blueprint = world.get_blueprint_library().find("vehicle.ford.mustang")
    with pytest.raises(RuntimeError, match=r"pose of spawn_actor is \[\[nan, 1.75"):
        world.spawn_actor(blueprint, carla.Transform(carla.Location(float("nan"), 1.75, 0.3)))
    name = world.get_names_of_all_objects()[0]
    with pytest.raises(RuntimeError, match="a message is larger than 16777216 bytes"):
        world.apply_color_texture_to_object(name, carla.MaterialParameter.Diffuse, carla.TextureColor(2048, 2048))


def test_a_control_that_is_no_number_leaves_the_one_before(world):
    ego = car(world)
    ego.apply_control(carla.VehicleControl(throttle=0.5))
    ego.apply_control(carla.VehicleControl(throttle=float("nan")))
    world.tick()
    assert ego.get_control().throttle == 0.5


def test_a_free_running_world_goes_on_by_itself(client):
    world = client.get_world()
    ego = car(world)
    ego.apply_control(carla.VehicleControl(throttle=1.0))
    first = world.wait_for_tick(PATIENCE_S).frame
    while world.wait_for_tick(PATIENCE_S).frame < first + 20:
        pass
    assert ego.get_velocity().length() > 1.0
    assert ego.destroy()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [(["--first", "nowhere"], "there is no map 'nowhere'"), (["--map", "missing.xodr"], "missing.xodr")],
    ids=["unknown map", "missing file"],
)
def test_what_cannot_be_served_is_one_clear_line(arguments, complaint):
    with pytest.raises(RuntimeError, match=complaint) as caught, serving(*arguments):
        pass
    assert "Traceback" not in str(caught.value)


def test_a_map_that_clients_could_not_be_given_is_one_clear_line(street, tmp_path):
    text = "<?xml version='1.0' encoding='ISO-8859-1'?><!-- ß -->" + pathlib.Path(street).read_text().partition("?>")[2]
    (tmp_path / "own.xodr").write_text(text, encoding="ISO-8859-1")
    told = roadproof("carla", "serve", "--port", free_port(), "--map", tmp_path / "own.xodr")
    assert (told.returncode, "own.xodr is not UTF-8" in told.stderr, told.stderr.count("\n")) == (2, True, 1)


def test_a_taken_port_is_one_clear_line(street):
    with socket.socket() as taken:
        port = free_port()
        taken.bind(("127.0.0.1", port))
        taken.listen()
        told = roadproof("carla", "serve", "--port", port, "--map", street)
    assert told.returncode == 2
    assert f"port {port} of 127.0.0.1 cannot be opened" in told.stderr


def test_depth_and_kinds_of_things_fit_the_picture(world):
    ego, other = car(world), car(world, x=32.0, name="vehicle.mercedes.sprinter")
    place = carla.Transform(carla.Location(x=2.0, z=1.4))
    size = {"image_size_x": 160, "image_size_y": 120, "fov": 90}
    seen = {name: sensor(world, ego, f"camera.{name}", place, **size) for name in ("depth", "semantic_segmentation")}
    for queue_ in seen.values():
        shown(world, queue_)
    frame = world.tick()
    images = {}
    for name, queue_ in seen.items():
        image = queue_.get(timeout=PATIENCE_S)
        while image.frame < frame:
            image = queue_.get(timeout=PATIENCE_S)
        images[name] = pixels(image).astype(float)
    levels = images["depth"]
    depth = (levels[..., 2] + 256 * levels[..., 1] + 65536 * levels[..., 0]) / (2**24 - 1) * 1000.0
    labels = images["semantic_segmentation"][..., 2]
    road = carla.CityObjectLabel.Roads
    below = (labels == int(road)) & (np.arange(120) > 70)[:, None]
    # Level camera, focal length 80 px: the ground at row r is 1.4 · 80 / (r − 59.5) away.
    expected = 1.4 * 80 / (np.arange(120)[:, None] - 59.5) + np.zeros((1, 160))
    assert below.sum() > 2000
    np.testing.assert_allclose(depth[below], expected[below], rtol=1e-4)
    vehicle = labels == int(carla.CityObjectLabel.Car)
    assert 200 < vehicle.sum() < 4000
    back = other.get_location().x - 2.25 - (ego.get_location().x + 2.0)
    assert np.median(depth[vehicle]) == pytest.approx(back, abs=0.3)
    assert (labels[:5] == int(carla.CityObjectLabel.Sky)).mean() > 0.5
    assert depth[0, 80] > 999


def test_pieces_of_road_take_textures_until_the_map_is_loaded_again(client, world):
    names = list(world.get_names_of_all_objects())
    assert names == [f"Road_Road_street_{number}" for number in range(8)]
    place = carla.Transform(carla.Location(40.0, 0.0, 8.0), carla.Rotation(pitch=-35.0))
    size = {"image_size_x": 80, "image_size_y": 80, "fov": 60}
    magenta = carla.TextureColor(4, 4)
    for k in range(16):
        magenta.set(k % 4, k // 4, carla.Color(255, 0, 255))

    def magenta_share(shown_world):
        _, image = shown(shown_world, sensor(shown_world, None, "camera.rgb", place, **size))
        picture = pixels(image).astype(int)
        return float((np.minimum(picture[..., 0], picture[..., 2]) - picture[..., 1] > 60).mean())

    diffuse = carla.MaterialParameter.Diffuse
    assert magenta_share(world) == 0.0
    world.apply_color_texture_to_object("Road_Road_street_99", diffuse, magenta)
    world.apply_color_texture_to_object(names[2], carla.MaterialParameter.Normal, magenta)
    assert magenta_share(world) == 0.0
    world.apply_color_texture_to_object(names[2], diffuse, magenta)
    one = magenta_share(world)
    assert one > 0.1
    world.apply_color_texture_to_objects(names[2:4], diffuse, magenta)
    assert magenta_share(world) > one + 0.02
    forget_sensors(world)
    assert magenta_share(client.reload_world(False)) == 0.0


TRAFFIC = """
import socket, sys
import carla
client = carla.Client("127.0.0.1", int(sys.argv[1]), worker_threads=1)
client.set_timeout(60.0)
world = client.get_world()
found = world.get_settings()
settings = world.get_settings()
settings.synchronous_mode, settings.fixed_delta_seconds = True, 0.05
world.apply_settings(settings)
with socket.socket() as free:
    free.bind(("", 0))
    port = free.getsockname()[1]
manager = client.get_trafficmanager(port)
manager.set_synchronous_mode(True)
manager.set_random_device_seed(7)
command, blueprint = carla.command, world.get_blueprint_library().find("vehicle.tesla.model3")
places = [carla.Transform(carla.Location(x, 1.75, 0.3)) for x in (20.0, 50.0)]
pilot = command.SetAutopilot(command.FutureActor, True, port)
commands = [command.SpawnActor(blueprint, place).then(pilot) for place in places]
ids = [answer.actor_id for answer in client.apply_batch_sync(commands, True)]
for _ in range(60):
    world.tick()
for car in world.get_actors(ids):
    print("car", car.get_location().x, car.get_location().y, car.get_velocity().length())
client.apply_batch_sync([command.DestroyActor(i) for i in ids], True)
manager.set_synchronous_mode(False)
world.apply_settings(found)
"""


def test_carlas_own_traffic_manager_drives_cars(port):
    # In a process of its own: the manager's threads live until its end.
    told = subprocess.run([sys.executable, "-c", TRAFFIC, str(port)], capture_output=True, text=True, timeout=120)
    assert told.returncode == 0, told.stderr
    cars = [[float(v) for v in line.split()[1:]] for line in told.stdout.splitlines() if line.startswith("car")]
    assert len(cars) == 2
    for start, (x, y, speed) in zip((20.0, 50.0), cars, strict=True):
        assert x > start + 5.0
        assert abs(y - 1.75) < 0.3
        assert 3.0 < speed < 12.0
