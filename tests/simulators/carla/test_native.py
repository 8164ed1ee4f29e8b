"""Paint on the server's own road, found by looking, against `roadproof carla serve` in another process."""

import dataclasses

import numpy as np
import pytest

import needs
from carla_serving import CAMERA, INPUT, serving
from carla_serving import STREET as WHOLE_STREET

pytest.importorskip("carla", reason="CARLA's client is not installed: pip install 'roadproof[carla]'")
needs.town()
pytest.importorskip("msgpack", reason="serving needs the extra roadproof[carla]")
from roadproof.datatypes import Control, VehicleState
from roadproof.driving.episode import Episode
from roadproof.driving.rollout import rollout
from roadproof.errors import SimulatorError
from roadproof.geometry import CANVAS_SIZE_PX, CanvasPlacement
from roadproof.roads.maps import load_map
from roadproof.simulators.carla.inject import ASPHALT_LEVEL
from roadproof.simulators.carla.native import Ground, find_ground, texture_of
from roadproof.simulators.carla.session import Session
from roadproof.simulators.carla.simulator import CarlaSimulator
from roadproof.simulators.carla_server.pieces import road_pieces
from roadproof.simulators.checks import check_simulator
from roadproof.simulators.loading import open_simulator
from roadproof.simulators.protocol import PaintKind

STREET = dataclasses.replace(WHOLE_STREET, start=VehicleState(25.0, -1.75, 0.0, 0.0, 0.0))
# A server on which no texture ever changes, as where a road's material has no parameter of the right name.
DEAF = """
from roadproof.simulators.carla_server import world
world.World.paint = lambda self, names, picture: None
from roadproof.cli import main
main()
"""
# A server whose pictures are laid four times along each piece.
REPEATED = """
import numpy as np
from roadproof.simulators.carla_server import pieces
once = pieces.Piece.pattern
pieces.Piece.pattern = lambda self, picture: once(self, np.tile(picture, (4, 4, 1)))
from roadproof.cli import main
main()
"""


@pytest.fixture
def session(port):
    opened = Session("127.0.0.1", port, dt_s=0.05, patience_s=20.0, loading_s=60.0)
    yield opened
    opened.close()


def truth(street, canvas):
    """The piece under a canvas, and u, v of canvas pixels, by asking the served road where it puts a picture."""
    pieces = road_pieces("street", load_map(str(street)))
    (piece,) = [each for each in pieces if abs(each.placement.x_m - canvas.x_m) < each.placement.length_m / 2]
    columns, rows = np.meshgrid(np.arange(CANVAS_SIZE_PX), np.arange(CANVAS_SIZE_PX))
    laid = piece.pattern(np.stack([columns // 2, rows // 2, columns % 2 + 2 * (rows % 2)], axis=-1).astype(np.uint8))
    x, y = np.meshgrid(*[np.linspace(10.0, 389.0, 9)] * 2)
    points = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    there = (
        points @ (np.linalg.inv(piece.placement.world_from_canvas[[0, 1, 3]]) @ canvas.world_from_canvas[[0, 1, 3]]).T
    )
    column, row = np.rint(there[:, :2]).astype(int).T
    half_column, half_row, odd = laid[row, column, :3].astype(int).T
    return (
        piece,
        points,
        (2 * np.stack([half_column, half_row], axis=-1) + np.stack([odd & 1, odd >> 1], -1) + 0.5) / 400,
    )


@pytest.mark.slow
@pytest.mark.parametrize("at_m", [30.0, 50.0, 70.0])
def test_the_piece_and_its_texture_are_found_by_looking(session, street, at_m):
    canvas = CanvasPlacement(x_m=at_m, y_m=0.0, width_m=6.0)
    ground = find_ground(session, canvas)
    piece, points, places = truth(street, canvas)
    assert ground.name == piece.name
    off = np.abs(points @ ground.texture_from_canvas.T - places) * piece.placement.length_m
    assert off.max() < 0.08, off.max()
    assert not session.painted


@pytest.mark.slow
def test_it_keeps_what_a_simulator_promises(port):
    with CarlaSimulator(port=port, camera=CAMERA, input=INPUT, paint="native") as simulator:
        report = check_simulator(simulator, STREET, steps=12)
    assert report.passed, str(report)


@pytest.mark.slow
def test_auto_takes_the_servers_road_where_it_can_be_painted_and_the_pictures_where_not(port, street, tmp_path):
    with open_simulator(f"carla://127.0.0.1:{port}?paint=auto") as simulator:
        assert simulator.paint is PaintKind.NATIVE
    with serving("--map", street, program=DEAF) as (_, deaf):
        with open_simulator(f"carla://127.0.0.1:{deaf}?paint=auto") as simulator:
            assert simulator.paint is PaintKind.INJECT
            pattern = np.full((400, 400, 4), 255, np.uint8)
            brake = Control(0.0, brake=1.0)
            short = dataclasses.replace(STREET, time_limit_s=0.2)
            rollout(simulator, lambda _: lambda _: brake, short, pattern=pattern).save(tmp_path / "episode.npz")
        with (
            open_simulator(f"carla://127.0.0.1:{deaf}?paint=native") as simulator,
            pytest.raises(SimulatorError, match=r"no texture of its roads changes .*paint=inject"),
        ):
            simulator.reset(STREET)
    assert Episode.load(tmp_path / "episode.npz").paint is PaintKind.INJECT


@pytest.mark.slow
def test_a_canvas_on_two_pieces_is_refused_with_their_names(session):
    with pytest.raises(SimulatorError, match=r"several pieces of road .*Road_Road_street_1, Road_Road_street_2"):
        find_ground(session, CanvasPlacement(x_m=40.0, y_m=0.0, width_m=6.0))
    assert not session.painted


@pytest.mark.slow
def test_a_texture_that_is_repeated_is_refused(street):
    with serving("--map", street, program=REPEATED) as (_, port):
        opened = Session("127.0.0.1", port, dt_s=0.05, patience_s=20.0, loading_s=60.0)
        with pytest.raises(SimulatorError, match="repeated or bent under the canvas"):
            find_ground(opened, STREET.canvas)
        opened.close()


@pytest.mark.slow
def test_the_road_is_as_it_was_after_the_simulator_is_left(port):
    white = np.full((400, 400, 4), 255, np.uint8)

    def seen(paint, pattern=None):
        with CarlaSimulator(port=port, camera=CAMERA, input=INPUT, paint=paint) as simulator:
            return simulator.reset(STREET, pattern=pattern).frame

    before = seen("inject")
    native = seen("native", white)
    assert np.abs(native.astype(int) - before).max() > 60
    np.testing.assert_array_equal(seen("inject"), before)


def test_a_texture_holds_the_pattern_where_the_canvas_is_and_asphalt_elsewhere():
    # The canvas is the right half of the texture, its far edge to the left.
    ground = Ground("road", np.array([[0.0, 0.5 / 400, 0.5 + 0.25 / 400], [1 / 400, 0.0, 0.5 / 400]]), 0.0)
    pattern = np.zeros((400, 400, 4), np.uint8)
    pattern[:100] = (250, 10, 20, 255)
    pattern[300:] = (10, 250, 20, 128)
    texture = texture_of(ground, pattern)
    asphalt = round(255 * ASPHALT_LEVEL)
    assert (texture[:, :256] == asphalt).all()
    assert (texture[2:-2, 258:318] == (250, 10, 20)).all()
    assert (texture[2:-2, 322:446] == asphalt).all()
    half = asphalt * (1 - 128 / 255) + np.array([10, 250, 20]) * 128 / 255
    assert np.abs(texture[2:-2, 450:510] - half).max() <= 1
    assert (texture_of(ground, None) == asphalt).all()
