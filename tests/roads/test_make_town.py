"""The built-in towns: the files are what the script writes, and they are towns one can drive in."""

import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from roadproof.roads.roadmap import RoadMap, Surface

ROOT = Path(__file__).parents[2]
ASSETS = ROOT / "src" / "roadproof" / "roads" / "assets"


@pytest.fixture(scope="module")
def make_town() -> ModuleType:
    pytest.importorskip("scenariogeneration", reason="scenariogeneration is not installed")
    spec = importlib.util.spec_from_file_location("make_town", ROOT / "tools" / "make_town.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["make_town"] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module", params=["town", "second"])
def town(request: pytest.FixtureRequest) -> RoadMap:
    return RoadMap.from_opendrive(ASSETS / f"{request.param}.xodr")


def test_the_committed_towns_are_what_the_script_writes(make_town: ModuleType) -> None:
    for town in (make_town.TOWN, make_town.SECOND):
        assert make_town.written(town) == (ASSETS / f"{town.name}.xodr").read_text(encoding="utf-8")


def test_a_bend_joins_its_tangents(make_town: ModuleType) -> None:
    for turn, radius, spiral in [(math.pi / 2, 20.0, 0.0), (-0.7, 30.0, 12.0)]:
        pieces, tangent = make_town.bend_pieces(turn, radius, spiral)
        if spiral == 0.0:
            assert tangent == pytest.approx(radius * math.tan(abs(turn) / 2))
        assert sum(length * (start + end) / 2 for length, start, end in pieces) == pytest.approx(turn)
    with pytest.raises(ValueError, match="no arc"):
        make_town.bend_pieces(0.2, 20.0, 10.0)


def test_lanes_join_smoothly(town: RoadMap) -> None:
    for lane in town.lanes:
        for index in lane.successors:
            after = town.lanes[index]
            assert np.linalg.norm(after.centre[0] - lane.centre[-1]) < 1e-6
            if lane.kind == "driving":
                turn = float(after.headings_rad[0] - lane.headings_rad[-1])
                assert abs(math.remainder(turn, 2 * math.pi)) < 0.06  # headings are differences over up to a metre


def test_every_lane_can_be_reached_from_every_other(town: RoadMap) -> None:
    driving = [lane.index for lane in town.lanes if lane.kind == "driving"]
    for begin in driving[:3]:
        reached, open_ends = {begin}, [begin]
        while open_ends:
            after = set(town.lanes[open_ends.pop()].successors) - reached
            reached |= after
            open_ends += after
        assert reached >= set(driving)


def test_sidewalks_run_round_every_block(town: RoadMap) -> None:
    walks = [lane for lane in town.lanes if lane.kind == "sidewalk"]
    assert all(lane.successors for lane in walks)
    entered = {index for lane in walks for index in lane.successors}
    assert entered == {lane.index for lane in walks}


def test_the_two_towns_have_what_drives_need(town: RoadMap) -> None:
    low_x, low_y, high_x, high_y = town.bounds_m
    assert high_x - low_x < 320
    assert high_y - low_y < 320
    colours = {line.mark.colour for line in town.mark_lines}
    assert colours == {"white", "yellow"}
    curvature = np.concatenate(
        [
            np.diff(lane.headings_rad) / np.diff(lane.stations_m)
            for lane in town.lanes
            if lane.kind == "driving" and lane.junction is None
        ]
    )
    assert (curvature > 1 / 30).any()
    assert (curvature < -1 / 30).any()
    assert (np.abs(curvature) < 1 / 11).all()
    for area in town.junctions:
        middle = area.outline[:, :2].mean(axis=0)
        assert town.surface_at(middle[None])[0] == Surface.DRIVING
