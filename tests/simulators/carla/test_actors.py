"""Where the town's traffic stands in CARLA's world."""

from types import SimpleNamespace

import pytest

from carla_serving import straight_map
from roadproof.datatypes import VehicleState

pytest.importorskip("carla", reason="CARLA's client is not installed: pip install 'roadproof[carla]'")
from roadproof.roads.maps import load_map
from roadproof.simulators.carla.actors import PERSON_UP_M, Crowd
from roadproof.simulators.carla.session import Session
from roadproof.traffic.traffic import Traffic


class Nowhere(Session):
    """A connection to no server."""

    def __init__(self):
        pass

    def library(self):
        return SimpleNamespace(filter=lambda _name: [])


@pytest.mark.parametrize(("rise", "height_m"), [('a="0" b="0"', 0.0), ('a="7" b="0"', 7.0), ('a="0" b="0.05"', None)])
def test_the_traffic_stands_on_its_road_however_high_it_is(tmp_path, monkeypatch, rise, height_m):
    path = straight_map(tmp_path)
    path.write_text(path.read_text().replace('<elevation s="0" a="0" b="0"', f'<elevation s="0" {rise}'))
    roads = load_map(str(path))
    traffic = Traffic(roads, cars=3, pedestrians=3, seed=0, ego=VehicleState(5.0, -1.75))
    monkeypatch.setattr(Crowd, "_spawn", lambda _self, _what, _blueprints, agents, _up_m: list(range(len(agents))))
    moves = Crowd(Nowhere(), roads, traffic).moves()
    for move, up_m in zip(moves, 3 * [0.0] + 3 * [PERSON_UP_M], strict=True):
        at = move.transform.location
        road_m = 0.05 * at.x if height_m is None else height_m
        assert at.z == pytest.approx(road_m + up_m, abs=0.05)
