"""A recorded drive comes back as it was written; anything else is refused in one line."""

import json
import zipfile

import numpy as np
import pytest

from roadproof.errors import TrainingError
from roadproof.training.shards import Shard


def drive(count=5, **changes):
    generator = np.random.default_rng(0)
    values = {
        "frames": generator.integers(0, 256, (count, 8, 12, 3), dtype=np.uint8),
        "speed_mps": generator.uniform(0, 8, count).astype(np.float32),
        "command": np.full(count, 3, np.int8),
        "expert": generator.uniform(-1, 1, (count, 3)).astype(np.float32),
        "lateral_m": np.zeros(count, np.float32),
        "path_m": generator.uniform(-9, 9, (count, 8, 2)).astype(np.float32),
        "about": {"weather": "clear-noon"},
    }
    return Shard(**(values | changes))


def test_a_drive_survives_its_file(tmp_path):
    saved = drive()
    saved.save(tmp_path / "a" / "drive.npz")
    loaded = Shard.load(tmp_path / "a" / "drive.npz")
    for name in ("frames", "speed_mps", "command", "expert", "lateral_m", "path_m"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(saved, name))
        assert getattr(loaded, name).dtype == getattr(saved, name).dtype
    assert loaded.about == saved.about
    assert len(loaded) == 5


def test_the_file_is_compressed_and_holds_no_pickle(tmp_path):
    flat = drive(frames=np.full((5, 80, 120, 3), 7, np.uint8))
    flat.save(tmp_path / "drive.npz")
    assert (tmp_path / "drive.npz").stat().st_size < flat.frames.nbytes / 20
    with np.load(tmp_path / "drive.npz", allow_pickle=False) as stored:
        assert json.loads(str(stored["header"]))["format"] == "roadproof-shard"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"speed_mps": np.zeros(4, np.float32)}, "speed_mps has shape"),
        ({"expert": np.zeros((5, 2), np.float32)}, "expected"),
        ({"expert": np.full((5, 3), np.nan, np.float32)}, "NaN"),
        ({"lateral_m": np.full(5, np.inf, np.float32)}, "infinite"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(changes, message):
    with pytest.raises(TrainingError, match=message):
        drive(**changes)


def test_missing_damaged_and_foreign_files_are_refused(tmp_path):
    with pytest.raises(TrainingError, match="is missing; the same command collects it again"):
        Shard.load(tmp_path / "none.npz")
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(TrainingError, match="damaged"):
        Shard.load(tmp_path / "cut.npz")
    drive().save(tmp_path / "drive.npz")
    with zipfile.ZipFile(tmp_path / "drive.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(tmp_path / "newer.npz", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content.replace(b"\x32\x00\x00\x00\x2c", b"\x33\x00\x00\x00\x2c"))
    with np.load(tmp_path / "newer.npz") as stored:
        assert json.loads(str(stored["header"]))["version"] == 3
    with pytest.raises(TrainingError, match="version 3"):
        Shard.load(tmp_path / "newer.npz")
