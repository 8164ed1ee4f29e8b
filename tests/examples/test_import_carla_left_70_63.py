"""The published CARLA recordings become a set, and the whole attack runs on them with a network others trained."""

import json
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from roadproof.cli import main
from roadproof.recordings import load_recordings

EXAMPLE = Path(__file__).parents[2] / "examples" / "import_carla_left_70_63.py"


@pytest.fixture(scope="module")
def imported(carla_data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("imported") / "set"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(EXAMPLE), str(carla_data), str(folder)])
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    return folder


def test_the_consistent_frames_of_three_drives_are_imported(imported):
    recordings = load_recordings(imported)
    assert {drive.name: len(drive.frames) for drive in recordings.recordings} == {"clean": 23, "right": 17, "left": 20}
    clean = recordings.recordings[0]
    assert clean.speed_mps.min() > 5
    assert set(clean.command) == {2}
    assert clean.frames.std() > 20


def test_the_imported_drives_are_placed_and_hold_what_was_applied(imported):
    recordings = load_recordings(imported)
    assert recordings.canvas.width_m == pytest.approx(7.56, rel=0.02)
    assert recordings.canvas.length_m == pytest.approx(9.53, rel=0.02)
    clean, right, left = (drive.track for drive in recordings.recordings)
    assert {track.dt_s for track in (clean, right, left)} == {0.1}
    assert [len(track) for track in (clean, right, left)] == [23, 17, 20]
    at = 46
    assert right.steer[right.rows(np.array([at]))[0]] == pytest.approx(0.05298, abs=1e-5), "the noise, not the answer"
    assert clean.steer[clean.rows(np.array([at]))[0]] == pytest.approx(-0.05631, abs=1e-5)
    assert left.throttle.min() > 0.4
    assert not clean.brake.any()


def test_real_recordings_and_a_real_network_are_attacked(imported, pilotnet_data, tmp_path, monkeypatch):
    weights = pilotnet_data / "pilotnet.safetensors"
    arguments = ["attack", str(imported), "--controller", f"pilotnet:{weights}", "--out", str(tmp_path)]
    few = [
        "--iterations",
        "12",
        "--restarts",
        "1",
        "--figures",
        "3",
        "--random-patterns",
        "0",
    ]
    monkeypatch.setattr(sys, "argv", ["roadproof", *arguments, *few])
    try:
        main()
    except SystemExit as stopped:
        assert not stopped.code
    result = json.loads((tmp_path / "result.json").read_text())
    # A few steps from one start: each side gains, whether or not it began above nothing.
    begun = [group[0] for group in result["history"][0]]
    assert all(best > first for best, first in zip(result["by_group"].values(), begun, strict=True))
    assert all(check["passed"] for check in result["checks"][:2])
    assert (tmp_path / f"film-{result['group'].split('+')[1]}.png").exists()
