from __future__ import annotations

from command import answered, roadproof, stored
from own_drives import write_own
from roadproof.errors import RecordingError
from roadproof.io.pictures import read_picture
from roadproof.recordings import load_recordings


def test_pictures_and_tables_become_recordings(tmp_path, invoke):
    folder, out = write_own(tmp_path / "mine"), tmp_path / "set"
    code, printed = invoke("import", folder, "--out", tmp_path / "told", "--json")
    assert (code, printed.err) == (0, "")
    assert answered(printed.out) == stored(tmp_path / "told" / "recordings.json")
    said = roadproof("import", folder, "--out", out).stdout
    assert "canvas 7.60 m across the road, 9.50 m along it" in said
    assert f"next: roadproof attack {out}" in said
    assert [drive.name for drive in load_recordings(out).recordings] == ["clean", "right", "left"]
    assert read_picture(out / "preview.png", RecordingError, "").shape == (3 * 176, 3 * 400, 3)


def test_what_is_there_already_is_kept_and_nothing_is_read(tmp_path):
    folder, out = tmp_path / "not there", tmp_path / "set"
    out.mkdir()
    (out / "mine.txt").write_text("mine")
    done = roadproof("import", folder, "--out", out)
    assert done.returncode == 2
    assert "exists already" in done.stderr
    assert [path.name for path in out.iterdir()] == ["mine.txt"]
