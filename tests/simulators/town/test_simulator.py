import dataclasses
import inspect
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import needs
from carla_serving import straight_map
from references import homography_jacobian
from roadproof.datatypes import Command, Control, VehicleState, Weather
from roadproof.errors import ScenarioError, SimulatorError
from roadproof.geometry import CIL_CAMERA, CIL_INPUT, CameraModel, CanvasPlacement, CropResize, homography_from_pose
from roadproof.homographies import apply_homography
from roadproof.roads.maps import load_map
from roadproof.scenarios import Scenario, builtin_scenarios, find_scenario
from town_driving import drive, fingerprint

needs.town()
from roadproof.simulators.protocol import Simulator
from roadproof.simulators.town import engine
from roadproof.simulators.town.scenery import build_scenery
from roadproof.simulators.town.simulator import TownSimulator

SCENARIOS = builtin_scenarios()
STRAIGHT = find_scenario("straight-01", SCENARIOS)
LEFT = find_scenario("left-05", SCENARIOS)
TRAFFIC = {"cars": 5, "pedestrians": 5, "seed": 1}
STEPS = {weather: 20 if number else 150 for number, weather in enumerate(Weather)}


def before_canvas(scenario, distance_m, aside_m=0.0, turned_rad=0.0):
    """A vehicle pose at a distance before the canvas of a scenario."""
    canvas = scenario.canvas
    c, s = np.cos(canvas.yaw_rad), np.sin(canvas.yaw_rad)
    x, y = canvas.x_m - distance_m * c - aside_m * s, canvas.y_m - distance_m * s + aside_m * c
    return VehicleState(float(x), float(y), 0.0, canvas.yaw_rad + turned_rad, 0.0)


def at_rest(scenario, state):
    """The scenario started elsewhere: an observation of it shows what is seen from there."""
    return Scenario(
        name=scenario.name,
        kind=scenario.kind,
        map_name=scenario.map_name,
        start=state,
        goal_m=scenario.goal_m,
        canvas=scenario.canvas,
        time_limit_s=scenario.time_limit_s,
    )


def opaque(colour):
    pattern = np.zeros((400, 400, 4), np.uint8)
    pattern[:] = (*colour, 255)
    return pattern


def expected_middle(homography, left, top, size):
    """Centre of gravity, in the picture, of a square of the canvas, and the extent of its outline."""
    inside = (np.arange(40) + 0.5) / 40 * size - 0.5
    x, y = np.meshgrid(left + inside, top + inside)
    points = np.stack([x.ravel(), y.ravel()], axis=-1)
    area = np.abs(np.linalg.det(homography_jacobian(homography, points)))[:, None]
    seen = apply_homography(homography, points)
    return (seen * area).sum(axis=0) / area.sum(), seen.min(axis=0), seen.max(axis=0)


def found_middle(painted, bare, full):
    """Centre of gravity of the paint: what changed, as a share of what a canvas all in paint changes."""
    full_change = (full.astype(float) - bare).sum(axis=-1)
    share = np.where(full_change > 30, (painted.astype(float) - bare).sum(axis=-1) / np.maximum(full_change, 30), 0)
    yy, xx = np.mgrid[0 : share.shape[0], 0 : share.shape[1]]
    return np.array([(share * xx).sum(), (share * yy).sum()]) / share.sum()


def test_it_is_a_simulator(town):
    assert isinstance(town, Simulator)


def test_a_reset_shows_the_start_of_the_scenario(town):
    seen = town.reset(STRAIGHT)
    assert seen.frame.shape == (88, 200, 3)
    assert seen.frame.dtype == np.uint8
    assert seen.frame.std() > 20
    assert seen.picture is None
    assert seen.state == STRAIGHT.start
    assert seen.command is Command.FOLLOW
    assert (seen.time_s, seen.events, seen.done) == (0.0, (), False)


def test_the_full_picture_is_what_the_frame_is_cut_from(town):
    seen = town.reset(STRAIGHT, full_pictures=True)
    assert seen.picture.shape == (600, 800, 3)
    difference = np.abs(CIL_INPUT(seen.picture).astype(float) - seen.frame)
    assert difference.mean() < 4.0


def test_it_says_how_its_frames_are_reduced_whatever_was_asked_for(town):
    assert CIL_INPUT.resampling != "area"
    assert town.input == dataclasses.replace(CIL_INPUT, resampling="area")
    picture = town.reset(STRAIGHT, full_pictures=True)
    # The box tells the frame better than the tent does.
    boxed, smoothed = (
        np.abs(cut(picture.picture).astype(float) - picture.frame).mean() for cut in (town.input, CIL_INPUT)
    )
    assert boxed < smoothed


def test_steering_right_turns_right_and_time_passes_by_dt(town):
    town.reset(STRAIGHT)
    for _ in range(20):
        seen = town.step(Control(0.5, throttle=0.6))
    assert seen.time_s == pytest.approx(20 * 0.05)
    assert seen.state.yaw_rad < STRAIGHT.start.yaw_rad - 0.05
    assert seen.state.speed_mps > 1.0


def test_a_drive_along_the_route_reaches_the_goal_without_events(town):
    seen = drive(town, LEFT, 10)[-1]
    events = [*seen.events]
    commands = {seen.command}
    from town_driving import pursue

    while not seen.done:
        seen = town.step(pursue(town))
        events += seen.events
        commands.add(seen.command)
    assert np.hypot(seen.state.x_m - LEFT.goal_m[0], seen.state.y_m - LEFT.goal_m[1]) < 4.0
    assert seen.time_s < LEFT.time_limit_s
    assert events == []


@pytest.mark.parametrize("scenario", [STRAIGHT, LEFT], ids=lambda s: s.name)
def test_paint_lies_where_the_homography_says_over_a_drive(town, scenario):
    errors = []
    for distance in (20.0, 16.0, 13.0, 10.0, 8.0):
        state = before_canvas(scenario, distance, aside_m=-1.5, turned_rad=0.02 * np.sin(distance))
        start = at_rest(scenario, state)
        bare = town.reset(start, full_pictures=True).picture
        full = town.reset(start, pattern=opaque((255, 255, 255)), full_pictures=True).picture
        homography = homography_from_pose(CIL_CAMERA, state, scenario.canvas)
        np.testing.assert_array_equal(homography, town.image_from_canvas())
        for left, top in ((20, 20), (180, 90), (320, 180), (60, 280), (250, 310)):
            middle, low, high = expected_middle(homography, left, top, 60)
            if low.min() < 4 or high[0] > 795 or high[1] > 595 or (high - low).min() < 3:
                continue
            pattern = np.zeros((400, 400, 4), np.uint8)
            pattern[top : top + 60, left : left + 60] = 255
            seen = town.reset(start, pattern=pattern, full_pictures=True).picture
            errors.append(found_middle(seen, bare, full) - middle)
    assert len(errors) >= 12
    assert np.linalg.norm(errors, axis=1).max() < 0.3


def test_the_canvas_is_exact_for_other_cameras_too():
    camera = CameraModel(width_px=640, height_px=360, fov_deg=70.0, forward_m=0.5, left_m=0.3, up_m=1.7, pitch_deg=-9.0)
    crop = CropResize(left_px=40, top_px=120, right_px=600, bottom_px=350, width_px=160, height_px=80)
    state = before_canvas(STRAIGHT, 12.0, aside_m=-1.0, turned_rad=-0.05)
    start = at_rest(STRAIGHT, state)
    pattern = np.zeros((400, 400, 4), np.uint8)
    pattern[150:250, 100:200] = 255
    with TownSimulator(camera=camera, input=crop, dt_s=0.1) as simulator:
        bare = simulator.reset(start).frame
        full = simulator.reset(start, pattern=opaque((255, 255, 255))).frame
        seen = simulator.reset(start, pattern=pattern).frame
        homography = crop.input_from_camera @ simulator.image_from_canvas()
    assert seen.shape == (80, 160, 3)
    middle, _, _ = expected_middle(homography, 100, 150, 100)
    assert np.linalg.norm(found_middle(seen, bare, full) - middle) < 0.15


@pytest.mark.parametrize("weather", [Weather.CLEAR_NOON, Weather.CLEAR_SUNSET, Weather.RAINY_NOON])
def test_seen_colours_are_linear_in_painted_ones(town, weather):
    start = at_rest(STRAIGHT, before_canvas(STRAIGHT, 11.0))
    levels = np.array([0, 64, 128, 192, 255])
    seen = np.stack([town.reset(start, weather=weather, pattern=opaque((v, v, v))).frame for v in levels]).astype(float)
    inside = np.ptp(seen, axis=0).max(axis=-1) > 40
    assert inside.sum() > 100
    line = seen[0] + (seen[-1] - seen[0]) * levels[:, None, None, None] / 255
    assert np.abs(seen - line)[:, inside].max() < 2.0
    assert np.abs(seen - line)[:, inside].mean() < 0.5


def area_average(pattern, canvas_from_frame, samples=8):
    """What each pixel of a frame sees of a pattern, averaged over its footprint; the slow and plain way."""
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    y, x = np.mgrid[0:88, 0:200]
    total = np.zeros((88, 200, 3))
    for dy in offsets:
        for dx in offsets:
            points = np.stack([(x + dx).ravel(), (y + dy).ravel()], axis=-1)
            at = np.clip(np.nan_to_num(apply_homography(canvas_from_frame, points)), 0, 399).round().astype(int)
            total += pattern[at[:, 1], at[:, 0], :3].reshape(88, 200, 3)
    return total / samples**2


@pytest.mark.parametrize(("distance_m", "levels"), [(14.0, 2.5), (10.0, 1.0), (7.0, 1.0)])
def test_each_pixel_shows_the_average_of_the_paint_in_its_footprint(town, distance_m, levels):
    rng = np.random.default_rng(0)
    pattern = opaque((0, 0, 0))
    for _ in range(6):
        left, top, width, height = rng.integers(0, 330), rng.integers(0, 330), *rng.integers(30, 200, 2)
        pattern[top : top + height, left : left + width, :3] = rng.integers(0, 256, 3)
    start = at_rest(STRAIGHT, before_canvas(STRAIGHT, distance_m, aside_m=-1.5))
    black, white, seen = (
        town.reset(start, pattern=paint).frame.astype(float)
        for paint in (opaque((0, 0, 0)), opaque((255, 255, 255)), pattern)
    )
    canvas_from_frame = np.linalg.inv(CIL_INPUT.input_from_camera @ town.image_from_canvas())
    expected = black + (white - black) * area_average(pattern, canvas_from_frame) / 255
    painted = (white - black).max(axis=-1) > 30
    inner = (
        painted & np.roll(painted, 1, 0) & np.roll(painted, -1, 0) & np.roll(painted, 1, 1) & np.roll(painted, -1, 1)
    )
    assert inner.sum() > 200
    assert np.abs(seen - expected)[inner].mean() < levels


def test_half_transparent_paint_is_half_way_to_opaque_paint(town):
    start = at_rest(STRAIGHT, before_canvas(STRAIGHT, 11.0))
    bare = town.reset(start).frame.astype(float)
    full = town.reset(start, pattern=opaque((255, 40, 40))).frame.astype(float)
    pattern = opaque((255, 40, 40))
    pattern[..., 3] = 128
    half = town.reset(start, pattern=pattern).frame
    off = np.abs(half - (bare + (full - bare) * 128 / 255))
    assert off.max() < 2.0
    assert off.mean() < 0.1


def test_a_transparent_pattern_looks_like_none(town):
    start = at_rest(STRAIGHT, before_canvas(STRAIGHT, 11.0))
    bare = town.reset(start, pattern=None).frame
    pattern = opaque((255, 0, 255))
    pattern[..., 3] = 0
    np.testing.assert_array_equal(town.reset(start, pattern=pattern).frame, bare)


@pytest.fixture(scope="module")
def by_weather(town):
    """A drive in traffic in each weather, the first the longest."""
    return {weather: drive(town, LEFT, steps, weather=weather, **TRAFFIC) for weather, steps in STEPS.items()}


def test_every_weather_looks_different_and_none_is_dark_or_burnt_out(by_weather):
    frames = {weather: seen[0].frame.astype(float) for weather, seen in by_weather.items()}
    for weather, frame in frames.items():
        assert 50 < frame.mean() < 200, weather
        for other, its in frames.items():
            assert weather is other or np.abs(frame - its).mean() > 3.0, (weather, other)


def test_the_same_drive_twice_is_the_same_to_the_bit_even_after_other_drives(town):
    options = {"cars": 6, "pedestrians": 6, "seed": 3, "weather": Weather.WET_NOON, "pattern": opaque((200, 30, 60))}
    first = fingerprint(drive(town, LEFT, 60, **options))
    drive(town, STRAIGHT, 5, cars=2, weather=Weather.FOGGY_MORNING)
    assert fingerprint(drive(town, LEFT, 60, **options)) == first


def test_another_seed_gives_other_traffic(town):
    one, two = (drive(town, LEFT, 20, cars=15, pedestrians=15, seed=seed) for seed in (0, 1))
    assert fingerprint(one) != fingerprint(two)


SCRIPT = """
import json, sys
sys.path[:0] = json.loads(sys.argv[1])
from town_driving import drive, fingerprint
from roadproof.datatypes import Weather
from roadproof.scenarios import builtin_scenarios, find_scenario
from roadproof.simulators.town.simulator import TownSimulator
scenario = find_scenario("left-05")
with TownSimulator() as simulator:
    for weather, steps in json.loads(sys.argv[2]).items():
        print(fingerprint(drive(simulator, scenario, steps, weather=Weather(weather), **json.loads(sys.argv[3]))))
"""


@pytest.mark.slow
def test_150_frames_and_some_of_every_weather_are_the_same_in_two_processes(by_weather):
    paths = [str(Path(__file__).parents[2]), *[path for path in sys.path if path]]
    command = [sys.executable, "-c", SCRIPT, *map(json.dumps, (paths, STEPS, TRAFFIC))]
    printed = subprocess.run(command, check=True, capture_output=True, text=True, timeout=600).stdout
    assert printed.split() == [fingerprint(seen) for seen in by_weather.values()]


def test_running_into_a_car_is_one_event(town):
    seen = town.reset(STRAIGHT, cars=20, seed=0)
    other = min(
        range(len(town.cars)),
        key=lambda i: np.hypot(town.cars.x_m[i] - seen.state.x_m, town.cars.y_m[i] - seen.state.y_m),
    )
    assert len(town.cars) == 20
    x, y, yaw = (float(v[other]) for v in (town.cars.x_m, town.cars.y_m, town.cars.yaw_rad))
    behind = VehicleState(x - 12 * np.cos(yaw), y - 12 * np.sin(yaw), 0.0, yaw, 14.0)
    from roadproof.simulators.town.physics import Physics, Pose

    physics = Physics([], behind, [Pose(x, y, yaw)])
    for _ in range(30):
        physics.step(Control(0.0, throttle=1.0), 0.05)
        if physics.contacts():
            break
    assert [contact.kind for contact in physics.contacts()] == ["vehicle"]


def test_a_closed_simulator_says_so():
    simulator = TownSimulator()
    with pytest.raises(SimulatorError, match="with-block"):
        simulator.reset(STRAIGHT)
    with pytest.raises(SimulatorError, match="call reset first"):
        simulator.step(Control(0.0))


def test_bad_arguments_are_one_clear_line(town):
    with pytest.raises(SimulatorError, match="weather 'snow' is unknown"):
        town.reset(STRAIGHT, weather=Weather("snow"))
    with pytest.raises(SimulatorError, match=r"dt_s is 0\.033, expected a positive multiple of 0\.01"):
        TownSimulator(dt_s=0.033)
    with pytest.raises(SimulatorError, match=r"the crop ends at \(900, 88\)"):
        TownSimulator(input=CropResize(left_px=0, top_px=0, right_px=900, bottom_px=88, width_px=200, height_px=88))
    with pytest.raises(SimulatorError, match=r"-1 cars were asked for"):
        town.reset(STRAIGHT, cars=-1)


@pytest.mark.parametrize("name", ["frames", "full_pictures"])
def test_steps_that_are_none_are_refused_and_the_drive_under_way_goes_on(town, name):
    reset = inspect.unwrap(TownSimulator.reset)  # without the checks of types that tests run under
    town.reset(STRAIGHT)
    for asked in (3, None, "all", [0, 2], np.eye(9)):
        with pytest.raises(SimulatorError, match=rf"^{name} is of type \w+, expected True, False or a set of steps"):
            reset(town, STRAIGHT, **{name: asked})
    for steps, step in (({-1, 2}, "-1"), ({0.5}, r"0\.5"), ({True}, "True"), ({"all"}, "'all'")):
        with pytest.raises(SimulatorError, match=rf"^{name} asks for step {step}, expected whole numbers from 0$"):
            reset(town, STRAIGHT, **{name: steps})
    assert town.step(Control(0.0)).time_s == pytest.approx(town.dt_s)
    assert reset(town, STRAIGHT, **{name: {0, 5}}).frame.any()


def test_a_canvas_off_the_road_is_refused(town):
    moved = CanvasPlacement(x_m=STRAIGHT.canvas.x_m, y_m=STRAIGHT.canvas.y_m + 12, yaw_rad=STRAIGHT.canvas.yaw_rad)
    scenario = Scenario(
        name="beside", kind="straight", map_name="town", start=STRAIGHT.start, goal_m=STRAIGHT.goal_m, canvas=moved,
        time_limit_s=30.0,
    )  # fmt: skip
    with pytest.raises(ScenarioError, match="off the road"):
        town.reset(scenario)


def test_a_missing_libx11_is_named(monkeypatch):
    class NoPipe:
        @staticmethod
        def get_global_ptr():
            return NoPipe

        @staticmethod
        def make_pipe(*_):
            return None

    monkeypatch.setattr(engine, "_pipes", {})
    monkeypatch.setattr(engine.core, "GraphicsPipeSelection", NoPipe)
    with pytest.raises(SimulatorError, match="libx11-6") as caught, TownSimulator():
        pass
    assert "\n" not in str(caught.value)


def test_closing_frees_the_town_so_that_memory_does_not_grow():
    script = SCRIPT.split("scenario =")[0] + (
        "import resource\n"
        "scenario = builtin_scenarios()[0]\n"
        "for i in range(4):\n"
        "    with TownSimulator() as simulator:\n"
        "        simulator.reset(scenario)\n"
        "    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)\n"
    )
    paths = [str(Path(__file__).parents[2]), *[path for path in sys.path if path]]
    command = [sys.executable, "-c", script, json.dumps(paths)]
    peaks = [int(v) for v in subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()]
    assert peaks[-1] - peaks[1] < 40


def test_what_was_opened_in_vain_is_closed(monkeypatch):
    closed = []

    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(TownSimulator, "_open", interrupted)
    monkeypatch.setattr(TownSimulator, "_close", lambda self: closed.append(self))
    town = TownSimulator()
    with pytest.raises(KeyboardInterrupt), town:
        pass
    assert closed == [town]


def test_a_map_with_hills_is_refused_since_all_of_the_town_is_level(tmp_path):
    path = straight_map(tmp_path)
    path.write_text(path.read_text().replace('<elevation s="0" a="0" b="0"', '<elevation s="0" a="3" b="0"'))
    with pytest.raises(ScenarioError, match=r"road 1 of the map is at height 3.00 m, but the town is level"):
        build_scenery(load_map(str(path)))
