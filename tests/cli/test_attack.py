"""`roadproof attack` as its users call it: results, pictures, and one clear line for every mistake."""

import dataclasses
import os
import subprocess
import sys
import textwrap

import numpy as np
import pytest
from PIL import Image, ImageColor
from typer.testing import CliRunner

from command import stored
from roadproof.attacks import METHODS, AttackResult, Published, methods
from roadproof.attacks.gradopt import Rung
from roadproof.cli import app
from roadproof.patterns import load_pattern, raster
from roadproof.recordings import save_recordings
from scenes import recording_set

CONTROLLER = textwrap.dedent(
    """
    import torch

    class Linear(torch.nn.Module):
        input_size = (88, 200)

        def __init__(self):
            super().__init__()
            weight = torch.zeros(3, 88, 200)
            weight[:, :, 100:], weight[:, :, :100] = 1e-3, -1e-3
            self.register_buffer("weight", weight)

        def steer(self, frames, speed_mps, command):
            return (frames * self.weight).sum((1, 2, 3))

        def act(self, frame, speed_mps, command):
            raise NotImplementedError

    def small():
        controller = Linear()
        controller.input_size = (66, 200)
        return controller
    """
)
DRIVES = CONTROLLER.replace("class Linear", "class Drives").replace(
    "raise NotImplementedError",
    "from roadproof.datatypes import Control; return Control(0.0, 0.5, 0.0)",
)


@pytest.fixture(scope="module")
def workplace(tmp_path_factory):
    folder = tmp_path_factory.mktemp("workplace")
    save_recordings(recording_set(frames=3), folder / "set")
    (folder / "own_controller.py").write_text(CONTROLLER)
    return folder


@pytest.fixture
def here(workplace, monkeypatch):
    monkeypatch.chdir(workplace)
    return workplace


def has_colour(picture, name):
    return (picture == ImageColor.getrgb(name)).all(-1).any()


def command(*options, recordings="set", controller="own_controller:Linear"):
    quick = ["--figures", "2", "--iterations", "4", "--restarts", "2", "--random-patterns", "3"]
    return ["attack", str(recordings), "--controller", controller, *quick, *options]


def test_an_attack_leaves_its_pattern_result_and_pictures(here, tmp_path, invoke):
    code, printed = invoke(*command("--quiet", "--out", str(tmp_path / "out")))
    assert code == 0, printed.err
    assert "Strongest for clean+" in printed.out
    assert "on recorded frames" in printed.out
    assert printed.err == ""
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"pattern.json", "pattern.png", "result.json", "search.png", "film-clean.png"} <= names
    assert "search.safetensors" not in names
    result = AttackResult.load(tmp_path / "out")
    assert result.history.shape == (4, 2, 2)
    assert len(load_pattern(tmp_path / "out" / "pattern.json").shapes) == 2
    assert stored(tmp_path / "out" / "result.json")["kind"].startswith("surrogate")
    pictures = {path.stem: np.asarray(Image.open(path).convert("RGB")) for path in (tmp_path / "out").glob("*.png")}
    assert np.array_equal(pictures["pattern"], raster(result.pattern)[..., :3])
    assert has_colour(pictures["search"], "#0b6fa4")
    assert has_colour(pictures["film-clean"], "#c8501e"), "the painted drive's steering"
    frame = recording_set(frames=3).recordings[0].frames[0]
    corner = tuple(frame[0, 0])
    assert (pictures["film-clean"] == corner).all(-1).any(), "what the controller saw"


@pytest.mark.parametrize(
    "options",
    [
        ["--black"],
        ["--family", "free", "--shape", "ellipse"],
        ["--groups", "all"],
        ["--albedo", "0.1", "0.7", "--max-painted-share", "0.2"],
        ["--method", "published", "--family", "published-canvas-centre"],
        ["--method", "published", "--masks", "antialiased", "--black"],
        ["--method", "random", "--calls", "8"],
        ["--method", "published-bo", "--calls", "4"],
    ],
    ids=" ".join,
)
def test_every_kind_of_search_runs(here, tmp_path, options, monkeypatch):
    few = tuple(dataclasses.replace(rung, iterations=2) for rung in Published().ladder)
    monkeypatch.setattr(Published, "ladder", few)
    monkeypatch.setattr(methods, "SHIFT_RUNGS", (Rung(4, 2, every=2),))
    small = " ".join(command("--out", str(tmp_path), *options))
    if "--method" in options:
        small = small.replace("--iterations 4", "")
    if "--calls" in options:
        small = small.replace("--restarts 2", "")
    outcome = CliRunner().invoke(app, small.split())
    assert outcome.exit_code == 0, outcome.output
    searched = METHODS[options[1] if "--method" in options else "gradopt"]
    family = options[options.index("--family") + 1] if "--family" in options else searched.family
    assert AttackResult.load(tmp_path).space.family == family


def damaged(here, tmp_path, change):
    import shutil

    shutil.copytree(here / "set", tmp_path / "set")
    change(tmp_path / "set")
    return str(tmp_path / "set")


def nan_homography(folder):
    stored = dict(np.load(folder / "clean" / "drive.npz"))
    stored["image_from_canvas"] = np.full_like(stored["image_from_canvas"], np.nan)
    np.savez(folder / "clean" / "drive.npz", **stored)


def truncated_png(folder):
    picture = next((folder / "clean" / "frames").iterdir())
    picture.write_bytes(picture.read_bytes()[:80])


MISTAKES = {
    "missing folder": (["--figures", "2"], {"recordings": "nowhere"}, "no folder nowhere"),
    "empty folder": ([], {"recordings": lambda tmp: _empty(tmp)}, "has no recordings.json"),
    "truncated PNG": ([], {"damage": truncated_png}, "cannot be read"),
    "NaN homography": ([], {"damage": nan_homography}, "is NaN or infinite"),
    "no figure": (["--figures", "0"], {}, "--figures is 0, expected 1 to 64"),
    "no iterations": (["--iterations", "0"], {}, "--iterations is 0, expected 1"),
    "no restarts": (["--restarts", "0"], {}, "--restarts is 0, expected 1"),
    "wrong frame size": ([], {"controller": "own_controller:small"}, "takes frames of 200×66"),
    "unknown controller": ([], {"controller": "resnet"}, "no controller called 'resnet'"),
    "missing weights": ([], {"controller": "none.safetensors"}, "none.safetensors"),
    "missing factory": ([], {"controller": "own_controller:nothing"}, "nothing"),
    "unknown device": (["--device", "tpu"], {}, "tpu"),
    "unknown dtype": (["--dtype", "int4"], {}, "int4"),
    "unknown family": (["--family", "publised"], {}, "did you mean published?"),
    "unknown shape": (["--shape", "star"], {}, "expected one of rectangle, ellipse"),
    "unknown group": (["--groups", "clean+up"], {}, "group 'clean+up' is unknown"),
    "published with iterations": (["--method", "published"], {}, "method published has no iterations; it has masks"),
    "a black box with restarts": (["--method", "tpe"], {}, "method tpe has no iterations; it has calls"),
    "an unknown method": (["--method", "magic"], {}, "method is 'magic', expected one of gradopt"),
}


def _empty(tmp_path):
    (tmp_path / "empty").mkdir()
    return tmp_path / "empty"


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_clear_line_and_exit_code_2(here, tmp_path, invoke, name):
    options, kwargs, message = MISTAKES[name]
    kwargs = dict(kwargs)
    if "damage" in kwargs:
        kwargs["recordings"] = damaged(here, tmp_path, kwargs.pop("damage"))
    if callable(kwargs.get("recordings")):
        kwargs["recordings"] = kwargs["recordings"](tmp_path)
    code, printed = invoke(*command("--out", str(tmp_path / "out"), *options, **kwargs))
    assert code == 2
    assert message in printed.err
    assert printed.err.startswith("roadproof: ")
    assert printed.err.count("\n") == 1, "one line"
    assert not (tmp_path / "out" / "result.json").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--objective", "deviation"], "the published search enlarges the steering shift, not the path deviation"),
        (["--robust"], "the published search knows no variation"),
        (["--dtype", "bfloat16"], "the published search computes in float32, not bfloat16"),
        (["--albedo", "0.2", "0.8"], "without limits on paint or albedo"),
        (["--cheapest", "0.5"], "the published search looks for no least paint"),
    ],
    ids=str,
)
def test_a_published_search_with_what_was_not_published_is_refused_in_a_dry_run_too(
    here, tmp_path, invoke, options, message
):
    words = ["attack", "set", "--controller", "own_controller:Linear", "--method", "published"]
    code, printed = invoke(*words, "--out", str(tmp_path / "out"), *options, "--dry-run")
    assert (code, printed.out) == (2, "")
    assert message in printed.err
    assert printed.err.count("\n") == 1


def test_cuda_that_is_absent_is_named(here, tmp_path, invoke, monkeypatch):
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0)
    code, printed = invoke(*command("--out", str(tmp_path), "--device", "cuda"))
    assert code == 2
    assert "device 'cuda' is not there: this torch sees 0 CUDA devices; use cpu" in printed.err


def test_an_output_folder_that_cannot_be_made_is_named_before_the_search(here, tmp_path, invoke):
    (tmp_path / "file").write_text("")
    code, printed = invoke(*command("--out", str(tmp_path / "file" / "out")))
    assert code == 2
    assert "cannot write" in printed.err


def test_a_full_disk_is_named_and_leaves_nothing_half_written(here, tmp_path, invoke, monkeypatch):
    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_text", full)
    code, printed = invoke(*command("--out", str(tmp_path / "out")))
    assert code == 2
    assert "No space left" in printed.err
    assert not list((tmp_path / "out").glob(".result*"))


def test_importing_roadproof_is_quick_and_free_of_heavy_libraries():
    code = "import sys, roadproof; sys.exit(str({'torch', 'numpy', 'matplotlib'} & set(sys.modules) or '') or 0)"
    source = os.pathsep.join(sys.path)
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"PYTHONPATH": source},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr


def test_the_same_search_is_answered_from_its_folder_and_another_is_refused_there(tmp_path, invoke, monkeypatch):
    save_recordings(recording_set(frames=3), tmp_path / "set")
    (tmp_path / "driving_controller.py").write_text(DRIVES)
    monkeypatch.chdir(tmp_path)
    asked = {"controller": "driving_controller:Drives"}
    assert invoke(*command("--out", "out", **asked))[0] == 0
    found = (tmp_path / "out" / "result.json").read_bytes()
    code, printed = invoke(*command("--out", "out", **asked))
    assert code == 0
    assert "Strongest for clean+" in printed.out
    assert (tmp_path / "out" / "result.json").read_bytes() == found, "it took other seconds: it was searched again"
    for another in (["--seed", "1"], ["--iterations", "5"], ["--random-patterns", "4"]):
        code, printed = invoke(*command("--out", "out", *another, **asked))
        assert code == 2
        assert "out holds a search with" in printed.err
        assert "choose another folder, or remove it" in printed.err
        assert (tmp_path / "out" / "result.json").read_bytes() == found


def test_a_search_on_a_controller_that_cannot_drive_is_never_taken_for_a_kept_one(here, tmp_path, invoke):
    assert invoke(*command("--out", str(tmp_path / "out")))[0] == 0
    code, printed = invoke(*command("--out", str(tmp_path / "out")))
    assert code == 2
    assert "holds a search, perhaps of another controller" in printed.err
    assert "choose another folder, or remove it" in printed.err
