"""What stands beside the road on a CARLA server: boxes by hand, and the served town's through CARLA's own client."""

import dataclasses
import math
import textwrap

import numpy as np
import pytest

import needs
from carla_serving import SMALL, SMALL_INPUT, STREET, serving

pytest.importorskip("carla", reason="CARLA's client is not installed: pip install 'roadproof[carla]'")
needs.town()
pytest.importorskip("msgpack", reason="serving needs the extra roadproof[carla]")
import carla

from roadproof.datatypes import Control
from roadproof.errors import SimulatorError
from roadproof.geometry import CanvasPlacement
from roadproof.scenarios import find_scenario
from roadproof.simulators.carla.beside import footprints, standing
from roadproof.simulators.carla.simulator import CarlaSimulator
from roadproof.simulators.protocol import BESIDE_M, Furnished, obstacles_of
from roadproof.simulators.town.simulator import TownSimulator

CANVAS = CanvasPlacement(x_m=50.0, y_m=0.0, z_m=7.0, width_m=6.0)
NOWHERE = np.zeros((0, 2))

# As rpclib answers a call that the server has not bound: an error of msgpack-rpc itself.
OLDER = """
from roadproof.cli import main
from roadproof.simulators.carla_server import calls, wire

answer = calls.Calls.answer
def without_boxes(self, request):
    if request.name == "get_all_level_BBs":
        return wire.request_error(request.id, "rpclib: server could not find function 'get_all_level_BBs'")
    return answer(self, request)
calls.Calls.answer = without_boxes
main()
"""


def box(place, half, *, pitch=0.0, yaw=0.0, roll=0.0):
    """A box of CARLA's world."""
    made = carla.BoundingBox(carla.Location(*place), carla.Vector3D(*half))
    made.rotation = carla.Rotation(pitch, yaw, roll)
    return made


def stands(name, *boxes, free=NOWHERE):
    """The rows of boxes that stay."""
    return standing(name, footprints(boxes), CANVAS, free)


def rounded(obstacles):
    """What can be compared: places and sizes to a millimetre, directions to a thousandth."""
    rows = [
        (o.x_m, o.y_m, math.cos(o.yaw_rad), math.sin(o.yaw_rad), o.half_length_m, o.half_width_m) for o in obstacles
    ]
    return np.array(sorted(rows, key=lambda row: tuple(round(value, 1) for value in row)))


def test_a_turned_box_is_the_mirrored_one_of_carlas_world():
    turned = box((10.0, 4.0, 1.0), (3.0, 1.0, 0.5), yaw=30.0)
    # 3 m ahead and 1 m to the right of its middle, by the turn of a left-handed world; y is then mirrored.
    c, s = math.cos(math.radians(30.0)), math.sin(math.radians(30.0))
    corner = (10.0 + 3.0 * c - s, -(4.0 + 3.0 * s + c))
    ((x, y, yaw, length, width, low, high),) = footprints([turned]).tolist()
    assert (x, y, length, width, low, high) == pytest.approx((10.0, -4.0, 3.0, 1.0, 0.5, 1.5), abs=1e-5)
    assert yaw == pytest.approx(-math.radians(30.0))
    c, s, dx, dy = math.cos(yaw), math.sin(yaw), corner[0] - x, corner[1] - y
    assert (c * dx + s * dy, c * dy - s * dx) == pytest.approx((3.0, -1.0), abs=1e-5)


def test_a_box_that_lies_on_its_side_or_leans_is_as_large_as_it_stands():
    on_its_side, leaning = (
        footprints([each])[0, 3:].tolist()
        for each in (
            box((0.0, 0.0, 5.0), (3.0, 1.0, 0.5), roll=90.0),
            box((0.0, 0.0, 5.0), (3.0, 1.0, 0.5), pitch=30.0, yaw=70.0),
        )
    )
    assert on_its_side == pytest.approx([3.0, 0.5, 4.0, 6.0], abs=1e-5)
    long, tall = 3.0 * math.cos(math.pi / 6) + 0.25, 1.5 + 0.5 * math.cos(math.pi / 6)
    assert leaning == pytest.approx([long, 1.0, 5.0 - tall, 5.0 + tall], abs=1e-5)


def test_what_a_car_passes_under_or_over_stays_out_by_its_height_above_the_road():
    # The road is 7 m up: from its ground, a wall, a sign board, a kerb, and what lies 7 m below.
    heights = {"wall": (8.0, 1.0), "board": (10.0, 1.4), "kerb": (7.05, 0.1), "below": (1.0, 1.0)}
    kept = {
        name: len(stands("Walls", box((50.0, 8.0, middle), (2.0, 0.2, half))))
        for name, (middle, half) in heights.items()
    }
    assert kept == {"wall": 1, "board": 0, "kerb": 0, "below": 0}


def test_distance_counts_from_the_nearest_part_of_a_box():
    wall = box((50.0 + BESIDE_M + 30.0, 8.0, 8.0), (32.0, 0.2, 1.0))
    assert len(stands("Walls", wall)) == 1
    assert len(stands("Walls", box((50.0 + BESIDE_M + 30.0, 8.0, 8.0), (29.0, 0.2, 1.0)))) == 0


def test_a_tree_is_its_trunk_and_a_bush_no_obstacle():
    crown, bush = box((50.0, 8.0, 10.0), (3.0, 3.0, 3.0)), box((50.0, 8.0, 7.5), (1.0, 1.0, 0.5))
    ((x, y, _, length, width, _, _),) = stands("Vegetation", crown, bush).tolist()
    assert (x, y, length, width) == pytest.approx((50.0, -8.0, 0.2, 0.2), abs=1e-5)


@pytest.mark.parametrize(("half", "yaw"), [((0.1, 2.0, 3.0), 0.0), ((2.0, 0.1, 3.0), 90.0), ((2.0, 0.1, 3.0), 270.0)])
def test_a_lamp_is_its_post_at_the_end_away_from_the_road(half, yaw):
    # Its arm reaches from 8 m beside the middle of the road to 4 m; on the right as on the left.
    for side in (1.0, -1.0):
        ((x, y, _, length, width, _, _),) = stands("Poles", box((50.0, 6.0 * side, 10.0), half, yaw=yaw)).tolist()
        assert (x, y, length, width) == pytest.approx((50.0, -7.9 * side, 0.1, 0.1), abs=1e-4)


def test_a_box_over_a_place_that_is_known_to_be_free_is_left_out():
    lane = np.array([[45.0, -1.75], [46.0, -1.75]])
    bent, straight = box((45.0, 4.0, 7.5), (5.0, 3.0, 0.4)), box((45.0, 4.0, 7.5), (5.0, 0.1, 0.4))
    assert stands("GuardRail", bent, straight, free=lane)[:, 4].tolist() == pytest.approx([0.1])


def test_what_is_too_long_for_an_obstacle_is_left_out():
    assert len(stands("Buildings", box((50.0, 900.0, 20.0), (1500.0, 880.0, 40.0)))) == 0


def test_the_served_town_says_what_the_town_says_of_itself(port, street):
    with CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT) as served:
        assert isinstance(served, Furnished)
        town = TownSimulator(camera=SMALL, input=SMALL_INPUT)
        left = find_scenario("left-03")
        for scenario, own in ((STREET, dataclasses.replace(STREET, map_name=str(street))), (left, left)):
            expected = rounded(town.obstacles(own))
            assert len(expected) > 20
            np.testing.assert_allclose(rounded(served.obstacles(scenario)), expected, atol=1e-3)
    # The rail outside the bend, in pieces turned along it.
    assert np.ptp(expected[np.isclose(expected[:, 5], 0.08)][:, 2]) > 0.05


def test_a_car_that_drives_is_no_obstacle_and_drives_on(port):
    with CarlaSimulator(port=port, camera=SMALL, input=SMALL_INPUT) as served:
        before = served.obstacles(STREET)
        served.reset(STREET, cars=3, seed=2)
        for _ in range(10):
            served.step(Control(0.0, throttle=0.6))
        cars = len(served.session.world.get_level_bbs(carla.CityObjectLabel.Car))
        assert served.obstacles(STREET) == before
        assert served.step(Control(0.0)).time_s == pytest.approx(0.55)
        # The server did tell of it and of the traffic.
        served.session.clear()
        assert len(served.session.world.get_level_bbs(carla.CityObjectLabel.Car)) == cars - 4


def test_a_server_without_the_call_is_one_that_does_not_know_and_one_that_is_gone_is_told(street):
    with (
        serving("--map", street, program=textwrap.dedent(OLDER)) as (process, opened),
        CarlaSimulator(port=opened, camera=SMALL, input=SMALL_INPUT, patience_s=3.0) as older,
    ):
        assert obstacles_of(older, STREET) is None
        assert not older.reset(STREET).done
        process.kill()
        process.wait()
        with pytest.raises(SimulatorError, match="did not answer"):
            older.obstacles(STREET)
