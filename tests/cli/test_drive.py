"""`roadproof drive` as its users call it: film, episode, summary, and one clear line for every mistake."""

import textwrap
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import needs
from command import roadproof
from paint_shy import along_a_street, magenta
from roadproof.driving.episode import Episode
from roadproof.patterns import save_pattern
from roadproof.scenarios import save_scenarios

needs.town()
av = pytest.importorskip("av", reason="films need the extra roadproof[video]")

CONTROLLERS = textwrap.dedent(
    """
    from roadproof.datatypes import Control

    class Left:
        input_size = (88, 200)
        angle = -1.0

        def steer(self, frames, speed_mps, command):
            return frames.new_full((len(frames),), self.angle)

        def act(self, frame, speed_mps, command):
            return Control(self.angle, throttle=1.0)

    class NotANumber(Left):
        angle = float("nan")

    class Small(Left):
        input_size = (66, 200)
    """
)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("workplace")
    (folder / "own_drivers.py").write_text(CONTROLLERS)
    short, longer = along_a_street(folder, 0.4), along_a_street(folder, 2.0)
    save_scenarios([replace(short, name="short"), replace(longer, name="longer")], folder / "own.toml")
    save_pattern(magenta(300.0), folder / "pattern.json")
    Image.new("RGB", (100, 100)).save(folder / "small.png")
    (folder / "text.png").write_text("not a picture")
    (folder / "broken.json").write_text("{")
    return folder


@pytest.fixture
def refused(workplace, tmp_path, invoke, monkeypatch):
    """Calls the command in the workplace for something it refuses; gives what it said."""
    monkeypatch.chdir(workplace)

    def call(*options, out=tmp_path / "out"):
        code, said = invoke("drive", "--out", out, *options)
        assert code == 2
        assert not out.exists() or list(out.iterdir()) == []
        return said.err

    return call


def drive(workplace, *options, before=""):
    return roadproof("drive", "--scenarios", "own.toml", *options, folder=workplace, before=before)


def film_frames(path):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(container.streams.video[0])]


def test_a_drive_leaves_film_episode_and_a_summary(workplace, tmp_path):
    options = ["--cars", "2", "--pedestrians", "3", "--seed", "5", "--weather", "rainy-noon", "--out", str(tmp_path)]
    done = drive(workplace, "--scenario", "short", "--quiet", *options)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "short, rainy-noon, bare road, 2 cars, 3 pedestrians: time limit after 0.4 s, no events" in done.stdout
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drive.mp4", "episode.npz"]
    episode = Episode.load(tmp_path / "episode.npz")
    assert (episode.cars, episode.pedestrians, episode.seed, episode.weather) == (2, 3, 5, "rainy-noon")
    frames = film_frames(tmp_path / "drive.mp4")
    assert len(frames) == len(episode) == 9
    assert frames[-1].shape == (720, 1280, 3)
    assert np.std(frames[-1][:600, :800]) > 20


def test_a_controller_of_ones_own_drives_over_the_paint_and_its_events_are_told(workplace, tmp_path):
    own = ["--controller", "own_drivers:Left", "--pattern", "pattern.json", "--out", str(tmp_path)]
    done = drive(workplace, "--scenario", "longer", *own)
    assert done.returncode == 0, done.stderr
    assert "painted road" in done.stdout
    episode = Episode.load(tmp_path / "episode.npz")
    assert episode.painted
    assert set(episode.steer) == {-1.0}
    assert episode.events
    for event in episode.events:
        assert f"{event.time_s:5.1f} s  {event.kind}" in done.stdout
    red, green, blue = film_frames(tmp_path / "drive.mp4")[4][:600, :800].astype(int).transpose(2, 0, 1)
    assert ((red - green > 60) & (blue - green > 60)).sum() > 20, "magenta paint is seen"


MISTAKES = {
    "unknown scenario": (["--scenario", "left-3"], "no scenario is called 'left-3'; did you mean 'left-03'?"),
    "unknown weather": (["--weather", "rainy-non"], "did you mean rainy-noon?"),
    "unknown driver": (["--controller", "exprt"], "--controller is 'exprt', expected expert or a controller"),
    "missing weights": (["--controller", "none.safetensors"], "none.safetensors does not exist"),
    "missing list": (["--scenarios", "none.toml"], "cannot read none.toml"),
    "missing pattern": (["--pattern", "none.json"], "cannot read none.json"),
    "missing picture": (["--pattern", "none.png"], "none.png is missing; give a pattern"),
    "broken pattern": (["--pattern", "broken.json"], "broken.json is not valid JSON"),
    "no picture": (["--pattern", "text.png"], "text.png cannot be read"),
    "small picture": (["--pattern", "small.png"], "small.png has 100×100 pixels, expected the canvas' 400×400"),
    "wrong frame size": (["--controller", "own_drivers:Small"], "takes frames of 200×66, the simulator gives 200×88"),
    "unknown device": (["--controller", "own_drivers:Left", "--device", "tpu"], "tpu"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_clear_line_and_leaves_nothing(refused, name):
    options, message = MISTAKES[name]
    said = refused(*options)
    assert message in said
    assert said.startswith("roadproof: ")
    assert said.count("\n") == 1, "one line"


def test_an_output_folder_that_cannot_be_made_is_named(refused, tmp_path):
    (tmp_path / "file").write_text("")
    assert "cannot write" in refused(out=tmp_path / "file" / "out")


def test_a_missing_libx11_is_named(refused, monkeypatch):
    from roadproof.simulators.town import engine

    class NoPipes:
        get_global_ptr = make_pipe = staticmethod(lambda *_: NoPipes if not _ else None)

    monkeypatch.setattr(engine, "_pipes", {})
    monkeypatch.setattr(engine.core, "GraphicsPipeSelection", NoPipes)
    assert "apt-get install libx11-6" in refused()


BROKEN = {
    # None in sys.modules is how Python itself marks a module that cannot be imported.
    "no PyAV": ("import sys; sys.modules['av'] = None", "expert", "pip install 'roadproof[video]'"),
    "no Panda3D": ("import sys; sys.modules['panda3d.core'] = None", "expert", "pip install 'roadproof[town]'"),
    "NaN control": ("", "own_drivers:NotANumber", "control steer is nan, expected a finite number"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_one_clear_line_and_leaves_nothing(workplace, tmp_path, name):
    before, driver, message = BROKEN[name]
    done = drive(workplace, "--scenario", "short", "--controller", driver, "--out", str(tmp_path), before=before)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
