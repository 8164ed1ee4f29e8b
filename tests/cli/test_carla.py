"""The verbs against `roadproof carla serve` in another process, as their users call them."""

import inspect
import json

import pytest
from PIL import Image

import needs
from carla_serving import HALF, HALF_INPUT, free_port, serving, straight_map
from command import answered
from roadproof.datatypes import VehicleState
from roadproof.driving.episode import Episode
from roadproof.driving.evaluation import Evaluation
from roadproof.geometry import CanvasPlacement
from roadproof.scenarios import Scenario, save_scenarios
from roadproof.simulators.protocol import PaintKind

pytest.importorskip("carla", reason="CARLA's client is not installed: pip install 'roadproof[carla]'")
needs.town()
pytest.importorskip("msgpack", reason="serving needs the extra roadproof[carla]")
pytest.importorskip("av", reason="films need the extra roadproof[video]")

STREET = Scenario(
    name="street",
    kind="straight",
    map_name="street",
    start=VehicleState(25.0, -1.75, 0.0, 0.0, 7.0),
    goal_m=(140.0, -1.75),
    canvas=CanvasPlacement(x_m=45.0, y_m=0.0, width_m=6.0),
    time_limit_s=1.5,
)
OWN = ["--scenarios", "street.toml"]
SHY = ["--controller", "paint_shy:paint_shy"]


@pytest.fixture
def call(tmp_path, invoke, monkeypatch):
    save_scenarios([STREET], tmp_path / "street.toml")
    Image.new("RGBA", (400, 400), (255, 0, 255, 255)).save(tmp_path / "magenta.png")
    monkeypatch.chdir(tmp_path)

    def run(*options, code=0):
        left, said = invoke(*options)
        assert left == code, said.err
        return said.err if code else said.out

    return run


@pytest.fixture
def impatient(monkeypatch):
    """Nobody is there, so there is nothing to wait for."""
    from roadproof.simulators.carla.simulator import CarlaSimulator

    monkeypatch.setitem(inspect.unwrap(CarlaSimulator.__init__).__kwdefaults__, "patience_s", 0.5)


def check_nobody(said, port):
    # On a slow machine the command may say before that it takes long.
    last = said.splitlines()[-1]
    assert last.startswith(f"roadproof: the CARLA server at 127.0.0.1:{port} did not answer for its version in time")
    assert said.count("roadproof: ") == 1


@pytest.mark.slow
def test_record_calibrate_attack_evaluate_drive_and_report(call, tmp_path, impatient, monkeypatch):
    with serving("--map", straight_map(tmp_path)) as (_, port), monkeypatch.context() as patient:
        from roadproof.simulators.carla.simulator import CarlaSimulator

        for name, value in {"patience_s": 20.0, "camera": HALF, "input": HALF_INPUT}.items():
            patient.setitem(inspect.unwrap(CarlaSimulator.__init__).__kwdefaults__, name, value)
        there = ["--simulator", f"carla://127.0.0.1:{port}"]
        alone = ["--trajectories", "1", "--frames", "3", "--out", "runs"]
        call("record", "street", *OWN, *SHY, *alone, *there)
        call("calibrate", "runs", *there)
        run = tmp_path / "runs" / "street"
        few = ["--figures", "1", "--iterations", "3", "--restarts", "1", "--random-patterns", "0", "--groups", "all"]
        call("attack", str(run / "recordings"), *SHY, *few, "--objective", "steering", "--out", str(run / "attack"))
        once = ["--weathers", "clear-noon", "--runs", "0", "--scenario", "street", *OWN, *SHY]
        told = call(
            "evaluate", str(run / "attack" / "pattern.json"), *once, *there,
            "--recordings", str(run / "recordings"), "--no-film", "--out", str(run / "evaluation"),
        )  # fmt: skip
        assert "paint inject" in told
        assert "of 255 levels off in the paint" in told
        driven = ["--scenario", "street", *OWN, *SHY, "--pattern", "magenta.png", "--out", "driven"]
        assert "painted road (inject)" in call("drive", *driven, *there)
    call("report", str(run))
    assert Evaluation.load(run / "evaluation").paint is PaintKind.INJECT
    assert json.loads((run / "evaluation" / "evaluation.json").read_text())["paint"] == "inject"
    assert json.loads((run / "result.json").read_text())["closed_loop"]["paint"] == "inject"
    assert Episode.load(tmp_path / "driven" / "episode.npz").paint is PaintKind.INJECT
    page = (run / "report.html").read_text()
    assert "(paint: inject)" in page
    assert "--simulator carla://HOST:PORT" in page
    assert "127.0.0.1" not in page
    # What was recorded elsewhere is calibrated there: the command does not go on in the town.
    (run / "recordings").rename(run / "before")
    port = free_port()
    check_nobody(call("calibrate", "runs", "--simulator", f"carla://127.0.0.1:{port}", code=2), port)


@pytest.mark.parametrize("words", [["record", "left-03"], ["drive"], ["demo"], ["evaluate", "magenta.png"]])
def test_every_verb_that_drives_says_in_one_line_that_nobody_answers(call, impatient, words):
    port = free_port()
    check_nobody(call(*words, "--simulator", f"carla://127.0.0.1:{port}", code=2), port)


def test_the_doctor_answers_programs_too(invoke, impatient):
    code, printed = invoke("carla", "doctor", "--port", free_port(), "--json")
    assert (code, printed.err) == (1, "")
    told = answered(printed.out)
    assert (told["passed"], [check["name"] for check in told["checks"]]) == (False, ["connection"])


def test_a_list_that_is_damaged_is_refused_before_a_server_is_asked(call, tmp_path):
    (tmp_path / "own.toml").write_text("[[scenario]")
    said = call("carla", "scenario", "0", "3", "--out", "own.toml", "--port", str(free_port()), code=2)
    assert "own.toml is not valid TOML" in said


@pytest.mark.parametrize("verb", ["drive", "demo"])
def test_an_unknown_way_to_paint_is_refused(call, verb):
    said = call(verb, "--simulator", "carla://127.0.0.1:2000?paint=spray", code=2)
    assert "asks for 'paint=spray', expected nothing or paint= and one of inject, native, auto" in said
    assert said.count("\n") == 1
