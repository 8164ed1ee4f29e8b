"""The town drawn by OpenGL: its promises, and how near its pictures are to the software's, from which they are told."""

import numpy as np
import pytest

import needs
from roadproof.datatypes import Control, Weather
from roadproof.errors import RoadproofError, SimulatorError
from roadproof.scenarios import find_scenario
from roadproof.simulators.checks import check_simulator
from roadproof.simulators.loading import open_simulator
from roadproof.simulators.protocol import uniform

needs.town()
from roadproof.drives import Trajectories, record
from roadproof.simulators.town import engine
from roadproof.simulators.town.simulator import TownSimulator
from roadproof.training.expert import expert

SCENARIO = find_scenario("left-05")


@pytest.fixture(scope="module")
def opengl():
    needs.egl()
    with open_simulator("town:egl") as town:
        yield town


def test_it_keeps_the_promises_of_a_simulator(opengl):
    report = check_simulator(opengl, SCENARIO)
    report.require()


@pytest.mark.parametrize("weather", [Weather.CLEAR_NOON, Weather.RAINY_NOON, Weather.CLEAR_SUNSET])
def test_its_pictures_are_those_of_the_software_but_for_edges(opengl, weather):
    asked = {"weather": weather, "pattern": uniform(200, 40, 40), "cars": 20, "pedestrians": 20, "seed": 1}
    with TownSimulator() as software:
        for town in (software, opengl):
            town.reset(SCENARIO, **asked)
        for _ in range(80):
            seen = [town.step(Control(0.0, 0.4)) for town in (software, opengl)]
    assert seen[0].state == seen[1].state
    off = np.abs(seen[0].frame.astype(int) - seen[1].frame.astype(int))
    assert off.any(), "the software drew both"
    assert np.median(off) <= 2
    assert off.mean() < 5
    # Wrong haze, land or order of drawing would be seen over whole stretches, not at edges.
    rows = off.mean((1, 2))
    assert rows.max() < 25, rows.round(1)


def test_towns_come_and_go_and_leave_each_other_alone(opengl):
    before = opengl.reset(SCENARIO).frame
    for graphics in ("egl", "software", "egl"):
        with TownSimulator(graphics=graphics) as another:
            another.reset(SCENARIO, weather=Weather.RAINY_NOON)
    assert (opengl.reset(SCENARIO).frame == before).all()


def test_other_graphics_are_refused_and_a_missing_library_is_named(monkeypatch):
    with pytest.raises(SimulatorError, match="graphics is 'vulkan', expected software or egl"):
        TownSimulator(graphics="vulkan")

    class NoPipe:
        get_global_ptr = make_pipe = staticmethod(lambda *_: NoPipe if not _ else None)

    monkeypatch.setattr(engine, "_pipes", {})
    monkeypatch.setattr(engine.core, "GraphicsPipeSelection", NoPipe)
    with (
        pytest.raises(SimulatorError, match=r"libEGL\.so\.1 and a driver; install it"),
        open_simulator("town:egl"),
    ):
        pass


def test_a_folder_of_the_one_is_not_gone_on_with_by_the_other(opengl, tmp_path):
    asked = {"trajectories": Trajectories(count=1), "folder": tmp_path}
    with TownSimulator() as software:
        record(software, expert, SCENARIO, **asked)
        with pytest.raises(RoadproofError, match="a recording with world '', now it is 'drawn by egl'"):
            record(opengl, expert, SCENARIO, **asked)
