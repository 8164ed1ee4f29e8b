"""`roadproof evaluate` and `roadproof report` as their users call them."""

import pytest
from PIL import Image

import needs
from command import answered, roadproof, stored
from paint_shy import along_a_street, magenta
from roadproof.driving.evaluation import Evaluation
from roadproof.patterns import save_pattern
from roadproof.pipeline.fidelity import Fidelity
from roadproof.scenarios import save_scenarios

needs.town()
av = pytest.importorskip("av", reason="films need the extra roadproof[video]")

ONE_DRIVE = ["--weathers", "clear-noon", "--starts", "0", "--runs", "0", "--controller", "paint_shy:paint_shy"]


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("workplace")
    save_scenarios([along_a_street(folder, 1.5)], folder / "own.toml")
    save_pattern(magenta(300.0), folder / "pattern.json")
    Image.new("RGBA", (400, 400), (255, 0, 255, 255)).save(folder / "magenta.png")
    return folder


def test_a_pattern_is_driven_over_filmed_judged_and_reported(workplace, tmp_path, invoke):
    run = tmp_path / "run"
    options = [
        "--scenarios",
        "own.toml",
        "--scenario",
        "street",
        "--quiet",
        *ONE_DRIVE,
        "--out",
        str(run / "evaluation"),
    ]
    done = roadproof("evaluate", "pattern.json", *options, folder=workplace)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    evaluation = Evaluation.load(run / "evaluation")
    (trial,) = evaluation.trials
    assert trial.lateral_m < -0.05
    assert f"{trial.deviation_m:.2f}" in done.stdout
    assert "2 drives" in done.stdout
    with av.open(str(run / "evaluation" / "film.mp4")) as film:
        frames = sum(1 for _ in film.decode(video=0))
    assert frames == 16, "one for every second of 31 observations"

    said = roadproof("report", run)
    assert said.returncode == 0, said.stderr
    code, printed = invoke("report", run, "--json")
    assert (code, printed.err) == (0, "")
    assert answered(printed.out) == stored(run / "result.json")
    assert "paint_shy:paint_shy" in said.stdout
    page = (run / "report.html").read_text()
    assert "data:video/mp4;base64," in page
    assert f"{abs(trial.lateral_m):.2f} m to the right" in page

    again = roadproof("evaluate", "pattern.json", *options, "--no-film", "--json", folder=workplace)
    assert (again.returncode, again.stderr) == (0, "")
    assert answered(again.stdout) == stored(run / "evaluation" / "evaluation.json")
    assert Evaluation.load(run / "evaluation").trials == evaluation.trials
    assert (run / "evaluation" / "film.mp4").exists()
    (run / "evaluation" / "fidelity.npz").touch()
    Image.new("RGBA", (400, 400)).save(workplace / "nothing.png")
    refused = roadproof("evaluate", "nothing.png", *options, "--no-film", folder=workplace)
    assert (refused.returncode, "paints nothing" in refused.stderr) == (2, True)
    assert (run / "evaluation" / "film.mp4").exists()
    other = roadproof("evaluate", "magenta.png", *options, "--no-film", folder=workplace)
    assert (other.returncode, other.stderr) == (0, "")
    shown = {path.name for path in (run / "evaluation").iterdir()}
    assert not shown & {"film.mp4", "film.jpg", "strip.npz", "fidelity.npz"}, "of the paint before"


@pytest.mark.slow
def test_composites_are_compared_with_renders_in_the_light_that_they_were_recorded_in(workplace, tmp_path):
    own = ["--scenarios", "own.toml", "--controller", "paint_shy:paint_shy"]
    recorded = ["street", "--weather", "clear-sunset", "--trajectories", "1", "--frames", "4", "--out", str(tmp_path)]
    for words in (["record", *recorded, *own], ["calibrate", str(tmp_path), "--method", "pose"]):
        done = roadproof(*words, folder=workplace)
        assert done.returncode == 0, done.stderr
    place, there = tmp_path / "evaluation", ["--scenario", "street", "--scenarios", "own.toml", "--no-film"]
    compared = ["--recordings", str(tmp_path / "street" / "recordings"), "--out", str(place)]
    done = roadproof("evaluate", "pattern.json", *there, *ONE_DRIVE, *compared, folder=workplace)
    assert done.returncode == 0, done.stderr
    blind = ["--controller", "expert", *there, *ONE_DRIVE[:-2], *compared]
    done = roadproof("evaluate", "pattern.json", *blind, folder=workplace)
    assert (done.returncode, "expert looks at none; leave it out" in done.stderr) == (2, True)
    # At noon, in which this evaluation drives, the paint is some 60 levels brighter.
    assert Fidelity.load(place / "fidelity.npz").agreement.paint_error < 5.0


MISTAKES = {
    "unknown weather": (["pattern.json", "--weathers", "clear-noon,rainy-non"], "did you mean rainy-noon?"),
    "unknown scenario": (["pattern.json", "--scenario", "left-3"], "did you mean 'left-03'?"),
    "missing pattern": (["none.json"], "cannot read none.json"),
    "picture with random": (["magenta.png", "--random", "2"], "magenta.png is a picture"),
    "missing recordings": (["pattern.json", "--recordings", "nowhere"], "no folder nowhere"),
    "runs without traffic": (["pattern.json", "--runs", "2", "--cars", "0", "--pedestrians", "0"], "ask for some"),
    "one server for two": (
        ["pattern.json", "--processes", "2", "--simulator", "carla://localhost:2000"],
        "would step the one server",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_clear_line(workplace, tmp_path, invoke, monkeypatch, name):
    options, message = MISTAKES[name]
    monkeypatch.chdir(workplace)
    given = ["--controller", "expert", *options, "--out", str(tmp_path)]
    code, printed = invoke("evaluate", *given)
    assert code == 2
    said = printed.err
    assert message in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_empty_run_is_refused_in_one_line(tmp_path, invoke):
    code, said = invoke("report", tmp_path)
    assert code == 2
    assert "nothing to report yet" in said.err
